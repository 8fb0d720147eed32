# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow compare``: compare the proposed method with two from the literature."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from valveflow_ros.cli import command

USAGE = 'LOG -o DIR [options]'
DESCRIPTION = """\
Identify the flow characteristic in three ways - from special segments, as a Hammerstein model
and by sparse identification - and judge all three on data that none of them was fitted to, as
Section IV of the paper does: parameters, mean squared errors in special segments, paired t
tests. DIR gets report.html for people, comparison.json and three tables for programs. Without
--test the last third of the log is used for testing only.

example:
  valveflow compare plant.mcap -o result --test other_days.mcap

with a simulated plant, whose true curve is known:
  valveflow simulate -o days.mcap --seed 1 --truth truth.json
  valveflow simulate -o other.mcap --seed 2
  valveflow compare days.mcap -o result --test other.mcap --truth truth.json"""


def arguments(parser: ArgumentParser) -> None:
    """Add the options."""
    command.add_analysis(parser, 'the log to learn from')
    parser.add_argument(
        '--test', metavar='LOG2', type=Path, help='a log of other days, for testing only'
    )
    command.add_file(
        parser,
        '--truth',
        'the true curve, as "simulate --truth" writes it; a characteristic.json too',
    )
    command.add_analysis_options(parser)


def run(options: Namespace, console: command.Console) -> command.VerbResult:
    """Open the log, identify in three ways, judge, write."""
    log = command.log_of(options, console)
    from valveflow_ros.interface.compare import compare
    from valveflow_ros.interface.logs import open_log
    from valveflow_ros.report.comparison import data_words, finding_words
    from valveflow_ros.report.comparison_tables import parameters_cells, totals_cells

    def other_days() -> object:
        return open_log(options.test, command.mapping_of(options), progress=console)

    found = compare(
        log, test=None if options.test is None else other_days, truth=options.truth,
        parameters=command.checked_parameters(options), progress=console,
    )  # fmt: skip
    console(0.95, 'writing the report')
    data = found.data
    head, rows = totals_cells(data)
    text = command.lines(
        data_words(data), *finding_words(data), command.table(*parameters_cells(data)),
        command.table(head[:5], [row[:5] for row in rows]),
    )  # fmt: skip
    # The segments are only written to the file.
    brief = {k: v for k, v in found.to_json().items() if k != 'segments'}
    return command.write_results(found, options, text, brief)
