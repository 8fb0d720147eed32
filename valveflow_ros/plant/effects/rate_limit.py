"""The servo is slow.

Oil flow and pump bound the speed of the stem; a fast move takes the longer the
larger it is, a slow one is not affected.
"""

from __future__ import annotations

from valveflow_ros.config import Parameter
from valveflow_ros.plant.effect import BEFORE_SENSOR, Effect, Values
from valveflow_ros.plant.hooks import Hooks


def install(values: Values, hooks: Hooks) -> None:
    """Bound the speed on one side of the position sensor."""
    before = values['before_sensor']
    hooks.claim('rate_limit', 'before the sensor' if before else 'behind the sensor')
    hooks.bank(before).rate_percent_per_s = values['r_percent_per_s']


EFFECT = Effect(
    'rate_limit',
    'The valve cannot move faster than a certain speed.',
    (
        Parameter('r_percent_per_s', 0.12, '%/s', 'Fastest motion.', 0.001, 1000.0),
        BEFORE_SENSOR,
    ),
    install,
)
