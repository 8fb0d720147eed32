"""A loose linkage between the position sensor and the plug.

The plug follows only when one flank of the slack pushes it (the play operator); the loop
this draws is as wide at any speed, unlike that of a lag.

    plug = min(max(plug before, V - w / 2), V + w / 2)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from valveflow_ros.diagnosis import kernels
from valveflow_ros.diagnosis.bench import Bench
from valveflow_ros.diagnosis.cause import Cause, Kind, Stage, Start, Unknown, Values
from valveflow_ros.diagnosis.scene import Scene
from valveflow_ros.records import FloatArray

_TRIED = (0.1, 0.2, 0.35, 0.6, 1.0, 1.6, 2.7, 4.5)


def act(v: FloatArray, values: Values, scene: Scene) -> FloatArray:
    """Return the position of the plug; V is taken as it is, filtering would narrow the loop."""
    out = np.empty(len(v))
    kernels.play(v, 0.5 * values[0], out)
    return out


def starts(bench: Bench) -> Sequence[Start]:
    """Try some widths."""
    return bench.best(CAUSE, [(w,) for w in _TRIED])


def sentence(values: dict[str, float]) -> str:
    """Say it."""
    return (
        f'The plug hangs loosely behind the position sensor: it moves only after a slack of '
        f'{values["w_percent"]:.2g} % of opening is taken up.'
    )


CAUSE = Cause(
    'backlash', 'slack', Stage.OPENING,
    (Unknown('w_percent', '%', 0.03, 0.0, 20.0, Kind.ROUGH),),
    act, starts, sentence, ('stiction', 'region_lag', 'reheater'),
    'Run the same ramp at two speeds: the loop of a slack keeps its width, that of a lag grows.',
    order=3,
)  # fmt: skip
