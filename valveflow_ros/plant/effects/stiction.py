"""The valve sticks and then slips.

The two-parameter picture of Choudhury in the form of He: the valve stays until
the pull has grown beyond (S + J) / 2, then slips by J and stays (S - J) / 2
behind. S is the width of the band, J of the jump; J = 0 is plain backlash.
"""

from __future__ import annotations

from valveflow_ros.config import Parameter
from valveflow_ros.plant.effect import BEFORE_SENSOR, Effect, Values
from valveflow_ros.plant.hooks import Hooks


def install(values: Values, hooks: Hooks) -> None:
    """Put friction on one side of the position sensor."""
    before = values['before_sensor']
    hooks.claim('stiction', 'before the sensor' if before else 'behind the sensor')
    bank = hooks.bank(before)
    bank.band_percent = values['s_percent']
    bank.jump_percent = values['j_percent']


def problem(values: Values) -> str:
    """Say that the jump is too large."""
    fits = values['j_percent'] <= values['s_percent']
    return '' if fits else 'j_percent must not exceed s_percent'


EFFECT = Effect(
    'stiction',
    'Friction holds the valve until it slips.',
    (
        Parameter('s_percent', 1.0, '%', 'Stick band S.', 0.0, 20.0),
        Parameter('j_percent', 0.7, '%', 'Slip jump J.', 0.0, 20.0),
        BEFORE_SENSOR,
    ),
    install,
    problem=problem,
)
