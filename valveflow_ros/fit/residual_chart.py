# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Control chart for a lasting shift of the residual: whitened block means, two-sided CUSUMs.

The residual is averaged over blocks of a minute, which removes the fast noise. The block means are
correlated, and limits for independent values would give eighty times as many false alarms as
intended. So each block is whitened by the autocorrelation of the curve's own clean residual. Two
cumulative sums (Page, Biometrika 41, 1954) monitor each side: one for small lasting shifts, one
for large shifts that must be detected within minutes. Their limits are stored with the curve and
follow from the required time between false alarms (`design_chart`).
"""

from __future__ import annotations

import math

import numpy as np

from valveflow_ros.curve.characteristic import ChartDesign
from valveflow_ros.numerics import jit
from valveflow_ros.records import NS_PER_S, ByteArray, FloatArray, IntArray
from valveflow_ros.state import Memory

# A single outlier block cannot raise the alarm.
_CLIP = 4.0
# Upper bound of a sum, in limits: without it a sum that grew for hours would need hours to fall.
_CEILING = 1.25
_BLOCK, _GOOD = range(2)
_SUM, _LAST, _EVIDENCE, _SHIFT = range(4)
# For each of four sums: its value, and the sum and number of residuals since it left zero.
_C, _TOTAL, _COUNT = range(3)
SMALL, LARGE = 0, 1


@jit
def innovation(mean: float, before: float, correlation: float, sd: float) -> float:
    """Return the whitened block mean, clipped; ``before`` is NaN after a gap."""
    if math.isnan(before):
        e = mean * math.sqrt(1.0 - correlation * correlation) / sd
    else:
        e = (mean - correlation * before) / sd
    return min(max(e, -_CLIP), _CLIP)


@jit
def add(sums: FloatArray, e: float, mean: float, slack: FloatArray, limit: FloatArray) -> None:
    """Add one block to the four sums (4, 3): up and down for small shifts, then for large ones."""
    for k in range(4):
        which = k // 2
        sign = 1.0 if k % 2 == 0 else -1.0
        value = sums[k, _C] + sign * e - slack[which]
        if value <= 0.0:
            sums[k, :] = 0.0
            continue
        sums[k, _C] = min(value, _CEILING * limit[which])
        sums[k, _TOTAL] += mean
        sums[k, _COUNT] += 1.0


@jit
def _judge(sums: FloatArray, limit: FloatArray, state: FloatArray) -> None:
    """Write the signed evidence of the strongest sum, and its shift."""
    state[_EVIDENCE] = 0.0
    state[_SHIFT] = 0.0
    for k in range(4):
        share = sums[k, _C] / limit[k // 2]
        if share > abs(state[_EVIDENCE]):
            state[_EVIDENCE] = share if k % 2 == 0 else -share
            state[_SHIFT] = sums[k, _TOTAL] / sums[k, _COUNT]


@jit
def _run(
    time_ns: IntArray,
    residual: FloatArray,
    block_ns: int,
    least: int,
    correlation: float,
    sd: float,
    slack: FloatArray,
    limit: FloatArray,
    place: IntArray,
    state: FloatArray,
    sums: FloatArray,
    evidence: FloatArray,
    shift: FloatArray,
) -> None:
    """Add rows to the chart; a block is evaluated at the first row after it."""
    for t in range(residual.size):
        block = time_ns[t] // block_ns
        if block != place[_BLOCK]:
            if place[_GOOD] >= least:
                mean = state[_SUM] / place[_GOOD]
                e = innovation(mean, state[_LAST], correlation, sd)
                add(sums, e, mean, slack, limit)
                _judge(sums, limit, state)
                state[_LAST] = mean
            else:
                state[_LAST] = np.nan
            if block != place[_BLOCK] + 1:
                state[_LAST] = np.nan
            place[_BLOCK], place[_GOOD], state[_SUM] = block, 0, 0.0
        if math.isfinite(residual[t]):
            place[_GOOD] += 1
            state[_SUM] += residual[t]
        evidence[t] = state[_EVIDENCE]
        shift[t] = state[_SHIFT]


class ResidualChart(Memory):
    """Monitor the residual of one curve, in constant time per row.

    Parameters
    ----------
    design : ChartDesign
    step_s : float
        Step of the rows. Blocks with less than half of their rows are ignored.
    """

    REMEMBERED = ('_place', '_state', '_sums')

    def __init__(self, design: ChartDesign, step_s: float) -> None:
        self.design = design
        block_s = max(design.block_s, step_s)
        self._block_ns = round(block_s * NS_PER_S)
        self._least = max(1, math.ceil(0.5 * block_s / step_s))
        self._slack, self._limit = np.array(design.slack), np.array(design.limit)
        self._place = np.array([-1, 0], dtype=np.int64)
        self._state = np.array([0.0, math.nan, math.nan, math.nan])
        self._sums = np.zeros((4, 3))

    def follow(self, other: ResidualChart) -> None:
        """Continue the chart of an earlier curve: a new curve does not remove evidence.

        Each sum keeps its ratio to the limit. If the block length differs, nothing is copied.
        """
        if other._block_ns != self._block_ns:
            return
        np.copyto(self._place, other._place)
        np.copyto(self._state, other._state)
        np.copyto(self._sums, other._sums)
        self._sums[:, _C] *= np.repeat(self._limit / other._limit, 2)

    def feed(self, time_ns: IntArray, residual_mw: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the evidence and the corresponding shift after each row, shapes (n,).

        Parameters
        ----------
        time_ns : int64 (n,)
        residual_mw : float64 (n,)
            NaN without a residual.

        Returns
        -------
        evidence : float64 (n,)
            Ratio of the strongest sum to its limit, positive if the plant gives more than
            expected; above 1 or below -1 there is an alarm. NaN before the first block.
        shift_mw : float64 (n,)
            Mean residual since that sum left zero.
        """
        evidence, shift = np.empty(len(time_ns)), np.empty(len(time_ns))
        _run(
            time_ns, residual_mw, self._block_ns, self._least, self.design.correlation,
            self.design.innovation_mw, self._slack, self._limit, self._place, self._state,
            self._sums, evidence, shift,
        )  # fmt: skip
        return evidence, shift


# Limits of the residual chart for a required time between false alarms.
#
# Tables of limits are valid for independent normal values. The unit's own clean residual is not
# exactly independent after whitening, and not normal. So its blocks are resampled in runs of an
# hour (moving-block bootstrap, Kuensch, Ann. Stat. 17, 1989), and the limits are chosen such that
# the chart then gives one alarm in the required time. A short window does not show everything:
# the limits are never below those for independent normal values, and the slack includes the
# curve's own error.

_SEED = 19540301
_RUN = 60  # blocks drawn together
_ALARMS = 35  # that the resampled record should contain
_LARGEST_CORRELATION = 0.995
_MAD_TO_SD = 1.4826022185056018
_SLACK_SMALL, _SLACK_LARGE = 0.25, 1.0
_DAY_S = 86400.0
# Margin, because correlation and spread are estimated from few days: without it, new residuals
# gave one alarm in 25 to 28 days instead of 30 (`benchmarks.alarm_run_length`).
_SPARE = 1.4
# A curve from few data has not seen all operation of its unit; where it first meets new operation,
# it is wrong for a quarter of an hour. `benchmarks.monitor_study` tells the days of the alarms.
_YOUNG_DAYS = 0.4
_HIGHEST = 400.0
_LEAST_LIMIT = 4.5  # more than one clipped block can add
# Weather, cooling water and fouling change the output by megawatts over days, and a window of days
# shows little of that. So the spread over days is extrapolated from the changes within six hours;
# `benchmarks.monitor_study` counts the alarms of healthy units with this factor.
_WANDER_S = 21_600.0
_TO_DAYS = 1.5
# Weight of the prior value, half of the smallest shift to be found, in six-hour blocks.
_PRIOR_BLOCKS = 4.0
_LARGEST_MOVE = 2.5  # in usual changes; a larger one is a fault
# A healthy unit may differ from the curve by this many times its spread over days.
_WANDERS = 4.0


def design_chart(
    residual_mw: FloatArray,
    weight: ByteArray,
    step_s: float,
    *,
    block_s: float,
    run_length_days: float,
    floor_mw: float,
    curve_error_mw: float,
    wander_mw: float = 0.0,
) -> ChartDesign:
    """Return the chart for a curve from its clean residual.

    Parameters
    ----------
    residual_mw : float64 (n,)
        Consecutive rows, or means of rows, of the data to which the curve was fitted.
    weight : uint8 (n,)
        0 for rows that are not used.
    step_s : float
        Step of those rows.
    block_s : float
    run_length_days : float
        Required mean time between false alarms.
    floor_mw : float
        Shifts below this need not be found.
    curve_error_mw : float
        Standard error of the curve in the range of its data.
    wander_mw : float
        sd of the slow random variation of the residual of this curve, see `slow_wander`.
    """
    block_s = max(block_s, step_s)
    rows = max(1, round(block_s / step_s))
    block_s = rows * step_s
    means = block_means(residual_mw, weight, rows)
    correlation, sd = _correlation(means)
    seen = 1.0 - correlation  # fraction of a lasting shift that remains in an innovation
    # On a unit with little noise the allowed shift is many sd of the innovations, and innovations
    # are clipped: the slack would exceed every shift. There the sd is that of the allowed shift.
    passes_mw = math.hypot(2.0 * curve_error_mw, _WANDERS * wander_mw)
    sd = max(sd, (0.5 * floor_mw + passes_mw) * seen)
    # A curve that is wrong by two of its standard errors, or a usual effect of the weather on the
    # unit, must not raise an alarm.
    error = passes_mw * seen / sd
    small = max(_SLACK_SMALL, 0.5 * floor_mw * seen / sd) + error
    slack = (small, max(_SLACK_LARGE + error, small))
    # Each of the two sums may give half of the false alarms.
    blocks = 2.0 * _SPARE * run_length_days * _DAY_S / block_s
    e = _innovations(means, correlation, sd)
    drawn = _drawn(e, int(min(_ALARMS * blocks, 4_000_000)))
    judged_days = int(np.isfinite(means).sum()) * block_s / _DAY_S
    wider = 1.0 + min(1.0, _YOUNG_DAYS / max(judged_days, 1e-9))
    limit = tuple(
        wider * max(limit_for(drawn, k, blocks), normal_limit(k, blocks), _LEAST_LIMIT)
        for k in slack
    )
    return ChartDesign(block_s, correlation, sd, slack, (limit[0], limit[1]), run_length_days)


def slow_wander(
    residual_mw: FloatArray, weight: ByteArray, step_s: float, floor_mw: float
) -> float:
    """Return the sd of the random variation of the residual's level from day to day, MW.

    Parameters
    ----------
    residual_mw : float64 (n,)
        Consecutive rows, or means of rows, of the data to which the curve was fitted.
    weight : uint8 (n,)
        0 for rows that are not used.
    step_s : float
        Step of those rows.
    floor_mw : float
        Lasting shifts below this need not be found.
    """
    means = block_means(residual_mw, weight, max(1, round(_WANDER_S / step_s)))
    moves = np.diff(means)
    moves = np.abs(moves[np.isfinite(moves)])
    prior = 0.5 * floor_mw
    if len(moves):
        # A fault is a single change that is larger than those by weather: limit it.
        usual = max(_MAD_TO_SD * float(np.median(moves)), prior)
        moves = np.minimum(moves, _LARGEST_MOVE * usual)
    power = _PRIOR_BLOCKS * prior**2 + float(np.sum(moves**2))
    return _TO_DAYS * math.sqrt(power / (_PRIOR_BLOCKS + len(moves)))


def block_means(residual: FloatArray, weight: ByteArray, rows: int) -> FloatArray:
    """Return means over ``rows`` rows, shape (n // rows,); NaN if less than half are used."""
    count = len(residual) // rows
    w = weight[: count * rows].reshape(count, rows) > 0
    values = np.where(w, residual[: count * rows].reshape(count, rows), 0.0)
    known = w.sum(axis=1)
    with np.errstate(invalid='ignore', divide='ignore'):
        return np.where(2 * known >= rows, values.sum(axis=1) / known, np.nan)


def _correlation(means: FloatArray) -> tuple[float, float]:
    """Return the lag-one correlation of blocks, and the robust sd after removing it."""
    pairs = np.isfinite(means[1:]) & np.isfinite(means[:-1])
    before, now = means[:-1][pairs], means[1:][pairs]
    power = float((before**2).sum())
    known = means[np.isfinite(means)]
    if len(before) < 3 or power <= 0.0:
        sd = float(np.std(known)) if len(known) else 0.0
        return 0.0, max(sd, 1e-9)
    correlation = float(np.clip((before * now).sum() / power, 0.0, _LARGEST_CORRELATION))
    rest = now - correlation * before
    sd = _MAD_TO_SD * float(np.median(np.abs(rest - np.median(rest))))
    return correlation, max(sd, 1e-9)


def _innovations(means: FloatArray, correlation: float, sd: float) -> FloatArray:
    """Whiten like the chart; missing blocks are left out."""
    out, before = [], math.nan
    for mean in means.tolist():
        if not math.isnan(mean):
            out.append(innovation(mean, before, correlation, sd))
        before = mean
    return np.array(out)


def _drawn(e: FloatArray, length: int) -> FloatArray:
    """Resample runs of consecutive innovations up to ``length`` values."""
    rng = np.random.default_rng(_SEED)
    run = max(1, min(_RUN, len(e) // 4))
    if len(e) < 2:
        return np.asarray(rng.standard_normal(length))
    starts = rng.integers(0, len(e) - run + 1, length // run + 1)
    return np.asarray(e[(starts[:, None] + np.arange(run)[None, :]).ravel()[:length]])


@jit
def alarms(e: FloatArray, slack: float, limit: float) -> int:
    """Count the alarms of a two-sided sum of innovations ``e``; each alarm resets the sum."""
    up = down = 0.0
    count = 0
    for value in e:
        up = max(0.0, up + value - slack)
        down = max(0.0, down - value - slack)
        if up > limit or down > limit:
            count += 1
            up = down = 0.0
    return count


@jit
def peaks(e: FloatArray, slack: float, out: FloatArray) -> int:
    """Write the peaks of both sums of ``e`` between two zeros; return the number of peaks.

    ``out`` must have the size of ``e`` plus two.
    """
    count = 0
    for sign in (1.0, -1.0):
        value = highest = 0.0
        for t in range(e.size):
            value += sign * e[t] - slack
            if value <= 0.0:
                if highest > 0.0:
                    out[count] = highest
                    count += 1
                value = highest = 0.0
            highest = max(highest, value)
        if highest > 0.0:
            out[count] = highest
            count += 1
    return count


def limit_for(e: FloatArray, slack: float, run_length: float) -> float:
    """Return the two-sided limit at which ``e`` gives one alarm in ``run_length`` blocks.

    A sum restarts whenever it reaches zero, so alarms are as frequent as peaks above the
    limit, and one pass gives the frequency for every limit.
    """
    out = np.empty(len(e) + 2)
    found = out[: peaks(e, slack, out)]
    wanted = max(1, math.floor(len(e) / run_length))
    if len(found) <= wanted:
        return float(found.max()) if len(found) else 0.0
    return float(np.partition(found, len(found) - wanted)[len(found) - wanted])


def normal_limit(slack: float, run_length: float) -> float:
    """Return the limit for independent normal innovations by Siegmund's approximation.

    One side gives (exp(2 k b) - 1 - 2 k b) / (2 k^2) blocks between alarms with b = h + 1.166
    (Sequential Analysis, 1985); two sides give half of it.
    """
    low, high = 0.0, _HIGHEST
    for _ in range(60):
        middle = 0.5 * (low + high)
        power = 2.0 * slack * (middle + 1.166)
        found = 0.5 * (math.expm1(min(power, 700.0)) - power) / (2.0 * slack * slack)
        low, high = (middle, high) if found < run_length else (low, middle)
    return high


__all__ = ['alarms', 'block_means', 'design_chart', 'limit_for', 'normal_limit', 'slow_wander']
