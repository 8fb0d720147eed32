"""The traditional manual test: constant pressure, the opening in steps, a mean at each level.

Section I of the paper names it as what plants do today. Its log is not ordinary operation:
nothing streams, and only settled levels count.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from valveflow_ros.config import Settings
from valveflow_ros.curve.characteristic import (
    Characteristic,
    Choice,
    Piece,
    ResidualStatistics,
    Source,
)
from valveflow_ros.errors import DataError, TooFewSamplesError
from valveflow_ros.fit.step_curve import BrokenLine, Points, broken_line, interval, pooled
from valveflow_ros.fit.step_levels import Level, find_levels
from valveflow_ros.monitoring.feeding import Rows
from valveflow_ros.records import (
    FloatArray,
    IntArray,
    SampleTable,
    SegmentKind,
    Signal,
    SpecialSegment,
)

PRESSURE_SPREAD_PERCENT = 3.0
LEAST_LEVELS = 3
RULE = 'step_test'
_HELD_LEAST = 0.5  # of the time: the rest are moves
_TOLD = 5  # levels left out that are named one by one
_NEAR = 0.005  # of the range of u: closer levels are one opening visited twice


@dataclass(frozen=True, slots=True)
class StepTest:
    """What a step test gave.

    Attributes
    ----------
    characteristic : Characteristic
    levels : tuple of Level
        All that were found, in order of time.
    segments : tuple of SpecialSegment
        The settled parts of those that count.
    pressure_spread_percent : float
        Central 95 % of the pressure in the settled parts, in % of its mean.
    """

    characteristic: Characteristic
    levels: tuple[Level, ...]
    segments: tuple[SpecialSegment, ...]
    pressure_spread_percent: float


def identify_step_test(table: SampleTable, settings: Settings) -> StepTest:
    """Find the curve of a step test.

    Raises
    ------
    DataError
        Too few levels, the pressure was not constant, or the power does not rise with the
        opening; the sentence says what was found.
    """
    rows = Rows.of(table, settings.real('pressure_exponent'))
    levels = find_levels(table, rows.u, settings)
    _is_one(levels, table, settings)
    good = [level for level in levels if not level.problem]
    if len(good) < LEAST_LEVELS:
        raise TooFewSamplesError(
            'Levels at which the opening was held until the unit had settled', len(good),
            LEAST_LEVELS, ' '.join(_left_out(levels)),
        )  # fmt: skip
    inside = np.concatenate([np.arange(v.first, v.end) for v in good])
    spread = _pressure_spread(table.column(Signal.MAIN_STEAM_PRESSURE)[inside])
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
    segments = tuple(_segment(k + 1, table, rows.u, v, settings) for k, v in enumerate(good))
    notes = (*_notes(levels, good, spread, members), *_left_out(levels))
    curve = _characteristic(table, rows.u, inside, good, line, settings, notes)
    return StepTest(curve, tuple(levels), segments, spread)


def _is_one(levels: Sequence[Level], table: SampleTable, settings: Settings) -> None:
    """Refuse ordinary operation, in which the valve is hardly ever held."""
    held_s = sum(v.held_s for v in levels)
    all_s = max(len(table), 1) * settings.real('sample_period')
    if held_s < _HELD_LEAST * all_s:
        raise DataError(
            f'This is no step test: the opening was held for {100.0 * held_s / all_s:.0f} % of '
            f'the time only (at least {100.0 * _HELD_LEAST:.0f} % needed). Ordinary operation is '
            'identified without --step-test.'
        )


def _pressure_spread(pressure: FloatArray) -> float:
    """Return the spread in %; refuse one that makes the test something else."""
    low, high = np.quantile(pressure, (0.025, 0.975))
    spread = 100.0 * float(high - low) / float(pressure.mean())
    if spread > PRESSURE_SPREAD_PERCENT:
        raise DataError(
            f'The pressure was not constant: at the settled levels it lies between {low:.2f} and '
            f'{high:.2f} MPa, {spread:.1f} % of its mean (at most {PRESSURE_SPREAD_PERCENT:g} % '
            'for a step test). Ordinary operation is identified without --step-test.'
        )
    return spread


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
    """Return a level's settled part as the steady-state segment it is."""
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
    """Bring the line into the form of every result."""
    pieces = _pieces(line, u[inside])
    if line.cost:
        why = (
            'The pieces are the exact partition of the means of the levels, weighted by their '
            'errors; their number has the least sum of squares after a price is paid for each '
            'number a piece takes.'
        )
        gaps = zip(line.knots[1:-1].tolist(), line.knot_error.tolist(), strict=True)
        intervals = tuple(interval(knot, error) for knot, error in gaps)
    else:
        why = 'There are too few levels to look for knees: each is a knot.'
        intervals = tuple((math.nan, math.nan) for _ in pieces[1:])
    return Characteristic(
        pressure_exponent=settings.real('pressure_exponent'),
        pieces=pieces,
        breakpoint_intervals=intervals,
        choice=Choice(RULE, line.cost, {}, why),
        source=_source(table, inside, len(good), settings),
        residuals=_residuals(table, u, good, line, settings),
        partition_pieces=pieces,
        notes=notes,
    ).with_id()


def _pieces(line: BrokenLine, u: FloatArray) -> tuple[Piece, ...]:
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


def _source(table: SampleTable, inside: IntArray, levels: int, settings: Settings) -> Source:
    temperature = table.column(Signal.MAIN_STEAM_TEMPERATURE)[inside]
    temperature = temperature[np.isfinite(temperature)]
    mean = spread = math.nan
    if len(temperature):
        low, high = np.quantile(temperature, (0.025, 0.975))
        mean, spread = float(temperature.mean()), float(high - low)
    return Source(
        window_start_ns=int(table.time_ns[0]), window_end_ns=int(table.time_ns[-1]),
        steady=levels, slope_response=0, samples=len(inside), temperature_mean_degc=mean,
        temperature_spread_k=spread,
        temperature_flag=bool(spread > settings.real('temperature_spread_limit')),
    )  # fmt: skip


def _residuals(
    table: SampleTable,
    u: FloatArray,
    good: Sequence[Level],
    line: BrokenLine,
    settings: Settings,
) -> ResidualStatistics:
    """Describe the rows of the settled parts about the curve, and their block means."""
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
