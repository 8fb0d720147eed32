"""The exponent of the pressure differs from the one in eq. (1).

9/8 comes from the drum boiler of Bell and Astrom, fitted to one unit; ideal choked flow
has 1. With a true exponent m + dm the flow follows

    u_true = u (p / mean p)^dm

Under sliding pressure the curve takes up most of it: only the pressure's departure
from its line over the load tells.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from valveflow_ros.curve.model import RegionalModel
from valveflow_ros.diagnosis.bench import Bench
from valveflow_ros.diagnosis.cause import Cause, Stage, Start, Unknown, Values
from valveflow_ros.diagnosis.scene import Scene
from valveflow_ros.records import FloatArray


def act(u: FloatArray, values: Values, scene: Scene, model: RegionalModel) -> FloatArray:
    """Return the factor on u."""
    log = np.log(np.maximum(scene.pressure, 1e-6))
    return np.asarray(np.exp(values[0] * (log - scene.reference.log_pressure)))


def starts(bench: Bench) -> Sequence[Start]:
    """Try both signs: behind the regions a tangent understates it."""
    return bench.scaled(CAUSE, (0.02,))


def sentence(values: dict[str, float]) -> str:
    """Say it."""
    dm = values['dm']
    return (
        f'The flow follows the main steam pressure with an exponent that is {abs(dm):.2g} '
        f'{"larger" if dm > 0.0 else "smaller"} than the model has.'
    )


def hindered(scene: Scene) -> str:
    """Say that the pressure does not change."""
    spread = float(np.std(scene.pressure)) / max(float(scene.pressure.mean()), 1e-9)
    return '' if spread >= 1e-3 else 'the main steam pressure hardly changes'


CAUSE = Cause(
    'exponent', 'nozzle', Stage.INPUT,
    (Unknown('dm', '', 0.002, -0.5, 0.5),),
    act, starts, sentence, ('choked', 'temperature', 'curve_shape'),
    'Move the pressure by 0.5 MPa at constant load, with the temperature held.',
    hindered,
)  # fmt: skip
