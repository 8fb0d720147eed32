# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Check with little computation whether the model still fits.

The control chart of the residual detects an error of the mean power. A fault at one load, in one
direction, at one time of day or after moves may not change the mean residual. So the residual of
each minute is regressed on the expected pattern of such faults: one scalar recursive least squares
estimate per statistic, with a memory of three days. The standard errors come from the scores of
blocks of two hours and of neighbouring blocks (White; Newey and West, Econometrica 55, 1987), so
that neither the correlation of the residual nor the load dependence of its noise must be known.
The result is that the model does not fit, with a hint at most; finding the cause needs the whole
record (`valveflow_ros.diagnosis`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from valveflow_ros.curve.regional_model import RegionalModel, curve
from valveflow_ros.monitoring.prediction import PredictionBlock
from valveflow_ros.numerics import jit
from valveflow_ros.records import NS_PER_S, FloatArray, IntArray
from valveflow_ros.state import Memory

MINUTE_NS = 60 * NS_PER_S
BLOCK_NS = 7200 * NS_PER_S
_DAY_NS = 86400 * NS_PER_S
MEMORY_BLOCKS = 36.0  # three days
_MEMORY_MINUTES = 4320.0
BINS = 12
OFFSET, GAIN, INPUT, TEMPERATURE, COSINE, SINE, DIRECTION, LAG_LOW, LAG_HIGH = range(9)
MOVE = 9  # responses to the moves of this minute and of the two minutes before
MOVES = 3
BIN = MOVE + MOVES
FEATURES = BIN + BINS
# Half width of the play operator for the direction of u, as a fraction of u.
_PLAY = 0.005

# Sums over a block for each statistic (block), and sums over blocks with forgetting (kept).
S, Q, N = range(3)
(SUM_S, SUM_Q, SUM_N, SUM_SS, SUM_SQ, SUM_QQ, NEXT_SS, NEXT_SQ, NEXT_QS, NEXT_QQ, LAST_S,
 LAST_Q) = range(12)  # fmt: skip
KEPT = 12
# Sums over the current minute.
_R, _X, _D, _U, _T, _GOOD, _WARM = range(7)
MINUTE = 7
# State: sum of squared residuals and their count, both with forgetting; the mean temperature
# and its weight; the middle of the play; the flows of the last minutes.
POWER, COUNT, MEAN_T, WEIGHT_T, PLAY, PAST = range(6)
STATE = PAST + MOVES + 1
AT_MINUTE, AT_BLOCK, BLOCKS = range(3)


class _Curve(NamedTuple):
    knots: FloatArray
    left: FloatArray
    right: FloatArray


class _Sums(NamedTuple):
    place: IntArray  # number of the current minute and block, -1 before the first; ended blocks
    minute: FloatArray  # (MINUTE,)
    state: FloatArray  # (STATE,)
    block: FloatArray  # (FEATURES, 3)
    kept: FloatArray  # (FEATURES, KEPT)
    z: FloatArray  # (FEATURES,)


@jit
def _forget_past(state: FloatArray) -> None:
    state[PAST : PAST + MOVES + 1] = np.nan


@jit
def _play(state: FloatArray, u: float) -> float:
    """Update the play operator; return the position of u in it, -1 falling to 1 rising."""
    half = _PLAY * abs(u)
    if half == 0.0:
        return 0.0
    middle = state[PLAY]
    if math.isnan(middle):
        middle = u
    middle = min(max(middle, u - half), u + half)
    state[PLAY] = middle
    return float((u - middle) / half)


@jit
def _warm(state: FloatArray, minute: FloatArray) -> float:
    """Return the temperature minus its mean so far, then update that mean."""
    if minute[_WARM] == 0.0:
        return 0.0
    t = minute[_T] / minute[_WARM]
    off = t - state[MEAN_T] if state[WEIGHT_T] > 0.0 else 0.0
    state[WEIGHT_T] = min(state[WEIGHT_T] + 1.0, _MEMORY_MINUTES)
    state[MEAN_T] += (t - state[MEAN_T]) / state[WEIGHT_T]
    return float(off)


@jit
def _features(middle_ns: int, f: _Curve, sums: _Sums) -> None:
    """Write the regressor of each statistic for the residual of a minute."""
    minute, state, z = sums.minute, sums.state, sums.z
    good = minute[_GOOD]
    x, answer, u = minute[_X] / good, minute[_D] / good, minute[_U] / good
    low, high = f.knots[0], f.knots[-1]
    step = 1e-3 * (high - low)
    below, above = max(low, u - step), min(high, u + step)
    rise = curve(above, f.knots, f.left, f.right) - curve(below, f.knots, f.left, f.right)
    swing = u * rise / max(above - below, 1e-12)
    whole = max(abs(f.right[-1]), abs(f.left[0]), 1e-9)
    share = min(max((u - low) / (high - low), 0.0), 1.0)
    z[:] = 0.0
    z[OFFSET] = 1.0
    z[GAIN] = x / whole
    z[INPUT] = swing / whole
    z[TEMPERATURE] = _warm(state, minute) * x / whole
    angle = 2.0 * math.pi * (middle_ns % _DAY_NS) / _DAY_NS
    z[COSINE] = math.cos(angle) * x / whole
    z[SINE] = math.sin(angle) * x / whole
    z[DIRECTION] = _play(state, u) * swing / whole
    if math.isfinite(answer):
        z[LAG_LOW if share < 0.5 else LAG_HIGH] = x - answer
    for k in range(MOVES, 0, -1):
        state[PAST + k] = state[PAST + k - 1]
    state[PAST] = x
    for k in range(MOVES):
        move = state[PAST + k] - state[PAST + k + 1]
        z[MOVE + k] = move if math.isfinite(move) else 0.0
    place = share * (BINS - 1)
    k = min(int(place), BINS - 2)
    z[BIN + k] = 1.0 - (place - k)
    z[BIN + k + 1] = place - k


@jit
def _end_minute(middle_ns: int, f: _Curve, sums: _Sums) -> None:
    """Add a complete minute to the block."""
    minute, state, block, z = sums.minute, sums.state, sums.block, sums.z
    _features(middle_ns, f, sums)
    r = minute[_R] / minute[_GOOD]
    state[POWER] += r * r
    state[COUNT] += 1.0
    for j in range(FEATURES):
        if z[j] != 0.0:
            block[j, S] += r * z[j]
            block[j, Q] += z[j] * z[j]
            block[j, N] += 1.0


@jit
def _end_block(follows: int, sums: _Sums) -> None:
    """Add a block to the sums; ``follows`` is the number of blocks until the next one."""
    block, kept, state = sums.block, sums.kept, sums.state
    forget = math.exp(-follows / MEMORY_BLOCKS)
    twice = forget * forget
    state[POWER] *= forget
    state[COUNT] *= forget
    for j in range(FEATURES):
        k = kept[j]
        s, q = block[j, S], block[j, Q]
        before_s, before_q = k[LAST_S], k[LAST_Q]
        k[SUM_S] = forget * (k[SUM_S] + s)
        k[SUM_Q] = forget * (k[SUM_Q] + q)
        k[SUM_N] = forget * (k[SUM_N] + block[j, N])
        k[SUM_SS] = twice * (k[SUM_SS] + s * s)
        k[SUM_SQ] = twice * (k[SUM_SQ] + s * q)
        k[SUM_QQ] = twice * (k[SUM_QQ] + q * q)
        k[NEXT_SS] = twice * (k[NEXT_SS] + s * before_s)
        k[NEXT_SQ] = twice * (k[NEXT_SQ] + s * before_q)
        k[NEXT_QS] = twice * (k[NEXT_QS] + q * before_s)
        k[NEXT_QQ] = twice * (k[NEXT_QQ] + q * before_q)
        k[LAST_S], k[LAST_Q] = (s, q) if follows == 1 else (0.0, 0.0)
    block[:] = 0.0


@jit
def _run(
    time_ns: IntArray, u: FloatArray, temperature: FloatArray, static: FloatArray,
    dynamic: FloatArray, residual: FloatArray, minute_ns: int, least: int, f: _Curve, sums: _Sums,
) -> None:  # fmt: skip
    """Process rows; a minute or block ends with the first row after it.

    ``minute_ns`` is longer than a minute if the step of the rows is; a minute counts if it has
    ``least`` rows.
    """
    place, minute, state = sums.place, sums.minute, sums.state
    for t in range(u.size):
        now = time_ns[t] // minute_ns
        if now != place[AT_MINUTE]:
            if minute[_GOOD] >= least:
                middle_ns = place[AT_MINUTE] * minute_ns + minute_ns // 2
                _end_minute(middle_ns, f, sums)
            else:
                _forget_past(state)
            if now != place[AT_MINUTE] + 1:
                _forget_past(state)
            minute[:] = 0.0
            here = time_ns[t] // BLOCK_NS
            if place[AT_BLOCK] >= 0 and here > place[AT_BLOCK]:
                _end_block(here - place[AT_BLOCK], sums)
                place[BLOCKS] += 1
            place[AT_MINUTE], place[AT_BLOCK] = now, here
        if math.isfinite(residual[t]):
            minute[_GOOD] += 1.0
            minute[_R] += residual[t]
            minute[_X] += static[t]
            minute[_D] += dynamic[t]
            minute[_U] += u[t]
            if math.isfinite(temperature[t]):
                minute[_T] += temperature[t]
                minute[_WARM] += 1.0


# Effects below this fraction of the residual's sd are not reported, even if significant.
FLOOR = 0.05
# Effective number of two-hour blocks needed to judge a statistic.
LEAST_BLOCKS = 10.0
NAMES = (
    'offset', 'gain', 'input', 'temperature', 'time of day (cosine)', 'time of day (sine)',
    'direction', 'lag at low load', 'lag at high load',
    *(f'move {minutes} min ago' for minutes in range(MOVES)),
    *(f'bin {number} of u' for number in range(BINS)),
)  # fmt: skip


class Misfit(NamedTuple):
    """The largest statistic; `NOTHING` if nothing can be judged."""

    score: float  # signed, as a standard normal deviate
    name: str  # one of `NAMES`
    hint: str  # variable on which the residual depends, as the end of a sentence


NOTHING = Misfit(0.0, '', '')


class Mismatch(Memory):
    """Recursive statistics of the residual, with constant memory and time per row."""

    REMEMBERED = ('_place', '_minute', '_z', '_state', '_block', '_kept', '_ends')

    def __init__(self, step_s: float) -> None:
        self._minute_ns = max(MINUTE_NS, round(step_s * NS_PER_S))
        self._least = max(1, math.ceil(0.5 * self._minute_ns / NS_PER_S / step_s))
        self._place = np.array([-1, -1, 0], dtype=np.int64)
        self._minute, self._z = np.zeros(MINUTE), np.zeros(FEATURES)
        self._state = np.zeros(STATE)
        self._state[PLAY:] = math.nan
        self._block, self._kept = np.zeros((FEATURES, 3)), np.zeros((FEATURES, KEPT))
        self._ends = 0.0, 0.0

    def feed(
        self, block: PredictionBlock, temperature_degc: FloatArray, model: RegionalModel
    ) -> None:
        """Process rows that ``model`` has predicted; the statistics continue with a new model."""
        self._ends = float(model.knots[0]), float(model.knots[-1])
        _run(
            block.time_ns, block.u, temperature_degc, block.static_mw, block.dynamic_mw,
            block.residual_mw, self._minute_ns, self._least,
            _Curve(model.knots, model.left, model.right),
            _Sums(self._place, self._minute, self._state, self._block, self._kept, self._z),
        )  # fmt: skip

    def scores(self) -> FloatArray:
        """Return the statistics as normal deviates, shape (len(NAMES),); 0 where not judged."""
        with np.errstate(over='ignore', invalid='ignore'):
            theta, spread, blocks = self._estimates()
        # Values whose squares overflow are not judged.
        judged = (blocks >= LEAST_BLOCKS) & (spread > 0.0) & np.isfinite(theta + spread)
        t = np.divide(theta, spread, out=np.zeros_like(theta), where=judged)
        # Student's t as the normal deviate of equal probability (Wallace, 1959).
        n = np.maximum(blocks - 1.0, 1.0)
        factor = (8.0 * n + 1.0) / (8.0 * n + 3.0)
        return np.asarray(np.sign(t) * factor * np.sqrt(n * np.log1p(t * t / n)))

    def judge(self, place: Callable[[float], str] = 'u = {:.0f}'.format) -> Misfit:
        """Return the largest statistic."""
        scores = self.scores()
        j = int(np.argmax(np.abs(scores)))
        if scores[j] == 0.0:
            return NOTHING
        effect = self._estimates()[0][j] * self._size()[j]
        return Misfit(float(scores[j]), NAMES[j], self._hint(j, float(effect), place))

    def _size(self) -> FloatArray:
        """Return the root mean square of each regressor."""
        count = np.maximum(self._kept[:, SUM_N], 1.0)
        return np.asarray(np.sqrt(self._kept[:, SUM_Q] / count))

    def _estimates(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return estimates, their standard errors, and their effective numbers of blocks."""
        kept = self._kept
        q, qq = kept[:, SUM_Q], kept[:, SUM_QQ]
        there = (q > 0.0) & (qq > 0.0)
        q = np.where(there, q, 1.0)
        theta = np.where(there, kept[:, SUM_S] / q, 0.0)
        own = kept[:, SUM_SS] - 2.0 * theta * kept[:, SUM_SQ] + theta**2 * qq
        cross = (
            kept[:, NEXT_SS] - theta * (kept[:, NEXT_SQ] + kept[:, NEXT_QS])
            + theta**2 * kept[:, NEXT_QQ]
        )  # fmt: skip
        own = np.maximum(own, 0.0)
        variance = np.maximum(own, own + 2.0 * cross) / q**2
        noise = math.sqrt(self._state[POWER] / max(self._state[COUNT], 1.0))
        floor = FLOOR * noise / np.where(there, self._size(), 1.0)
        spread = np.where(there, np.sqrt(variance + floor**2), 0.0)
        return theta, spread, np.where(there, q**2 / np.where(there, qq, 1.0), 0.0)

    def _hint(self, j: int, effect: float, place: Callable[[float], str]) -> str:
        """Return the meaning of a statistic in words; ``effect`` in MW."""
        size, side = f'{abs(effect):.2g} MW', 'more' if effect > 0.0 else 'less'
        mean = 'on average'
        if j >= BIN:
            low, high = self._ends
            at = low + (high - low) * (j - BIN) / (BINS - 1)
            return f'at about {place(at)} the unit gives {size} {side} than the model predicts'
        if j >= MOVE:
            return f'in the minutes after a move of the valve the power differs by {size}'
        if j in (LAG_LOW, LAG_HIGH):
            how = 'faster' if effect > 0.0 else 'more slowly'
            load = 'low' if j == LAG_LOW else 'high'
            return f'at {load} load the power follows the valve {how} than the model predicts'
        if j == DIRECTION:
            apart = f'{2.0 * abs(effect):.2g} MW'
            return f'at the same opening the power differs by {apart} between opening and closing'
        return {
            OFFSET: f'the unit gives {size} {side} than the model predicts {mean}',
            GAIN: f'the unit gives {size} {side} than the model predicts {mean}, in proportion to '
            'the load',
            INPUT: f'the unit gives {size} {side} than the model predicts {mean}, most where the '
            'curve is steep',
            TEMPERATURE: f'the power changes with the main steam temperature, by {size} {mean}',
        }.get(j, f'the power varies with the time of day, by {size} {mean}')
