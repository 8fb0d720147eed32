"""The zero of the power drifts.

A drifting zero of the power transducer, or auxiliary load that comes and
stays, adds the same at any load:

    y = G x + b t / 10 d,  t from the first row on
"""

from __future__ import annotations

from valveflow_ros.config import Parameter
from valveflow_ros.plant.effect import Effect, Values, ramp
from valveflow_ros.plant.hooks import Forcing, Hooks


def install(values: Values, hooks: Hooks) -> None:
    """Add a ramp in time to the power."""
    b_mw = values['b_mw']

    def change(rows: Forcing) -> None:
        rows.offset_mw[:] += b_mw * ramp(rows.time_s)

    hooks.forcing.append(change)


EFFECT = Effect(
    'output_offset_drift',
    'The power drifts by the same amount at any load.',
    (Parameter('b_mw', 2.0, 'MW/(10 d)', 'Change in ten days.', -50.0, 50.0),),
    install,
)
