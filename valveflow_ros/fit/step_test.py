# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The traditional manual test: constant pressure, opening changed in steps, a mean per level.

Section I of the paper describes it as the present practice of plants. Its log is no ordinary
operation: it is evaluated as a whole, and only settled levels are used.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from valveflow_ros.curve.characteristic import (
    Characteristic,
    Choice,
    FittedData,
    Piece,
    ResidualStatistics,
)
from valveflow_ros.errors import DataError, TooFewSamplesError
from valveflow_ros.fit.step_levels import Level, find_levels
from valveflow_ros.parameters import Settings
from valveflow_ros.records import (
    FloatArray,
    IntArray,
    SampleTable,
    SegmentKind,
    Signal,
    SpecialSegment,
)
from valveflow_ros.signals.static_form import integrated_input

# A rising broken line through the levels of a step test.

ENOUGH = 8  # from this number of levels on, each piece is fitted to several of them
_LEAST_LEVELS = 2  # per piece
# Penalty per parameter, in units of Schwarz' log n. The best of many positions of a breakpoint
# fits well by chance: at 1.4 noise gives a false one in 4 of 100 tests, at 1 in 10 of 100.
_PRICE = 1.4
_Z95 = 1.959963984540054


@dataclass(frozen=True, slots=True)
class Points:
    """Means of levels, sorted by u; all arrays have shape (n,)."""

    u: FloatArray
    power_mw: FloatArray
    error_mw: FloatArray

    def __len__(self) -> int:
        """Return the number of levels."""
        return len(self.u)


@dataclass(frozen=True, slots=True)
class BrokenLine:
    """The line and its errors."""

    # knots, values: float64 (J + 1,)
    knots: FloatArray
    values: FloatArray
    covariance: FloatArray  # float64 (J + 1, J + 1), of the values, with the knots kept fixed
    # Standard errors of the inner knots, (J - 1,); NaN if a level is the knot.
    knot_error: FloatArray
    # Weighted sum of squares by number of pieces; empty if each level is a knot.
    cost: dict[int, float]


def pooled(points: Points, near_u: float) -> tuple[Points, list[int]]:
    """Return levels in rising order of u, and the number of levels merged into each.

    Levels closer than ``near_u`` are merged: the same opening was visited twice. If each level
    is a knot, a level with no more power than the one below is merged with it, as means
    weighted by their errors (pool adjacent violators), because the curve must rise.
    """
    found = _groups(points, near_u, rising=False)
    return found if len(found[0]) >= ENOUGH else _groups(points, near_u, rising=True)


def _groups(points: Points, near_u: float, rising: bool) -> tuple[Points, list[int]]:
    order = np.argsort(points.u, kind='stable')
    groups: list[list[float]] = []  # weight, u, power, members
    for k in order:
        group = [1.0 / points.error_mw[k] ** 2, float(points.u[k]), float(points.power_mw[k]), 1.0]
        while groups and (
            group[1] - groups[-1][1] < near_u or (rising and group[2] <= groups[-1][2])
        ):
            before = groups.pop()
            weight = before[0] + group[0]
            group = [
                weight,
                (before[0] * before[1] + group[0] * group[1]) / weight,
                (before[0] * before[2] + group[0] * group[2]) / weight,
                before[3] + group[3],
            ]
        groups.append(group)
    table = np.array(groups).reshape(-1, 4)
    return Points(table[:, 1], table[:, 2], 1.0 / np.sqrt(table[:, 0])), [
        int(g[3]) for g in groups
    ]


def broken_line(points: Points, most: int) -> BrokenLine:
    """Fit the line: a knot at each level, or the exact partition if there are enough levels.

    Parameters
    ----------
    points : Points
        In rising order.
    most : int
        Largest number of pieces tried.

    Notes
    -----
    The partition of the levels into pieces of at least two is exact (by dynamic programming).
    Their number J minimises the weighted sum of squares plus ``1.4 log n`` for each of the
    3 J - 1 parameters. Neighbouring lines are joined at knots, and the values there are refitted
    together. A line with a falling piece is rejected.
    """
    n = len(points)
    if n < ENOUGH:
        knots = points.u
        return BrokenLine(
            knots,
            points.power_mw,
            np.asarray(np.diag(points.error_mw**2)),
            np.full(n - 2, math.nan),
            {},
        )
    starts, cost = partition_points(points, min(most, n // _LEAST_LEVELS))
    score = {j: c + _PRICE * (3 * j - 1) * math.log(n) for j, c in cost.items()}
    for j in sorted(score, key=lambda j: score[j]):
        line = joined(points, starts[j], cost)
        if np.all(np.diff(line.values) > 0.0):
            return line
    return joined(points, starts[1], cost)


def _line(points: Points, a: int, b: int) -> tuple[FloatArray, FloatArray, float]:
    """Return value at the middle, slope, their covariance, and the cost of levels [a, b)."""
    w = 1.0 / points.error_mw[a:b]
    middle = float(points.u[a:b].mean())
    design = np.column_stack([w, w * (points.u[a:b] - middle)])
    covariance = np.linalg.pinv(design.T @ design)
    found = covariance @ (design.T @ (w * points.power_mw[a:b]))
    rest = w * points.power_mw[a:b] - design @ found
    slope = float(found[1])
    return (
        np.array([float(found[0]) - slope * middle, slope, middle]),
        np.asarray(covariance),
        float(rest @ rest),
    )


def partition_points(
    points: Points, most: int, least: int = _LEAST_LEVELS
) -> tuple[dict[int, list[int]], dict[int, float]]:
    """Return starts and costs of pieces of at least ``least`` points, by number of pieces."""
    n = len(points)
    error = np.full((n + 1, n + 1), math.inf)
    for a in range(n):
        for b in range(a + least, n + 1):
            error[a, b] = _line(points, a, b)[2]
    best = np.full((most + 1, n + 1), math.inf)
    came = np.zeros((most + 1, n + 1), dtype=np.int64)
    best[0, 0] = 0.0
    for j in range(1, most + 1):
        for b in range(1, n + 1):
            total = best[j - 1, :b] + error[:b, b]
            came[j, b] = int(np.argmin(total))
            best[j, b] = total[came[j, b]]
    starts: dict[int, list[int]] = {}
    for j in range(1, most + 1):
        if math.isfinite(best[j, n]):
            b, found = n, []
            for left in range(j, 0, -1):
                b = int(came[left, b])
                found.append(b)
            starts[j] = found[::-1]
    return starts, {j: float(best[j, n]) for j in starts}


def joined(points: Points, starts: list[int], cost: dict[int, float]) -> BrokenLine:
    """Join neighbouring lines, and fit the values at the knots together."""
    ends = [*starts[1:], len(points)]
    lines = [_line(points, a, b) for a, b in zip(starts, ends, strict=True)]
    knots, errors = [float(points.u[0])], []
    for k, at in enumerate(starts[1:]):
        (one, var_one, _), (two, var_two, _) = lines[k], lines[k + 1]
        low, high = float(points.u[at - 1]), float(points.u[at])
        bend = two[1] - one[1]
        place = (one[0] - two[0]) / bend if bend else 0.5 * (low + high)
        place = min(max(place, low), high)
        variance = sum(
            v[0, 0] + 2.0 * v[0, 1] * (place - c[2]) + v[1, 1] * (place - c[2]) ** 2
            for c, v in ((one, var_one), (two, var_two))
        )
        knots.append(place)
        errors.append(math.sqrt(variance) / abs(bend) if bend else math.nan)
    knots.append(float(points.u[-1]))
    at_knots = np.array(knots)
    hats = np.column_stack([np.interp(points.u, at_knots, row) for row in np.eye(len(knots))])
    w = 1.0 / points.error_mw
    design = hats * w[:, None]
    covariance = np.linalg.pinv(design.T @ design)
    values = covariance @ (design.T @ (w * points.power_mw))
    return BrokenLine(at_knots, values, np.asarray(covariance), np.array(errors), cost)


def interval(knot: float, error: float) -> tuple[float, float]:
    """Return the 95 % interval of a knot."""
    return knot - _Z95 * error, knot + _Z95 * error


PRESSURE_SPREAD_PERCENT = 3.0
LEAST_LEVELS = 3
RULE = 'step_test'
_HELD_LEAST = 0.5  # of the time; moves take the rest
_TOLD = 5  # maximum number of omitted levels that are named
_NEAR = 0.005  # of the range of u: closer levels are the same opening


@dataclass(frozen=True, slots=True)
class StepTest:
    """The result of a step test."""

    characteristic: Characteristic
    levels: tuple[Level, ...]  # all levels that were found, in chronological order
    segments: tuple[SpecialSegment, ...]  # the settled parts of the levels that are used
    # Central 95 % of the pressure in the settled parts, in % of its mean.
    pressure_spread_percent: float


def identify_step_test(table: SampleTable, settings: Settings) -> StepTest:
    """Identify the curve of a step test.

    Raises `DataError` if there are too few levels, the pressure was not constant, or the power
    does not rise with the opening; the message says what was found.
    """
    opening = np.ascontiguousarray(table.column(Signal.VALVE_OPENING))
    pressure = table.column(Signal.MAIN_STEAM_PRESSURE)
    u = integrated_input(opening, pressure, settings.real('pressure_exponent'))
    levels = find_levels(table, u, settings)
    _is_one(levels, table, settings)
    good = [level for level in levels if not level.problem]
    if len(good) < LEAST_LEVELS:
        raise TooFewSamplesError(
            'Levels at which the opening was held until the unit had settled', len(good),
            LEAST_LEVELS, ' '.join(_left_out(levels)),
        )  # fmt: skip
    inside = np.concatenate([np.arange(v.first, v.end) for v in good])
    spread = _pressure_spread(pressure[inside])
    points = Points(
        np.array([v.u for v in good]),
        np.array([v.power_mw for v in good]),
        np.array([v.power_error_mw for v in good]),
    )
    span = float(np.ptp(points.u))
    points, members = pooled(points, _NEAR * span)
    if len(points) < LEAST_LEVELS:
        raise DataError(
            f'Of {len(good)} levels only {len(points)} differ in opening and rise in power; '
            f'a curve needs {LEAST_LEVELS}.'
        )
    line = broken_line(points, settings.whole('max_pieces'))
    if np.any(np.diff(line.values) <= 0.0):
        worst = int(np.argmin(np.diff(line.values)))
        raise DataError(
            f'Between u = {line.knots[worst]:.0f} and {line.knots[worst + 1]:.0f} the power does '
            'not rise with the opening, so this is no characteristic of a valve: check which '
            'signals were logged, and that nothing else moved the power.'
        )
    segments = tuple(_segment(k + 1, table, u, v, settings) for k, v in enumerate(good))
    notes = (
        *_notes(levels, good, spread, members),
        form_note(pressure[inside]),
        *_left_out(levels),
    )
    curve = _characteristic(table, u, inside, good, line, settings, notes)
    return StepTest(curve, tuple(levels), segments, spread)


def _is_one(levels: Sequence[Level], table: SampleTable, settings: Settings) -> None:
    """Raise `DataError` for ordinary operation, in which the valve is rarely held."""
    held_s = sum(v.held_s for v in levels)
    all_s = max(len(table), 1) * settings.real('sample_period')
    if held_s < _HELD_LEAST * all_s:
        raise DataError(
            f'This is no step test: the opening was held for {100.0 * held_s / all_s:.0f} % of '
            f'the time only (at least {100.0 * _HELD_LEAST:.0f} % needed). Ordinary operation is '
            'identified without --step-test.'
        )


def _pressure_spread(pressure: FloatArray) -> float:
    """Return the spread in %; raise `DataError` if it is too large for a step test."""
    low, high = np.quantile(pressure, (0.025, 0.975))
    spread = 100.0 * float(high - low) / float(pressure.mean())
    if spread > PRESSURE_SPREAD_PERCENT:
        raise DataError(
            f'The pressure was not constant: at the settled levels it lies between {low:.2f} and '
            f'{high:.2f} MPa, {spread:.1f} % of its mean (at most {PRESSURE_SPREAD_PERCENT:g} % '
            'for a step test). Ordinary operation is identified without --step-test.'
        )
    return spread


def form_note(pressure: FloatArray) -> str:
    """Return a note that a test at one pressure does not determine the form of the power."""
    low, high = f'{pressure.min():.2f}', f'{pressure.max():.2f}'
    stayed = f'was {low} MPa' if low == high else f'stayed between {low} and {high} MPa'
    return (
        f'The pressure {stayed}. Such data do not show how the power depends on the pressure: at '
        'other pressures the curve may be wrong.'
    )


def _notes(
    levels: Sequence[Level], good: Sequence[Level], spread: float, members: Sequence[int]
) -> list[str]:
    openings = ', '.join(f'{v.opening_percent:.1f}' for v in good)
    errors = [v.power_error_mw for v in good]
    notes = [
        f'Manual step test: {len(good)} of {len(levels)} levels count, at openings of {openings} '
        f'%. Each is a mean with an error of {max(errors):.2g} MW or less. The pressure stayed '
        f'within {spread:.1f} % of its mean.'
    ]
    joined = sum(1 for m in members if m > 1)
    if joined:
        notes.append(
            f'{joined} of the points of the curve {"is" if joined == 1 else "are"} made of '
            'several levels: the same opening visited again, or a power that did not rise.'
        )
    return notes


def _left_out(levels: Sequence[Level]) -> list[str]:
    told = [
        f'Level {k + 1} (opening {v.opening_percent:.1f} %) is left out: it {v.problem}.'
        for k, v in enumerate(levels)
        if v.problem
    ]
    more = len(told) - _TOLD
    return told if more <= 0 else [*told[:_TOLD], f'{more} more levels are left out likewise.']


def _segment(
    number: int, table: SampleTable, u: FloatArray, level: Level, settings: Settings
) -> SpecialSegment:
    """Return a level's settled part as a steady-state segment."""
    part = slice(level.first, level.end)
    power = table.column(Signal.GENERATED_POWER)[part]
    temperature = table.column(Signal.MAIN_STEAM_TEMPERATURE)[part]
    temperature = temperature[np.isfinite(temperature)]
    return SpecialSegment(
        number=number,
        kind=SegmentKind.STEADY,
        start_ns=int(table.time_ns[level.first]),
        end_ns=int(table.time_ns[level.end - 1]),
        samples=level.samples,
        u_start=level.u,
        u_end=level.u,
        u_rate_per_s=0.0,
        u_rms=float(u[part].std()),
        power_start_mw=level.power_mw,
        power_end_mw=level.power_mw,
        power_rms_mw=float(power.std()),
        temperature_mean_degc=float(temperature.mean()) if len(temperature) else math.nan,
    )


def _characteristic(
    table: SampleTable,
    u: FloatArray,
    inside: IntArray,
    good: Sequence[Level],
    line: BrokenLine,
    settings: Settings,
    notes: tuple[str, ...],
) -> Characteristic:
    """Convert the line into a characteristic."""
    pieces = pieces_of_line(line, u[inside])
    if line.cost:
        why = (
            'The pieces are the exact partition of the means of the levels, weighted by their '
            'errors; their number has the least sum of squares plus a penalty for each '
            'number a piece takes.'
        )
        gaps = zip(line.knots[1:-1].tolist(), line.knot_error.tolist(), strict=True)
        intervals = tuple(interval(knot, error) for knot, error in gaps)
    else:
        why = 'There are too few levels to look for breakpoints: each level is one.'
        intervals = tuple((math.nan, math.nan) for _ in pieces[1:])
    return Characteristic(
        pressure_exponent=settings.real('pressure_exponent'),
        pieces=pieces,
        breakpoint_intervals=intervals,
        choice=Choice(RULE, line.cost, {}, why),
        source=tested_data(table, inside, len(good), settings),
        residuals=_residuals(table, u, good, line, settings),
        partition_pieces=pieces,
        notes=notes,
    ).measured_in(settings.output_unit)


def pieces_of_line(line: BrokenLine, u: FloatArray) -> tuple[Piece, ...]:
    """Return the pieces of a line with their errors; ``u`` are the samples of the line."""
    knots, values, covariance = line.knots, line.values, line.covariance
    counts = np.histogram(u, bins=np.concatenate([[-np.inf], knots[1:-1], [np.inf]]))[0]
    pieces = []
    for k in range(len(knots) - 1):
        width = knots[k + 1] - knots[k]
        both = covariance[k : k + 2, k : k + 2]
        to_slope = np.array([-1.0, 1.0]) / width
        to_intercept = np.array([knots[k + 1], -knots[k]]) / width
        slope = float(to_slope @ values[k : k + 2])
        pieces.append(
            Piece(float(knots[k]), float(knots[k + 1]), slope, float(values[k] - slope * knots[k]),
                  math.sqrt(max(0.0, float(to_slope @ both @ to_slope))),
                  math.sqrt(max(0.0, float(to_intercept @ both @ to_intercept))), int(counts[k]))
        )  # fmt: skip
    return tuple(pieces)


def tested_data(
    table: SampleTable, inside: IntArray, levels: int, settings: Settings
) -> FittedData:
    """Return the description of a test's rows, including the temperature."""
    return FittedData.of(
        table.time_ns, levels, 0, table.column(Signal.MAIN_STEAM_TEMPERATURE)[inside],
        settings.real('temperature_spread_limit'),
    )  # fmt: skip


def _residuals(
    table: SampleTable,
    u: FloatArray,
    good: Sequence[Level],
    line: BrokenLine,
    settings: Settings,
) -> ResidualStatistics:
    """Return the residual statistics of rows and block means in the settled parts."""
    power = table.column(Signal.GENERATED_POWER)
    block = max(1, round(settings.real('block') / settings.real('sample_period')))
    rest, means, still = [], [], []
    for level in good:
        part = slice(level.first, level.end)
        rest.append(power[part] - np.interp(u[part], line.knots, line.values))
        blocks = level.samples // block * block
        means.append(rest[-1][:blocks].reshape(-1, block).mean(axis=1))
        still.append((u[part] - level.u)[:blocks].reshape(-1, block).mean(axis=1))
    off = [float(r.mean()) for r in rest]
    return ResidualStatistics(
        rmse_mw=float(np.sqrt(np.mean(np.concatenate(rest) ** 2))),
        average_sd_mw=max(float(np.std(off)), 1e-9),
        average_s=float(np.mean([v.samples for v in good])) * settings.real('sample_period'),
        input_noise=float(np.std(np.concatenate(still))),
        power_noise_mw=float(np.std(np.concatenate(means))),
    )
