# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What stands in a log that a verb has written, and tables with one column changed."""

from valveflow_ros.logs import open_log


def values(path, signal):
    readings = open_log(path).readings
    return readings.value[readings.signal == signal]


def rewritten(source, target, column, change, name=None):
    """Copy a table as CSV; ``change(k, cell)`` makes the cells of one column, named anew."""
    table = [line.split(',') for line in source.read_text().splitlines()]
    place = table[0].index(column)
    table[0][place] = name or column
    for k, row in enumerate(table[1:]):
        row[place] = change(k, row[place])
    target.write_text(''.join(','.join(row) + '\n' for row in table))
    return target
