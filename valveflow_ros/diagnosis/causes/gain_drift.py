"""The power per flow drifts.

Erosion and deposits behind the valve, a cycle that loses efficiency, or the scale of the
power transducer; from the four signals these are one thing.

    x = F(u) (1 + g (t - middle) / 10 d)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from valveflow_ros.diagnosis.bench import GAIN, Bench
from valveflow_ros.diagnosis.cause import Cause, Stage, Start, Unknown, Values
from valveflow_ros.diagnosis.causes._time import a_day, change, ramp
from valveflow_ros.diagnosis.scene import Scene
from valveflow_ros.records import FloatArray


def act(values: Values, scene: Scene, extra: Values) -> FloatArray:
    """Return the factor on x."""
    return np.asarray(1.0 + values[0] * ramp(scene, scene.time_s))


def starts(bench: Bench) -> Sequence[Start]:
    """Regress on the power times a ramp in time."""
    _, found = bench.modulated([GAIN], ramp(bench.scene, bench.scene.sub_middle_s)[None, :])
    return bench.best(CAUSE, [(float(found[0]),)])


def sentence(values: dict[str, float]) -> str:
    """Say it."""
    return (
        f'The power per flow drifts: {change(values["g"])} in ten days, at every load alike '
        '(wear, efficiency, or the scale of the power meter).'
    )


CAUSE = Cause(
    'gain_drift', 'drift', Stage.GAIN,
    (Unknown('g', '1/(10 d)', 5e-4, -0.5, 0.5),),
    act, starts, sentence, ('input_drift', 'output_offset_drift', 'gain_step'),
    'An hour on the flat end of the curve and an hour at low load: a drift of the input '
    'vanishes on the flat end, one of the offset is the same at both.',
    a_day, slow=True,
)  # fmt: skip
