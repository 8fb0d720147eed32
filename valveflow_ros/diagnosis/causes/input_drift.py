"""The flow area that belongs to a reading of u drifts.

The scale of the pressure transmitter, that of the position sensor, or wear of the seat;
from the four signals these are one thing.

    u_true = u (1 + g (t - middle) / 10 d)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from valveflow_ros.curve.model import RegionalModel
from valveflow_ros.diagnosis.bench import INPUT, Bench
from valveflow_ros.diagnosis.cause import Cause, Stage, Start, Unknown, Values
from valveflow_ros.diagnosis.causes._time import a_day, change, ramp
from valveflow_ros.diagnosis.scene import Scene
from valveflow_ros.records import FloatArray


def act(u: FloatArray, values: Values, scene: Scene, model: RegionalModel) -> FloatArray:
    """Return the factor on u."""
    return np.asarray(1.0 + values[0] * ramp(scene, scene.time_s))


def starts(bench: Bench) -> Sequence[Start]:
    """Regress on the input's effect times a ramp in time."""
    _, found = bench.modulated([INPUT], ramp(bench.scene, bench.scene.sub_middle_s)[None, :])
    g = float(found[0])
    return bench.best(CAUSE, [(g,), (0.6 * g,)])


def sentence(values: dict[str, float]) -> str:
    """Say it."""
    return (
        f'The same reading of opening and pressure passes {change(values["g"])} steam after ten '
        'days (scale of the pressure or position transmitter, or wear of the seat).'
    )


CAUSE = Cause(
    'input_drift', 'drift', Stage.INPUT,
    (Unknown('g', '1/(10 d)', 5e-4, -0.5, 0.5),),
    act, starts, sentence, ('gain_drift', 'output_offset_drift', 'input_step'),
    'An hour on the flat end of the curve and an hour at low load: a drift of the input '
    'vanishes on the flat end.',
    a_day, slow=True,
)  # fmt: skip
