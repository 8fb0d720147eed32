# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow export``: convert a log to a table."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from valveflow_ros.cli.command import (
    Console,
    VerbResult,
    add_mapping,
    add_output,
    add_set,
    mapping_of,
    rejected_words,
)

USAGE = 'LOG -o TABLE [options]'
DESCRIPTION = """\
Write a log as a table with one row for each time: the rows that are used for fitting, in their
units. Where a signal has no usable value the cell is empty.

With --outputs write instead what a monitor published in its recording, one table for each kind:
curves, predictions, alarms, diagnoses and health become said_curves.csv, said_predictions.csv,
...

example:
  valveflow export plant.mcap -o plant.csv
  valveflow export recordings/U1 -o said.parquet --outputs"""


def arguments(parser: ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument('log', metavar='LOG', type=Path, help='the log to read')
    add_output(parser, 'TABLE', 'a .csv or .parquet file')
    parser.add_argument(
        '--outputs', action='store_true',
        help='what the monitor published: TABLE names the tables, which get a kind behind '
        'their name',
    )  # fmt: skip
    add_mapping(parser)
    add_set(parser, 'a parameter, such as sample_period=10')
    parser.add_argument('--overwrite', action='store_true', help='replace a table that is there')


def run(options: Namespace, console: Console) -> VerbResult:
    """Align the log and write the table."""
    mapping = mapping_of(options)
    if options.outputs:
        return _outputs(options, console)
    from valveflow_ros.errors import DataError
    from valveflow_ros.interface.files import TABLES, check_output, write_log
    from valveflow_ros.interface.logs import open_log
    from valveflow_ros.interface.settings import read_parameters, settings_for
    from valveflow_ros.report.words import counted, duration, moment
    from valveflow_ros.signals.align import align_whole

    given = read_parameters(None, options.pairs)
    check_output(options.output, TABLES, source=options.log, overwrite=options.overwrite)
    console(0.1, 'reading')
    log = open_log(options.log, mapping, progress=console)
    given, told = log.parameters(given)
    settings, notes = settings_for(log.steps(), 0.0, given)
    for sentence in [*told, *notes]:
        console.say(sentence)
    table, resets, counts = align_whole(log.readings, settings, console)
    if not len(table):
        raise DataError('The log holds no usable reading, so there is no row to write.')
    if len(resets):
        raise DataError(
            'The clock goes back within the log, and a table must go forward in time; '
            'split the log there first.'
        )
    console(0.7, 'writing')
    write_log(table, options.output, options.overwrite)
    first, last = int(table.time_ns[0]), int(table.time_ns[-1])
    step = duration(settings.real('sample_period'))
    text = (
        f'Wrote {counted(len(table), "row")}, one every {step}, {moment(first)} to '
        f'{moment(last)}, to {options.output}.\n{rejected_words(counts)}'
    )
    if log.output_unit != 'MW':
        # The specified columns have fixed units.
        told_by = f'--column generated_power=generated_power_mw:{log.output_unit}'
        text += f'\nThe table does not say that its flow is in {log.output_unit}: add {told_by}.'
    data = {
        'table': str(options.output),
        'rows': len(table),
        'sample_period_s': settings.real('sample_period'),
        'start_ns': first,
        'end_ns': last,
        'readings': counts,
    }
    return VerbResult(text, data)


def _outputs(options: Namespace, console: Console) -> VerbResult:
    """Write the messages of the monitor."""
    from valveflow_ros.interface.files import TABLES, check_output, write_outputs
    from valveflow_ros.logs import open_log
    from valveflow_ros.report.words import counted

    check_output(options.output, TABLES, source=options.log, overwrite=True)
    console(0.1, 'reading')
    found = write_outputs(open_log(options.log), options.output, options.overwrite)
    text = '\n'.join(f'Wrote {counted(n, "row")} to {path}.' for path, n in found.items())
    return VerbResult(text, {'tables': {str(path): n for path, n in found.items()}})
