"""Friction holds the valve until it slips.

The two-parameter picture of Choudhury in the form of He: the valve stays until the pull
exceeds (S + J) / 2, then slips and stays (S - J) / 2 behind. The moment it slips hangs on
every hundredth of a per cent of the measured opening, so several paths are run, each
with a draw of the sensor's noise (see `draws`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from valveflow_ros.diagnosis import kernels
from valveflow_ros.diagnosis.bench import Bench
from valveflow_ros.diagnosis.cause import Cause, Kind, Stage, Start, Unknown, Values
from valveflow_ros.diagnosis.causes import backlash
from valveflow_ros.diagnosis.scene import Scene
from valveflow_ros.records import FloatArray

_DRAWS, _ROUGH_DRAWS = 10, 5
_SEED = 20_240
_BANDS = (0.3, 0.5, 0.7, 0.95, 1.25, 1.6, 2.1, 2.8, 3.7, 4.9, 6.5, 8.6, 11.4, 15.0)
_FACTORS = (0.88, 0.94, 1.0, 1.07, 1.15)
_OVER_SLACK, _SHARES = (0.97, 1.04, 1.1), (0.15, 0.4, 0.6, 0.75, 0.9)
_LIKE_SLACK = 3.0
_SLACKS = (0.8, 0.86, 0.91, 0.95, 0.98, 1.0, 1.03, 1.07)
_STEPS = (0.04, 0.02, 0.01, 0.005)
_SHIFT = 7_919


def _noise(v: FloatArray, scene: Scene) -> FloatArray:
    """Return noise like that of the position sensor, the same for every call."""
    if 'noise of v' not in scene.cache:
        normal = np.random.default_rng(_SEED).standard_normal(len(v))
        scene.cache['noise of v'] = scene.reference.opening_noise * normal
    return scene.cache['noise of v']


def draw(number: int) -> Callable[[FloatArray, Values, Scene], FloatArray]:
    """Return what acts in one draw of the noise."""

    def path(v: FloatArray, values: Values, scene: Scene) -> FloatArray:
        out = np.empty(len(v))
        moved = v + np.roll(_noise(v, scene), number * _SHIFT)
        kernels.stick_slip(moved, values[0], min(values[1], values[0]), out)
        return out

    return path


def act(v: FloatArray, values: Values, scene: Scene) -> FloatArray:
    """Return the mean position of the plug over the draws."""
    total = np.zeros(len(v))
    for k in range(_DRAWS):
        total += draw(k)(v, values, scene)
    return np.asarray(total / _DRAWS)


def starts(bench: Bench) -> Sequence[Start]:
    """Begin at the slack it looks like, then walk downhill: the path forgives little."""
    slack = bench.best(backlash.CAUSE, [(s,) for s in _BANDS])
    if not slack or slack[0].gain < _LIKE_SLACK:
        return []  # a valve that sticks looks loose first of all
    (near,) = bench.best(backlash.CAUSE, [(slack[0].values[0] * f,) for f in _FACTORS])
    rough = replace(CAUSE, draws=_ROUGH_DRAWS)
    width = near.values[0]
    tried = bench.best(rough, [(width * f, width * f * j) for f in _OVER_SLACK for j in _SHARES])
    return [_downhill(bench, rough, tried[0], width)] if tried else []


def _downhill(bench: Bench, cause: Cause, best: Start, width: float) -> Start:
    """Move where the valve breaks loose, (S + J)/2, and where it stops, (S - J)/2, in turn."""
    for step in _STEPS:
        for by_band, by_jump in ((1.0, 1.0), (-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0)):
            while True:
                band, jump = best.values[0] + step * width * by_band, best.values[1]
                jump += step * width * by_jump
                if not 0.0 <= jump <= band:
                    break
                trial = bench.displaced(cause, (band, jump))
                if not trial.gain > best.gain:
                    break
                best = trial
    return best


def simpler(values: Values) -> list[Values]:
    """Return values without a jump, which are a slack of about the same width."""
    return [(values[0] * f, 0.0) for f in _SLACKS]


def sentence(values: dict[str, float]) -> str:
    """Say it."""
    return (
        f'The valve sticks and slips: it stays until pulled by {values["s_percent"]:.2g} % of '
        f'opening and then jumps by {values["j_percent"]:.2g} %.'
    )


CAUSE = Cause(
    'stiction', 'slack', Stage.OPENING,
    (
        Unknown('s_percent', '%', 0.04, 0.02, 20.0, Kind.LINE),
        Unknown('j_percent', '%', 0.04, 0.0, 20.0, Kind.LINE),
    ),
    act, starts, sentence, ('backlash',),
    'A slow ramp below 0.05 %/s, with the position logged to 0.01 %: slipping shows as stairs.',
    order=1, draws=_DRAWS, draw=draw, contains='backlash', simpler=simpler,
    # The path of the plug is known roughly; where it is wrong the power lags and leads.
    conceals=('slack', 'lag'),
)  # fmt: skip
