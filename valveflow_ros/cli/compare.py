"""``valveflow compare``: the proposed method beside the two of the literature."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from valveflow_ros.cli.console import Console, Outcome
from valveflow_ros.cli.options import MAPPING_HELP, add_mapping, add_parameters, read_mapping
from valveflow_ros.cli.report_files import add_report_files, check_report_files, with_report

_DESCRIPTION = """\
Identify the flow characteristic in three ways - from special segments, as a Hammerstein model
and by sparse identification - and judge all of them on data none has seen, as Section IV of
the paper does: parameters, mean squared errors in special segments, paired t tests. DIR gets
report.html for people, comparison.json and three tables for programs. Without --test
the last third of the log is held back to judge by.

example:
  valveflow compare plant.mcap -o result --test other_days.mcap

with a simulated plant, whose true curve is known:
  valveflow simulate -o days.mcap --seed 1 --truth truth.json
  valveflow simulate -o other.mcap --seed 2
  valveflow compare days.mcap -o result --test other.mcap --truth truth.json"""


def arguments(parser: ArgumentParser) -> None:
    """Add description, example and options."""
    parser.description = _DESCRIPTION
    parser.usage = 'valveflow compare LOG -o DIR [options]'
    parser.epilog = MAPPING_HELP
    parser.add_argument('log', metavar='LOG', type=Path, help='the log to learn from')
    parser.add_argument(
        '-o', '--output', metavar='DIR', type=Path, required=True,
        help='folder for the results, made if absent; the report of another verb there is kept',
    )  # fmt: skip
    parser.add_argument(
        '--test', metavar='LOG2', type=Path, help='a log of other days to judge by'
    )
    parser.add_argument(
        '--truth', metavar='FILE', type=Path,
        help='the true curve, as "simulate --truth" writes it; a characteristic.json too',
    )  # fmt: skip
    add_parameters(parser)
    add_report_files(parser)
    add_mapping(parser)


def run(options: Namespace, console: Console) -> Outcome:
    """Read, identify in three ways, judge, write."""
    mapping = read_mapping(options.column, options.constant)
    console.progress(0.0, 'starting')
    from valveflow_ros.cli.comparing import compared, outcome, texts
    from valveflow_ros.cli.files import check_folder
    from valveflow_ros.cli.options import read_parameters
    from valveflow_ros.cli.truth_file import read_truth_file
    from valveflow_ros.report.comparison import comparison_page

    given = read_parameters(options.params, options.pairs)
    check_folder(options.output)
    check_report_files(options)
    truth = None if options.truth is None else read_truth_file(options.truth)
    data = compared(options.log, options.test, truth, mapping, given, console)
    console.progress(0.95, 'writing the report')
    content, files = texts(data)
    return with_report(
        options, files, comparison_page(data), lambda written: outcome(data, content, written)
    )
