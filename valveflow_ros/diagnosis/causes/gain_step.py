"""The power per flow changes at one moment and stays changed.

Maintenance, another power meter, a heater or an extraction taken in or out for good.

    x = F(u) (1 + g),  t >= t0
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from valveflow_ros.diagnosis.bench import GAIN, Bench
from valveflow_ros.diagnosis.cause import Cause, Stage, Start, Told, Unknown, Values
from valveflow_ros.diagnosis.causes._time import ONSET, a_day, change, since
from valveflow_ros.diagnosis.scene import Scene
from valveflow_ros.records import FloatArray


def act(values: Values, scene: Scene, extra: Values) -> FloatArray:
    """Return the factor on x."""
    return np.asarray(1.0 + values[0] * since(scene, values[1]))


def starts(bench: Bench) -> Sequence[Start]:
    """Try a step at every half hour."""
    return bench.best_onset(CAUSE, bench.only(GAIN))


def sentence(values: Told) -> str:
    """Say it."""
    return (
        f'From {values.onset} the same flow gives {change(values["g"])} power, at every '
        'load alike (maintenance, power meter, a heater or extraction).'
    )


CAUSE = Cause(
    'gain_step', 'step', Stage.GAIN,
    (Unknown('g', '', 5e-4, -0.5, 0.5), ONSET),
    act, starts, sentence, ('input_step', 'curve_step', 'intervals', 'gain_drift'),
    'An hour on the flat end of the curve and an hour at low load: a step of the input '
    'vanishes on the flat end.',
    a_day, slow=True,
)  # fmt: skip
