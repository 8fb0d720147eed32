"""``valveflow diagnose``: what the simulation gets wrong, the cause, the gain."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from valveflow_ros.cli.console import Console, Outcome
from valveflow_ros.cli.options import MAPPING_HELP, add_mapping, add_parameters, read_mapping
from valveflow_ros.cli.report_files import (
    add_report_files,
    check_report_files,
    with_report,
)

_DESCRIPTION = """\
Compare the simulation (flow characteristic and regional dynamics, run on the measured opening
and pressure) with the measured power, name the physical cause of what differs, extend the model
by it, and measure the gain on blocks of time that nothing was fitted to. DIR gets
diagnosis.json, extended_model.json and report.html.

example:
  valveflow diagnose plant.mcap -o result

against the curve of an earlier record:
  valveflow diagnose plant.mcap -o result --model last_year/characteristic.json"""


def arguments(parser: ArgumentParser) -> None:
    """Add description, example and options."""
    parser.description = _DESCRIPTION
    parser.usage = 'valveflow diagnose LOG -o DIR [options]'
    parser.epilog = MAPPING_HELP
    parser.add_argument('log', metavar='LOG', type=Path, help='the log to read')
    parser.add_argument(
        '-o', '--output', metavar='DIR', type=Path, required=True,
        help='folder for the results, made if absent; the report of another verb there is kept',
    )  # fmt: skip
    parser.add_argument(
        '--model', metavar='FILE', type=Path,
        help='characteristic.json or extended_model.json of an earlier log, to be held against '
        'this one; found anew without it',
    )  # fmt: skip
    add_parameters(parser)
    add_report_files(parser)
    add_mapping(parser)


def run(options: Namespace, console: Console) -> Outcome:
    """Read, simulate, search, write."""
    mapping = read_mapping(options.column, options.constant)
    console.progress(0.0, 'starting')
    from valveflow_ros.cli.diagnosing import diagnosed_in, outcome, read_model, texts
    from valveflow_ros.cli.files import check_folder
    from valveflow_ros.cli.log_input import open_input
    from valveflow_ros.cli.model_file import check_exponent
    from valveflow_ros.cli.options import read_parameters
    from valveflow_ros.report.diagnosis import diagnosis_page

    given = read_parameters(options.params, options.pairs)
    model = read_model(options.model) if options.model else None
    if model is not None:
        check_exponent(model, options.model, given)
        given = {**given, 'pressure_exponent': model.pressure_exponent}
    check_folder(options.output)
    check_report_files(options)
    console.progress(0.02, 'reading')
    log = open_input(options.log, mapping, console)
    found = diagnosed_in(log, model, given, options.log, console)
    console.progress(0.95, 'writing the report')
    page = diagnosis_page(found.page)
    return with_report(options, texts(found), page, lambda written: outcome(found, written))
