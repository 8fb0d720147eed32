# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow compensate``: the inverse curve as a table for the turbine controller."""

from __future__ import annotations

import csv
import math
from argparse import ArgumentParser, Namespace
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from valveflow_ros.cli.command import Console, VerbResult, add_file, add_output, lines, table
from valveflow_ros.errors import DataError, UsageError
from valveflow_ros.report.terminal.text import number, whole

if TYPE_CHECKING:
    from valveflow_ros.curve.characteristic import Characteristic
    from valveflow_ros.curve.compensation import Compensation
    from valveflow_ros.records import FloatArray

_FAR = 0.25  # of the usual pressure

USAGE = '--model FILE -o TABLE [options]'
DESCRIPTION = """\
Write the inverse of a flow characteristic as a table: the input u of the curve that gives a
demanded power, and for each --pressure the opening. Used in the controller before the valve,
it makes the response of the unit equal at every load. The breakpoints of the curve are rows of
the table, so that linear interpolation is exact. The command reports where the table must not
be used.

u is V p^m, with the opening V in % and the pressure p in MPa. For a valve with breakpoints at
fixed openings, p^m F(V) + c, u is the opening, and the power belongs to one pressure: several
--pressure give one table below the other, with the pressure as the first column. A controller
interpolates between them by the pressure.

The column within_gain_limit is 1 where the table may be used from this row to the next. Columns
named seen are 1 where identify saw this opening at about this pressure, else 0.

example:
  valveflow compensate --model result/characteristic.json -o table.csv --pressure 16.7"""


def arguments(parser: ArgumentParser) -> None:
    """Add the options."""
    add_file(parser, '--model', 'a characteristic.json, as identify writes it', required=True)
    add_output(parser, 'TABLE', 'a .csv or .parquet file')
    parser.add_argument(
        '--points', metavar='N', default=16,
        type=whole('a number of points', 2, 10_000, '--points 16'),
        help='length of the table (default: 16)',
    )  # fmt: skip
    parser.add_argument(
        '--pressure', metavar='MPA', action='append', default=[],
        type=number('a pressure in MPa', 1e-6, 100, '--pressure 16.7'),
        help='add a column with the opening at this main steam pressure; may be repeated',
    )  # fmt: skip
    parser.add_argument(
        '--max-gain', metavar='G',
        type=number('units of u per MW', 0, 1e9, '--max-gain 50', above=True),
        help='units of u per MW above which the table is marked as not useful (default: 5 '
        'times the least of the curve)',
    )  # fmt: skip
    parser.add_argument(
        '--tolerance', metavar='MW', default=0.01,
        type=number('a power in MW', 0, 1e9, '--tolerance 0.01', above=True),
        help='largest error allowed of F(F^-1(x)) and of the table; beyond it nothing is written '
        '(default: 0.01)',
    )  # fmt: skip
    for way, which, example, end in (
        ('from', 'smaller', 1100, -math.inf), ('to', 'larger', 2200, math.inf),
    ):  # fmt: skip
        parser.add_argument(
            f'--u-{way}', metavar='U', default=end,
            help=f'leave {which} values of u out of the table',
            type=number('a number, a value of u', -math.inf, math.inf, f'--u-{way} {example}'),
        )  # fmt: skip
    parser.add_argument('--overwrite', action='store_true', help='replace a table that is there')


def run(options: Namespace, console: Console) -> VerbResult:
    """Read the curve, invert, check, write."""
    from valveflow_ros.curve.compensation import compensate
    from valveflow_ros.interface.files import TABLES, check_output
    from valveflow_ros.interface.models import load_characteristic
    from valveflow_ros.signals.static_form import OPENING

    check_output(options.output, TABLES, source=options.model, overwrite=options.overwrite)
    curve = load_characteristic(options.model)
    console.measured_in(curve.output_unit)
    pressures = sorted(set(options.pressure))
    shown = [(curve, pressures)]
    if curve.axis == OPENING:
        if not pressures and math.isnan(curve.reference_pressure_mpa):
            raise UsageError(
                'The power of this curve at an opening depends on the pressure, and its file '
                'states no reference pressure: give one, as in --pressure 16.7.'
            )
        # At each pressure its breakpoints are at other powers.
        at = pressures or [curve.reference_pressure_mpa]
        shown = [(curve.at_pressure(p), [p]) for p in at]

    def make(cut: Characteristic, points: int) -> Compensation:
        return compensate(cut, points, options.max_gain, options.u_from, options.u_to)

    tables, texts, data = [], [], []
    for sentence in (*curve.notes, *_far(curve, [p for _, at in shown for p in at])):
        console.warn(sentence)
    for cut, shown_at in shown:
        made = make(cut, options.points)
        _check(made, options.tolerance, partial(make, cut))
        tables.append(_table(made, shown_at))
        for sentence in (*made.notes[1:], *_unseen(tables[-1], curve, shown_at)):
            console.warn(sentence)
        texts.append(_text(made, shown_at, options.tolerance, options.output))
        data.append(_data(made, tables[-1], shown_at, options.tolerance, options.output))
    _write(tables[0] if len(shown) == 1 else _stacked(tables, pressures), options.output)
    names = ('axis', 'pressure_exponent', 'pressure_scale_exponent', 'offset_mw')
    form = {name: getattr(curve, name) for name in names}
    if len(shown) == 1:
        return VerbResult(texts[0], {**form, **data[0]})
    text = '\n'.join(f'At {p:g} MPa:\n{one}' for p, one in zip(pressures, texts, strict=True))
    return VerbResult(text, {**form, 'table': str(options.output), 'tables': data})


def _unseen(
    table: Mapping[str, FloatArray], curve: Characteristic, pressures: Sequence[float]
) -> list[str]:
    """Return a warning for each pressure at which openings of the table were not seen."""
    from valveflow_ros.curve.compensation import seen_at
    from valveflow_ros.report.words import counted

    told = []
    for p in pressures:
        marks = table.get(f'seen_at_{p:g}_mpa')
        if marks is None or marks.all():
            continue
        seen, rows = seen_at(curve, p), counted(int((marks == 0.0).sum()), 'row')
        where = f'from {seen[0]:.1f} to {seen[1]:.1f} % opening only' if seen else 'at no opening'
        told.append(
            f'At about {p:g} MPa identify saw the unit {where}: {rows} of the table, marked 0 as '
            'not seen, come from other pressures by the law of the pressure.'
        )
    return told


def _stacked(
    tables: Sequence[Mapping[str, FloatArray]], pressures: Sequence[float]
) -> dict[str, FloatArray]:
    """Return tables of one pressure each as one table with the pressure as first column."""
    import numpy as np

    rows = [len(table['u']) for table in tables]
    stacked = {'pressure_mpa': np.repeat(np.array(pressures), rows)}
    names = [{name.partition('_at_')[0]: column for name, column in t.items()} for t in tables]
    return stacked | {name: np.concatenate([t[name] for t in names]) for name in names[0]}


def _far(curve: Characteristic, pressures: Sequence[float]) -> list[str]:
    """Return a warning for each pressure that is far from that of the data."""
    from valveflow_ros.curve.compensation import seen_at

    usual = curve.reference_pressure_mpa
    return [
        f'The usual pressure of the data was {usual:.1f} MPa. At {p:g} MPa the table rests on the '
        'law of the pressure alone: do not use it where the unit did not run.'
        for p in pressures
        if abs(p - usual) > _FAR * usual and seen_at(curve, p) is None
    ]


def _check(made: Compensation, tolerance_mw: float, again: Callable[[int], Compensation]) -> None:
    """Raise if the inverse or the table is inaccurate; give the necessary number of points.

    ``again`` makes the same table with another number of points.
    """
    from valveflow_ros.curve.compensation import corner_count
    from valveflow_ros.report.words import counted

    if made.identity_mw <= tolerance_mw and made.table_mw <= tolerance_mw:
        return
    if made.identity_mw > tolerance_mw:
        raise DataError(
            f'The inverse is not exact: F(F^-1(x)) differs from x by up to '
            f'{made.identity_mw:.2g} MW (tolerance {tolerance_mw:g} MW). Nothing was written.'
        )
    have, corners = len(made.u), corner_count(made.curve)
    off = f'Interpolating in a table of {counted(have, "point")} is off by up to'
    least = min(made, again(corners), key=lambda m: m.table_mw)
    if least.table_mw > tolerance_mw:
        raise DataError(
            f'{off} {made.table_mw:.2g} MW (tolerance {tolerance_mw:g} MW), and with as many as '
            f'it takes {least.table_mw:.2g} MW are left, from rounding. Ask for a larger '
            '--tolerance. Nothing was written.'
        )
    # With the best positions of the points the error decreases with their number.
    tried = range(2, corners + 1)
    enough = tried[bisect_left(tried, True, key=lambda n: again(n).table_mw <= tolerance_mw)]
    raise DataError(
        f'{off} {made.table_mw:.2g} MW (tolerance {tolerance_mw:g} MW); --points {enough} would '
        'do. Nothing was written.'
    )


def _table(made: Compensation, pressures: Sequence[float]) -> dict[str, FloatArray]:
    """Return the columns of the table; opening in % of full opening, not limited to 100."""
    import numpy as np

    from valveflow_ros.curve.compensation import seen_at

    table = {
        'power_mw': made.power_mw,
        'u': made.u,
        'u_stderr': np.round(made.u_stderr, 4),
        'gain_u_per_mw': np.round(made.gain, 4),
        'within_gain_limit': made.within.astype(np.float64),
    }
    for p in pressures:
        opening = np.round(made.u / p**made.curve.pressure_exponent, 6)
        table[f'opening_percent_at_{p:g}_mpa'] = opening
        if made.curve.openings_seen:
            low, high = seen_at(made.curve, p) or (math.inf, -math.inf)
            table[f'seen_at_{p:g}_mpa'] = ((opening >= low) & (opening <= high)).astype(np.float64)
    return table


def _write(table: Mapping[str, FloatArray], path: Path) -> None:
    """Write CSV or Parquet; values that are not finite are empty cells."""
    import numpy as np

    from valveflow_ros.interface.files import whole_file

    with whole_file(path) as draft:
        if path.suffix.lower() == '.parquet':
            import pyarrow as pa
            import pyarrow.parquet as pq

            cells = {n: pa.array(c, mask=~np.isfinite(c)) for n, c in table.items()}
            pq.write_table(pa.table(cells), draft)
            return
        with draft.open('w', encoding='utf-8', newline='') as file:
            writer = csv.writer(file)
            writer.writerow(table)
            for row in zip(*table.values(), strict=True):
                writer.writerow([f'{v:.10g}' if math.isfinite(v) else '' for v in row])


def _text(made: Compensation, pressures: Sequence[float], tolerance: float, path: Path) -> str:
    from valveflow_ros.report.words import counted, decimals, plain

    x, u = made.power_mw, made.u
    low, high = made.useful_mw
    m = made.curve.pressure_exponent
    return lines(
        f'Wrote {counted(len(x), "point")} to {path}: {decimals(float(x[0]), 2)} to '
        f'{decimals(float(x[-1]), 2)} MW, u from {decimals(float(u[0]), 2)} to '
        f'{decimals(float(u[-1]), 2)}.',
        f'The opening in % is u / p^{m:.4g}, with the main steam pressure p in MPa, absolute.'
        if m
        else 'Here u is the opening in %.',
        _pieces(made, pressures),
        f'Largest gain {plain(float(made.gains.max()), 3)} units of u per MW, least '
        f'{plain(float(made.gains.min()), 3)}; from one piece to the next it changes by up '
        f'to {plain(made.largest_step, 3)} times.',
        f'The table is of use from {decimals(low, 1)} to {decimals(high, 1)} MW (gain at most '
        f'{plain(made.gain_limit, 3)} units of u per MW).'
        if math.isfinite(low)
        else 'Nowhere is the gain within its limit.',
        made.notes[0],
        *_full_words(made, pressures),
        f'Checked: F(F^-1(x)) differs from x by at most {made.identity_mw:.1e} MW; '
        'interpolating in the table as written is off by at most '
        f'{made.table_mw:.2g} MW ({made.table_u:.2g} in u); tolerance {tolerance:g} MW.',
    )


def _pieces(made: Compensation, pressures: Sequence[float]) -> str:
    """Return one line per piece."""
    from valveflow_ros.report.words import decimals, plain

    def span(low: float, high: float, places: int = 1) -> str:
        return f'{decimals(low, places)} to {decimals(high, places)}'

    rows = []
    factors = [p**made.curve.pressure_exponent for p in pressures]
    pairs = zip(made.curve.pieces, made.gains, strict=True)
    for k, (piece, gain) in enumerate(pairs, made.first_piece):
        low, high = piece.u_from, piece.u_to
        rows.append([
            str(k),
            span(piece.slope * low + piece.intercept, piece.slope * high + piece.intercept),
            span(low, high), plain(float(gain), 3),
            *(span(low / f, high / f, 2) for f in factors),
            'yes' if gain <= made.gain_limit else 'no',
        ])  # fmt: skip
    head = ['piece', 'power (MW)', 'u', 'u per MW']
    head += [f'opening at {p:g} MPa (%)' for p in pressures]
    return table([*head, 'of use'], rows)


def _data(
    made: Compensation, table: Mapping[str, FloatArray], pressures: Sequence[float],
    tolerance: float, path: Path,
) -> dict[str, Any]:  # fmt: skip
    return {
        'table': str(path),
        'model_id': made.curve.model_id,
        'columns': {name: [float(v) for v in column] for name, column in table.items()},
        'power_limits_mw': [float(made.power_mw[0]), float(made.power_mw[-1])],
        'u_limits': [float(made.u[0]), float(made.u[-1])],
        'beyond_limits': 'hold',
        'monotone': True,
        'gains_u_per_mw': [float(g) for g in made.gains],
        'gain_limit_u_per_mw': made.gain_limit,
        'largest_gain_ratio': made.largest_step,
        'useful_mw': list(made.useful_mw),
        'full_opening_mw': {f'{p:g}': _full(made, p) for p in pressures},
        'reachable_rows': {f'{p:g}': int((made.u <= _full_u(made, p)).sum()) for p in pressures},
        'jumps': [
            {'u': u, 'power_from_mw': low, 'power_to_mw': high} for u, low, high in made.jumps
        ],
        'checks': {
            'identity_mw': made.identity_mw,
            'table_mw': made.table_mw,
            'table_u': made.table_u,
            'tolerance_mw': tolerance,
            # An inaccurate table is never written.
            'passed': True,
        },
        'notes': list(made.notes),
    }


def _full_words(made: Compensation, pressures: Sequence[float]) -> list[str]:
    """Return a line for each pressure at which the valve is fully open within the table."""
    from valveflow_ros.report.words import decimals

    return [
        f'At {p:g} MPa no row of the table is reachable: the valve is fully open at u = '
        f'{decimals(_full_u(made, p), 1)}, below the first row.'
        if math.isnan(x)
        else f'At {p:g} MPa the valve is fully open at {decimals(x, 1)} MW: openings above '
        '100 % in the table are out of reach.'
        for p, x in ((p, _full(made, p)) for p in pressures)
        if x is not None
    ]


def _full(made: Compensation, pressure: float) -> float | None:
    """Return the power at which the valve is fully open.

    None if it is above the last row; NaN if it is below the first row, where it is unknown.
    """
    u = _full_u(made, pressure)
    if u > made.u[-1]:
        return None
    if u < made.u[0]:
        return math.nan
    import numpy as np

    return float(made.curve.model.static(np.array([u]))[0])


def _full_u(made: Compensation, pressure: float) -> float:
    return float(100.0 * pressure**made.curve.pressure_exponent)
