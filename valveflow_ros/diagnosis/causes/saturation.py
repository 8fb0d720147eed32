"""A stop keeps the valve from opening fully.

A mechanical or a configured limit behind the position sensor:

    V_true = min(V, V_max)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from valveflow_ros.diagnosis.bench import Bench
from valveflow_ros.diagnosis.cause import Cause, Kind, Stage, Start, Unknown, Values
from valveflow_ros.diagnosis.scene import Scene
from valveflow_ros.records import FloatArray

_TRIED_SHARES = (0.6, 0.7, 0.78, 0.85, 0.9, 0.94, 0.97, 0.99)


def act(v: FloatArray, values: Values, scene: Scene) -> FloatArray:
    """Return the position of the plug."""
    return np.minimum(v, values[0])


def starts(bench: Bench) -> Sequence[Start]:
    """Try some places among the highest openings."""
    places = np.quantile(bench.scene.v[np.isfinite(bench.scene.v)], _TRIED_SHARES)
    return bench.best(CAUSE, [(float(p),) for p in places])


def sentence(values: dict[str, float]) -> str:
    """Say it."""
    return f'The plug does not open beyond {values["max_percent"]:.4g} %, whatever is measured.'


CAUSE = Cause(
    'saturation', 'stop', Stage.OPENING,
    (Unknown('max_percent', '%', 0.1, 1.0, 150.0, Kind.ROUGH),),
    act, starts, sentence, ('curve_shape', 'exponent', 'choked'),
    'Hold the opening high and change the pressure: a stop shows in the opening, not in u.',
    order=2,
)  # fmt: skip
