"""The pressure or position transmitter is recalibrated.

From then on the same reading of u stands for another flow area.

    u_true = u (1 + g),  t >= t0
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from valveflow_ros.curve.model import RegionalModel
from valveflow_ros.diagnosis.bench import INPUT, Bench
from valveflow_ros.diagnosis.cause import Cause, Stage, Start, Told, Unknown, Values
from valveflow_ros.diagnosis.causes._time import ONSET, a_day, change, since
from valveflow_ros.diagnosis.scene import Scene
from valveflow_ros.records import FloatArray


def act(u: FloatArray, values: Values, scene: Scene, model: RegionalModel) -> FloatArray:
    """Return the factor on u."""
    return np.asarray(1.0 + values[0] * since(scene, values[1]))


def starts(bench: Bench) -> Sequence[Start]:
    """Try a step at every half hour."""
    return bench.best_onset(CAUSE, bench.only(INPUT))


def sentence(values: Told) -> str:
    """Say it."""
    return (
        f'From {values.onset} the same reading of opening and pressure passes '
        f'{change(values["g"])} steam (a transmitter was recalibrated or failed partly).'
    )


CAUSE = Cause(
    'input_step', 'step', Stage.INPUT,
    (Unknown('g', '', 5e-4, -0.5, 0.5), ONSET),
    act, starts, sentence, ('gain_step', 'curve_step', 'input_drift'),
    'An hour on the flat end of the curve and an hour at low load: a step of the input '
    'vanishes on the flat end.',
    a_day, slow=True,
)  # fmt: skip
