# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The difference of each special segment from a curve, from the segments' records only."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import fdtrc, ndtri, stdtr

from valveflow_ros.curve.characteristic import Characteristic, piece_of
from valveflow_ros.records import NS_PER_S, FloatArray, IntArray, SegmentKind, SpecialSegment
from valveflow_ros.signals.static_form import StaticForm

LEAST_SIDE = 4  # minimum members on each side of a change
_LARGEST_RHO = 0.9
_LEAST_VARIANCE = 1e-200  # keeps z^2 finite without noise
_FAR = 38.0  # normal deviate beyond which the density underflows


class Scan(NamedTuple):
    """One change of the mean, tested at every position; values in the unit of the series."""

    place: int  # members before the change
    p_value: float  # of such a change at any position if there is none
    before: float  # weighted means on both sides
    after: float
    after_error: float  # standard error of `after`


def scan(values: FloatArray, weights: FloatArray, first: int = 0) -> Scan | None:
    """Test for one change of the mean; return None if the series is too short.

    The values (n,) are in chronological order, the weights (n,) inverse variances up to a factor.
    Changes with fewer than ``first`` members before them are not tested.

    Notes
    -----
    The statistic is the two-sample z of each split. Its variance is that at the best split,
    increased for the remaining correlation of neighbours. The distribution of its maximum
    without a change is that of a standardised Brownian bridge (James, James and
    Siegmund 1987), ``b phi(b) ((1 - b^-2) log T + 4 b^-2)`` with
    ``T = s1 (1 - s0) / (s0 (1 - s1))`` for splits between the fractions s0 and s1 of the weight.
    """
    n = len(values)
    first = max(first, LEAST_SIDE)
    if n < first + LEAST_SIDE:
        return None
    share = np.cumsum(weights) / np.sum(weights)
    total = np.cumsum(weights * values)
    places = np.arange(first, n - LEAST_SIDE + 1)
    s = share[places - 1]
    before = total[places - 1] / (s * weights.sum())
    after = (total[-1] - total[places - 1]) / ((1.0 - s) * weights.sum())
    gain = weights.sum() * s * (1.0 - s) * (after - before) ** 2
    k = int(np.argmax(gain))
    place = int(places[k])
    rest = values - np.where(np.arange(n) < place, before[k], after[k])
    variance = _variance(rest, weights, max(n - 2, 1)) * _widening(rest)
    z = np.sqrt(gain / variance)
    b = _as_normal(float(z[k]), n - 2)
    return Scan(
        place, _chance(b, float(s[0]), float(s[-1])), float(before[k]), float(after[k]),
        math.sqrt(variance / float(weights[place:].sum())),
    )  # fmt: skip


def _variance(rest: FloatArray, weights: FloatArray, freedom: int) -> float:
    """Return the variance of a member with weight 1."""
    return max(float(np.sum(weights * rest**2)) / freedom, _LEAST_VARIANCE)


def _widening(rest: FloatArray) -> float:
    """Return the factor by which lag-one correlation increases the variance of a long mean."""
    power = float(np.sum(rest**2))
    if power <= 0.0:
        return 1.0
    rho = float(np.sum(rest[1:] * rest[:-1])) / power
    rho = min(max(rho, 0.0), _LARGEST_RHO)
    return (1.0 + rho) / (1.0 - rho)


def _as_normal(t: float, freedom: int) -> float:
    """Return the normal deviate with the tail probability of Student's ``t``."""
    chance = float(stdtr(freedom, -t))
    tail = math.log(chance) if chance > 0.0 else -math.inf
    # Far in the tail `ndtri` fails; the log of the normal tail is about quadratic there.
    return float(-ndtri(math.exp(tail))) if tail > -600.0 else math.sqrt(-2.0 * tail)


def _chance(b: float, low: float, high: float) -> float:
    """Return the probability that the maximum over splits exceeds ``b``."""
    if b < 1.0:
        return 1.0
    if b > _FAR:
        return 0.0
    spread = math.log(max(high * (1.0 - low) / (low * (1.0 - high)), 1.0))
    density = math.exp(-0.5 * b * b) / math.sqrt(2.0 * math.pi)
    return min(1.0, b * density * ((1.0 - b**-2) * spread + 4.0 * b**-2))


_MOST_WEIGHT = 900.0
_KNOWN = 0.01  # p-value below which a change within the reference's data is accepted
_POINTS = 64  # points along a ramp, for the mean of a curve with breakpoints


@dataclass(frozen=True, slots=True)
class SegmentResiduals:
    """Residuals of segments about one curve, sorted by time; all arrays have shape (n,)."""

    time_ns: IntArray  # middle of the segment
    u: FloatArray  # middle of the segment, % MPa^m
    residual_mw: FloatArray  # mean power minus the power of the curve
    samples: IntArray

    def __len__(self) -> int:
        """Return the number of segments."""
        return len(self.time_ns)

    @property
    def weights(self) -> FloatArray:
        """Return inverse variances up to a factor, shape (n,).

        A longer segment averages its own noise, but not the slow disturbances. So the weight
        has an upper limit.
        """
        return np.minimum(self.samples.astype(np.float64), _MOST_WEIGHT)

    def inside(self, low: float, high: float) -> SegmentResiduals:
        """Return the segments with their middle in ``[low, high)``."""
        return self.part((self.u >= low) & (self.u < high))

    def count_until(self, time_ns: int) -> int:
        """Return the number of segments up to a time."""
        return int(np.searchsorted(self.time_ns, time_ns, side='right'))

    def part(self, keep: np.ndarray) -> SegmentResiduals:
        """Return the segments chosen by a mask or an index."""
        return SegmentResiduals(
            self.time_ns[keep], self.u[keep], self.residual_mw[keep], self.samples[keep]
        )


def segment_residuals(
    curve: Characteristic, segments: Sequence[SpecialSegment]
) -> SegmentResiduals:
    """Return the mean residual of each segment inside the curve's range.

    On a ramp the power lags by ``K_f eta_1 (T + tau)``, the term that eq. (14) of the paper
    neglects: it is computed from the dynamics of the curve and removed. With a curve without
    dynamics only steady-state segments are used.
    """
    known = bool(curve.dynamics)
    knots = curve.breakpoints
    placed = [(s, *_ends(curve.static_form, s)) for s in segments]
    placed = [
        (s, u, scale) for s, u, scale in placed
        if u.min() >= knots[0] and u.max() <= knots[-1]
        and (known or s.kind == SegmentKind.STEADY)
    ]  # fmt: skip
    placed.sort(key=lambda each: each[0].end_ns)
    kept = [s for s, _, _ in placed]
    u, scale = (np.array([each[k] for each in placed]).reshape(-1, 2) for k in (1, 2))
    middle = u.mean(axis=1)
    measured = np.array([0.5 * (s.power_start_mw + s.power_end_mw) for s in kept])
    return SegmentResiduals(
        np.array([(s.start_ns + s.end_ns) // 2 for s in kept], dtype=np.int64),
        middle,
        measured - _expected(curve, kept, u, scale),
        np.array([s.samples for s in kept], dtype=np.int64),
    )


def _ends(form: StaticForm, s: SpecialSegment) -> tuple[FloatArray, FloatArray]:
    """Return argument and factor of a curve at both ends of a segment; NaN if unknown."""
    if not form.scaled and (math.isnan(s.exponent) or s.exponent == form.exponent):
        return np.array([s.u_start, s.u_end]), np.ones(2)
    u, scale = form.of_rows(
        np.array([s.opening_start_percent, s.opening_end_percent]),
        np.array([s.pressure_start_mpa, s.pressure_end_mpa]),
    )
    return u, np.ones(2) if scale is None else scale


def _expected(
    curve: Characteristic, segments: Sequence[SpecialSegment], ends: FloatArray,
    scales: FloatArray,
) -> FloatArray:  # fmt: skip
    """Return the mean power of the curve along each segment; ``ends``, ``scales``: (k, 2)."""
    if not segments:
        return np.empty(0)
    model = curve.model
    share = (np.arange(_POINTS) + 0.5) / _POINTS
    u, scale = (x[:, :1] + (x[:, 1:] - x[:, :1]) * share for x in (ends, scales))
    flow = model.static(u, scale).mean(axis=1)
    if not curve.dynamics:
        return np.asarray(flow)
    region = np.searchsorted(model.levels, flow)
    behind_s = (model.time_constants + model.delays)[region]
    sloping = np.array([s.kind == SegmentKind.SLOPE for s in segments])
    middle, factor = ends.mean(axis=1), scales.mean(axis=1)
    rate = np.array([s.u_rate_per_s for s in segments])
    duration_s = np.array([max(s.end_ns - s.start_ns, 1) / NS_PER_S for s in segments])
    if curve.static_form.scaled:
        rate = (ends[:, 1] - ends[:, 0]) / duration_s
    by_pressure = model.shape(middle) * (scales[:, 1] - scales[:, 0]) / duration_s
    climb = factor * model.slopes()[piece_of(curve, middle)] * rate + by_pressure
    return np.asarray(flow - np.where(sloping, climb, 0.0) * behind_s)


def after_known_changes(series: SegmentResiduals, known_ns: int) -> SegmentResiduals:
    """Return the segments after the most significant change before a time.

    A change before the end of the reference's data, ``known_ns``, is contained in the reference,
    and is no shift relative to it.
    """
    known = series.part(np.arange(series.count_until(known_ns)))
    found = scan(known.residual_mw, known.weights)
    if found is None or found.p_value > _KNOWN:
        return series
    return series.part(np.arange(found.place, len(series)))


def common_change(series: Sequence[SegmentResiduals], known_ns: int) -> tuple[int, int, int]:
    """Return the common time of change of several pieces of a curve, with an interval.

    Each piece has a level before and a level after the time; one member on a side is enough, for
    the members of all pieces determine the time together.

    Changes before ``known_ns`` are not considered. Return median and 95 % interval of the time in
    ns, for a prior that is uniform in time; 0, 0, 0 if no common change is seen.
    """
    edges = np.unique(np.concatenate([s.time_ns for s in series]))
    allowed = edges[1:] > known_ns
    count = sum(len(s) for s in series)
    freedom = count - 2 * len(series)
    if freedom < LEAST_SIDE or not allowed.any():
        return 0, 0, 0
    gain = np.zeros(len(edges) - 1)
    before = np.zeros(len(edges) - 1)  # weight of all members before the change
    sided = np.zeros(len(edges) - 1, dtype=np.int64)  # pieces with members on both sides
    for s in series:
        places = np.searchsorted(s.time_ns, edges[:-1], side='right')
        weight = np.append(0.0, np.cumsum(s.weights))
        total = np.append(0.0, np.cumsum(s.weights * s.residual_mw))
        both = (places > 0) & (places < len(s))
        first, last = weight[places], weight[-1] - weight[places]
        with np.errstate(divide='ignore', invalid='ignore'):
            change = (total[-1] - total[places]) / last - total[places] / first
            gain += np.where(both, first * last / weight[-1] * change**2, 0.0)
        before += first
        sided += both
    gain[~allowed] = 0.0
    best = int(np.argmax(gain))
    split_ns = int(edges[best])
    rest = np.concatenate([_about_levels(s, split_ns) for s in series])
    weights = np.concatenate([s.weights for s in series])
    order = np.argsort(np.concatenate([s.time_ns for s in series]), kind='stable')
    variance = _variance(rest, weights, freedom)
    likelihood = np.where(allowed, 0.5 * gain / (variance * _widening(rest[order])), -math.inf)
    # The tail of F with one level per piece, as the normal deviate of one level.
    levels = max(int(sided[best]), 1)
    tail = float(fdtrc(levels, freedom, 2.0 * likelihood[best] / levels))
    normal = float(-ndtri(0.5 * tail)) if tail > 0.0 else _FAR
    share_before = before[allowed] / sum(float(s.weights.sum()) for s in series)
    if _chance(normal, float(share_before[0]), float(share_before[-1])) > _KNOWN:
        return 0, 0, 0
    # The last member before `known_ns` may be much older: a change until then is known.
    edges = np.maximum(edges, known_ns)
    mass = np.exp(likelihood - likelihood.max()) * np.diff(edges)
    reached = np.concatenate([[0.0], np.cumsum(mass) / mass.sum()])
    offset = np.interp([0.5, 0.025, 0.975], reached, (edges - edges[0]).astype(np.float64))
    middle, low, high = (int(edges[0]) + int(v) for v in offset)
    return middle, low, high


def _about_levels(series: SegmentResiduals, split_ns: int) -> FloatArray:
    """Return the residuals about the means before and after a time."""
    rest = series.residual_mw.copy()
    for part in (series.time_ns <= split_ns, series.time_ns > split_ns):
        if part.any():
            rest[part] -= np.average(rest[part], weights=series.weights[part])
    return rest
