"""A stop keeps the valve from opening fully.

A mechanical or a configured limit:

    V_true = min(V, V_max)
"""

from __future__ import annotations

from valveflow_ros.config import Parameter
from valveflow_ros.plant.effect import BEFORE_SENSOR, Effect, Values
from valveflow_ros.plant.hooks import Hooks


def install(values: Values, hooks: Hooks) -> None:
    """Put a stop on one side of the position sensor."""
    before = values['before_sensor']
    hooks.claim('saturation', 'before the sensor' if before else 'behind the sensor')
    hooks.bank(before).top_percent = values['max_percent']


EFFECT = Effect(
    'saturation',
    'The valve does not open beyond a certain opening.',
    (
        Parameter('max_percent', 84.0, '%', 'Highest opening.', 1.0, 100.0),
        BEFORE_SENSOR,
    ),
    install,
)
