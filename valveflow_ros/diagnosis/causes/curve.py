# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Causes in the curve itself: a bend, and a valve that no longer opens as before."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.diagnosis import kernels
from valveflow_ros.diagnosis.cause import (
    U_UNIT,
    Cause,
    Kind,
    SentenceValues,
    Stage,
    Start,
    Unknown,
    Values,
    axis_unit,
)
from valveflow_ros.diagnosis.causes.changes import ONSET, a_day, since
from valveflow_ros.diagnosis.grids import Grids
from valveflow_ros.diagnosis.screening import CURVE, HATS, Screening
from valveflow_ros.records import FloatArray

_KEPT = 3
_HEIGHTS = (1.0, 2.0)
_WIDTHS = (0.06, 0.1, 0.16, 0.25)  # of the range of u


def apply_curve_shape(u: FloatArray, values: Values, grids: Grids) -> FloatArray:
    """The curve has a bend that its straight pieces cannot follow.

    If a valve opens before the previous one is fully open, the overlap raises the curve; too
    little overlap lowers it. The bump is a raised cosine added to F:

        x = F(u) + h (1 + cos(pi (u - u0) / w)) / 2,  |u - u0| <= w
    """
    h, centre, width = values
    out = np.empty(len(u))
    kernels.bump(u, centre, width, out)
    return h * out


def curve_shape_starts(screening: Screening) -> Sequence[Start]:
    """Try bumps of several widths along the curve; keep the best places that are far apart.

    Each begins with the height of the regression and with twice as much, because the breakpoints
    take up a part of a bump, and with its regions at the same MW or at the same u.
    """
    low, high = screening.hats[0], screening.hats[-1]
    tried: list[Start] = []
    for share in _WIDTHS:
        width = share * (high - low)
        places = np.arange(low + 0.5 * width, high, 0.8 * width)
        tried += [
            screening.scaled_height(CURVE_SHAPE, (float(u), float(width))) for u in places.tolist()
        ]
    best: list[Start] = []
    for start in sorted(tried, key=lambda s: -s.gain):
        if all(_apart(start.values, other.values) for other in best) and len(best) < _KEPT:
            best.append(start)
    scale = float(np.median(screening.grids.scale))
    base, out = screening.model.base, []
    for start, factor in itertools.product(best, _HEIGHTS):
        values = (factor * start.values[0], *start.values[1:])
        lifted = _levels_under(base, values, scale)
        bases = (base,) if lifted is base else (base, lifted)
        out += [replace(start, values=values, base=b) for b in bases]
    return out


def _apart(one: Values, other: Values) -> bool:
    """Return True if the centres of two bumps are further apart than half their widths."""
    return abs(one[1] - other[1]) > 0.5 * max(one[2], other[2])


def _levels_under(base: RegionalModel, values: Values, scale: float) -> RegionalModel:
    """Return the base with its levels raised by the bump: regions then change at the same u."""
    if not len(base.levels) or np.any(base.right <= base.left):
        return base
    x = scale * np.append(base.left, base.right[-1]) + base.offset
    lift = np.empty(len(base.levels))
    kernels.bump(np.interp(base.levels, x, base.knots), values[1], values[2], lift)
    levels = base.levels + values[0] * lift
    return base.with_levels(levels) if np.all(np.diff(levels) > 0.0) else base


def curve_shape_sentence(values: SentenceValues) -> str:
    """Return the sentence for the operator."""
    what = 'bump' if values['h_mw'] > 0.0 else 'dent'
    return (
        f'The curve has a {what} of {abs(values["h_mw"]):.2g} MW at {values.place(values["u0"])} '
        'that straight pieces do not follow (overlap of valves).'
    )


CURVE_SHAPE = Cause(
    'curve_shape', 'curve', Stage.FLOW,
    (
        Unknown('h_mw', 'MW', 0.1, -500.0, 500.0),
        Unknown('u0', U_UNIT, 10.0, 0.0, 1e5, Kind.ROUGH),
        Unknown('width_u', U_UNIT, 10.0, 5.0, 1e5, Kind.ROUGH),
    ),
    apply_curve_shape, curve_shape_starts, curve_shape_sentence,
    ('saturation', 'exponent', 'choked'),
    'Run slowly through the whole range of loads and look at the slope of the curve.',
)  # fmt: skip


_NARROWEST = 5.0  # % MPa^m


def apply_curve_step(u: FloatArray, values: Values, grids: Grids) -> FloatArray:
    """From some time on, one of several valves no longer opens as before.

    The curve is the sum of valves that open one after the other. If one valve sticks, its stem
    breaks, or the order is changed, its contribution is missing above its opening point:

        x = F(u) + s min(max((u - u1) / (u2 - u1), 0), 1),  t >= t0
    """
    s, low, high, t0 = values
    share = np.clip((u - low) / max(high - low, _NARROWEST * axis_unit(grids.form)), 0.0, 1.0)
    return np.asarray(s * share * since(grids, t0))


def curve_step_starts(screening: Screening) -> Sequence[Start]:
    """Try contributions between all pairs of points on the curve, at every half hour."""
    pairs = [(i, k) for i, k in itertools.combinations(range(HATS), 2) if i >= 1 and k <= HATS - 1]
    shapes = np.zeros((len(pairs), 3 + HATS))
    for row, (i, k) in enumerate(pairs):
        at = (screening.hats - screening.hats[i]) / (screening.hats[k] - screening.hats[i])
        shapes[row, CURVE:] = np.clip(at, 0.0, 1.0)
    gains, found = screening.onsets(shapes)
    sub, row = divmod(int(np.argmax(gains)), len(pairs))
    i, k = pairs[row]
    values = (
        float(found[sub, row]), float(screening.hats[i]), float(screening.hats[k]),
        screening.onset_days(sub),
    )  # fmt: skip
    return screening.best(CURVE_STEP, [values])


def curve_step_sentence(values: SentenceValues) -> str:
    """Return the sentence for the operator."""
    full = max(values['u_from'], values['u_to'])  # a step if u_from is not below u_to
    return (
        f'From {values.onset} the unit gives {abs(values["s_mw"]):.2g} MW '
        f'{"less" if values["s_mw"] < 0.0 else "more"} above {values.place(full)} than before, '
        f'and nothing has changed below {values.place(values["u_from"])} (a valve that sticks, or '
        'another order of opening).'
    )


CURVE_STEP = Cause(
    'curve_step', 'step', Stage.FLOW,
    (
        Unknown('s_mw', 'MW', 0.1, -500.0, 500.0),
        Unknown('u_from', U_UNIT, 10.0, 0.0, 1e5, Kind.ROUGH),
        Unknown('u_to', U_UNIT, 10.0, 0.0, 1e5, Kind.ROUGH),
        ONSET,
    ),
    apply_curve_step, curve_step_starts, curve_step_sentence, ('gain_step', 'input_step'),
    'Run slowly through the whole range of loads and compare with the curve from before.',
    a_day, slow=True,
)  # fmt: skip
