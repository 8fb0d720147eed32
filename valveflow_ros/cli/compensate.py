"""``valveflow compensate``: the inverse curve as a table for the turbine controller."""

from __future__ import annotations

from argparse import ArgumentParser, ArgumentTypeError, Namespace
from pathlib import Path

from valveflow_ros.cli.console import Console, Outcome

_DESCRIPTION = """\
Write the inverse of a flow characteristic as a table: the integrated input u that gives a
demanded power, and at stated pressures the opening. Put before the valve, it makes the unit
answer alike at every load. The knees of the curve are points of the table, so that linear
interpolation is exact; what the table is good for, and where not, is said.

example:
  valveflow compensate --model result/characteristic.json -o table.csv --pressure 16.7"""


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ArgumentTypeError(f"must be a number, not '{text}'") from None


def _pressure(text: str) -> float:
    value = _number(text)
    if not 0.05 <= value <= 40.0:
        raise ArgumentTypeError(f'must be from 0.05 to 40 MPa, not {text}')
    return value


def _points(text: str) -> int:
    value = int(text) if text.strip().isdigit() else 0
    if not 2 <= value <= 10_000:
        raise ArgumentTypeError(f'must be from 2 to 10000, not {text}')
    return value


def _positive(text: str) -> float:
    value = _number(text)
    if not 0.0 < value <= 1e9:
        raise ArgumentTypeError(f'must be above 0, not {text}')
    return value


def _finite(text: str) -> float:
    value = _number(text)
    if not -1e9 <= value <= 1e9:
        raise ArgumentTypeError(f'must be a number, not {text}')
    return value


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
        '--points', metavar='N', type=_points, default=16,
        help='length of the table (default: 16)',
    )  # fmt: skip
    parser.add_argument(
        '--pressure', metavar='MPA', type=_pressure, action='append', default=[],
        help='add a column with the opening at this main steam pressure; may be repeated',
    )  # fmt: skip
    parser.add_argument(
        '--max-gain', metavar='G', type=_positive,
        help='units of u per MW beyond which the table is of no use (default: 5 times the '
        'least of the curve)',
    )  # fmt: skip
    parser.add_argument(
        '--tolerance', metavar='MW', type=_positive, default=0.01,
        help='largest error allowed of F(F^-1(x)) and of the table; beyond it nothing is written '
        '(default: 0.01)',
    )  # fmt: skip
    parser.add_argument('--u-from', metavar='U', type=_finite, help='leave out smaller u')
    parser.add_argument('--u-to', metavar='U', type=_finite, help='leave out larger u')
    parser.add_argument('--overwrite', action='store_true', help='replace a table that is there')


def run(options: Namespace, console: Console) -> Outcome:
    """Read, invert, check, write."""
    import math

    from valveflow_ros.cli.compensation_check import check
    from valveflow_ros.cli.compensation_table import columns_of, outcome, write
    from valveflow_ros.cli.files import check_output
    from valveflow_ros.cli.model_file import read_model
    from valveflow_ros.cli.outputs import TABLES
    from valveflow_ros.core.compensation import Compensation, compensate

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
