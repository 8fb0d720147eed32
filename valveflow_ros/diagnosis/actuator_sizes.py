"""Sizes of a fault between command and position, from rows the sensor's noise cannot choose.

A fit of positions one row ahead finds which fault there is, but its sizes are pulled aside:
the noise of the reading a row before decides, together with the threshold, whether the valve
is taken to move, and stands in the prediction as well. Here rows are chosen by readings that
have no part in what is averaged over them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.special import log_ndtr

from valveflow_ros.records import BoolArray, FloatArray, IntArray

Sizes = tuple[tuple[float, float, float], ...]  # value, low, high of each parameter
_LEAST_ROWS = 12  # of one direction
_CLEAR = 3.0  # standard deviations of the reading that count as surely
_SLIP = 3.5  # what half a jump must exceed, likewise
_RUN = 4
_MOVED_PERCENT = 0.015  # more than two readings rounded to 0.01 % can differ at rest
_ROUNDED = 0.003  # standard deviation of a rounded reading, in %
_BINS = 300
_Z95, _CHI95 = 1.96, 3.84


def sized(
    name: str, c: FloatArray, v: FloatArray, step_s: float, values: tuple[float, ...]
) -> Sizes | None:
    """Return sizes with 95 % intervals, None where too few rows tell them.

    Parameters
    ----------
    name : str
        'stiction', 'backlash' or 'rate_limit'; others are left to the fit.
    c, v : float64 (n,)
        Command and measured position in %, one row after the other; NaN where missing.
    step_s : float
        Time between rows.
    values : tuple of float
        The parameters as fitted: of stiction S and J, of backlash the width, of the rate limit
        the rate.
    """
    ways: dict[str, Callable[..., Sizes | None]] = {
        'stiction': _stiction, 'backlash': _backlash, 'rate_limit': _rate,
    }  # fmt: skip
    if name not in ways or len(v) < 10:
        return None
    return ways[name](c, v, _noise(v), step_s, values)


def _noise(v: FloatArray) -> float:
    """Return the noise of a reading from steps while nothing moves; a rounded 0.01 % at least."""
    step = np.abs(np.diff(v))
    return max(float(np.nanmedian(step) / (0.6745 * np.sqrt(2.0))), 0.01)


def _both_ways(
    choose: Callable[[float], BoolArray], distance: FloatArray
) -> tuple[float, float, float] | None:
    """Return the mean distance upward and downward and the standard error of half their sum."""
    found = []
    for sign in (1.0, -1.0):
        some = sign * distance[choose(sign)]
        some = some[np.isfinite(some)]
        if len(some) < _LEAST_ROWS:
            return None
        found.append((float(some.mean()), float(some.var()) / len(some)))
    (up, up2), (down, down2) = found
    return up, down, 0.5 * float(np.sqrt(up2 + down2))


def _rate(
    c: FloatArray, v: FloatArray, noise: float, step_s: float, values: tuple[float, ...]
) -> Sizes | None:
    """Average steps where the command was out of reach already from two rows before."""
    reach = 2.0 * values[0] * step_s + _CLEAR * noise

    def far(sign: float) -> BoolArray:
        return sign * (c[2:] - v[:-2]) > reach

    found = _both_ways(far, v[2:] - v[1:-1])
    if found is None:
        return None
    rate, error = 0.5 * (found[0] + found[1]) / step_s, _Z95 * found[2] / step_s
    return ((rate, rate - error, rate + error),)


def _backlash(
    c: FloatArray, v: FloatArray, noise: float, step_s: float, values: tuple[float, ...]
) -> Sizes | None:
    """Average the distance where a flank pushed a row before and the command has gone further."""
    reach = 0.5 * values[0] + _CLEAR * noise

    def pushed(sign: float) -> BoolArray:
        later = sign * c
        highest = np.maximum(np.maximum(later[:-3], later[1:-2]), later[2:-1])
        return (later[2:-1] - sign * v[:-3] > reach) & (later[3:] - highest > _MOVED_PERCENT)

    found = _both_ways(pushed, (c - v)[3:])
    if found is None:
        return None
    width, error = found[0] + found[1], float(np.hypot(2.0 * _Z95 * found[2], _ROUNDED))
    return ((width, width - error, width + error),)


def _stiction(
    c: FloatArray, v: FloatArray, noise: float, step_s: float, values: tuple[float, ...]
) -> Sizes | None:
    """Average where it slips to; find the pull at which it slips from slips and rests."""
    off = 0.5 * (values[0] + values[1])
    if 0.5 * values[1] < _SLIP * noise:  # a slip is not told from noise, which pulls the fit
        return tuple((x, x - 2.0 * noise, x + 2.0 * noise) for x in values)
    margin, offset, near, spread = _CLEAR * noise, 0.0, 0.0, 0.0
    for _ in range(2):  # again with what the first time finds of the sensor's offset
        free = c - offset

        def slips(sign: float, free: FloatArray = free) -> BoolArray:
            pulled = sign * (free[2:] - v[:-2]) > off + margin
            return pulled & (sign * (free[1:-1] - v[:-2]) < off - margin)

        found = _both_ways(slips, (c - v)[2:])
        if found is None:
            return None
        up, down, spread = found
        near, offset = 0.5 * (up + down), 0.5 * (up - down)
    threshold = _threshold(c - offset, v, 0.5 * values[1], off)
    if threshold is None:
        return None
    off, error = threshold[0], float(np.hypot(_Z95 * spread, threshold[1]))
    s, j = off + near, off - near
    return (s, s - error, s + error), (j, j - error, j + error)


def _threshold(
    c: FloatArray, v: FloatArray, moved: float, off: float
) -> tuple[float, float] | None:
    """Return the pull at which the valve slips and the half width of its 95 % interval.

    The place it rests at is the mean of some rows without a slip. A slip is probit in the pull.
    """
    step = np.abs(np.diff(v)) > moved
    n = len(v) - _RUN
    rests = np.ones(n, dtype=bool)
    for k in range(_RUN - 1):
        rests &= ~step[k : k + n] & np.isfinite(v[k : k + n])
    place = np.convolve(v, np.full(_RUN, 1.0 / _RUN), 'valid')[:n]
    pull = c[_RUN:] - place
    slip = (v[_RUN:] - place) * np.sign(pull) > moved
    near = rests & (np.abs(np.abs(pull) - off) < 0.3 * off) & np.isfinite(v[_RUN:])
    pull, slip = np.abs(pull[near]), slip[near]
    if slip.sum() < _LEAST_ROWS or (~slip).sum() < _LEAST_ROWS:
        return None
    edges = off * np.linspace(0.7, 1.3, _BINS + 1)
    slips, stays = (np.histogram(pull[m], edges)[0] for m in (slip, ~slip))
    return _probit(0.5 * (edges[1:] + edges[:-1]), slips, stays, off)


def _probit(pull: FloatArray, slips: IntArray, rests: IntArray, off: float) -> tuple[float, float]:
    """Return the pull at which half slip, and the half width of its profile's interval."""
    centres = off * np.linspace(0.92, 1.08, 161)
    best = np.full(len(centres), -np.inf)
    for width in off * np.geomspace(0.003, 0.1, 9):
        side = (pull - centres[:, None]) / width
        best = np.maximum(best, log_ndtr(side) @ slips + log_ndtr(-side) @ rests)
    k = int(np.argmax(best))
    inside = centres[best > best[k] - 0.5 * _CHI95]
    return float(centres[k]), float(max(inside[-1] - centres[k], centres[k] - inside[0], _ROUNDED))
