"""``valveflow validate``: does a characteristic hold on other days."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from valveflow_ros.cli.console import Console, Outcome
from valveflow_ros.cli.options import MAPPING_HELP, add_mapping, add_parameters, read_mapping
from valveflow_ros.cli.report_files import add_report_files, check_report_files, with_report
from valveflow_ros.report.terminal.text import number

_DESCRIPTION = """\
Hold a characteristic against a log it was not made from: in each steady-state and
slope-response segment of the log, how far is the measured power from the predicted one?
Says whether the curve holds, is off (and on which piece), or cannot be told. DIR gets
report.html for people, validation.json and segments.csv for programs.

example:
  valveflow validate other.mcap --model result/characteristic.json -o checked"""


def arguments(parser: ArgumentParser) -> None:
    """Add description, example and options."""
    parser.description = _DESCRIPTION
    parser.usage = 'valveflow validate LOG --model FILE -o DIR [options]'
    parser.epilog = MAPPING_HELP
    parser.add_argument('log', metavar='LOG', type=Path, help='the log to judge by')
    parser.add_argument(
        '--model', metavar='FILE', type=Path, required=True,
        help='a characteristic.json of identify, or an extended_model.json of diagnose',
    )  # fmt: skip
    parser.add_argument(
        '-o', '--output', metavar='DIR', type=Path, required=True,
        help='folder for the results, made if absent; the report of another verb there is kept',
    )  # fmt: skip
    parser.add_argument(
        '--against', metavar='FILE', type=Path,
        help='a second characteristic.json, to see which of the two is better',
    )  # fmt: skip
    parser.add_argument(
        '--tolerance', metavar='MW',
        type=number('a power in MW', 0, 10_000, '--tolerance 2', above=True),
        help='a mean difference that does not matter (default: the parameter alarm_floor, 1 MW)',
    )  # fmt: skip
    add_parameters(parser)
    add_report_files(parser)
    add_mapping(parser)


def run(options: Namespace, console: Console) -> Outcome:
    """Read, find segments, judge, write."""
    mapping = read_mapping(options.column, options.constant)
    console.progress(0.0, 'starting')
    from valveflow_ros.cli.files import check_folder
    from valveflow_ros.cli.model_file import check_exponent, read_either, read_model
    from valveflow_ros.cli.options import read_parameters
    from valveflow_ros.cli.validating import outcome, refuse_two, texts, validated
    from valveflow_ros.report.validation import validation_page

    given = read_parameters(options.params, options.pairs)
    check_folder(options.output)
    check_report_files(options)
    model = read_either(options.model)
    against = None if options.against is None else read_model(options.against)
    refuse_two(model, against)
    check_exponent(model, options.model, given)
    data = validated(options, model, against, mapping, given, console)
    console.progress(0.9, 'writing the report')
    content, files = texts(data)
    return with_report(
        options, files, validation_page(data), lambda written: outcome(data, content, written)
    )
