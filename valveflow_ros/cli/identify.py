"""``valveflow identify``: the flow characteristic of a log."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from valveflow_ros.cli.console import Console, Outcome
from valveflow_ros.cli.options import MAPPING_HELP, add_mapping, add_parameters, read_mapping
from valveflow_ros.cli.report_files import (
    add_report_files,
    check_report_files,
    with_report,
)
from valveflow_ros.cli.usage import UsageError

if TYPE_CHECKING:
    from valveflow_ros.report.identified import Identified

_DESCRIPTION = """\
Find the flow characteristic of the valve in a log of ordinary operation: the moments in
which the unit rests or moves along a ramp are searched out, and the best curve of straight
pieces is put through them. DIR gets report.html for people and characteristic.json for
programs. The step of the data is found by itself.

example:
  valveflow identify plant.mcap -o result

and for a table with names of your own:
  valveflow identify history.csv -o result --column valve_opening=CV_POS
      --column main_steam_pressure=PT_100:bar --column generated_power=MW_GROSS
      --constant main_steam_temperature=540

with the causes that diagnose found in an earlier log held:
  valveflow identify plant.mcap -o result --model earlier/extended_model.json"""


def arguments(parser: ArgumentParser) -> None:
    """Add description, example and options."""
    parser.description = _DESCRIPTION
    parser.usage = 'valveflow identify LOG -o DIR [options]'
    parser.epilog = MAPPING_HELP
    parser.add_argument('log', metavar='LOG', type=Path, help='the log to read')
    parser.add_argument(
        '-o', '--output', metavar='DIR', type=Path, required=True,
        help='folder for the results, made if absent; the report of another verb there is kept',
    )  # fmt: skip
    add_parameters(parser)
    parser.add_argument(
        '--model', metavar='FILE', type=Path,
        help='an extended_model.json of diagnose: its causes are held, curve and dynamics found '
        'anew',
    )  # fmt: skip
    parser.add_argument(
        '--reference', metavar='FILE', type=Path,
        help='a characteristic.json to judge the curve against: DIR gets shift.json',
    )  # fmt: skip
    parser.add_argument(
        '--step-test', action='store_true',
        help='the log is a manual test: pressure constant, the opening in steps, each held',
    )  # fmt: skip
    add_report_files(parser)
    add_mapping(parser)


def run(options: Namespace, console: Console) -> Outcome:
    """Read, watch, fit, write."""
    mapping = read_mapping(options.column, options.constant)
    console.progress(0.0, 'starting')
    from valveflow_ros.cli.files import check_folder
    from valveflow_ros.cli.identification import found_in, judged, outcome, texts
    from valveflow_ros.cli.log_input import open_input
    from valveflow_ros.cli.model_file import check_exponent, read_extended, read_model
    from valveflow_ros.cli.options import read_parameters
    from valveflow_ros.report.identification import identification_page

    given = read_parameters(options.params, options.pairs)
    check_folder(options.output)
    check_report_files(options)
    reference = read_model(options.reference) if options.reference else None
    extended = None
    # A file of the node's parameters may name a model too.
    if named := options.model or given.get('model_file'):
        path = Path(str(named)).expanduser()
        if options.step_test:
            raise UsageError('--step-test and --model do not go together.')
        extended = read_extended(path)
        check_exponent(extended, path, given)
        given = {**given, 'pressure_exponent': extended.pressure_exponent}
    console.progress(0.02, 'reading')
    log = open_input(options.log, mapping, console)
    found: Identified = found_in(log, given, options.log, console, options.step_test, extended)
    if reference is not None:
        found = judged(found, reference)
    console.progress(0.9, 'writing the report')
    page = identification_page(found)
    files = texts(found, extended)
    return with_report(options, files, page, lambda written: outcome(found, written, log))
