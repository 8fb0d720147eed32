"""The pressure or position transmitter is recalibrated.

From then on the same reading of u stands for another flow area:

    u_true = u (1 + g),  t >= t0
"""

from __future__ import annotations

from valveflow_ros.config import Parameter
from valveflow_ros.plant.effect import ONSET, Effect, Values, at_onset, step
from valveflow_ros.plant.hooks import Forcing, Hooks


def install(values: Values, hooks: Hooks) -> None:
    """Multiply u from the onset on."""

    def change(rows: Forcing) -> None:
        rows.input_gain[:] *= 1.0 + values['g'] * step(rows.time_s, values)

    hooks.forcing.append(change)


EFFECT = Effect(
    'input_step',
    'The flow area belonging to a reading of u changes at one moment.',
    (Parameter('g', 0.006, '', 'Relative change.', -0.2, 0.2), ONSET),
    install,
    starts_days=at_onset,
)
