# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The streaming piecewise linear representation of u and power, row by row.

Rows are averaged over short blocks. A straight line is fitted to u from the last
break on. The next break is where two consecutive blocks or a mean over a minute
deviate from the line. After a break the first 5 T + tau are transient, eq. (13)
of the paper, and are ignored. From then on a line is also fitted to the power,
and a deviation from it is a break, too. The blocks between the end of the
transient and the next break are classified by `judge`.

All state lives in arrays, so that it can be copied, saved and compared.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from valveflow_ros.numerics import copied, helper, jit
from valveflow_ros.records import ByteArray, FloatArray, IntArray

# A line fitted recursively is five running sums over (k, v), k = 0, 1, 2, ... and v taken
# relative to the first point, so that a large offset causes no loss of digits.
N, ORIGIN, SV, SKV, SVV = range(5)
LINE_SIZE = 5


@helper
def line_reset(line: FloatArray) -> None:
    """Forget all points."""
    line[:] = 0.0


@helper
def line_add(line: FloatArray, value: float) -> None:
    """Append the next point."""
    if line[N] == 0.0:
        line[ORIGIN] = value
    v = value - line[ORIGIN]
    k = line[N]
    line[N] += 1.0
    line[SV] += v
    line[SKV] += k * v
    line[SVV] += v * v


@helper
def line_fit(line: FloatArray) -> tuple[float, float, float]:
    """Return mean, slope per point, and rms residual (n - 2 degrees of freedom).

    Two points or fewer have no residual (0); one point has no slope (0).
    """
    n = line[N]
    if n < 1.0:
        return math.nan, 0.0, 0.0
    mean = line[SV] / n
    if n < 2.0:
        return mean + line[ORIGIN], 0.0, 0.0
    middle = (n - 1.0) / 2.0
    sxx = n * (n * n - 1.0) / 12.0
    sxy = line[SKV] - middle * line[SV]
    slope = sxy / sxx
    if n < 3.0:
        return mean + line[ORIGIN], slope, 0.0
    rest = line[SVV] - line[SV] * mean - slope * sxy
    return mean + line[ORIGIN], slope, math.sqrt(max(rest, 0.0) / (n - 2.0))


@helper
def line_ahead(line: FloatArray, steps: float) -> tuple[float, float]:
    """Extrapolate to ``steps`` points after the last one.

    Return the value, and the ratio ``sqrt(1 + leverage)`` of the error of a new
    point there to the noise sd.
    """
    mean, slope, _ = line_fit(line)
    n = line[N]
    x = n - 1.0 + steps - (n - 1.0) / 2.0
    spread = n * (n * n - 1.0) / 12.0
    leverage = 1.0 / n + (x * x / spread if spread > 0.0 else 0.0)
    return mean + slope * x, math.sqrt(1.0 + leverage)


# Online estimate of the signals' noise.
#
# Each stretch of `WINDOW` block means gives one rms about its own straight line.
# These values are collected in a histogram on a log scale. The noise is a low
# quantile of it: stretches that contain moves only fill its upper end. A stretch
# of seven minutes is long enough to contain the slow motion of a valve under
# load control; in a shorter one this motion would look like a trend.

WINDOW = 42  # block means per stretch
BINS = 480
_PER_DECADE = 40.0
_LOWEST = -6.0  # log10 of the histogram's lower end
QUANTILE = 0.4
WARM_UP = 4  # minimum number of stretches for an estimate
FORGET_AT = 4000.0  # stretches after which all counts are halved (about three weeks)


@helper
def noise_add(histogram: FloatArray, rms: float) -> None:
    """Add one stretch's rms; halve all counts when their sum is large.

    An exactly constant signal contains no information on its noise.
    """
    if not 10.0**_LOWEST < rms < 10.0 ** (_LOWEST + BINS / _PER_DECADE):
        return
    place = min(max(int((math.log10(rms) - _LOWEST) * _PER_DECADE), 0), BINS - 1)
    histogram[place] += 1.0
    if histogram.sum() >= FORGET_AT:
        histogram *= 0.5


@helper
def noise_level(histogram: FloatArray) -> float:
    """Return the noise sd: the quantile, interpolated inside its bin."""
    wanted = QUANTILE * histogram.sum()
    below = 0.0
    for k in range(histogram.size):
        count = histogram[k]
        if count > 0.0 and below + count >= wanted:
            inside = (wanted - below) / count
            return float(10.0 ** (_LOWEST + (k + inside) / _PER_DECADE))
        below += count
    return 0.0


# Integer state.
(ROW, ROWS_IN_BLOCK, BLOCKS, FIRST_ROW, SKIP, RUN_U, RUN_Y, STRETCHES, IN_STRETCH, LAST_NS,
 END_NS) = range(11)  # fmt: skip
INT_STATE = 11

# The current block: sums of u, power, temperature, and the number of temperatures.
BLOCK_T_COUNT = 3
SUMS = 4

# Rows of `lines`: u up to now, u up to a minute ago, power, and the noise stretch of each.
LINE_U, LINE_U_BEHIND, LINE_Y, STRETCH_U, STRETCH_Y = range(5)
LINES = 5

# Rows of `blocks`: means of u, power and temperature of the open segment.
BLOCK_U, BLOCK_Y, BLOCK_T = range(3)

# Settings in the form of the kernel.
(BLOCK_ROWS, SETTLE, LONGEST, STEADY_MIN, SLOPE_MIN, TRIM, BREAK, STEADY, SLOPE, NOISE_U, NOISE_Y,
 PERIOD_NS) = range(12)  # fmt: skip

_BEHIND = 6  # blocks whose mean is compared with the line before them
_BEHIND_LIMIT = 2.5  # in sd of that mean, with half the blocks taken as independent
_LEAST = 6  # minimum number of blocks of a line
_ROUGH = 2.0  # a segment with a larger rms residual, in noise sd, is no straight line

# Values that describe a finished segment.
(SEG_FIRST, SEG_END, SEG_KIND, SEG_U_MEAN, SEG_U_SLOPE, SEG_U_RMS, SEG_Y_MEAN, SEG_Y_SLOPE,
 SEG_Y_RMS, SEG_T) = range(10)  # fmt: skip
SEG_SIZE = 10

# Kind of a row, as far as known when it arrives.
TRANSIENT, SETTLED_STEADY, SETTLED_SLOPE, NO_DATA = range(4)


class Arrays(NamedTuple):
    """The arrays of one segmentation: state, settings and the last segment found."""

    state: IntArray  # (INT_STATE,)
    sums: FloatArray  # (SUMS,)
    lines: FloatArray  # (LINES, LINE_SIZE)
    blocks: FloatArray  # (3, room)
    histograms: FloatArray  # (2, BINS)
    setting: FloatArray  # (12,)
    found: FloatArray  # (SEG_SIZE,)


@jit
def noise_now(histograms: FloatArray, setting: FloatArray) -> tuple[float, float]:
    """Return the noise sd of u and of the power; a given value overrides the estimate."""
    u = setting[NOISE_U] if setting[NOISE_U] > 0.0 else noise_level(histograms[0])
    y = setting[NOISE_Y] if setting[NOISE_Y] > 0.0 else noise_level(histograms[1])
    # Exact straight lines have no noise; their rounding must not cause a break.
    return max(u, 1e-6), max(y, 1e-6)


@copied
def _learn(a: Arrays, u: float, y: float) -> None:
    """Add one block to the current noise stretch and close it when it is long enough."""
    state, lines = a.state, a.lines
    line_add(lines[STRETCH_U], u)
    line_add(lines[STRETCH_Y], y)
    state[IN_STRETCH] += 1
    if state[IN_STRETCH] == WINDOW:
        noise_add(a.histograms[0], line_fit(lines[STRETCH_U])[2])
        noise_add(a.histograms[1], line_fit(lines[STRETCH_Y])[2])
        state[STRETCHES] += 1
        state[IN_STRETCH] = 0
        line_reset(lines[STRETCH_U])
        line_reset(lines[STRETCH_Y])


@helper
def _begin(a: Arrays, drop: int, skip: int) -> None:
    """Begin a segment ``drop`` blocks after the old one's first, keeping the later blocks.

    The first ``skip`` blocks are ignored: they are transient, or were used before.
    """
    state, lines, blocks = a.state, a.lines, a.blocks
    keep = state[BLOCKS] - drop
    for k in range(keep):
        for row in range(3):
            blocks[row, k] = blocks[row, drop + k]
    state[BLOCKS] = 0
    state[SKIP] = skip
    state[RUN_U] = 0
    state[RUN_Y] = 0
    for row in range(3):
        line_reset(lines[row])
    for _ in range(keep):
        _grow(a)


@helper
def _grow(a: Arrays) -> None:
    """Add the block at the end of ``blocks`` to the lines."""
    state, lines, blocks = a.state, a.lines, a.blocks
    k = state[BLOCKS]
    line_add(lines[LINE_U], blocks[BLOCK_U, k])
    if k >= _BEHIND:
        line_add(lines[LINE_U_BEHIND], blocks[BLOCK_U, k - _BEHIND])
    if k >= state[SKIP]:
        line_add(lines[LINE_Y], blocks[BLOCK_Y, k])
    state[BLOCKS] = k + 1


@helper
def _leaves(line: FloatArray, value: float, noise: float, limit: float, run: int) -> int:
    """Return the signed number of consecutive blocks that deviate from the line (0: none)."""
    if line[N] < _LEAST:
        return 0
    ahead, factor = line_ahead(line, 1.0)
    off = (value - ahead) / (noise * factor)
    if abs(off) <= limit:
        return 0
    step = 1 if off > 0.0 else -1
    if abs(off) > 2.0 * limit:
        step *= 2
    return run + step if run * step >= 0 else step


@copied
def _drifts(lines: FloatArray, blocks: FloatArray, k: int, noise: float) -> bool:
    """Return True if the last minute's mean deviates from the line through the earlier blocks."""
    behind = lines[LINE_U_BEHIND]
    if behind[N] < 2 * _BEHIND:
        return False
    off = 0.0
    for step in range(_BEHIND):
        ahead, _ = line_ahead(behind, step + 1.0)
        off += blocks[BLOCK_U, k - _BEHIND + step] - ahead
    _, factor = line_ahead(behind, (_BEHIND + 1) / 2.0)
    leverage = factor * factor - 1.0
    # Neighbouring blocks are correlated: six of them count as two.
    sd = noise * math.sqrt(0.5 + _BEHIND * leverage / 2.0)
    return abs(off / _BEHIND) > _BEHIND_LIMIT * sd


@copied
def _judge(a: Arrays, first: int, end: int, noise_u: float, noise_y: float) -> int:
    """Classify the blocks ``[first, end)``: 0 none, 1 steady state, 2 slope response."""
    blocks, setting, found = a.blocks, a.setting, a.found
    line = np.zeros((2, LINE_SIZE))
    temperature, known = 0.0, 0
    for k in range(first, end):
        line_add(line[BLOCK_U], blocks[BLOCK_U, k])
        line_add(line[BLOCK_Y], blocks[BLOCK_Y, k])
        if math.isfinite(blocks[BLOCK_T, k]):
            temperature += blocks[BLOCK_T, k]
            known += 1
    mean_u, slope_u, rms_u = line_fit(line[BLOCK_U])
    mean_y, slope_y, rms_y = line_fit(line[BLOCK_Y])
    n = end - first
    move_u = abs(slope_u) * n / noise_u
    move_y = abs(slope_y) * n / noise_y
    found[SEG_U_MEAN], found[SEG_U_SLOPE], found[SEG_U_RMS] = mean_u, slope_u, rms_u
    found[SEG_Y_MEAN], found[SEG_Y_SLOPE], found[SEG_Y_RMS] = mean_y, slope_y, rms_y
    found[SEG_T] = temperature / known if known > 0 else math.nan
    if rms_u > _ROUGH * noise_u or rms_y > _ROUGH * noise_y:
        return 0
    if move_u <= setting[STEADY] and move_y <= setting[STEADY] + 0.5:
        return 1 if n >= setting[STEADY_MIN] else 0
    if move_u >= setting[SLOPE]:
        return 2 if n >= setting[SLOPE_MIN] else 0
    return 0


@helper
def _close(a: Arrays, end: int) -> bool:
    """Classify the open segment up to block ``end``; True if it is a special segment."""
    state, setting, found = a.state, a.setting, a.found
    first = state[SKIP]
    least = min(setting[STEADY_MIN], setting[SLOPE_MIN])
    if end - first < max(least, 3):
        return False
    noise_u, noise_y = noise_now(a.histograms, setting)
    kind = _judge(a, first, end, noise_u, noise_y)
    if kind == 0:
        return False
    rows = int(setting[BLOCK_ROWS])
    found[SEG_FIRST] = state[FIRST_ROW] + first * rows
    found[SEG_END] = state[FIRST_ROW] + end * rows
    found[SEG_KIND] = kind
    # The rows of a segment have no gap.
    behind = state[ROW] - state[FIRST_ROW] - end * rows
    state[END_NS] = state[LAST_NS] - behind * int(setting[PERIOD_NS])
    return True


@copied
def _take_block(a: Arrays) -> bool:
    """Process the block at the end of ``blocks``; True if that closed a special segment."""
    state, lines, blocks, setting = a.state, a.lines, a.blocks, a.setting
    rows = int(setting[BLOCK_ROWS])
    k = state[BLOCKS]
    u, y = blocks[BLOCK_U, k], blocks[BLOCK_Y, k]
    _learn(a, u, y)
    if state[STRETCHES] < WARM_UP and (setting[NOISE_U] <= 0.0 or setting[NOISE_Y] <= 0.0):
        # Without a noise level a break cannot be detected: start the line later.
        state[FIRST_ROW] += rows
        return False
    noise_u, noise_y = noise_now(a.histograms, setting)
    state[RUN_U] = _leaves(lines[LINE_U], u, noise_u, setting[BREAK], state[RUN_U])
    state[RUN_Y] = _leaves(lines[LINE_Y], y, noise_y, setting[BREAK], state[RUN_Y])
    back = 0
    if abs(state[RUN_U]) >= 2 or abs(state[RUN_Y]) >= 2:
        back = 1
    elif _drifts(lines, blocks, k, noise_u):
        back = _BEHIND
    if back == 0:
        _grow(a)
        return _cut_if_long(a)
    closed = _close(a, k - back - int(setting[TRIM]))
    # The move happened before now: the transient begins at the previous block.
    at = max(k - 1, 0)
    state[FIRST_ROW] += at * rows
    state[BLOCKS] = k + 1
    _begin(a, at, int(setting[SETTLE]))
    return closed


@copied
def _cut_if_long(a: Arrays) -> bool:
    """Close a segment that has become too long; True if it is a special segment.

    The next one has no transient. Its line keeps some blocks from before the cut,
    and the last minute belongs to it, so that a move that began there is still
    detected as a break.
    """
    state, setting = a.state, a.setting
    trim = int(setting[TRIM])
    if state[BLOCKS] < int(setting[LONGEST]) + state[SKIP] + trim:
        return False
    closed = _close(a, state[BLOCKS] - trim)
    keep = min(3 * _BEHIND, state[BLOCKS])
    drop = state[BLOCKS] - keep
    state[FIRST_ROW] += drop * int(setting[BLOCK_ROWS])
    _begin(a, drop, max(keep - trim, 0))
    return closed


@copied
def _kind_now(a: Arrays) -> int:
    """Return the kind of the newest row, as far as known now."""
    state = a.state
    if state[BLOCKS] < max(state[SKIP], _LEAST):
        return TRANSIENT
    if state[RUN_U] != 0 or state[RUN_Y] != 0:
        return TRANSIENT
    noise_u, _ = noise_now(a.histograms, a.setting)
    slope = line_fit(a.lines[LINE_U])[1]
    moved = abs(slope) * state[BLOCKS] / noise_u
    return SETTLED_SLOPE if moved >= a.setting[SLOPE] else SETTLED_STEADY


@copied
def _break_off(a: Arrays) -> bool:
    """Close the open segment at a gap, because the operation in the gap is unknown.

    Return True if that closed a special segment; the row after the gap is not
    processed yet.
    """
    state, lines = a.state, a.lines
    closed = state[BLOCKS] > 0 and _close(a, state[BLOCKS])
    _begin(a, state[BLOCKS], int(a.setting[SETTLE]))
    state[FIRST_ROW] = state[ROW]
    state[ROWS_IN_BLOCK] = 0
    a.sums[:] = 0.0
    # The stretch for the noise must not contain a gap either.
    state[IN_STRETCH] = 0
    line_reset(lines[STRETCH_U])
    line_reset(lines[STRETCH_Y])
    return closed


@copied
def _take_row(a: Arrays, u: float, y: float, temperature: float) -> bool:
    """Add a row to the current block; True if that closed a special segment."""
    state, sums, blocks = a.state, a.sums, a.blocks
    sums[BLOCK_U] += u
    sums[BLOCK_Y] += y
    if math.isfinite(temperature):
        sums[BLOCK_T] += temperature
        sums[BLOCK_T_COUNT] += 1.0
    state[ROWS_IN_BLOCK] += 1
    if state[ROWS_IN_BLOCK] < int(a.setting[BLOCK_ROWS]):
        return False
    k = state[BLOCKS]
    blocks[BLOCK_U, k] = sums[BLOCK_U] / state[ROWS_IN_BLOCK]
    blocks[BLOCK_Y, k] = sums[BLOCK_Y] / state[ROWS_IN_BLOCK]
    count = sums[BLOCK_T_COUNT]
    blocks[BLOCK_T, k] = sums[BLOCK_T] / count if count > 0.0 else math.nan
    sums[:] = 0.0
    state[ROWS_IN_BLOCK] = 0
    return _take_block(a)


@jit
def run(
    time_ns: IntArray, u: FloatArray, y: FloatArray, temperature: FloatArray, a: Arrays,
    kinds: ByteArray,
) -> tuple[int, bool]:  # fmt: skip
    """Process rows until they end or a special segment closes.

    Return the number of rows processed, and whether ``a.found`` contains a segment that
    closed at the last of them; one code per row is written to ``kinds``.
    """
    state = a.state
    gap_ns = int(1.5 * a.setting[PERIOD_NS])
    for i in range(u.size):
        usable = math.isfinite(u[i]) and math.isfinite(y[i])
        jumped = time_ns[i] - state[LAST_NS] > gap_ns or time_ns[i] <= state[LAST_NS]
        closed = False
        if jumped or not usable:
            closed = _break_off(a)
        state[LAST_NS] = time_ns[i]
        state[ROW] += 1
        if usable:
            if _take_row(a, u[i], y[i], temperature[i]):
                closed = True
            kinds[i] = _kind_now(a)
        else:
            state[FIRST_ROW] = state[ROW]
            kinds[i] = NO_DATA
        if closed:
            return i + 1, True
    return u.size, False
