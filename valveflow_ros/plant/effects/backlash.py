"""A loose linkage between the position sensor and the plug.

The plug follows only when one of the two flanks of the slack pushes it (the
play operator); the loop this draws is as wide at any speed.

    plug = min(max(plug before, V - w / 2), V + w / 2)
"""

from __future__ import annotations

from valveflow_ros.config import Parameter
from valveflow_ros.plant.effect import Effect, Values
from valveflow_ros.plant.hooks import Hooks


def install(values: Values, hooks: Hooks) -> None:
    """Put slack behind the position sensor."""
    hooks.claim('backlash')
    hooks.after_sensor.slack_percent = values['w_percent']


EFFECT = Effect(
    'backlash',
    'The plug hangs loosely on the stem whose position is measured.',
    (Parameter('w_percent', 0.6, '%', 'Full width of the slack.', 0.0, 20.0),),
    install,
)
