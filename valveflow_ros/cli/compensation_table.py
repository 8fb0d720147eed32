"""The table of a compensation as a file, and what is said of it."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from valveflow_ros.cli.console import Outcome
from valveflow_ros.cli.files import whole_file
from valveflow_ros.cli.report_words import columns
from valveflow_ros.curve.compensation import Compensation
from valveflow_ros.records import FloatArray
from valveflow_ros.report.words import counted, decimals, plain


def columns_of(made: Compensation, pressures: Sequence[float]) -> dict[str, FloatArray]:
    """Return the columns of the table; the opening in % of full opening, not limited to 100."""
    exponent = made.curve.pressure_exponent
    table = {
        'power_mw': made.power_mw,
        'u': made.u,
        'u_stderr': np.round(made.u_stderr, 4),
        'gain_u_per_mw': np.round(made.gain, 4),
        'within_gain_limit': made.within.astype(np.float64),
    }
    for p in pressures:
        table[f'opening_percent_at_{p:g}_mpa'] = np.round(made.u / p**exponent, 6)
    return table


def write(table: Mapping[str, FloatArray], path: Path) -> None:
    """Write CSV or Parquet; what is not finite is an empty cell.

    Raises
    ------
    RecordingError
        The file cannot be written.
    """
    with whole_file(path) as draft:
        if path.suffix.lower() == '.parquet':
            import pyarrow as pa
            import pyarrow.parquet as pq

            cells = {name: [_cell(v) for v in column] for name, column in table.items()}
            pq.write_table(
                pa.table({n: pa.array(c, pa.float64()) for n, c in cells.items()}), draft
            )
            return
        with draft.open('w', encoding='utf-8', newline='') as file:
            writer = csv.writer(file)
            writer.writerow(table)
            for row in zip(*table.values(), strict=True):
                writer.writerow(['' if _cell(v) is None else f'{v:.10g}' for v in row])


def _cell(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def within(made: Compensation, tolerance: float) -> bool:
    """Tell whether the inverse and the table are as exact as was asked."""
    return made.identity_mw <= tolerance and made.table_mw <= tolerance


def outcome(
    made: Compensation, pressures: Sequence[float], tolerance: float, path: Path
) -> Outcome:
    """Return what is printed at the end."""
    x, u = made.power_mw, made.u
    text = '\n'.join(
        [
            f'Wrote {counted(len(x), "point")} to {path}: {decimals(float(x[0]), 2)} to '
            f'{decimals(float(x[-1]), 2)} MW, u from {decimals(float(u[0]), 2)} to '
            f'{decimals(float(u[-1]), 2)}.',
            _pieces(made, pressures),
            f'Largest gain {plain(float(made.gains.max()), 3)} units of u per MW, least '
            f'{plain(float(made.gains.min()), 3)}; from one piece to the next it changes by up '
            f'to {plain(made.largest_step, 3)} times.',
            _useful(made),
            made.notes[0],
            *_full_words(made, pressures),
            f'Checked: F(F^-1(x)) differs from x by at most {made.identity_mw:.1e} MW; '
            'interpolating in the table as written is off by at most '
            f'{made.table_mw:.2g} MW ({made.table_u:.2g} in u); tolerance {tolerance:g} MW.',
        ]
    )
    return Outcome(text, _data(made, pressures, tolerance, path))


def _useful(made: Compensation) -> str:
    low, high = made.useful_mw
    if not math.isfinite(low):
        return 'Nowhere is the gain within its limit.'
    return (
        f'The table is of use from {decimals(low, 1)} to {decimals(high, 1)} MW (gain at most '
        f'{plain(made.gain_limit, 3)} units of u per MW).'
    )


def _pieces(made: Compensation, pressures: Sequence[float]) -> str:
    """Return one line a piece."""
    rows = []
    pairs = zip(made.curve.pieces, made.gains, strict=True)
    for number, (piece, gain) in enumerate(pairs, made.first_piece):
        low, high = (piece.slope * end + piece.intercept for end in (piece.u_from, piece.u_to))
        row = [
            str(number), f'{decimals(low, 1)} to {decimals(high, 1)}',
            f'{decimals(piece.u_from, 1)} to {decimals(piece.u_to, 1)}', plain(float(gain), 3),
        ]  # fmt: skip
        for p in pressures:
            factor = p**made.curve.pressure_exponent
            row.append(
                f'{decimals(piece.u_from / factor, 2)} to {decimals(piece.u_to / factor, 2)}'
            )
        rows.append([*row, 'yes' if gain <= made.gain_limit else 'no'])
    head = ['piece', 'power (MW)', 'u', 'u per MW']
    head += [f'opening at {p:g} MPa (%)' for p in pressures]
    return columns(rows, [*head, 'of use'])


def _data(
    made: Compensation, pressures: Sequence[float], tolerance: float, path: Path
) -> dict[str, Any]:
    table = columns_of(made, pressures)
    return {
        'table': str(path),
        'model_id': made.curve.model_id,
        'pressure_exponent': made.curve.pressure_exponent,
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
        'reachable_rows': {
            f'{p:g}': int(np.count_nonzero(made.u <= _full_u(made, p))) for p in pressures
        },
        'jumps': [
            {'u': u, 'power_from_mw': low, 'power_to_mw': high} for u, low, high in made.jumps
        ],
        'checks': {
            'identity_mw': made.identity_mw,
            'table_mw': made.table_mw,
            'table_u': made.table_u,
            'tolerance_mw': tolerance,
            'passed': within(made, tolerance),
        },
        'notes': list(made.notes),
    }


def _full_words(made: Compensation, pressures: Sequence[float]) -> list[str]:
    """Return a line for each pressure at which the valve is fully open before the table ends."""
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

    None if that is beyond the last row; NaN if it is before the first, where nothing is known.
    """
    u = _full_u(made, pressure)
    if u > made.u[-1]:
        return None
    if u < made.u[0]:
        return math.nan
    return float(made.curve.model.static(np.array([u]))[0])


def _full_u(made: Compensation, pressure: float) -> float:
    return float(100.0 * pressure**made.curve.pressure_exponent)
