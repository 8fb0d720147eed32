# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Effects in the curve itself: a bump, and a valve that no longer opens."""

from __future__ import annotations

import numpy as np

from valveflow_ros.parameters import Parameter
from valveflow_ros.plant.effect import DAY_S, ONSET, AddedCurve, Hooks, Values, effect

_POINTS = 65


@effect(
    'The curve has a bump between its breakpoints.',
    Parameter('h_mw', 1.5, 'MW', 'Height of the bump.', -50.0, 50.0),
    Parameter('u0', 1425.0, '% MPa^(9/8)', 'Its centre.', 0.0, 1e5),
    Parameter('width_u', 150.0, '% MPa^(9/8)', 'From its centre to its foot.', 1.0, 1e4),
)
def curve_shape(values: Values, hooks: Hooks) -> None:
    """The curve has a bump that few straight pieces cannot describe.

    If a valve begins to open before the previous one is open, their overlap raises
    the curve; too little overlap lowers it. The bump is a raised cosine:

        x = F(u) + h (1 + cos(pi (u - u0) / w)) / 2,  |u - u0| <= w
    """
    place = np.linspace(-1.0, 1.0, _POINTS)
    bump = 0.5 + 0.5 * np.cos(np.pi * place)
    bump[[0, -1]] = 0.0
    u = values['u0'] + values['width_u'] * place
    hooks.added_curves.append(AddedCurve(u, values['h_mw'] * bump))


@effect(
    'At one moment the share of one valve is lost from the curve.',
    Parameter('s_mw', -2.5, 'MW', 'Power added where the valve is open.', -50.0, 50.0),
    Parameter('u_from', 1450.0, '% MPa^(9/8)', 'Where the valve should begin to open.', 0.0, 1e5),
    Parameter('u_to', 1750.0, '% MPa^(9/8)', 'Where it should be open.', 0.0, 1e5),
    ONSET,
    problem=lambda v: '' if v['u_from'] < v['u_to'] else 'u_from must be less than u_to',
)
def curve_step(values: Values, hooks: Hooks) -> None:
    """One of several valves no longer opens.

    The curve is the sum of valves that open in sequence. If one of them sticks, if
    its stem is broken, or if the order of opening is changed, its part is missing
    above the opening at which it should have opened:

        x = F(u) + s min(max((u - u1) / (u2 - u1), 0), 1),  t >= t0
    """
    u = np.array([values['u_from'], values['u_to']])
    share = np.array([0.0, values['s_mw']])
    hooks.added_curves.append(AddedCurve(u, share, values['t0_days'] * DAY_S))
