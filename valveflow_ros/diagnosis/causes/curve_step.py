"""From one moment on, one of several valves no longer takes part.

The curve is the sum of valves that open one after the other. If one sticks, breaks its
stem, or the order is changed, its share is missing from where it should have opened:

    x = F(u) + s min(max((u - u1) / (u2 - u1), 0), 1),  t >= t0
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from valveflow_ros.diagnosis.bench import CURVE, HATS, Bench
from valveflow_ros.diagnosis.cause import Cause, Kind, Stage, Start, Told, Unknown, Values
from valveflow_ros.diagnosis.causes._time import ONSET, a_day, since
from valveflow_ros.diagnosis.scene import Scene
from valveflow_ros.records import FloatArray

_NARROWEST = 5.0


def act(u: FloatArray, values: Values, scene: Scene) -> FloatArray:
    """Return MW added to the flow."""
    s, low, high, t0 = values
    share = np.clip((u - low) / max(high - low, _NARROWEST), 0.0, 1.0)
    return np.asarray(s * share * since(scene, t0))


def starts(bench: Bench) -> Sequence[Start]:
    """Try shares between all pairs of places on the curve, at every half hour."""
    pairs = [(i, k) for i, k in itertools.combinations(range(HATS), 2) if i >= 1 and k <= HATS - 1]
    shapes = np.zeros((len(pairs), 3 + HATS))
    for row, (i, k) in enumerate(pairs):
        at = (bench.hats - bench.hats[i]) / (bench.hats[k] - bench.hats[i])
        shapes[row, CURVE:] = np.clip(at, 0.0, 1.0)
    gains, found = bench.onsets(shapes)
    sub, row = divmod(int(np.argmax(gains)), len(pairs))
    i, k = pairs[row]
    values = (
        float(found[sub, row]), float(bench.hats[i]), float(bench.hats[k]), bench.onset_days(sub)
    )  # fmt: skip
    return bench.best(CAUSE, [values])


def sentence(values: Told) -> str:
    """Say it."""
    return (
        f'From {values.onset} the curve lacks part of its course: '
        f'{values["s_mw"]:+.2g} MW above u = {values["u_to"]:.0f}, nothing below '
        f'{values["u_from"]:.0f} (a valve that sticks, or another order of opening).'
    )


CAUSE = Cause(
    'curve_step', 'step', Stage.FLOW,
    (
        Unknown('s_mw', 'MW', 0.1, -500.0, 500.0),
        Unknown('u_from', '% MPa^m', 10.0, 0.0, 1e5, Kind.ROUGH),
        Unknown('u_to', '% MPa^m', 10.0, 0.0, 1e5, Kind.ROUGH),
        ONSET,
    ),
    act, starts, sentence, ('gain_step', 'input_step'),
    'Run slowly through the whole range of loads and compare with the curve from before.',
    a_day, slow=True,
)  # fmt: skip
