"""Most of the power comes behind the reheater, which fills slowly.

The turbine models of IEEE (IEEEG1, TGOV1) split the power: a share is made in
front of the reheater at once, the rest follows its filling.

    y = alpha y1 + (1 - alpha) y1 / (1 + T s),  y1 = G x
"""

from __future__ import annotations

from valveflow_ros.config import Parameter
from valveflow_ros.plant.effect import Effect, Values
from valveflow_ros.plant.hooks import Hooks


def install(values: Values, hooks: Hooks) -> None:
    """Split the power."""
    hooks.claim('reheater')
    hooks.reheater_share = values['alpha']
    hooks.reheater_s = values['time_s']


EFFECT = Effect(
    'reheater',
    'Part of the power follows later, through the reheater.',
    (
        Parameter('alpha', 0.3, '', 'Share made in front of the reheater.', 0.0, 1.0),
        Parameter('time_s', 20.0, 's', 'Time constant of the reheater.', 0.0, 600.0),
    ),
    install,
)
