# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Effects in the flow through the valve: exponent of the pressure, unchoked flow, temperature."""

from __future__ import annotations

import numpy as np

from valveflow_ros.errors import InputError
from valveflow_ros.parameters import Parameter
from valveflow_ros.plant.effect import Hooks, Values, effect


@effect(
    'The flow follows another power of the pressure than eq. (1) says.',
    Parameter('dm', 0.06, '', 'True exponent minus that of eq. (1).', -0.5, 0.5),
    Parameter('reference_mpa', 13.0, 'MPa', 'Pressure of no change.', 1.0, 40.0),
)
def exponent(values: Values, hooks: Hooks) -> None:
    """The exponent of the pressure differs from 9/8.

    The 9/8 of eq. (1) comes from the drum boiler model of Bell and Astrom, fitted
    to one unit; ideal choked flow has 1.0. A unit whose true exponent is m + dm
    has, compared with the u of eq. (1),

        u_true = u (p / p_ref)^dm
    """
    reference = values['reference_mpa']
    hooks.scale_input(lambda rows: (rows.pressure_mpa / reference) ** values['dm'])


_LARGEST_USUAL_RATIO = 0.9


@effect(
    'At high load the valve is not choked and the pressure behind it throttles the flow.',
    Parameter(
        'kappa', 0.038, 'MPa/MW', 'Pressure behind the valve per power; 0: choked.', 0.0, 0.1
    ),
    Parameter('critical_ratio', 0.546, '', 'Pressure ratio of choked flow.', 0.3, 0.8),
)
def choked(values: Values, hooks: Hooks) -> None:
    """The flow is not choked: it depends on the pressure after the valve.

    Below the critical ratio of the pressures after and before a nozzle the flow
    does not depend on the pressure after it; above, it follows an ellipse,

        psi(r) = sqrt(1 - ((r - r_c) / (1 - r_c))^2),  r > r_c,

    with r_c about 0.546 for superheated steam. The pressure after the valve is
    proportional to the flow (Stodola), r = kappa x / p. A curve identified with
    sliding pressure contains the usual psi, so only the deviation from the sliding
    line p_s has an effect; x is taken from the curve, F(u):

        u_true = u psi(kappa x / p) / psi(kappa x / p_s(x))

    IEC 60534 describes this effect in control valves by an expansion factor.
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


@effect(
    'The power depends on the main steam temperature.',
    Parameter('k', -0.0006, '1/K', 'Relative change of the power per kelvin.', -0.01, 0.01),
    Parameter('reference_degc', 539.0, 'degC', 'Temperature of no change.', 300.0, 700.0),
)
def temperature(values: Values, hooks: Hooks) -> None:
    """The power depends on the main steam temperature, which the paper assumes constant.

    A turbine has a constant swallowing capacity, m ~ p / sqrt(T_K) (the cone law
    of Stodola and Fluegel): hotter steam has a smaller mass flow, about -0.062 %/K
    at 539 degC. The enthalpy drop rises with the temperature and compensates a
    part; -0.03 to -0.06 %/K of power remain for main steam only.

        x = F(u) (1 + k (T - T_ref))
    """
    reference = values['reference_degc']
    hooks.scale_power(lambda rows: 1.0 + values['k'] * (rows.temperature_degc - reference))
