"""The zero of the power drifts.

The zero of the power transducer, or auxiliary load that comes and stays, adds the same
at any load.

    y = G x + b (t - middle) / 10 d
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from valveflow_ros.diagnosis.bench import OFFSET, Bench
from valveflow_ros.diagnosis.cause import Cause, Stage, Start, Unknown, Values
from valveflow_ros.diagnosis.causes._time import a_day, ramp
from valveflow_ros.diagnosis.scene import Scene
from valveflow_ros.records import FloatArray


def act(y: FloatArray, values: Values, scene: Scene) -> FloatArray:
    """Return the power shown."""
    return np.asarray(y + values[0] * ramp(scene, scene.time_s))


def starts(bench: Bench) -> Sequence[Start]:
    """Regress on a ramp in time."""
    _, found = bench.modulated([OFFSET], ramp(bench.scene, bench.scene.sub_middle_s)[None, :])
    return bench.best(CAUSE, [(float(found[0]),)])


def sentence(values: dict[str, float]) -> str:
    """Say it."""
    b = values['b_mw']
    return (
        f'The power drifts by {b:+.2g} MW in ten days, by the same at every load (zero of the '
        'power meter, or auxiliary load).'
    )


CAUSE = Cause(
    'output_offset_drift', 'drift', Stage.OUTPUT,
    (Unknown('b_mw', 'MW/(10 d)', 0.1, -200.0, 200.0),),
    act, starts, sentence, ('gain_drift', 'input_drift'),
    'Hours at low and at full load: a drift of the gain grows with the load, one of the '
    'offset does not.',
    a_day, slow=True,
)  # fmt: skip
