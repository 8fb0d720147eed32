"""For hours at a time part of the steam or of the heat goes elsewhere.

An extraction or a feed water heater is in or out of service:

    x = F(u) (1 + g w(t)),  w = 0 or 1

w is not measured. It is taken as a path of two states that rarely switches, and found
by the method of Viterbi on sums over half hours.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from valveflow_ros.diagnosis import kernels
from valveflow_ros.diagnosis.bench import GAIN, Bench
from valveflow_ros.diagnosis.cause import Active, Cause, Stage, Start, Unknown, Values
from valveflow_ros.diagnosis.causes._time import change, three_days
from valveflow_ros.diagnosis.scene import Scene
from valveflow_ros.records import BoolArray, ByteArray, FloatArray

_SWITCH_PENALTY = 9.0
_FIRST_SIZES = (0.003, 0.008, 0.02)
_FIRST_SHARE = 0.3
_ROUNDS = 8
_LEAST_SWITCHES = 2


def act(values: Values, scene: Scene, extra: Values) -> FloatArray:
    """Return the factor on x; ``extra`` holds the times of switches in seconds."""
    inside = np.searchsorted(np.asarray(extra), scene.time_s, side='right') % 2
    # Counted from the record's mean, as everything in time.
    span = scene.reference.span_s
    edges = np.clip(np.append(np.asarray(extra), span if len(extra) % 2 else []), 0.0, span)
    share = float(np.sum(edges[1::2] - edges[::2])) / span
    return np.asarray(1.0 + values[0] * (inside - share))


def starts(bench: Bench) -> Sequence[Start]:
    """Alternate between the path and the size, from several sizes of both signs."""
    tried = []
    for sign in (1.0, -1.0):
        for size in _FIRST_SIZES:
            tried.append(_search(bench, sign * size))
    good = [s for s in tried if s is not None and s.gain > 0.0]
    return sorted(good, key=lambda s: -(s.gain - 5.0 * len(s.extra)))[:1]


def _search(bench: Bench, size: float) -> Start | None:
    own, toward = bench.gain_by_sub()
    path = np.zeros(len(own), dtype=np.uint8)
    share = _FIRST_SHARE
    for _ in range(_ROUNDS):
        before = path.copy()
        _path(bench, own, toward, size, share, path)
        if not path.any() or path.all() or np.array_equal(path, before):
            break
        _, found = bench.modulated([GAIN], path[None, :].astype(np.float64))
        size, share = float(found[0]), float(path.mean())
    if path.mean() > 0.5:  # what is rarer is the event
        path, size = (1 - path).astype(np.uint8), -size
    times = _switches(bench, path)
    return bench.displaced(CAUSE, (size,), times) if len(times) >= _LEAST_SWITCHES else None


def _path(
    bench: Bench, own: FloatArray, toward: FloatArray, size: float, share: float, path: ByteArray
) -> None:
    """Write the cheapest path of the state for a size and the share of time it is on."""
    # The curve has taken up the mean: outside, the level lies as far below as it must.
    on, off = size * (1.0 - share), -size * share
    cost = (on * on - off * off) * own - 2.0 * (on - off) * toward
    kernels.viterbi(cost / (2.0 * bench.variance), _SWITCH_PENALTY, path)


def _switches(bench: Bench, path: ByteArray) -> Values:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], path]).astype(int)))
    return tuple(bench.sub_start_s(int(k)) for k in edges)


def infer(bench: Bench, active: Active, allowed: BoolArray) -> Values:
    """Return the switches that the allowed sub-blocks show, for a size that is known.

    The bench is that of the model without this cause.
    """
    own, toward = (np.where(allowed, x, 0.0) for x in bench.gain_by_sub())
    edges = np.asarray(active.extra)
    middle = bench.scene.sub_middle_s
    share = float((np.searchsorted(edges, middle, side='right') % 2).mean())
    path = np.zeros(len(own), dtype=np.uint8)
    _path(bench, own, toward, active.values[0], share, path)
    return _switches(bench, path)


def sentence(values: dict[str, float]) -> str:
    """Say it."""
    return (
        f'For hours at a time the same flow gives {change(values["g"])} power: something is '
        'switched in and out (an extraction, a feed water heater).'
    )


CAUSE = Cause(
    'intervals', 'hidden', Stage.GAIN,
    (Unknown('g', '', 5e-4, -0.5, 0.5),),
    act, starts, sentence, ('gain_step', 'diurnal'),
    'Log the state of extractions and heaters beside the power.',
    three_days, slow=True, infer=infer,
)  # fmt: skip
