"""One pass over rows: means of a minute, what they say, and sums that forget."""

from __future__ import annotations

import math

import numpy as np

from valveflow_ros.curve.regional_kernel import curve
from valveflow_ros.jit import jit
from valveflow_ros.records import NS_PER_S, FloatArray, IntArray

MINUTE_NS = 60 * NS_PER_S
BLOCK_NS = 7200 * NS_PER_S
_DAY_NS = 86400 * NS_PER_S
MEMORY_BLOCKS = 36.0  # three days
_MEMORY_MINUTES = 4320.0
BINS = 12
OFFSET, GAIN, INPUT, TEMPERATURE, COSINE, SINE, DIRECTION, LAG_LOW, LAG_HIGH = range(9)
MOVE = 9  # answers to the move of this minute, of the one before and of the one before that
MOVES = 3
BIN = MOVE + MOVES
FEATURES = BIN + BINS
# Half the band in which a change of u is no move, as a share of u.
_PLAY = 0.005

# What a block adds up for each statistic (block), and the sums over blocks that forget (kept).
S, Q, N = range(3)
(SUM_S, SUM_Q, SUM_N, SUM_SS, SUM_SQ, SUM_QQ, NEXT_SS, NEXT_SQ, NEXT_QS, NEXT_QQ, LAST_S,
 LAST_Q) = range(12)  # fmt: skip
KEPT = 12
# Of the minute at hand.
_R, _X, _D, _U, _T, _GOOD, _WARM = range(7)
MINUTE = 7
# Numbers that live on: squares of the residual and their count, both forgetting; the mean
# temperature and its weight; the middle of the play; the flows of the last minutes.
POWER, COUNT, MEAN_T, WEIGHT_T, PLAY, PAST = range(6)
STATE = PAST + MOVES + 1
AT_MINUTE, AT_BLOCK, BLOCKS = range(3)


@jit
def _forget_past(state: FloatArray) -> None:
    state[PAST : PAST + MOVES + 1] = np.nan


@jit
def _play(state: FloatArray, u: float) -> float:
    """Move the play along; return where in it u stands, -1 falling to 1 rising."""
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
    """Return the mean temperature less its mean so far, which this minute then joins."""
    if minute[_WARM] == 0.0:
        return 0.0
    t = minute[_T] / minute[_WARM]
    off = t - state[MEAN_T] if state[WEIGHT_T] > 0.0 else 0.0
    state[WEIGHT_T] = min(state[WEIGHT_T] + 1.0, _MEMORY_MINUTES)
    state[MEAN_T] += (t - state[MEAN_T]) / state[WEIGHT_T]
    return float(off)


@jit
def _features(
    middle_ns: int, minute: FloatArray, state: FloatArray, knots: FloatArray, left: FloatArray,
    right: FloatArray, z: FloatArray,
) -> None:  # fmt: skip
    """Write what the residual of a minute would be in proportion to, statistic by statistic."""
    good = minute[_GOOD]
    x, answer, u = minute[_X] / good, minute[_D] / good, minute[_U] / good
    low, high = knots[0], knots[-1]
    step = 1e-3 * (high - low)
    below, above = max(low, u - step), min(high, u + step)
    rise = curve(above, knots, left, right) - curve(below, knots, left, right)
    swing = u * rise / max(above - below, 1e-12)
    whole = max(abs(right[-1]), abs(left[0]), 1e-9)
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
def _end_minute(
    middle_ns: int, minute: FloatArray, state: FloatArray, knots: FloatArray, left: FloatArray,
    right: FloatArray, block: FloatArray, z: FloatArray,
) -> None:  # fmt: skip
    """Add a whole minute to the block."""
    _features(middle_ns, minute, state, knots, left, right, z)
    r = minute[_R] / minute[_GOOD]
    state[POWER] += r * r
    state[COUNT] += 1.0
    for j in range(FEATURES):
        if z[j] != 0.0:
            block[j, S] += r * z[j]
            block[j, Q] += z[j] * z[j]
            block[j, N] += 1.0


@jit
def _end_block(follows: int, block: FloatArray, kept: FloatArray, state: FloatArray) -> None:
    """Add a block to the sums that forget; ``follows`` is how many blocks on the next one is."""
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
def run(
    time_ns: IntArray,
    u: FloatArray,
    temperature: FloatArray,
    static: FloatArray,
    dynamic: FloatArray,
    residual: FloatArray,
    minute_ns: int,
    least: int,
    knots: FloatArray,
    left: FloatArray,
    right: FloatArray,
    place: IntArray,
    minute: FloatArray,
    state: FloatArray,
    block: FloatArray,
    kept: FloatArray,
    z: FloatArray,
) -> None:
    """Run rows; a minute and a block are judged by the first row behind them.

    Parameters
    ----------
    minute_ns : int
        Length of a minute; longer than one where rows are rarer.
    least : int
        Rows without which a minute does not count.
    place : int64 (3,)
        Number of the minute and of the block at hand, -1 before the first, and blocks ended.
    minute (MINUTE,), state (STATE,), block (FEATURES, 3), kept (FEATURES, KEPT), z (FEATURES,)
        The memory, and room.
    """
    for t in range(u.size):
        now = time_ns[t] // minute_ns
        if now != place[AT_MINUTE]:
            if minute[_GOOD] >= least:
                middle_ns = place[AT_MINUTE] * minute_ns + minute_ns // 2
                _end_minute(middle_ns, minute, state, knots, left, right, block, z)
            else:
                _forget_past(state)
            if now != place[AT_MINUTE] + 1:
                _forget_past(state)
            minute[:] = 0.0
            here = time_ns[t] // BLOCK_NS
            if place[AT_BLOCK] >= 0 and here > place[AT_BLOCK]:
                _end_block(here - place[AT_BLOCK], block, kept, state)
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
