"""From the plug's opening to steam power: eqs. (1) and (2), and what effects change in them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from valveflow_ros.jit import jit
from valveflow_ros.plant.hooks import AddedCurve, Hooks
from valveflow_ros.records import FloatArray

# Beyond it the ellipse would end in no flow at all.
_LARGEST_RATIO = 0.98


class FlowLaw(NamedTuple):
    """The curve, what is added to it, and the nozzle.

    ``added_u``, ``added_x`` (k, m) and ``added_from_s`` (k,) are curves on top
    of F; ``nozzle`` is (kappa, critical ratio, and the sliding pressure as
    pressure at no load and rise per MW).
    """

    curve_u: FloatArray
    curve_x: FloatArray
    added_u: FloatArray
    added_x: FloatArray
    added_from_s: FloatArray
    nozzle: FloatArray


def _same_length(curves: list[AddedCurve]) -> tuple[FloatArray, FloatArray]:
    """Return curves as two tables; short ones get further points on their level end."""
    m = max((c.u.size for c in curves), default=2)
    u, x = np.zeros((len(curves), m)), np.zeros((len(curves), m))
    for k, curve in enumerate(curves):
        missing = m - curve.u.size
        u[k] = np.append(curve.u, curve.u[-1] + 1.0 + np.arange(missing))
        x[k] = np.append(curve.x_mw, np.full(missing, curve.x_mw[-1]))
    return u, x


def flow_law(hooks: Hooks) -> FlowLaw:
    """Collect the flow law of a run from its hooks."""
    plan = hooks.unit.programme
    curve_x, curve_u = hooks.unit.curve.inverse_table()
    rise = plan.pressure_rise_mpa / plan.pressure_span_mw
    at_no_load = plan.pressure_low_mpa - rise * plan.load_low_mw
    nozzle = (hooks.kappa_mpa_per_mw, hooks.critical_ratio, at_no_load, rise)
    since = np.array([curve.from_s for curve in hooks.added_curves])
    return FlowLaw(curve_u, curve_x, *_same_length(hooks.added_curves), since, np.array(nozzle))


@jit
def interpolate(x: float, xs: FloatArray, ys: FloatArray) -> float:
    """Interpolate linearly; beyond the ends the outer pieces go on."""
    k = 0
    while k < xs.size - 2 and x >= xs[k + 1]:
        k += 1
    return float(ys[k] + (ys[k + 1] - ys[k]) * (x - xs[k]) / (xs[k + 1] - xs[k]))


@jit
def subcritical_factor(ratio: float, critical: float) -> float:
    """Return the flow relative to the choked flow at a pressure ratio behind/before."""
    if ratio <= critical:
        return 1.0
    share = (min(ratio, _LARGEST_RATIO) - critical) / (1.0 - critical)
    return float(np.sqrt(1.0 - share * share))


@jit
def nozzle_factor(x: float, pressure: float, nozzle: FloatArray) -> float:
    """Return what the pressure behind the valve makes of u, against the sliding line."""
    kappa, critical = nozzle[0], nozzle[1]
    if kappa == 0.0:
        return 1.0
    usual = subcritical_factor(kappa * x / (nozzle[2] + nozzle[3] * x), critical)
    return float(subcritical_factor(kappa * x / pressure, critical) / usual)


@jit
def added(
    u: float, time_s: float, curve_u: FloatArray, curve_x: FloatArray, from_s: FloatArray
) -> float:
    """Return the sum in MW of the added curves that have begun."""
    total = 0.0
    for k in range(from_s.size):
        if time_s >= from_s[k]:
            inside = min(max(u, curve_u[k, 0]), curve_u[k, -1])
            total += interpolate(inside, curve_u[k], curve_x[k])
    return total
