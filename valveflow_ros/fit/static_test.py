# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A static flow test: a table of steady rows with one opening each, and no data between them.

Such a table has no information on time constants and on the noise in time. Its rows are points of
the curve, which is found by the exact partition with at least four rows per piece. The number of
pieces is chosen by BIC, and neighbouring pieces are joined.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from valveflow_ros.curve.characteristic import Characteristic, Choice, ResidualStatistics
from valveflow_ros.errors import counted
from valveflow_ros.fit.step_test import (
    BrokenLine,
    Points,
    form_note,
    interval,
    joined,
    partition_points,
    pieces_of_line,
    tested_data,
)
from valveflow_ros.parameters import Settings
from valveflow_ros.records import (
    COARSE_STEP_S,
    BoolArray,
    FloatArray,
    IntArray,
    SampleTable,
    SegmentKind,
    Signal,
    SpecialSegment,
)
from valveflow_ros.signals.static_form import integrated_input

STATIC_RULE = 'static_test'
_PRICE = 1.4  # penalty per parameter, in units of Schwarz' log n
LEAST_ROWS_A_PIECE = 4
_LEAST_ROWS, _MOST_ROWS = 3 * LEAST_ROWS_A_PIECE, 300
_PRESSURE_SPREAD = 0.05  # of the mean: at constant pressure both forms of the curve are equal
_LEAST_MOVE_PERCENT = 5.0
_LARGEST_MISFIT = 0.02  # of the range of the power
_DYNAMIC_T = 4.0  # t value of the last move's effect; above it the rows are not steady


@dataclass(frozen=True, slots=True)
class StaticTest:
    """The result of a static test."""

    characteristic: Characteristic
    segments: tuple[SpecialSegment, ...]  # one segment for each row that is used


def find_static_test(table: SampleTable, settings: Settings) -> StaticTest | None:
    """Return the curve of a static test; None if the table does not look like one.

    It must have 12 to 300 rows at least 20 s apart, at nearly constant pressure and several
    openings, on a rising curve, and the residual must not depend on the last move.

    Notes
    -----
    BIC with an unknown variance: n log(S / n) + 1.4 (3 J - 1) log n for J pieces with the sum of
    squares S. As in a step test, the factor 1.4 allows for the search for the breakpoints.
    """
    step_s = settings.real('sample_period')
    opening, pressure, power = (
        table.column(s)
        for s in (Signal.VALVE_OPENING, Signal.MAIN_STEAM_PRESSURE, Signal.GENERATED_POWER)
    )
    rows = _rows(opening, pressure, power)
    if step_s < COARSE_STEP_S or not _LEAST_ROWS <= len(rows) <= _MOST_ROWS:
        return None
    if (
        np.ptp(pressure[rows]) > _PRESSURE_SPREAD * float(pressure[rows].mean())
        or np.ptp(opening[rows]) < _LEAST_MOVE_PERCENT
    ):
        return None
    u = integrated_input(opening, pressure, settings.real('pressure_exponent'))
    line = _line(u[rows], power[rows], settings.whole('max_pieces'))
    if line is None:
        return None
    rest = power[rows] - np.interp(u[rows], line.knots, line.values)
    sd = math.sqrt(float(rest @ rest) / max(len(rows) - 2 * len(line.knots) + 2, 1))
    if sd > _LARGEST_MISFIT * float(np.ptp(power[rows])) or _moves_show(u[rows], rest):
        return None
    line = replace(line, covariance=line.covariance * sd**2, knot_error=line.knot_error * sd)
    segments = tuple(
        _segment(k + 1, int(row), table, u, power) for k, row in enumerate(rows.tolist())
    )
    return StaticTest(_characteristic(table, u, rows, line, rest, settings), segments)


def may_be_static_test(table: SampleTable, settings: Settings) -> bool:
    """Return True for a table with rows as far apart and as few as those of a static test."""
    return settings.real('sample_period') >= COARSE_STEP_S and len(table) <= _MOST_ROWS


def _rows(opening: FloatArray, pressure: FloatArray, power: FloatArray) -> IntArray:
    """Return the indices of rows with all values, without repetitions of the previous row."""
    values = np.column_stack([opening, pressure, power])
    known: IntArray = np.flatnonzero(np.isfinite(values).all(axis=1) & (pressure > 0.0))
    new: BoolArray = np.append(True, (np.diff(values[known], axis=0) != 0.0).any(axis=1))
    return known[new] if len(known) else known


def _line(u: FloatArray, power: FloatArray, most: int) -> BrokenLine | None:
    """Return the rising broken line with the smallest BIC; its covariance is for noise of 1 MW."""
    order = np.argsort(u, kind='stable')
    points = Points(u[order], power[order], np.ones(len(u)))
    if np.ptp(points.u) == 0.0:
        return None
    n = len(points)
    starts, _ = partition_points(points, min(most, n // LEAST_ROWS_A_PIECE), LEAST_ROWS_A_PIECE)
    lines = {j: _settled(points, joined(points, begun, {})) for j, begun in starts.items()}
    cost = {j: _squares(points, line) for j, line in lines.items()}
    least = 1e-12 * float(np.var(points.power_mw)) * n
    score = {
        j: n * math.log(max(c, least) / n) + _PRICE * (3 * j - 1) * math.log(n)
        for j, c in cost.items()
    }
    for j in sorted(score, key=lambda j: score[j]):
        if np.all(np.diff(lines[j].values) > 0.0):
            return replace(lines[j], cost=cost)
    return None


def _settled(points: Points, line: BrokenLine) -> BrokenLine:
    """Return the line with its inner knots moved to the best fit of the joined pieces."""
    inner = line.knots[1:-1]
    if not len(inner):
        return line
    first, last = line.knots[0], line.knots[-1]
    # At most half a piece in each direction, so that no knot passes another.
    half = 0.45 * np.diff(line.knots)

    def rest(knots: FloatArray) -> FloatArray:
        at = np.concatenate([[first], knots, [last]])
        hats = _hats(points.u, at)
        # The default of `rcond` differs between NumPy 1 and NumPy 2.
        heights = np.linalg.lstsq(hats, points.power_mw, rcond=None)[0]
        return np.asarray(hats @ heights - points.power_mw)

    scale = float(last - first)
    found = least_squares(
        rest, inner, bounds=(inner - half[:-1], inner + half[1:]), x_scale=scale,
        diff_step=1e-5, max_nfev=60,
    )  # fmt: skip
    knots = np.concatenate([[first], found.x, [last]])
    hats = _hats(points.u, knots)
    covariance = np.linalg.pinv(hats.T @ hats)
    return BrokenLine(
        knots, covariance @ (hats.T @ points.power_mw), np.asarray(covariance),
        np.sqrt(np.maximum(np.diag(np.linalg.pinv(found.jac.T @ found.jac)), 0.0)), {},
    )  # fmt: skip


def _hats(u: FloatArray, knots: FloatArray) -> FloatArray:
    return np.column_stack([np.interp(u, knots, row) for row in np.eye(len(knots))])


def _squares(points: Points, line: BrokenLine) -> float:
    rest = points.power_mw - np.interp(points.u, line.knots, line.values)
    return float(rest @ rest)


def _moves_show(u: FloatArray, rest: FloatArray) -> bool:
    """Return True if the misfit depends on the last move, so that the rows are not steady."""
    move = np.diff(u) - np.diff(u).mean()
    left = rest[1:] - rest[1:].mean()
    if not (move @ move) > 0.0 or not (left @ left) > 0.0:
        return False
    r = float(move @ left) / math.sqrt(float(move @ move) * float(left @ left))
    return abs(r) * math.sqrt((len(move) - 2) / max(1.0 - r * r, 1e-12)) > _DYNAMIC_T


def _segment(
    number: int, row: int, table: SampleTable, u: FloatArray, power: FloatArray
) -> SpecialSegment:
    """Return a row as a steady-state segment."""
    at_ns = int(table.time_ns[row])
    return SpecialSegment(
        number=number, kind=SegmentKind.STEADY, start_ns=at_ns, end_ns=at_ns, samples=1,
        u_start=float(u[row]), u_end=float(u[row]), u_rate_per_s=0.0, u_rms=0.0,
        power_start_mw=float(power[row]), power_end_mw=float(power[row]), power_rms_mw=0.0,
        temperature_mean_degc=float(table.column(Signal.MAIN_STEAM_TEMPERATURE)[row]),
    )  # fmt: skip


def _characteristic(
    table: SampleTable,
    u: FloatArray,
    rows: IntArray,
    line: BrokenLine,
    rest: FloatArray,
    settings: Settings,
) -> Characteristic:
    """Convert the line into a characteristic."""
    pieces = pieces_of_line(line, u[rows])
    step_s = settings.real('sample_period')
    sd = max(float(np.std(rest)), 1e-9)
    pressure = table.column(Signal.MAIN_STEAM_PRESSURE)[rows]
    gaps = zip(line.knots[1:-1].tolist(), line.knot_error.tolist(), strict=True)
    note = (
        f'The table was taken as a static test: {len(rows)} steady rows, '
        f'{counted(step_s, "s", "s")} apart or more. Steady rows show no time constant and no '
        'delay.'
    )
    return Characteristic(
        pressure_exponent=settings.real('pressure_exponent'),
        pieces=pieces,
        breakpoint_intervals=tuple(interval(knot, error) for knot, error in gaps),
        choice=Choice(
            STATIC_RULE, line.cost, {},
            f'Each piece holds at least {LEAST_ROWS_A_PIECE} rows; the number of pieces has the '
            'least BIC.',
        ),
        source=tested_data(table, rows, len(rows), settings),
        residuals=ResidualStatistics(
            rmse_mw=float(np.sqrt(np.mean(rest**2))), average_sd_mw=sd, average_s=step_s,
            input_noise=0.0, power_noise_mw=sd,
        ),
        partition_pieces=pieces,
        notes=(note, form_note(pressure)),
    ).measured_in(settings.output_unit)  # fmt: skip
