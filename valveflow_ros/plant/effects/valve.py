# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Effects between measured and true position: slack, friction, servo, a stop."""

from __future__ import annotations

from valveflow_ros.parameters import Parameter
from valveflow_ros.plant.effect import BEFORE_SENSOR, Effect, Hooks, Values


def install_backlash(values: Values, hooks: Hooks) -> None:
    """A loose linkage between the position sensor and the plug.

    The plug follows only when one of the two flanks of the slack pushes it (the
    play operator); the loop this draws is as wide at any speed.

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

    The two-parameter picture of Choudhury in the form of He: the valve stays until
    the pull has grown beyond (S + J) / 2, then slips by J and stays (S - J) / 2
    behind. S is the width of the band, J of the jump; J = 0 is plain backlash.
    """
    before = values['before_sensor']
    hooks.claim('stiction', 'before the sensor' if before else 'behind the sensor')
    bank = hooks.bank(before)
    bank.band_percent = values['s_percent']
    bank.jump_percent = values['j_percent']


def problem(values: Values) -> str:
    """Say that the jump is too large."""
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

    Oil flow and pump bound the speed of the stem; a fast move takes the longer the
    larger it is, a slow one is not affected.
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
    """A stop keeps the valve from opening fully.

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
