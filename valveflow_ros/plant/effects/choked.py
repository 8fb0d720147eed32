"""Flow that is not choked: the pressure behind the valve matters.

Below the critical ratio of the pressures behind and before a nozzle the flow
no longer depends on the pressure behind it; above, it follows an ellipse,

    psi(r) = sqrt(1 - ((r - r_c) / (1 - r_c))^2),  r > r_c,

r_c being about 0.546 for superheated steam. The pressure behind the valve is
proportional to the flow (Stodola), r = kappa x / p. A curve identified under
sliding pressure has the usual psi inside, so only the departure from the
sliding line p_s shows; x is taken from the curve, F(u):

    u_true = u psi(kappa x / p) / psi(kappa x / p_s(x))

IEC 60534 describes the same of control valves by an expansion factor.
"""

from __future__ import annotations

import numpy as np

from valveflow_ros.config import Parameter
from valveflow_ros.errors import InputError
from valveflow_ros.plant.effect import Effect, Values
from valveflow_ros.plant.hooks import Hooks

_LARGEST_USUAL_RATIO = 0.9


def install(values: Values, hooks: Hooks) -> None:
    """Give the nozzle its back pressure.

    Raises
    ------
    InputError
        On this unit's sliding line the pressure behind the valve would come
        near the one before it, where nothing flows.
    """
    hooks.claim('choked')
    plan = hooks.unit.programme
    loads = np.array([plan.load_low_mw, plan.load_high_mw])
    per_kappa = float(np.max(loads / plan.sliding_pressure_mpa(loads)))
    if values['kappa'] * per_kappa > _LARGEST_USUAL_RATIO:
        raise InputError(
            f"Effect 'choked': kappa must be {_LARGEST_USUAL_RATIO / per_kappa:.4f} at most for "
            f'this unit, not {values["kappa"]:g}, or hardly any steam would flow.'
        )
    hooks.kappa_mpa_per_mw = values['kappa']
    hooks.critical_ratio = values['critical_ratio']


EFFECT = Effect(
    'choked',
    'At high load the valve is not choked and the pressure behind it throttles the flow.',
    (
        Parameter(
            'kappa', 0.038, 'MPa/MW', 'Pressure behind the valve per power; 0: choked.', 0.0, 0.1
        ),
        Parameter('critical_ratio', 0.546, '', 'Pressure ratio of choked flow.', 0.3, 0.8),
    ),
    install,
)
