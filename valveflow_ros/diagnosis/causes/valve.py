# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Causes between the measured and the true valve position: backlash, friction, servo, limit."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from valveflow_ros.diagnosis import kernels
from valveflow_ros.diagnosis.cause import Cause, Kind, Stage, Start, Unknown, Values
from valveflow_ros.diagnosis.grids import Grids
from valveflow_ros.diagnosis.screening import Screening
from valveflow_ros.records import FloatArray

_BACKLASH_TRIED = (0.1, 0.2, 0.35, 0.6, 1.0, 1.6, 2.7, 4.5)


def apply_backlash(v: FloatArray, values: Values, grids: Grids) -> FloatArray:
    """A loose linkage between the position sensor and the plug.

    The plug moves only when one end of the backlash gap pushes it (the play operator). The width
    of the hysteresis loop does not depend on the speed, unlike that of a lag.

        plug = min(max(plug before, V - w / 2), V + w / 2)
    """
    # Return the plug position; V is not filtered, because filtering would narrow the loop.
    out = np.empty(len(v))
    kernels.play(v, 0.5 * values[0], out)
    return out


def backlash_starts(screening: Screening) -> Sequence[Start]:
    """Try several widths."""
    return screening.best(BACKLASH, [(w,) for w in _BACKLASH_TRIED])


def backlash_sentence(values: dict[str, float]) -> str:
    """Return the sentence for the operator."""
    return (
        'There is backlash between the position sensor and the plug: at each reversal the plug '
        f'stays still for the first {values["w_percent"]:.2g} % of opening.'
    )


BACKLASH = Cause(
    'backlash', 'slack', Stage.OPENING,
    (Unknown('w_percent', '%', 0.03, 0.0, 20.0, Kind.ROUGH),),
    apply_backlash, backlash_starts, backlash_sentence, ('stiction', 'region_lag', 'reheater'),
    'Run the same ramp at two speeds: with backlash the difference between up and down is the '
    'same, with a lag it is larger at the higher speed.',
    order=3,
)  # fmt: skip


_DRAWS, _ROUGH_DRAWS = 10, 5
_SEED = 20_240
_BANDS = (0.3, 0.5, 0.7, 0.95, 1.25, 1.6, 2.1, 2.8, 3.7, 4.9, 6.5, 8.6, 11.4, 15.0)
_FACTORS = (0.88, 0.94, 1.0, 1.07, 1.15)
# The cost is a narrow valley in S and J, 0.03 wide in J / S; a coarser grid misses it.
_OVER_SLACK = (0.97, 1.01, 1.05, 1.09, 1.13, 1.17)
_SHARES = (0.1, 0.2, 0.3, 0.4, *np.arange(0.45, 0.96, 0.05))
_LIKE_SLACK = 3.0
_SLACKS = (0.8, 0.86, 0.91, 0.95, 0.98, 1.0, 1.03, 1.07)
_STEPS = (0.04, 0.02, 0.01, 0.005)
_SHIFT = 7_919


def _noise(v: FloatArray, grids: Grids) -> FloatArray:
    """Return noise like that of the position sensor, the same for every call."""
    if 'noise of v' not in grids.cache:
        normal = np.random.default_rng(_SEED).standard_normal(len(v))
        grids.cache['noise of v'] = grids.reference.opening_noise * normal
    return grids.cache['noise of v']


@functools.cache
def draw(number: int) -> Callable[[FloatArray, Values, Grids], FloatArray]:
    """Return the ``act`` function of one noise realisation, the same for every call."""

    def path(v: FloatArray, values: Values, grids: Grids) -> FloatArray:
        out = np.empty(len(v))
        moved = v + np.roll(_noise(v, grids), number * _SHIFT)
        kernels.stick_slip(moved, values[0], min(values[1], values[0]), out)
        return out

    return path


def apply_stiction(v: FloatArray, values: Values, grids: Grids) -> FloatArray:
    """Friction holds the valve until it slips.

    This is the two-parameter model of Choudhury in the form of He: the valve stays until the
    distance to the command exceeds (S + J) / 2, then slips to (S - J) / 2 from it. The time of a
    slip depends on 0.01 % of measured opening, so several paths are simulated, each with another
    realisation of the sensor noise (see `fitting.beliefs`).
    """
    total = np.zeros(len(v))
    for k in range(_DRAWS):
        total += draw(k)(v, values, grids)
    return np.asarray(total / _DRAWS)


def stiction_starts(screening: Screening) -> Sequence[Start]:
    """Start from the most similar backlash, then descend: the cost is sensitive to the path."""
    slack = screening.best(BACKLASH, [(s,) for s in _BANDS])
    if not slack or slack[0].gain < _LIKE_SLACK:
        return []  # stiction looks like backlash first of all
    (near,) = screening.best(BACKLASH, [(slack[0].values[0] * f,) for f in _FACTORS])
    rough = replace(STICTION, draws=_ROUGH_DRAWS)
    width = near.values[0]
    tried = screening.best(
        rough, [(width * f, width * f * j) for f in _OVER_SLACK for j in _SHARES]
    )
    return [_downhill(screening, rough, tried[0], width)] if tried else []


def _downhill(screening: Screening, cause: Cause, best: Start, width: float) -> Start:
    """Adjust the slip threshold (S + J)/2 and the distance after a slip (S - J)/2 in turn."""
    for step in _STEPS:
        for by_band, by_jump in ((1.0, 1.0), (-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0)):
            while True:
                band, jump = best.values[0] + step * width * by_band, best.values[1]
                jump += step * width * by_jump
                if not 0.0 <= jump <= band:
                    break
                trial = screening.displaced(cause, (band, jump))
                if not trial.gain > best.gain:
                    break
                best = trial
    return best


def simpler(values: Values) -> list[Values]:
    """Return values without a jump: a backlash of about the same width."""
    return [(values[0] * f, 0.0) for f in _SLACKS]


def stiction_sentence(values: dict[str, float]) -> str:
    """Return the sentence for the operator."""
    return (
        'The valve sticks and slips: after a reversal it does not move until the demand has '
        f'changed by {values["s_percent"]:.2g} % of opening, then it jumps by '
        f'{values["j_percent"]:.2g} %.'
    )


STICTION = Cause(
    'stiction', 'slack', Stage.OPENING,
    (
        Unknown('s_percent', '%', 0.04, 0.02, 20.0, Kind.LINE),
        Unknown('j_percent', '%', 0.04, 0.0, 20.0, Kind.LINE),
    ),
    apply_stiction, stiction_starts, stiction_sentence, ('backlash',),
    'A slow ramp below 0.05 %/s, with the position logged to 0.01 %: slipping shows as stairs.',
    order=1, draws=_DRAWS, draw=draw, contains='backlash', simpler=simpler,
    # The plug path is only roughly known; where it is wrong, the power lags or leads.
    conceals=('slack', 'lag'),
)  # fmt: skip


_RATE_LIMIT_TRIED = (0.05, 0.08, 0.12, 0.18, 0.27, 0.4)


def apply_rate_limit(v: FloatArray, values: Values, grids: Grids) -> FloatArray:
    """The servo is slow.

    Oil flow and pump limit the speed of the stem. The duration of a fast move grows with its
    size; a slow move is not affected.
    """
    out = np.empty(len(v))
    kernels.rate_limit(v, values[0] * grids.fine_s, out)
    return out


def rate_limit_starts(screening: Screening) -> Sequence[Start]:
    """Try several speeds."""
    return screening.best(RATE_LIMIT, [(r,) for r in _RATE_LIMIT_TRIED])


def rate_limit_sentence(values: dict[str, float]) -> str:
    """Return the sentence for the operator."""
    return (
        f'The plug cannot move faster than {values["r_percent_per_s"]:.2g} % of opening a second.'
    )


RATE_LIMIT = Cause(
    'rate_limit', 'lag', Stage.OPENING,
    (Unknown('r_percent_per_s', '%/s', 0.005, 0.005, 100.0, Kind.ROUGH),),
    apply_rate_limit, rate_limit_starts, rate_limit_sentence, ('reheater', 'region_lag'),
    'Make steps of 1 % and of 4 %: with a limited speed the large one takes four times as long.',
    order=0,
)  # fmt: skip


_TRIED_SHARES = (0.4, 0.7, 0.9)  # of the range of the opening


def apply_saturation(v: FloatArray, values: Values, grids: Grids) -> FloatArray:
    """A limit keeps the valve from opening fully.

    It is a mechanical or configured limit downstream of the position sensor:

        V_true = min(V, V_max)
    """
    return np.minimum(v, values[0])


def saturation_starts(screening: Screening) -> Sequence[Start]:
    """Fit the whole model from limits spread over the openings; its curve has become flatter."""
    low, high = np.nanquantile(screening.grids.v, (0.01, 0.99))
    fitted = [
        screening.fitted(SATURATION, (low + share * (high - low),)) for share in _TRIED_SHARES
    ]
    return [start for start in fitted if start.gain > 0.0]


def saturation_sentence(values: dict[str, float]) -> str:
    """Return the sentence for the operator."""
    return f'The plug does not open beyond {values["max_percent"]:.4g} %, whatever is measured.'


SATURATION = Cause(
    'saturation', 'stop', Stage.OPENING,
    (Unknown('max_percent', '%', 0.1, 1.0, 150.0, Kind.ROUGH),),
    apply_saturation, saturation_starts, saturation_sentence,
    ('curve_shape', 'exponent', 'choked'),
    'Hold the opening high and change the pressure: at a stop the power still follows the '
    'pressure, but not the opening.',
    order=2,
)  # fmt: skip
