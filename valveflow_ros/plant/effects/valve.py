# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Faults of the actuator: backlash, friction, a slow servo, a stop."""

from __future__ import annotations

from valveflow_ros.parameters import Parameter
from valveflow_ros.plant.effect import BEFORE_SENSOR, Hooks, Values, effect, not_above


@effect(
    'There is backlash between the measured stem and the plug.',
    Parameter('w_percent', 0.6, '%', 'Full width of the slack.', 0.0, 20.0),
)
def backlash(values: Values, hooks: Hooks) -> None:
    """The linkage between the position sensor and the plug is loose.

    The plug follows only if it is pushed by one of the two sides of the slack (the
    play operator); the width of the hysteresis loop does not depend on the speed.

        plug = min(max(plug before, V - w / 2), V + w / 2)
    """
    hooks.claim('backlash')
    hooks.after_sensor.slack_percent = values['w_percent']


@effect(
    'Friction holds the valve until it slips.',
    Parameter('s_percent', 1.0, '%', 'Stick band S.', 0.0, 20.0),
    Parameter('j_percent', 0.7, '%', 'Slip jump J.', 0.0, 20.0),
    BEFORE_SENSOR,
    problem=not_above(('j_percent', 's_percent')),
)
def stiction(values: Values, hooks: Hooks) -> None:
    """The valve sticks and then slips.

    This is the two-parameter model of Choudhury in the form of He: the valve stays
    until the force exceeds (S + J) / 2, then slips by J and lags by (S - J) / 2.
    S is the width of the band, J that of the jump; J = 0 is pure backlash.
    """
    bank = hooks.bank('stiction', values['before_sensor'])
    bank.band_percent = values['s_percent']
    bank.jump_percent = values['j_percent']


@effect(
    'The valve cannot move faster than a certain speed.',
    Parameter('r_percent_per_s', 0.12, '%/s', 'Fastest motion.', 0.001, 1000.0),
    BEFORE_SENSOR,
)
def rate_limit(values: Values, hooks: Hooks) -> None:
    """The servo is slow.

    Oil flow and pump limit the speed of the stem: large fast moves take longer,
    slow moves are not affected.
    """
    bank = hooks.bank('rate_limit', values['before_sensor'])
    bank.rate_percent_per_s = values['r_percent_per_s']


@effect(
    'The valve does not open beyond a certain opening.',
    Parameter('max_percent', 84.0, '%', 'Highest opening.', 1.0, 100.0),
    BEFORE_SENSOR,
)
def saturation(values: Values, hooks: Hooks) -> None:
    """A stop prevents the valve from opening fully.

    A mechanical or a configured limit:

        V_true = min(V, V_max)
    """
    hooks.bank('saturation', values['before_sensor']).top_percent = values['max_percent']
