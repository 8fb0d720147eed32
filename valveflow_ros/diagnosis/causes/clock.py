"""The power carries stamps of another clock, so that the answer comes before its cause.

    y in the row of time t was measured at t + d,  d > 0

A power stamped too late is the same as a longer delay and cannot be told from it; of one
stamped too early only the part shows that the shortest delay does not hide: ``d_s`` is that
part, and its interval reaches higher by the longest delay a unit may have.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from valveflow_ros.diagnosis.bench import Bench
from valveflow_ros.diagnosis.cause import Cause, Stage, Start, Unknown, Values
from valveflow_ros.diagnosis.scene import Scene
from valveflow_ros.records import FloatArray

# Between valve and generator little more than the filling of a chest: 3 to 10 s in the paper.
_LONGEST_DELAY_S = 15.0
_TRIED_S = (3.0, 6.0, 10.0, 16.0, 25.0, 40.0)


def act(y: FloatArray, values: Values, scene: Scene) -> FloatArray:
    """Return what is shown under the early stamps."""
    late = values[0] / scene.step_s
    whole = int(np.floor(late))
    part = late - whole
    at = np.minimum(np.arange(len(y)) + whole, len(y) - 1)
    after = np.minimum(at + 1, len(y) - 1)
    return np.asarray(y[at] * (1.0 - part) + y[after] * part)


def starts(bench: Bench) -> Sequence[Start]:
    """Try some offsets."""
    return bench.best(CAUSE, [(d,) for d in _TRIED_S], keep=2)


def sentence(values: dict[str, float]) -> str:
    """Say it."""
    return (
        f'The power answers before the valve moves: its time stamps are at least '
        f'{values["d_s"]:.2g} s early against those of the opening.'
    )


CAUSE = Cause(
    'clock', 'lag', Stage.OUTPUT,
    (Unknown('d_s', 's', 0.5, 0.0, 60.0, concealed=_LONGEST_DELAY_S),),
    act, starts, sentence, ('reheater', 'region_lag'),
    'Compare the clocks of both loggers, or record both signals with one of them.',
    order=2,
)  # fmt: skip
