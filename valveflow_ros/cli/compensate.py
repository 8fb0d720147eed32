"""``valveflow compensate``: the inverse curve as a table for the turbine controller."""

from __future__ import annotations

import math
from argparse import ArgumentParser, Namespace
from pathlib import Path

from valveflow_ros.cli.console import Console, Outcome
from valveflow_ros.report.terminal.text import number, whole

_DESCRIPTION = """\
Write the inverse of a flow characteristic as a table: the integrated input u that gives a
demanded power, and at stated pressures the opening. Put before the valve, it makes the unit
answer alike at every load. The knees of the curve are points of the table, so that linear
interpolation is exact; what the table is good for, and where not, is said.

example:
  valveflow compensate --model result/characteristic.json -o table.csv --pressure 16.7"""


def arguments(parser: ArgumentParser) -> None:
    """Add description, example and options."""
    parser.description = _DESCRIPTION
    parser.usage = 'valveflow compensate --model FILE -o TABLE [options]'
    parser.add_argument(
        '--model', metavar='FILE', type=Path, required=True,
        help='a characteristic.json, as identify writes it',
    )  # fmt: skip
    parser.add_argument(
        '-o', '--output', metavar='TABLE', type=Path, required=True, help='a .csv or .parquet file'
    )
    parser.add_argument(
        '--points', metavar='N', default=16,
        type=whole('a number of points', 2, 10_000, '--points 16'),
        help='length of the table (default: 16)',
    )  # fmt: skip
    parser.add_argument(
        '--pressure', metavar='MPA', action='append', default=[],
        type=number('a pressure in MPa', 0.05, 40, '--pressure 16.7'),
        help='add a column with the opening at this main steam pressure; may be repeated',
    )  # fmt: skip
    parser.add_argument(
        '--max-gain', metavar='G',
        type=number('units of u per MW', 0, 1e9, '--max-gain 50', above=True),
        help='units of u per MW beyond which the table is of no use (default: 5 times the '
        'least of the curve)',
    )  # fmt: skip
    parser.add_argument(
        '--tolerance', metavar='MW', default=0.01,
        type=number('a power in MW', 0, 1e9, '--tolerance 0.01', above=True),
        help='largest error allowed of F(F^-1(x)) and of the table; beyond it nothing is written '
        '(default: 0.01)',
    )  # fmt: skip
    for way, which, example in (('from', 'smaller', 1100), ('to', 'larger', 2200)):
        parser.add_argument(
            f'--u-{way}', metavar='U', help=f'leave {which} values of u out of the table',
            type=number('a number, a value of u', -math.inf, math.inf, f'--u-{way} {example}'),
        )  # fmt: skip
    parser.add_argument('--overwrite', action='store_true', help='replace a table that is there')


def run(options: Namespace, console: Console) -> Outcome:
    """Read, invert, check, write."""
    from valveflow_ros.cli.compensation_check import check
    from valveflow_ros.cli.compensation_table import columns_of, outcome, write
    from valveflow_ros.cli.files import check_output
    from valveflow_ros.cli.model_file import read_model
    from valveflow_ros.cli.outputs import TABLES
    from valveflow_ros.curve.compensation import Compensation, compensate

    check_output(options.output, TABLES, source=options.model, overwrite=options.overwrite)
    curve = read_model(options.model)

    def make(points: int) -> Compensation:
        return compensate(
            curve, points, options.max_gain,
            -math.inf if options.u_from is None else options.u_from,
            math.inf if options.u_to is None else options.u_to,
        )  # fmt: skip

    made = make(options.points)
    check(made, options.tolerance, make)
    pressures = sorted(set(options.pressure))
    for sentence in made.notes[1:]:
        console.warn(sentence)
    write(columns_of(made, pressures), options.output)
    return outcome(made, pressures, options.tolerance, options.output)
