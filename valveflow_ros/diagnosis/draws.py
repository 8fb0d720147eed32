"""Causes whose path depends on noise nobody measured: several draws, weighed by the power.

A valve that sticks slips when the pull passes a threshold, and the noise of the position
sensor decides on which side of it a row lies. One simulated path soon leaves the true one
until both slip again. Several paths, each with noise of its own, are run; the power measured
*before* a row says how much each is believed in that row. The past weighs less and less, so
that a path that went astray can come back.

The rule is that of the fixed-share forecaster (Herbster and Warmuth, Machine Learning 32, 1998,
151): it never looks at the row it predicts, so that it gains nothing where the cause is absent.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from valveflow_ros.diagnosis.cause import Active, Cause, Kind, Stage, Values
from valveflow_ros.diagnosis.extended import Extended, answer
from valveflow_ros.diagnosis.scene import Scene
from valveflow_ros.jit import jit
from valveflow_ros.records import BoolArray, FloatArray

_EVERY = 7  # rows are enough for a median
_OF_NORMAL = 0.455  # the median square of a standard normal variable
_SHARED = 0.005  # of the belief that goes round at every mean: one change in half an hour


@jit
def beliefs(
    white: FloatArray, good: BoolArray, variance: float, shared: float, out: FloatArray
) -> None:
    """Write how much each of several predictions is believed in every row.

    Parameters
    ----------
    white : float64 (k, m)
        Whitened residuals of every prediction.
    good : bool (m,)
        Rows whose whitened residuals count.
    variance : float
        Of a whitened residual where the prediction is right.
    shared : float
        Part of the belief that is given to all alike at every row.
    out : float64 (k, m)
        Columns sum to 1.
    """
    count = white.shape[0]
    belief = np.full(count, 1.0 / count)
    for t in range(white.shape[1]):
        out[:, t] = belief
        if not good[t]:
            continue
        least = np.min(white[:, t] ** 2)
        total = 0.0
        for k in range(count):
            belief[k] *= np.exp(-(white[k, t] ** 2 - least) / (2.0 * variance))
            total += belief[k]
        for k in range(count):
            belief[k] = (1.0 - shared) * belief[k] / total + shared / count


def drawn(model: Extended) -> Active | None:
    """Return the cause of a model that is drawn, None if there is none."""
    return next((a for a in model.active if a.cause.draws), None)


def _believed(
    scene: Scene, model: Extended, a: Active, ar: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return residuals and beliefs of all draws, both (k, m)."""
    rest = np.empty((a.cause.draws, len(scene.power)))
    for k in range(a.cause.draws):
        one = replace(model, active=tuple(_single(b, k) if b is a else b for b in model.active))
        rest[k] = np.where(scene.scored, scene.power - answer(scene, one), 0.0)
    white = rest.copy()
    for lag, factor in enumerate(ar, start=1):
        white[:, lag:] -= factor * rest[:, :-lag]
    out = np.empty_like(rest)
    beliefs(white, scene.whole, _variance(white[:, scene.whole]), _SHARED, out)
    return rest, out


def believed_residual(scene: Scene, model: Extended, a: Active, ar: FloatArray) -> FloatArray:
    """Return the residual of the believed mean of all draws in MW, shape (m,).

    Parameters
    ----------
    a : Active
        The cause of the model that is drawn.
    ar : float64 (p,)
        Of the noise.
    """
    rest, belief = _believed(scene, model, a, ar)
    return np.asarray(np.einsum('km,km->m', rest, belief))


@dataclass(frozen=True, slots=True)
class _Path:
    """The believed path of the plug in one record, for the values it was found with."""

    path: FloatArray
    values: Values
    usual: Callable[..., FloatArray]

    def __call__(self, v: FloatArray, values: Values, scene: Scene) -> FloatArray:
        """Act as found, or as usual for another record or other values."""
        if values == self.values and len(v) == len(self.path):
            return self.path
        return self.usual(v, values, scene)


def held(scene: Scene, model: Extended, ar: FloatArray) -> Extended:
    """Return the model with the believed path in place of the draws; its parameters stay.

    Everything else can then be fitted at the usual speed.
    """
    a = drawn(model)
    if a is None or a.cause.draw is None or a is not _first_of_opening(model):
        return model
    _, belief = _believed(scene, model, a, ar)
    rows = np.minimum(np.arange(len(scene.v)) * len(scene.power) // len(scene.v),
                      len(scene.power) - 1)  # fmt: skip
    path = np.zeros(len(scene.v))
    for k in range(a.cause.draws):
        path += belief[k][rows] * a.cause.draw(k)(scene.v, a.values, scene)
    unknowns = tuple(replace(u, kind=Kind.HELD) for u in a.cause.unknowns)
    act = _Path(path, a.values, a.cause.act)
    return model.having(
        replace(a, cause=replace(a.cause, act=act, draws=0, draw=None, unknowns=unknowns))
    )


def free(model: Extended, causes: Mapping[str, Cause]) -> Extended:
    """Return the model with every cause as the catalogue has it."""
    return replace(
        model, active=tuple(replace(a, cause=causes[a.name]) for a in model.active)
    )  # fmt: skip


def _first_of_opening(model: Extended) -> Active:
    """Return the cause that acts on the measured opening itself."""
    return min(model.at(Stage.OPENING), key=lambda a: a.cause.order)


def _single(a: Active, draw: int) -> Active:
    """Return the cause as one of its draws; ``extra`` tells the draws apart."""
    assert a.cause.draw is not None
    return replace(
        a, cause=replace(a.cause, act=a.cause.draw(draw), draws=0), extra=(float(draw),)
    )


def _variance(white: FloatArray) -> float:
    """Return the variance where a draw is right, which is most of the time."""
    squares = white[:, ::_EVERY] ** 2
    return max(float(np.median(np.median(squares, axis=1))) / _OF_NORMAL, 1e-12)
