"""The opening or the pressure is read ever more wrongly, or the seat wears.

A drifting scale of the pressure transmitter, a drifting scale of the position
sensor and a wearing seat all change u against its reading:

    u_true = u (1 + g t / 10 d),  t from the first row on
"""

from __future__ import annotations

from valveflow_ros.config import Parameter
from valveflow_ros.plant.effect import Effect, Values, ramp
from valveflow_ros.plant.hooks import Forcing, Hooks


def install(values: Values, hooks: Hooks) -> None:
    """Multiply u by a ramp in time."""
    g = values['g']

    def change(rows: Forcing) -> None:
        rows.input_gain[:] *= 1.0 + g * ramp(rows.time_s)

    hooks.forcing.append(change)


EFFECT = Effect(
    'input_drift',
    'The flow area belonging to a reading of u rises or falls steadily.',
    (Parameter('g', 0.01, '1/(10 d)', 'Relative change in ten days.', -0.2, 0.2),),
    install,
)
