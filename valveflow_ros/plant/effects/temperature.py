"""Main steam temperature: what the paper holds constant.

A turbine has a constant swallowing capacity, m ~ p / sqrt(T_K) (the cone law
of Stodola and Fluegel): less mass passes when the steam is hotter, about
-0.062 %/K at 539 degC. The enthalpy drop rises with the temperature and gives
part of it back; -0.03 to -0.06 %/K of power remain for main steam alone.

    x = F(u) (1 + k (T - T_ref))
"""

from __future__ import annotations

from valveflow_ros.config import Parameter
from valveflow_ros.plant.effect import Effect, Values
from valveflow_ros.plant.hooks import Forcing, Hooks


def install(values: Values, hooks: Hooks) -> None:
    """Multiply x by a straight line in T."""
    k, reference = values['k'], values['reference_degc']

    def change(rows: Forcing) -> None:
        rows.gain[:] *= 1.0 + k * (rows.temperature_degc - reference)

    hooks.forcing.append(change)


EFFECT = Effect(
    'temperature',
    'The power depends on the main steam temperature.',
    (
        Parameter('k', -0.0006, '1/K', 'Relative change of the power per kelvin.', -0.01, 0.01),
        Parameter('reference_degc', 539.0, 'degC', 'Temperature of no change.', 300.0, 700.0),
    ),
    install,
)
