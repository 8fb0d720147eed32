"""The curve has a bend that its straight pieces cannot follow.

Where one valve begins to open before the one before it is open, their overlap raises the
curve; too little of it leaves a dent. The bump is a raised cosine on top of F:

    x = F(u) + h (1 + cos(pi (u - u0) / w)) / 2,  |u - u0| <= w
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from valveflow_ros.curve.model import RegionalModel
from valveflow_ros.diagnosis import kernels
from valveflow_ros.diagnosis.bench import Bench
from valveflow_ros.diagnosis.cause import Cause, Kind, Stage, Start, Unknown, Values
from valveflow_ros.diagnosis.scene import Scene
from valveflow_ros.records import FloatArray

_KEPT = 3
_WIDTHS = (0.06, 0.1, 0.16, 0.25)  # of the range of u


def act(u: FloatArray, values: Values, scene: Scene) -> FloatArray:
    """Return MW added to the flow."""
    h, centre, width = values
    out = np.empty(len(u))
    kernels.bump(u, centre, max(width, 1.0), out)
    return h * out


def starts(bench: Bench) -> Sequence[Start]:
    """Try bumps of some widths everywhere on the curve; keep the best of each width."""
    low, high = bench.hats[0], bench.hats[-1]
    found: list[Start] = []
    for share in _WIDTHS:
        width = share * (high - low)
        places = np.arange(low + 0.5 * width, high, 0.8 * width)
        tried = [bench.scaled_height(CAUSE, (float(u), float(width))) for u in places.tolist()]
        found.append(max(tried, key=lambda s: s.gain))
    best = sorted(found, key=lambda s: -s.gain)[:_KEPT]
    return [replace(s, base=_levels_under(bench.model.base, s.values)) for s in best]


def _levels_under(base: RegionalModel, values: Values) -> RegionalModel:
    """Return the base with its levels lifted by the bump: regions then change at the same u."""
    if not len(base.levels) or np.any(base.right <= base.left):
        return base
    x = np.append(base.left, base.right[-1])
    lift = np.empty(len(base.levels))
    kernels.bump(np.interp(base.levels, x, base.knots), values[1], values[2], lift)
    levels = base.levels + values[0] * lift
    return base.with_levels(levels) if np.all(np.diff(levels) > 0.0) else base


def sentence(values: dict[str, float]) -> str:
    """Say it."""
    return (
        f'The curve has a {"bump" if values["h_mw"] > 0.0 else "dent"} of '
        f'{abs(values["h_mw"]):.2g} MW around u = {values["u0"]:.0f} that straight pieces do not '
        'follow (overlap of valves).'
    )


CAUSE = Cause(
    'curve_shape', 'curve', Stage.FLOW,
    (
        Unknown('h_mw', 'MW', 0.1, -500.0, 500.0),
        Unknown('u0', '% MPa^m', 10.0, 0.0, 1e5, Kind.ROUGH),
        Unknown('width_u', '% MPa^m', 10.0, 5.0, 1e5, Kind.ROUGH),
    ),
    act, starts, sentence, ('saturation', 'exponent', 'choked'),
    'Run slowly through the whole range of loads and look at the slope of the curve.',
)  # fmt: skip
