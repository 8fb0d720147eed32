"""The power per flow changes at once and stays changed.

Maintenance, another power meter, a heater or an extraction taken in or out
for good:

    x = F(u) (1 + g),  t >= t0
"""

from __future__ import annotations

from valveflow_ros.config import Parameter
from valveflow_ros.plant.effect import ONSET, Effect, Values, at_onset, step
from valveflow_ros.plant.hooks import Forcing, Hooks


def install(values: Values, hooks: Hooks) -> None:
    """Multiply x from the onset on."""

    def change(rows: Forcing) -> None:
        rows.gain[:] *= 1.0 + values['g'] * step(rows.time_s, values)

    hooks.forcing.append(change)


EFFECT = Effect(
    'gain_step',
    'The power belonging to a flow changes at one moment.',
    (Parameter('g', 0.006, '', 'Relative change.', -0.2, 0.2), ONSET),
    install,
    starts_days=at_onset,
)
