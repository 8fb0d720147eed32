# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Faults of the actuator: backlash, friction, a slow servo, a stop."""

from __future__ import annotations

from valveflow_ros.parameters import Parameter
from valveflow_ros.plant.effect import BEFORE_SENSOR, Effect, Hooks, Values


def install_backlash(values: Values, hooks: Hooks) -> None:
    """The linkage between the position sensor and the plug is loose.

    The plug follows only if it is pushed by one of the two sides of the slack (the
    play operator); the width of the hysteresis loop does not depend on the speed.

        plug = min(max(plug before, V - w / 2), V + w / 2)
    """
    hooks.claim('backlash')
    hooks.after_sensor.slack_percent = values['w_percent']


BACKLASH = Effect(
    'backlash',
    'There is backlash between the measured stem and the plug.',
    (Parameter('w_percent', 0.6, '%', 'Full width of the slack.', 0.0, 20.0),),
    install_backlash,
)


def install_stiction(values: Values, hooks: Hooks) -> None:
    """The valve sticks and then slips.

    This is the two-parameter model of Choudhury in the form of He: the valve stays
    until the force exceeds (S + J) / 2, then slips by J and lags by (S - J) / 2.
    S is the width of the band, J that of the jump; J = 0 is pure backlash.
    """
    before = values['before_sensor']
    hooks.claim('stiction', 'before the sensor' if before else 'behind the sensor')
    bank = hooks.bank(before)
    bank.band_percent = values['s_percent']
    bank.jump_percent = values['j_percent']


def problem(values: Values) -> str:
    """Return a message if the jump is too large."""
    fits = values['j_percent'] <= values['s_percent']
    return '' if fits else 'j_percent must not exceed s_percent'


STICTION = Effect(
    'stiction',
    'Friction holds the valve until it slips.',
    (
        Parameter('s_percent', 1.0, '%', 'Stick band S.', 0.0, 20.0),
        Parameter('j_percent', 0.7, '%', 'Slip jump J.', 0.0, 20.0),
        BEFORE_SENSOR,
    ),
    install_stiction,
    problem=problem,
)


def install_rate_limit(values: Values, hooks: Hooks) -> None:
    """The servo is slow.

    Oil flow and pump limit the speed of the stem: large fast moves take longer,
    slow moves are not affected.
    """
    before = values['before_sensor']
    hooks.claim('rate_limit', 'before the sensor' if before else 'behind the sensor')
    hooks.bank(before).rate_percent_per_s = values['r_percent_per_s']


RATE_LIMIT = Effect(
    'rate_limit',
    'The valve cannot move faster than a certain speed.',
    (
        Parameter('r_percent_per_s', 0.12, '%/s', 'Fastest motion.', 0.001, 1000.0),
        BEFORE_SENSOR,
    ),
    install_rate_limit,
)


def install_saturation(values: Values, hooks: Hooks) -> None:
    """A stop prevents the valve from opening fully.

    A mechanical or a configured limit:

        V_true = min(V, V_max)
    """
    before = values['before_sensor']
    hooks.claim('saturation', 'before the sensor' if before else 'behind the sensor')
    hooks.bank(before).top_percent = values['max_percent']


SATURATION = Effect(
    'saturation',
    'The valve does not open beyond a certain opening.',
    (
        Parameter('max_percent', 84.0, '%', 'Highest opening.', 1.0, 100.0),
        BEFORE_SENSOR,
    ),
    install_saturation,
)
