"""Main steam temperature, which the paper holds constant.

A turbine swallows m ~ p / sqrt(T_K) (the cone law of Stodola and Fluegel): the hotter
the steam the less mass passes, about -0.062 %/K near 539 degC, while the enthalpy drop
grows. What remains is a few hundredths of a per cent of the power per kelvin.

    x = F(u) (1 + k (T - mean T))
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from valveflow_ros.diagnosis.bench import Bench
from valveflow_ros.diagnosis.cause import Cause, Stage, Start, Unknown, Values
from valveflow_ros.diagnosis.scene import Scene
from valveflow_ros.records import FloatArray

_LEAST_SPREAD_K = 0.1


def act(values: Values, scene: Scene, extra: Values) -> FloatArray:
    """Return the factor on x."""
    return np.asarray(1.0 + values[0] * (scene.temperature - scene.reference.temperature_degc))


def starts(bench: Bench) -> Sequence[Start]:
    """Try the slope of the residual against T."""
    return bench.scaled(CAUSE, (2e-4,))


def sentence(values: dict[str, float]) -> str:
    """Say it."""
    k = 100.0 * values['k']
    return (
        f'The power {"rises" if k > 0.0 else "falls"} by {abs(k):.2g} % for every kelvin that '
        'the main steam is hotter; the model takes the temperature as constant.'
    )


def hindered(scene: Scene) -> str:
    """Say that the temperature does not change."""
    spread = float(np.std(scene.temperature))
    if spread >= _LEAST_SPREAD_K:
        return ''
    return f'the main steam temperature hardly changes (standard deviation {spread:.2g} K)'


CAUSE = Cause(
    'temperature', 'steam', Stage.GAIN,
    (Unknown('k', '1/K', 2e-5, -0.01, 0.01),),
    act, starts, sentence, ('exponent', 'gain_drift', 'diurnal'),
    'Change the main steam temperature by 3 K for an hour at constant pressure and opening.',
    hindered,
)  # fmt: skip
