"""The servo is slow.

Oil flow and pump bound the speed of the stem; a fast move takes the longer the larger it
is, a slow one is not affected.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from valveflow_ros.diagnosis import kernels
from valveflow_ros.diagnosis.bench import Bench
from valveflow_ros.diagnosis.cause import Cause, Kind, Stage, Start, Unknown, Values
from valveflow_ros.diagnosis.scene import Scene
from valveflow_ros.records import FloatArray

_TRIED = (0.05, 0.08, 0.12, 0.18, 0.27, 0.4)


def act(v: FloatArray, values: Values, scene: Scene) -> FloatArray:
    """Return the position of the plug."""
    out = np.empty(len(v))
    kernels.rate_limit(v, values[0] * scene.fine_s, out)
    return out


def starts(bench: Bench) -> Sequence[Start]:
    """Try some speeds."""
    return bench.best(CAUSE, [(r,) for r in _TRIED])


def sentence(values: dict[str, float]) -> str:
    """Say it."""
    return (
        f'The plug cannot move faster than {values["r_percent_per_s"]:.2g} % of opening a second.'
    )


CAUSE = Cause(
    'rate_limit', 'lag', Stage.OPENING,
    (Unknown('r_percent_per_s', '%/s', 0.005, 0.005, 100.0, Kind.ROUGH),),
    act, starts, sentence, ('reheater', 'region_lag'),
    'Steps of 1 % and of 4 %: with a bounded speed the large one takes four times as long.',
    order=0,
)  # fmt: skip
