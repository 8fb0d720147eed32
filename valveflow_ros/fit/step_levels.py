# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The levels of a manual step test: openings that are held, and the settled part of each."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from valveflow_ros.errors import short
from valveflow_ros.fit.whitening import yule_walker
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S, FloatArray, IntArray, SampleTable, Signal

_LEAST_STEP_PERCENT = 0.3  # smaller changes of the opening are noise within a level
_MAD_TO_SD = 1.4826022185056018
_NOISES = 6.0  # and so are changes within this many noise sd
# The median move of a test, in smallest steps. Of 33 records of control loops that the other
# conditions leave, it is at most 2.1; in tests with steps of 3 % it is 10.
_CLEAR_STEP = 3.0
_SURE = 3.0  # a level is moving if its halves differ by more than this many standard errors
_ORDER = 2  # of the autoregressive model of the block means
_LARGEST_SUM = 0.95
_ROUNDS = 8
_GAP = 1.5  # a larger step between rows, in sample periods, is a gap
_DUST = 1e-6  # minimum error of a power, as a fraction


@dataclass(frozen=True, slots=True)
class Level:
    """An opening that was held."""

    # first, end: rows of its settled part, ``[first, end)``; equal if it has none
    first: int
    end: int
    held_s: float  # time for which it was held, including the transient
    # opening_percent, pressure_mpa, u, power_mw: means over the settled part; without one they are
    # NaN, except the opening
    opening_percent: float
    pressure_mpa: float
    u: float
    power_mw: float
    power_error_mw: float  # standard error of the mean power; it allows for correlation in time
    problem: str  # why the level is not used, as the end of a sentence; empty if it is used

    @property
    def samples(self) -> int:
        """Return the number of rows of the settled part."""
        return self.end - self.first


def holds(
    opening: FloatArray, block: int, least_blocks: int, gaps: Sequence[int] = ()
) -> list[tuple[int, int]]:
    """Return the stretches ``[first, end)`` of rows in which the opening was held.

    A stretch ends when a block mean differs from the running mean of the stretch by more than
    the smallest step and by more than the noise explains. Stretches shorter than
    ``least_blocks`` blocks are moves. ``gaps`` are the rows after a gap in time: the movement
    of the valve is unknown there, so no stretch contains a gap.
    """
    limit = _least_step(opening, block)
    edges = itertools.pairwise([0, *gaps, len(opening)])
    return [
        (begin + a, begin + b)
        for begin, end in edges
        for a, b in _stretches(opening[begin:end], block, least_blocks, limit)
    ]


def _least_step(opening: FloatArray, block: int) -> float:
    """Return the smallest change between block means that is no noise, %."""
    return max(_LEAST_STEP_PERCENT, _NOISES * _white(opening) / math.sqrt(block))


def _stretches(
    opening: FloatArray, block: int, least_blocks: int, limit: float
) -> list[tuple[int, int]]:
    """Return the held stretches of rows without a gap."""
    blocks = len(opening) // block
    table = opening[: blocks * block].reshape(blocks, block)
    good = np.asarray(np.isfinite(table).all(axis=1))
    means = np.where(good, np.where(good[:, None], table, 0.0).mean(axis=1), math.nan)
    found: list[tuple[int, int]] = []
    begin, total = 0, 0.0
    for k in range(blocks + 1):
        count = k - begin
        goes_on = k < blocks and bool(good[k])
        if goes_on and (count == 0 or abs(means[k] - total / count) <= limit):
            total += means[k]
            continue
        if count >= least_blocks:
            found.append((begin * block, k * block))
        begin, total = (k, float(means[k])) if goes_on else (k + 1, 0.0)
    return found


def _white(opening: FloatArray) -> float:
    """Return the sd of the opening's white noise, without the effect of moves."""
    bends = np.abs(np.diff(opening, 2))
    bends = bends[np.isfinite(bends)]
    return _MAD_TO_SD * float(np.median(bends)) / math.sqrt(6.0) if len(bends) else 0.0


def find_levels(table: SampleTable, u: FloatArray, settings: Settings) -> list[Level]:
    """Return all levels in chronological order, including those that are not used.

    Parameters
    ----------
    table : SampleTable
    u : float64 (n,)
        Integrated input of each row.
    settings : Settings
        ``time_constant`` and ``delay`` give the transient 5 T + tau that is ignored,
        ``steady_min`` the minimum time after it (a shorter hold is no level),
        ``block`` the length of means.

    Notes
    -----
    One level is too short to estimate the correlation time of its noise. So the error of a mean
    is estimated from all other levels together, and finally from all levels that are used.
    """
    step_s = settings.real('sample_period')
    block = max(1, round(settings.real('block') / step_s))
    opening = table.column(Signal.VALVE_OPENING)
    usable = np.isfinite(u) & np.isfinite(table.column(Signal.GENERATED_POWER))
    settle = math.ceil(settings.settle_s / step_s)
    least = max(2, math.ceil(settings.real('steady_min') / step_s))
    gaps = np.flatnonzero(np.diff(table.time_ns) > _GAP * step_s * NS_PER_S) + 1
    held = holds(
        np.where(usable, opening, math.nan), block, max(3, math.ceil(least / block)),
        gaps.tolist(),
    )  # fmt: skip
    parts = [(a + settle, b) if b - a >= settle + least else (b, b) for a, b in held]
    # If a log begins during a hold, its earlier duration is unknown: ignore a transient, too.
    power = np.ascontiguousarray(table.column(Signal.GENERATED_POWER))
    settled = [k for k, (a, b) in enumerate(parts) if b > a]
    blocks = {k: _means(power[slice(*parts[k])], block) for k in settled}
    least_sd = _resolution([power[slice(*parts[k])] for k in settled]) / math.sqrt(block)
    moving = {k for k in settled if _moves(blocks, k, least_sd)}
    sd = long_run_sd([blocks[k] for k in settled if k not in moving] or list(blocks.values()))
    sd = max(sd, least_sd)
    return [
        _level(table, u, span, part, sd * math.sqrt(block), k in moving, settings)
        for k, (span, part) in enumerate(zip(held, parts, strict=True))
    ]


def _means(values: FloatArray, block: int) -> FloatArray:
    """Return block means; an incomplete block at the end is ignored."""
    count = max(1, len(values) // block)
    width = min(block, len(values))
    return np.asarray(values[: count * width].reshape(count, width).mean(axis=1))


def _resolution(parts: Sequence[FloatArray]) -> float:
    """Return the sd of rounding in MW: even a constant power has an error.

    It follows from the smallest step between the logged powers. It is never 0: a level
    without an error would have an infinite weight.
    """
    values = np.unique(np.concatenate([*parts, np.empty(0)]))
    if not len(values):
        return 0.0
    span = float(values[-1] - values[0])
    steps = np.diff(values)
    steps = steps[steps > _DUST * span]
    step = float(steps.min()) if len(steps) else 0.0
    size = span if span > 0.0 else max(1.0, float(np.abs(values).max()))
    return max(step / math.sqrt(12.0), _DUST * size)


def _moves(blocks: dict[int, FloatArray], k: int, least_sd: float) -> bool:
    """Return True if the halves of a level differ by more than the others' noise explains."""
    others = [v for number, v in blocks.items() if number != k]
    own = blocks[k]
    half = len(own) // 2
    if not others or half < 1:
        return False
    error = max(long_run_sd(others), least_sd) / math.sqrt(len(own))
    return bool(abs(own[half:].mean() - own[:half].mean()) > _SURE * 2.0 * error)


def long_run_sd(series: Sequence[FloatArray]) -> float:
    """Return ``sd`` such that the mean of n values of this noise has the error ``sd / sqrt(n)``.

    Parameters
    ----------
    series : sequence of float64 (n,)
        Stretches of the same noise, each with its own mean.

    Notes
    -----
    The result is that of a Yule-Walker AR model. Subtracting its own mean from each stretch
    reduces every autocovariance by the variance V of that mean. V is added again and
    recomputed from the model, for a fixed number of iterations.
    """
    rest = [v - v.mean() for v in series]
    lags = range(_ORDER + 1)
    pairs = [sum(max(0, len(v) - k) for v in rest) for k in lags]
    products = [sum(float(v[k:] @ v[: len(v) - k]) for v in rest if len(v) > k) for k in lags]
    if not products[0] > 0.0:
        return 0.0
    if min(pairs) < 4 * _ORDER:
        return math.sqrt(products[0] / max(1, pairs[0] - len(rest)))
    found = np.array(products) / np.array(pairs)
    length = float(np.mean([len(v) for v in rest]))
    of_mean = 0.0
    for _ in range(_ROUNDS):
        covariance = found + of_mean
        covariance[0] *= 1.0 + 1e-9  # keeps the system solvable for almost constant values
        ar = yule_walker(covariance)
        total = min(float(ar.sum()), _LARGEST_SUM)
        innovation = max(float(covariance[0] - ar @ covariance[1:]), 0.0)
        long_run = innovation / (1.0 - total) ** 2
        of_mean = long_run / length
    return math.sqrt(long_run)


def _level(
    table: SampleTable,
    u: FloatArray,
    span: tuple[int, int],
    part: tuple[int, int],
    row_sd: float,
    moving: bool,
    settings: Settings,
) -> Level:
    step_s = settings.real('sample_period')
    a, b = part
    held_s = (span[1] - span[0]) * step_s
    opening = table.column(Signal.VALVE_OPENING)
    if a == b:
        nan = math.nan
        mean = float(np.mean(opening[slice(*span)]))
        told = (
            f'was held for {held_s:.0f} s only, and after a move the first '
            f'{settings.settle_s:.0f} s do not count'
        )
        return Level(a, b, held_s, mean, nan, nan, nan, nan, told)
    power = table.column(Signal.GENERATED_POWER)[a:b]
    half = (b - a) // 2
    moved = float(power[half:].mean() - power[:half].mean())
    problem = ''
    if moving:
        went = short(2.0 * moved, 1, '+')
        problem = f'had not settled: its power still went by {went} MW while it was held'
    return Level(
        a, b, held_s, float(opening[a:b].mean()),
        float(table.column(Signal.MAIN_STEAM_PRESSURE)[a:b].mean()), float(u[a:b].mean()),
        float(power.mean()), row_sd / math.sqrt(b - a), problem,
    )  # fmt: skip


def looks_like_step_test(table: SampleTable, settings: Settings) -> bool:
    """Return True if the opening was changed by hand: few levels, held most of the time.

    Load control moves the valve even at constant load, so that within a few minutes it moves
    by more than its noise. In rows far apart these moves are taken for noise; the levels of such
    a record are then close together, and those of a test are not.
    """
    step_s = settings.real('sample_period')
    block = max(1, round(settings.real('block') / step_s))
    opening = table.column(Signal.VALVE_OPENING)
    good = opening[np.isfinite(opening)]
    if len(good) < 10 * block or float(np.ptp(good)) < 3.0:
        return False
    held = holds(opening, block, max(3, math.ceil(60.0 / (block * step_s))))
    inside: IntArray = np.array([b - a for a, b in held], dtype=np.int64)
    if not (3 <= len(held) <= 200 and inside.sum() >= 0.8 * len(good)):
        return False
    moves = np.abs(np.diff([np.nanmean(opening[a:b]) for a, b in held]))
    return bool(np.median(moves) > _CLEAR_STEP * _least_step(opening, block))
