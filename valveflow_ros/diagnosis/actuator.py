"""Where the commanded opening was logged: faults between command and position sensor.

They need no turbine. Each fault says where the valve goes from where it was measured to be,
given the command; predicting one row ahead from the *measured* position keeps the path of a
sticking valve from running away from the true one on a rounded command. A first-order servo
and an offset of the sensor are no faults.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from valveflow_ros.diagnosis.actuator_sizes import sized
from valveflow_ros.diagnosis.gain import sign_flip
from valveflow_ros.diagnosis.scene import FOLDS, SEALED_FOLD, SUBS_IN_BLOCK, Scene
from valveflow_ros.records import BoolArray, FloatArray

_SERVO_S = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)
_LEAST_ROWS, _MOST_ROWS = 1000, 150_000
_LEAST_GAIN = 30.0
_PENALTY = 10.0
_LEAST_SHARE = 0.05
_DEPENDENT = 10.0  # rows that count as one: what is left is not white
_CHI95 = 3.84
_TOP_PERCENT, _MOSTLY_AT_TOP = 0.3, 0.3
_SHARES = (0.1, 0.05, 0.02, 0.008, 0.003, 0.001)

Values = tuple[float, ...]
# (command, position a row before, values, step in s) to the position predicted
Operator = Callable[[FloatArray, FloatArray, Values, float], FloatArray]


@dataclass(frozen=True, slots=True)
class ActuatorFault:
    """A fault between command and sensor.

    Attributes
    ----------
    name : str
    parameters : dict
        Value, low, high of each, 95 %.
    rms_before, rms_after : float
        Of position minus model on sealed blocks, in % of opening.
    p_value : float
        Chance of such a gain there, as in `gain.sign_flip`.
    """

    name: str
    parameters: dict[str, tuple[float, float, float]]
    rms_before: float
    rms_after: float
    p_value: float


@dataclass(frozen=True, slots=True)
class _Plan:
    """A fault to be tried: its name, parameters, operator and the sizes to begin with."""

    name: str
    keys: tuple[str, ...]
    operator: Operator
    grid: list[Values]


@dataclass(frozen=True, slots=True)
class _Fit:
    """A fault with values and its mean squared misfit."""

    plan: _Plan
    values: Values
    cost: float


def hindered(scene: Scene) -> str:
    """Say why the actuator cannot be judged directly; empty if it can."""
    both = np.isfinite(scene.command) & np.isfinite(scene.v)
    if not np.isfinite(scene.command).any():
        return 'the commanded opening was not logged'
    if both.sum() < _LEAST_ROWS or float(np.std(scene.command[both])) == 0.0:
        return 'the commanded opening hardly changes, or was rarely logged with the position'
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
    """Return every fault to be tried."""
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
    """Rows with command, position, and the position a row before."""

    c: FloatArray
    before: FloatArray
    v: FloatArray
    step_s: float

    def rest(self, plan: _Plan, values: Values) -> FloatArray:
        """Return position minus prediction in %."""
        return np.asarray(self.v - plan.operator(self.c, self.before, values, self.step_s))

    def cost(self, plan: _Plan, values: Values) -> float:
        """Return the mean squared misfit."""
        rest = self.rest(plan, values)
        return float(rest @ rest) / max(len(rest), 1)

    def part(self, rows: BoolArray | slice) -> _Pairs:
        """Return some of the rows."""
        return _Pairs(self.c[rows], self.before[rows], self.v[rows], self.step_s)


def judge(scene: Scene) -> ActuatorFault | None:
    """Return the fault between command and position sensor, None if there is none."""
    if hindered(scene):
        return None
    both = np.isfinite(scene.command[1:]) & np.isfinite(scene.v[1:]) & np.isfinite(scene.v[:-1])
    offset = _offset(scene.command[1:][both], scene.v[1:][both])
    pairs = _Pairs(
        scene.command[1:][both] + offset, scene.v[:-1][both], scene.v[1:][both], scene.fine_s
    )
    sub = np.arange(len(scene.v)) // max(1, len(scene.v) // scene.subs)
    sub = np.minimum(sub, scene.subs - 1)[1:][both]
    sealed = sub // SUBS_IN_BLOCK % FOLDS == SEALED_FOLD
    fitted = pairs.part(~sealed).part(slice(_MOST_ROWS))
    plain, *fits = [_fitted(fitted, plan) for plan in _plans(fitted.c)]
    effective = len(fitted.v) / _DEPENDENT

    def score(fit: _Fit) -> float:
        return float(0.5 * effective * np.log(max(fit.cost, 1e-12)) + _PENALTY * len(fit.values))

    best = min(fits, key=score)
    if score(plain) - score(best) < _LEAST_GAIN or best.cost > (1 - _LEAST_SHARE) * plain.cost:
        return None
    tested = pairs.part(sealed)
    old, new = tested.rest(plain.plan, plain.values), tested.rest(best.plan, best.values)
    scores = np.bincount(sub[sealed], old * (old - new)).astype(np.float64)
    scores = scores[np.unique(sub[sealed])]
    rms = [float(np.sqrt(np.mean(r**2))) if len(r) else np.nan for r in (old, new)]
    if not rms[1] < rms[0]:
        return None
    chance = min(1.0, len(fits) * sign_flip(scores))
    sharp = sized(best.plan.name, scene.command + offset, scene.v, scene.fine_s, best.values)
    parameters = (
        dict(zip(best.plan.keys, sharp, strict=True))
        if sharp
        else _intervals(fitted, best, effective)
    )
    return ActuatorFault(best.plan.name, parameters, rms[0], rms[1], chance)


def _offset(c: FloatArray, v: FloatArray) -> float:
    """Return by how much the position reads more than the command: the median.

    Where the valve stands at its highest much of the time, that may be a stop, and the lower
    half of the commands tells it.
    """
    at_top = float(np.mean(v > np.quantile(v, 0.999) - _TOP_PERCENT))
    asked = c <= np.median(c) if at_top > _MOSTLY_AT_TOP else slice(None)
    return float(np.median((v - c)[asked]))


def _fitted(pairs: _Pairs, plan: _Plan) -> _Fit:
    """Return the best values: the grid's best, then each moved in steps that shrink."""
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
    """Return where the profile falls by the 95 % point, walking out in growing steps."""
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
