"""Flow that is not choked: the pressure behind the valve throttles it.

Above the critical ratio r_c of pressures (0.546 for superheated steam) the flow follows an
ellipse, psi(r) = sqrt(1 - ((r - r_c) / (1 - r_c))^2); the pressure behind the valve is
proportional to the flow (Stodola), r = kappa x / p. The curve holds the usual psi on the
line p_s(x) of sliding pressure already, so what shows is

    u_true = u psi(kappa F(u) / p) / psi(kappa F(u) / p_s(F(u)))

IEC 60534 says the same of control valves with an expansion factor.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from valveflow_ros.curve.model import RegionalModel
from valveflow_ros.diagnosis import kernels
from valveflow_ros.diagnosis.bench import Bench
from valveflow_ros.diagnosis.cause import Cause, Stage, Start, Unknown, Values
from valveflow_ros.diagnosis.causes.exponent import hindered
from valveflow_ros.diagnosis.scene import Scene
from valveflow_ros.records import FloatArray

_CRITICAL, _LARGEST = 0.546, 0.98
_TRIED_RATIOS = (0.57, 0.61, 0.66, 0.72, 0.79, 0.87)


def _psi(ratio: FloatArray) -> FloatArray:
    share = (np.clip(ratio, _CRITICAL, _LARGEST) - _CRITICAL) / (1.0 - _CRITICAL)
    return np.asarray(np.sqrt(1.0 - share * share))


def _flow(u: FloatArray, model: RegionalModel) -> FloatArray:
    x = np.empty(len(u))
    kernels.flow(u, model.knots, model.left, model.right, x)
    return np.maximum(x, 0.0)


def act(u: FloatArray, values: Values, scene: Scene, model: RegionalModel) -> FloatArray:
    """Return the factor on u."""
    x = _flow(u, model)
    p = np.maximum(scene.pressure, 1e-6)
    line = np.maximum(scene.reference.pressure_level + scene.reference.pressure_slope * x, 0.1 * p)
    kappa = values[0]
    return np.asarray(_psi(kappa * x / p) / _psi(kappa * x / line))


def starts(bench: Bench) -> Sequence[Start]:
    """Try sizes that reach different pressure ratios at high load."""
    scene = bench.scene
    here = scene.usable > 0
    x = _flow(scene.u[here], bench.model.base)
    top = float(np.quantile(x / np.maximum(scene.pressure[here], 1e-6), 0.98))
    if not top > 0.0:
        return []
    return bench.best(CAUSE, [(r / top,) for r in _TRIED_RATIOS])


def sentence(values: dict[str, float]) -> str:
    """Say it."""
    return (
        'At high load the flow through the valve is not choked: the pressure behind it, about '
        f'{values["kappa"]:.3g} MPa for every MW, throttles the flow.'
    )


CAUSE = Cause(
    'choked', 'nozzle', Stage.INPUT,
    (Unknown('kappa', 'MPa/MW', 1e-4, 0.0, 0.5),),
    act, starts, sentence, ('exponent', 'curve_shape'),
    'Move the pressure by 0.5 MPa once at high and once at low load.',
    hindered,
)  # fmt: skip
