"""The curve has a bend that few straight pieces cannot follow.

Where one valve begins to open before the one before it is open, their overlap
raises the curve; too little overlap leaves a dent. The bump is a raised cosine:

    x = F(u) + h (1 + cos(pi (u - u0) / w)) / 2,  |u - u0| <= w
"""

from __future__ import annotations

import numpy as np

from valveflow_ros.config import Parameter
from valveflow_ros.plant.effect import Effect, Values
from valveflow_ros.plant.hooks import AddedCurve, Hooks

_POINTS = 65


def install(values: Values, hooks: Hooks) -> None:
    """Add the bump to the curve."""
    place = np.linspace(-1.0, 1.0, _POINTS)
    bump = 0.5 + 0.5 * np.cos(np.pi * place)
    bump[[0, -1]] = 0.0
    u = values['u0'] + values['width_u'] * place
    hooks.added_curves.append(AddedCurve(u, values['h_mw'] * bump))


EFFECT = Effect(
    'curve_shape',
    'The curve has a bump between its knots.',
    (
        Parameter('h_mw', 1.5, 'MW', 'Height of the bump.', -50.0, 50.0),
        Parameter('u0', 1425.0, '% MPa^(9/8)', 'Its centre.', 0.0, 1e5),
        Parameter('width_u', 150.0, '% MPa^(9/8)', 'From its centre to its foot.', 1.0, 1e4),
    ),
    install,
)
