"""The power carries stamps of another clock.

    y in the row of time t was measured at t + d

With d > 0 the answer seems to come before its cause. Power and its noise move
together; the control of the unit, which reads no stamps, does not notice.
"""

from __future__ import annotations

from valveflow_ros.config import Parameter
from valveflow_ros.plant.effect import Effect, Values
from valveflow_ros.plant.hooks import Hooks


def install(values: Values, hooks: Hooks) -> None:
    """Shift the stamps of the power."""
    hooks.claim('clock')
    hooks.lead_s = values['d_s']


EFFECT = Effect(
    'clock',
    'The power is stamped earlier (or later) than it was measured.',
    (Parameter('d_s', 12.0, 's', 'How much too early; negative: too late.', -600.0, 600.0),),
    install,
)
