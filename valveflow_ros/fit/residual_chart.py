# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A chart that watches the residual for a lasting shift: whitened block means, two-sided CUSUMs.

The residual is averaged over blocks of a minute, which takes the fast noise out; what is left is
correlated from block to block, and a chart with limits for independent values would cry wolf
eighty times as often as it says. So each block is whitened by the autocorrelation that the curve's
own clean residual had. Two cumulative sums (Page, Biometrika 41, 1954) watch each side: one for
small shifts that last, one for large ones that must be seen within minutes. Their limits come with
the curve (`run_length`): they belong to a wanted time between false alarms.
"""

from __future__ import annotations

import math

import numpy as np

from valveflow_ros.curve.characteristic import ChartDesign
from valveflow_ros.numerics import jit
from valveflow_ros.records import NS_PER_S, ByteArray, FloatArray, IntArray
from valveflow_ros.state import Memory

# One wild block cannot raise the alarm alone.
_CLIP = 4.0
# A sum that grew for hours would take hours to come down again.
_CEILING = 1.25
_BLOCK, _GOOD = range(2)
_SUM, _LAST, _EVIDENCE, _SHIFT = range(4)
# For each of four sums: its value, the residuals added since it left zero, and how many.
_C, _TOTAL, _COUNT = range(3)
SMALL, LARGE = 0, 1


@jit
def innovation(mean: float, before: float, correlation: float, sd: float) -> float:
    """Return the whitened block mean, clipped; ``before`` is NaN behind a gap."""
    if math.isnan(before):
        e = mean * math.sqrt(1.0 - correlation * correlation) / sd
    else:
        e = (mean - correlation * before) / sd
    return min(max(e, -_CLIP), _CLIP)


@jit
def add(sums: FloatArray, e: float, mean: float, slack: FloatArray, limit: FloatArray) -> None:
    """Add one block to the four sums (4, 3): up and down for small, then for large shifts."""
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
    """Write the strongest evidence, signed, and the shift it speaks of."""
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
    """Run rows through the chart; a block is judged by the first row behind it."""
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
    """Watch the residual of one curve, in constant time a row.

    Parameters
    ----------
    design : ChartDesign
    step_s : float
        Step of the rows. Blocks with less than half their rows are not judged.
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
        """Go on where the chart of an earlier curve was: a new curve undoes no evidence.

        The sums keep their shares of the limits. With another length of blocks it starts afresh.
        """
        if other._block_ns != self._block_ns:
            return
        np.copyto(self._place, other._place)
        np.copyto(self._state, other._state)
        np.copyto(self._sums, other._sums)
        self._sums[:, _C] *= np.repeat(self._limit / other._limit, 2)

    def feed(self, time_ns: IntArray, residual_mw: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the evidence and the shift it speaks of after each row, shapes (n,).

        Parameters
        ----------
        time_ns : int64 (n,)
        residual_mw : float64 (n,)
            NaN where there is nothing to judge.

        Returns
        -------
        evidence : float64 (n,)
            Share of the limit that the strongest sum has reached, positive where the plant gives
            more than expected: beyond 1 or -1 there is an alarm. NaN before the first block.
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


# Limits of the residual's chart for a wanted time between false alarms.
#
# Tables of limits hold for independent normal values. The unit's own clean residual is neither
# quite independent after whitening nor normal, so its blocks are drawn again and again in runs of
# an hour (moving-block bootstrap, Kuensch, Ann. Stat. 17, 1989), and the limits are put where the
# chart then gives one alarm in the wanted time. What a short window cannot show is guarded
# against: the limits are never below those for independent normal values, and the slack holds the
# curve's own error.

_SEED = 19540301
_RUN = 60  # blocks drawn together
_ALARMS = 35  # that the drawn record should hold
_LARGEST_CORRELATION = 0.995
_MAD_TO_SD = 1.4826022185056018
_SLACK_SMALL, _SLACK_LARGE = 0.25, 1.0
_DAY_S = 86400.0
# Correlation and spread come from days of data: without some to spare, residuals drawn anew gave
# an alarm in 25 to 28 days where 30 were wanted (`benchmarks.alarm_run_length`).
_SPARE = 1.4
# A young curve has not seen all of its unit: where that comes first, it is off for a quarter
# of an hour. How often that raises an alarm is counted by `benchmarks.young_curves`.
_YOUNG_DAYS = 0.4
_HIGHEST = 400.0
_LEAST_LIMIT = 4.5  # more than one clipped block can add
# Weather, cooling water and fouling move the output by megawatts over days, and a window of days
# shows little of that. It shows how far the residual goes in six hours, from which the level goes
# on; how often healthy units alarm with this factor is counted by `benchmarks.monitor_study`.
_WANDER_S = 21_600.0
_TO_DAYS = 1.5
# Until six hours have passed some times, half of what need not be found is taken for it.
_PRIOR_BLOCKS = 4.0
_LARGEST_MOVE = 2.5  # usual ones; beyond lies a fault
# A unit may be so many spreads of its days away from the curve, and nothing is wrong.
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
    """Return the chart for a curve whose clean residual is given.

    Parameters
    ----------
    residual_mw : float64 (n,)
        Of rows (or means of some) one after the other, on the data the curve was fitted to.
    weight : uint8 (n,)
        0 where it does not count.
    step_s : float
        Between those rows.
    block_s : float
    run_length_days : float
        Wanted mean time between false alarms.
    floor_mw : float
        Shifts below this need not be found.
    curve_error_mw : float
        How wrong the curve may be where it was fitted (standard error).
    wander_mw : float
        sd of the slow wander of the residual about this curve, see `slow_wander`.
    """
    block_s = max(block_s, step_s)
    rows = max(1, round(block_s / step_s))
    block_s = rows * step_s
    means = block_means(residual_mw, weight, rows)
    correlation, sd = _correlation(means)
    seen = 1.0 - correlation  # share of a lasting shift that is left in an innovation
    # On a quiet unit what need not be found is many innovations wide, and innovations are
    # clipped: the slack would swallow every shift. There the width is that of what may pass.
    passes_mw = math.hypot(2.0 * curve_error_mw, _WANDERS * wander_mw)
    sd = max(sd, (0.5 * floor_mw + passes_mw) * seen)
    # Where the curve is wrong by two of its standard errors, or the unit is off as it is by
    # weather, that alone must not raise an alarm.
    error = passes_mw * seen / sd
    small = max(_SLACK_SMALL, 0.5 * floor_mw * seen / sd) + error
    slack = (small, max(_SLACK_LARGE + error, small))
    # Each of the two charts may give half of the false alarms.
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
    """Return the sd with which the level of the residual wanders from day to day, MW.

    Parameters
    ----------
    residual_mw : float64 (n,)
        Of rows (or means of some) one after the other, on the data the curve was fitted to.
    weight : uint8 (n,)
        0 where it does not count.
    step_s : float
        Between those rows.
    floor_mw : float
        Lasting shifts below this need not be found.
    """
    means = block_means(residual_mw, weight, max(1, round(_WANDER_S / step_s)))
    moves = np.diff(means)
    moves = np.abs(moves[np.isfinite(moves)])
    prior = 0.5 * floor_mw
    if len(moves):
        # A fault moves it once, by more than weather does.
        usual = max(_MAD_TO_SD * float(np.median(moves)), prior)
        moves = np.minimum(moves, _LARGEST_MOVE * usual)
    power = _PRIOR_BLOCKS * prior**2 + float(np.sum(moves**2))
    return _TO_DAYS * math.sqrt(power / (_PRIOR_BLOCKS + len(moves)))


def block_means(residual: FloatArray, weight: ByteArray, rows: int) -> FloatArray:
    """Return means over ``rows`` rows, shape (n // rows,); NaN where less than half count."""
    count = len(residual) // rows
    w = weight[: count * rows].reshape(count, rows) > 0
    values = np.where(w, residual[: count * rows].reshape(count, rows), 0.0)
    known = w.sum(axis=1)
    with np.errstate(invalid='ignore', divide='ignore'):
        return np.where(2 * known >= rows, values.sum(axis=1) / known, np.nan)


def _correlation(means: FloatArray) -> tuple[float, float]:
    """Return the correlation from block to block, and the robust sd of what it leaves."""
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
    """Whiten as the chart does; blocks that are missing are left out."""
    out, before = [], math.nan
    for mean in means.tolist():
        if not math.isnan(mean):
            out.append(innovation(mean, before, correlation, sd))
        before = mean
    return np.array(out)


def _drawn(e: FloatArray, length: int) -> FloatArray:
    """Draw runs of consecutive innovations until ``length`` is reached."""
    rng = np.random.default_rng(_SEED)
    run = max(1, min(_RUN, len(e) // 4))
    if len(e) < 2:
        return np.asarray(rng.standard_normal(length))
    starts = rng.integers(0, len(e) - run + 1, length // run + 1)
    return np.asarray(e[(starts[:, None] + np.arange(run)[None, :]).ravel()[:length]])


@jit
def alarms(e: FloatArray, slack: float, limit: float) -> int:
    """Count the alarms of a two-sided sum on innovations ``e``; it starts afresh after each."""
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
    """Write how high both sums of ``e`` rise between two visits of zero; return how many.

    ``out`` must hold as many as there are innovations, and two.
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
    """Return the limit at which innovations ``e`` give one alarm in ``run_length`` blocks.

    A sum starts afresh whenever it comes to zero, so alarms are as frequent as peaks above the
    limit, and one pass tells that for every limit. Two-sided.
    """
    out = np.empty(len(e) + 2)
    found = out[: peaks(e, slack, out)]
    wanted = max(1, math.floor(len(e) / run_length))
    if len(found) <= wanted:
        return float(found.max()) if len(found) else 0.0
    return float(np.partition(found, len(found) - wanted)[len(found) - wanted])


def normal_limit(slack: float, run_length: float) -> float:
    """Return the limit for independent normal innovations by Siegmund's approximation.

    One side: (exp(2 k b) - 1 - 2 k b) / (2 k^2) blocks with b = h + 1.166 (Sequential Analysis,
    1985); two sides give half of it.
    """
    low, high = 0.0, _HIGHEST
    for _ in range(60):
        middle = 0.5 * (low + high)
        power = 2.0 * slack * (middle + 1.166)
        found = 0.5 * (math.expm1(min(power, 700.0)) - power) / (2.0 * slack * slack)
        low, high = (middle, high) if found < run_length else (low, middle)
    return high


__all__ = ['alarms', 'block_means', 'design_chart', 'limit_for', 'normal_limit', 'slow_wander']
