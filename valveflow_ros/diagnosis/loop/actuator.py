# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Faults between command and position sensor, if the commanded opening was logged.

They do not depend on the turbine. The model of each fault predicts the next position from the
command and the *measured* position one row before. So the simulated path of a sticking valve
cannot diverge from the true one if the command is rounded. A first-order servo and an offset of
the sensor are not faults.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import log_ndtr

from valveflow_ros.diagnosis.evidence import chance_of_gain
from valveflow_ros.diagnosis.grids import FOLDS, SEALED_FOLD, SUBS_IN_BLOCK, Grids
from valveflow_ros.records import BoolArray, FloatArray, IntArray

# Sizes of a fault between command and position, without selection bias from the sensor noise.
#
# The one-step prediction identifies the fault, but its sizes are biased: the noise of the previous
# reading decides, together with the threshold, whether the valve is expected to move, and it also
# enters the prediction. Here the rows are selected by readings that do not enter the averages
# over these rows.

Sizes = tuple[tuple[float, float, float], ...]  # value, low, high of each parameter
_LEAST_SIZED_ROWS = 12  # per direction
_CLEAR = 3.0  # standard deviations of the reading for a clear distance
_SLIP = 3.5  # minimum of half a jump, in standard deviations of the reading
_RUN = 4
_MOVED_PERCENT = 0.015  # larger than the difference at rest between two readings rounded to 0.01 %
_ROUNDED = 0.003  # standard deviation of a rounded reading, in %
_BINS = 300
_Z95 = 1.96
_CHI95 = 3.84


def sized(
    name: str, c: FloatArray, v: FloatArray, step_s: float, values: tuple[float, ...],
    most_noise: float = np.inf,
) -> Sizes | None:  # fmt: skip
    """Return sizes with 95 % intervals; None if there are too few suitable rows.

    Parameters
    ----------
    name : str
        'stiction', 'backlash' or 'rate_limit'; None for other names.
    c, v : float64 (n,)
        Command and measured position in %, consecutive rows; NaN if missing.
    step_s : float
        Time between rows.
    values : tuple of float
        The fitted parameters: S and J of stiction, the width of backlash, the rate of the rate
        limit.
    most_noise : float
        Upper bound of the standard deviation of a reading: if the valve hardly ever rests, the
        readings alone cannot give it.
    """
    ways: dict[str, Callable[..., Sizes | None]] = {
        'stiction': _stiction_size, 'backlash': _backlash_size, 'rate_limit': _rate_size,
    }  # fmt: skip
    if name not in ways or len(v) < 10:
        return None
    return ways[name](c, v, min(_noise(v), most_noise), step_s, values)


def _noise(v: FloatArray) -> float:
    """Return the noise of a reading from steps at rest; at least 0.01 %, the rounding."""
    step = np.abs(np.diff(v))
    return max(float(np.nanmedian(step) / (0.6745 * np.sqrt(2.0))), 0.01)


def _both_ways(
    choose: Callable[[float], BoolArray], distance: FloatArray
) -> tuple[float, float, float] | None:
    """Return the mean distance upward and downward and the standard error of their mean."""
    found = []
    for sign in (1.0, -1.0):
        some = sign * distance[choose(sign)]
        some = some[np.isfinite(some)]
        if len(some) < _LEAST_SIZED_ROWS:
            return None
        found.append((float(some.mean()), float(some.var()) / len(some)))
    (up, up2), (down, down2) = found
    return up, down, 0.5 * float(np.sqrt(up2 + down2))


def _rate_size(
    c: FloatArray, v: FloatArray, noise: float, step_s: float, values: tuple[float, ...]
) -> Sizes | None:
    """Average the steps in rows where the command was already out of reach two rows before."""
    reach = 2.0 * values[0] * step_s + _CLEAR * noise

    def far(sign: float) -> BoolArray:
        return sign * (c[2:] - v[:-2]) > reach

    found = _both_ways(far, v[2:] - v[1:-1])
    if found is None:
        return None
    rate, error = 0.5 * (found[0] + found[1]) / step_s, _Z95 * found[2] / step_s
    return ((rate, rate - error, rate + error),)


def _backlash_size(
    c: FloatArray, v: FloatArray, noise: float, step_s: float, values: tuple[float, ...]
) -> Sizes | None:
    """Average the distance in rows where the command pushed before and has moved further."""
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


def _stiction_size(
    c: FloatArray, v: FloatArray, noise: float, step_s: float, values: tuple[float, ...]
) -> Sizes | None:
    """Average the distance after a slip; find the threshold from rows with and without slip."""
    off = 0.5 * (values[0] + values[1])
    if 0.5 * values[1] < _SLIP * noise:  # slips are hidden by noise, which biases the fit
        return tuple((x, x - 2.0 * noise, x + 2.0 * noise) for x in values)
    margin, offset, near, spread = _CLEAR * noise, 0.0, 0.0, 0.0
    for _ in range(2):  # repeat with the sensor offset found in the first pass
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
    """Return the distance at which the valve slips and the half width of its 95 % interval.

    The rest position is the mean of several rows without slip. The slip probability is a probit.
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
    if slip.sum() < _LEAST_SIZED_ROWS or (~slip).sum() < _LEAST_SIZED_ROWS:
        return None
    edges = off * np.linspace(0.7, 1.3, _BINS + 1)
    slips, stays = (np.histogram(pull[m], edges)[0] for m in (slip, ~slip))
    return _probit(0.5 * (edges[1:] + edges[:-1]), slips, stays, off)


def _probit(pull: FloatArray, slips: IntArray, rests: IntArray, off: float) -> tuple[float, float]:
    """Return the distance with slip probability 0.5, and the half width of its interval."""
    centres = off * np.linspace(0.92, 1.08, 161)
    best = np.full(len(centres), -np.inf)
    for width in off * np.geomspace(0.003, 0.1, 9):
        side = (pull - centres[:, None]) / width
        best = np.maximum(best, log_ndtr(side) @ slips + log_ndtr(-side) @ rests)
    k = int(np.argmax(best))
    inside = centres[best > best[k] - 0.5 * _CHI95]
    return float(centres[k]), float(max(inside[-1] - centres[k], centres[k] - inside[0], _ROUNDED))


_SERVO_S = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)
_LEAST_ROWS, _MOST_ROWS = 1000, 150_000
_LEAST_GAIN = 30.0
_PENALTY = 10.0
_LEAST_SHARE = 0.05
_SUBS = 80  # number of parts of a record without given parts
_DEPENDENT = 10.0  # number of rows that count as one, because the residual is correlated
_TOP_PERCENT, _MOSTLY_AT_TOP = 0.3, 0.3
_SHARES = (0.1, 0.05, 0.02, 0.008, 0.003, 0.001)

Values = tuple[float, ...]
# (command, position one row before, values, step in s) -> predicted position
Operator = Callable[[FloatArray, FloatArray, Values, float], FloatArray]


@dataclass(frozen=True, slots=True)
class ActuatorFault:
    """A fault between command and sensor.

    Attributes
    ----------
    name : str
    parameters : dict
        Value, low, high of each, 95 % interval.
    rms_before, rms_after : float
        RMS of position minus model on sealed (test) blocks, in % of opening.
    p_value : float
        p-value of the gain on these blocks, as in `evidence.chance_of_gain`.
    """

    name: str
    parameters: dict[str, tuple[float, float, float]]
    rms_before: float
    rms_after: float
    p_value: float


@dataclass(frozen=True, slots=True)
class _Plan:
    """A fault to be fitted: its name, parameters, operator and initial sizes."""

    name: str
    keys: tuple[str, ...]
    operator: Operator
    grid: list[Values]


@dataclass(frozen=True, slots=True)
class _Fit:
    """A fault with fitted values and its mean squared error."""

    plan: _Plan
    values: Values
    cost: float


def hindered(grids: Grids) -> str:
    """Return why the actuator cannot be judged directly; empty if it can."""
    both = np.isfinite(grids.command) & np.isfinite(grids.v)
    if not np.isfinite(grids.command).any():
        return 'the commanded opening was not logged'
    if both.sum() < _LEAST_ROWS or float(np.std(grids.command[both])) == 0.0:
        return 'the commanded opening hardly changes, or was rarely logged with the position'
    if grids.blur.compressed:
        return 'the log is compressed, and command and position are kept at different times'
    return ''


def _servo(c: FloatArray, before: FloatArray, values: Values, step_s: float) -> FloatArray:
    if values[0] == 0.0:
        return c
    return np.asarray(before + (1.0 - np.exp(-step_s / values[0])) * (c - before))


def _backlash(c: FloatArray, before: FloatArray, values: Values, step_s: float) -> FloatArray:
    return np.clip(before, c - 0.5 * values[0], c + 0.5 * values[0])


def _stiction(c: FloatArray, before: FloatArray, values: Values, step_s: float) -> FloatArray:
    band, jump = values[0], min(values[1], values[0])
    pull, off, near = c - before, 0.5 * (band + jump), 0.5 * (band - jump)
    return np.where(np.abs(pull) > off, c - near * np.sign(pull), before)


def _rate(c: FloatArray, before: FloatArray, values: Values, step_s: float) -> FloatArray:
    largest = values[0] * step_s
    return np.asarray(before + np.clip(c - before, -largest, largest))


def _stop(c: FloatArray, before: FloatArray, values: Values, step_s: float) -> FloatArray:
    return np.minimum(c, values[0])


def _plans(c: FloatArray) -> list[_Plan]:
    """Return every fault to be fitted."""
    widths = np.geomspace(0.04, 8.0, 24).tolist()
    rates = np.geomspace(0.01, 3.0, 20).tolist()
    stops = np.quantile(c, (0.2, 0.3, 0.5, 0.7, 0.8, 0.88, 0.94, 0.98)).tolist()
    pairs: list[Values] = [(w, f * w) for w in widths for f in (0.2, 0.4, 0.6, 0.7, 0.8, 0.9)]
    return [
        _Plan('', ('time_s',), _servo, [(s,) for s in _SERVO_S]),
        _Plan('backlash', ('w_percent',), _backlash, [(w,) for w in widths]),
        _Plan('stiction', ('s_percent', 'j_percent'), _stiction, pairs),
        _Plan('rate_limit', ('r_percent_per_s',), _rate, [(r,) for r in rates]),
        _Plan('saturation', ('max_percent',), _stop, [(s,) for s in stops]),
    ]


@dataclass(frozen=True, slots=True)
class _Pairs:
    """Rows with command, position, and the position one row before."""

    c: FloatArray
    before: FloatArray
    v: FloatArray
    step_s: float

    def rest(self, plan: _Plan, values: Values) -> FloatArray:
        """Return position minus prediction in %."""
        return np.asarray(self.v - plan.operator(self.c, self.before, values, self.step_s))

    def cost(self, plan: _Plan, values: Values) -> float:
        """Return the mean squared error."""
        rest = self.rest(plan, values)
        return float(rest @ rest) / max(len(rest), 1)

    def part(self, rows: BoolArray | slice) -> _Pairs:
        """Return a subset of the rows."""
        return _Pairs(self.c[rows], self.before[rows], self.v[rows], self.step_s)


def judge(grids: Grids) -> ActuatorFault | None:
    """Return the fault between command and position sensor, None if there is none."""
    if hindered(grids):
        return None
    return judge_rows(grids.command, grids.v, grids.fine_s, grids.subs)


def judge_rows(
    command: FloatArray,
    position: FloatArray,
    step_s: float,
    subs: int = _SUBS,
    dependent: float = _DEPENDENT,
    offset: float | None = None,
) -> ActuatorFault | None:
    """Return the fault between command and position sensor, None if there is none.

    Parameters
    ----------
    command, position : float64 (n,)
        In %, consecutive rows; NaN if missing.
    step_s : float
        Time between rows.
    subs : int
        Number of parts of the record with independent scores.
    dependent : float
        Number of correlated rows that count as one.
    offset : float, optional
        Position reading minus command at rest; estimated from the rows by default. It is given for
        a short record, in which the valve may hardly rest: the noise of a reading is then bounded
        by the residual of the fit.
    """
    both = np.isfinite(command[1:]) & np.isfinite(position[1:]) & np.isfinite(position[:-1])
    rests = offset is None
    if offset is None:
        offset = _offset(command[1:][both], position[1:][both])
    pairs = _Pairs(command[1:][both] + offset, position[:-1][both], position[1:][both], step_s)
    sub = np.arange(len(position)) // max(1, len(position) // subs)
    sub = np.minimum(sub, subs - 1)[1:][both]
    sealed = sub // SUBS_IN_BLOCK % FOLDS == SEALED_FOLD
    fitted = pairs.part(~sealed).part(slice(_MOST_ROWS))
    plain, *fits = [_fitted(fitted, plan) for plan in _plans(fitted.c)]
    effective = len(fitted.v) / dependent

    def score(fit: _Fit) -> float:
        return float(0.5 * effective * np.log(max(fit.cost, 1e-12)) + _PENALTY * len(fit.values))

    best = min(fits, key=score)
    if score(plain) - score(best) < _LEAST_GAIN or best.cost > (1 - _LEAST_SHARE) * plain.cost:
        return None
    tested = pairs.part(sealed)
    old, new = tested.rest(plain.plan, plain.values), tested.rest(best.plan, best.values)
    rms = [float(np.sqrt(np.mean(r**2))) if len(r) else np.nan for r in (old, new)]
    if not rms[1] < rms[0]:
        return None
    chance = chance_of_gain(old, new, sub[sealed], len(fits))
    noise = np.inf if rests else float(np.sqrt(best.cost))
    sharp = sized(best.plan.name, command + offset, position, step_s, best.values, noise)
    parameters = (
        dict(zip(best.plan.keys, sharp, strict=True))
        if sharp
        else _intervals(fitted, best, effective)
    )
    return ActuatorFault(best.plan.name, parameters, rms[0], rms[1], chance)


def _offset(c: FloatArray, v: FloatArray) -> float:
    """Return the median of position minus command.

    If the position is often at its maximum, that may be a stop; then only the lower half of the
    commands is used.
    """
    at_top = float(np.mean(v > np.quantile(v, 0.999) - _TOP_PERCENT))
    asked = c <= np.median(c) if at_top > _MOSTLY_AT_TOP else slice(None)
    return float(np.median((v - c)[asked]))


def _fitted(pairs: _Pairs, plan: _Plan) -> _Fit:
    """Return the best values: a grid search, then a coordinate search with decreasing steps."""
    best = min((_Fit(plan, v, pairs.cost(plan, v)) for v in plan.grid), key=lambda f: f.cost)
    for share in _SHARES:
        for k in range(len(best.values)):
            for sign in (1.0, -1.0):
                while True:
                    values = list(best.values)
                    values[k] *= 1.0 + sign * share
                    cost = pairs.cost(plan, tuple(values))
                    if not cost < best.cost:
                        break
                    best = _Fit(plan, tuple(values), cost)
    return best


def _intervals(
    pairs: _Pairs, fit: _Fit, effective: float
) -> dict[str, tuple[float, float, float]]:
    """Return profile likelihood intervals (95 %), found with growing steps."""
    most = fit.cost * np.exp(_CHI95 / effective)
    out = {}
    for k, key in enumerate(fit.plan.keys):
        value, ends = fit.values[k], []
        for sign in (-1.0, 1.0):
            step = 1e-3 * value
            while step < 0.8 * value:
                moved = (*fit.values[:k], value + sign * step, *fit.values[k + 1 :])
                if pairs.cost(fit.plan, moved) > most:
                    break
                step *= 1.4
            ends.append(value + sign * step)
        out[key] = (value, ends[0], ends[1])
    return out
