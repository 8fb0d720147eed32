# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow validate``: check whether a characteristic is valid on other days."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from valveflow_ros.cli import command
from valveflow_ros.report.terminal.text import number

USAGE = 'LOG --model FILE -o DIR [options]'
DESCRIPTION = """\
Compare a characteristic with a log it was not made from: in each steady-state and
slope-response segment of the log, how far is the measured power from the predicted one?
Says whether the curve is still right, is wrong (and on which piece), or cannot be judged. DIR gets
report.html for people, validation.json and segments.csv for programs.

example:
  valveflow validate other.mcap --model result/characteristic.json -o checked"""


def arguments(parser: ArgumentParser) -> None:
    """Add the options."""
    command.add_analysis(parser, 'the log to compare with')
    command.add_file(
        parser,
        '--model',
        'a characteristic.json of identify, or an extended_model.json of diagnose',
        required=True,
    )
    command.add_file(
        parser, '--against', 'a second characteristic.json, to see which of the two is better'
    )
    parser.add_argument(
        '--tolerance', metavar='MW',
        type=number('a power in MW', 0, 10_000, '--tolerance 2', above=True),
        help='a mean difference that does not matter (default: the parameter alarm_floor, 1 MW)',
    )  # fmt: skip
    command.add_analysis_options(parser)


def run(options: Namespace, console: command.Console) -> command.VerbResult:
    """Open the log, find segments, judge, write."""
    log = command.log_of(options, console)
    from valveflow_ros.interface.compare import validate
    from valveflow_ros.report.validation import pieces_cells, totals_cells, verdict_words

    found = validate(
        log, options.model, against=options.against, tolerance_mw=options.tolerance,
        parameters=command.checked_parameters(options), progress=console,
    )  # fmt: skip
    console(0.9, 'writing the report')
    data = found.data
    text = command.lines(
        f'{data.model}, compared with {data.source}:', *verdict_words(data), data.held,
        command.table(*pieces_cells(data.result)), command.table(*totals_cells(data.result)),
    )  # fmt: skip
    # The segments are only written to the file.
    brief = {k: v for k, v in found.to_json().items() if k != 'segments'}
    return command.write_results(found, options, text, brief)
