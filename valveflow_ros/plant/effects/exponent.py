"""The exponent of the pressure differs from 9/8.

The 9/8 of eq. (1) comes from the drum boiler model of Bell and Astrom, fitted
to one unit; ideal choked flow has 1.0. A unit whose true exponent is m + dm
has, against the u of eq. (1),

    u_true = u (p / p_ref)^dm
"""

from __future__ import annotations

from valveflow_ros.config import Parameter
from valveflow_ros.plant.effect import Effect, Values
from valveflow_ros.plant.hooks import Forcing, Hooks


def install(values: Values, hooks: Hooks) -> None:
    """Multiply u by a power of the pressure."""
    dm, reference = values['dm'], values['reference_mpa']

    def change(rows: Forcing) -> None:
        rows.input_gain[:] *= (rows.pressure_mpa / reference) ** dm

    hooks.forcing.append(change)


EFFECT = Effect(
    'exponent',
    'The flow follows another power of the pressure than eq. (1) says.',
    (
        Parameter('dm', 0.06, '', 'True exponent minus that of eq. (1).', -0.5, 0.5),
        Parameter('reference_mpa', 13.0, 'MPa', 'Pressure of no change.', 1.0, 40.0),
    ),
    install,
)
