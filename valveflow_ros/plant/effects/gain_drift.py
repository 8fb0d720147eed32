"""The power per flow drifts.

Erosion and deposits behind the valve, falling efficiency of the cycle, and a
drifting scale of the power transducer are the same to the four signals:

    x = F(u) (1 + g t / 10 d),  t from the first row on
"""

from __future__ import annotations

from valveflow_ros.config import Parameter
from valveflow_ros.plant.effect import Effect, Values, ramp
from valveflow_ros.plant.hooks import Forcing, Hooks


def install(values: Values, hooks: Hooks) -> None:
    """Multiply x by a ramp in time."""
    g = values['g']

    def change(rows: Forcing) -> None:
        rows.gain[:] *= 1.0 + g * ramp(rows.time_s)

    hooks.forcing.append(change)


EFFECT = Effect(
    'gain_drift',
    'The power belonging to a flow rises or falls steadily.',
    (Parameter('g', 0.01, '1/(10 d)', 'Relative change in ten days.', -0.2, 0.2),),
    install,
)
