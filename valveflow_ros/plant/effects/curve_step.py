"""One of several valves no longer takes part.

The curve is the sum of valves that open one after the other. If one of them
sticks, breaks its stem, or the order of opening is changed, its share is
missing from the openings on where it should have opened:

    x = F(u) + s min(max((u - u1) / (u2 - u1), 0), 1),  t >= t0
"""

from __future__ import annotations

import numpy as np

from valveflow_ros.config import Parameter
from valveflow_ros.plant.effect import ONSET, Effect, Values, at_onset
from valveflow_ros.plant.hooks import DAY_S, AddedCurve, Hooks


def install(values: Values, hooks: Hooks) -> None:
    """Add the missing share to the curve from the onset on."""
    u = np.array([values['u_from'], values['u_to']])
    share = np.array([0.0, values['s_mw']])
    hooks.added_curves.append(AddedCurve(u, share, values['t0_days'] * DAY_S))


def problem(values: Values) -> str:
    """Say what is wrong with the range of u."""
    return '' if values['u_from'] < values['u_to'] else 'u_from must be less than u_to'


EFFECT = Effect(
    'curve_step',
    'At one moment the share of one valve is lost from the curve.',
    (
        Parameter('s_mw', -2.5, 'MW', 'Power added where the valve is open.', -50.0, 50.0),
        Parameter(
            'u_from', 1450.0, '% MPa^(9/8)', 'Where the valve should begin to open.', 0.0, 1e5
        ),
        Parameter('u_to', 1750.0, '% MPa^(9/8)', 'Where it should be open.', 0.0, 1e5),
        ONSET,
    ),
    install,
    starts_days=at_onset,
    problem=problem,
)
