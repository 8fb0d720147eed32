"""Friction holds the valve until it slips.

The two-parameter picture of Choudhury in the form of He: the valve stays until the pull
exceeds (S + J) / 2, then slips and stays (S - J) / 2 behind. The moment it slips hangs on
every hundredth of a per cent of the measured opening, so the path is averaged over
a few draws of the sensor's noise.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from valveflow_ros.diagnosis import kernels
from valveflow_ros.diagnosis.bench import Bench
from valveflow_ros.diagnosis.catalogue import backlash
from valveflow_ros.diagnosis.cause import Cause, Kind, Stage, Start, Unknown, Values
from valveflow_ros.diagnosis.scene import Scene
from valveflow_ros.records import FloatArray

_DRAWS = 10
_SEED = 20_240
_BANDS = (0.3, 0.5, 0.7, 0.95, 1.25, 1.6, 2.1, 2.8)
_FACTORS, _SHARES = (0.88, 0.94, 1.0, 1.07, 1.15), (0.3, 0.5, 0.62, 0.7, 0.78, 0.9)
_LIKE_SLACK, _WORTH_A_LOOK = 3.0, 10.0
_SHIFT = 7_919


def _noise_of(v: FloatArray) -> float:
    """Return the sd of the white noise of a position.

    A position that wanders has E (v[t + h] - v[t])^2 = 2 (noise + c h); two lags separate them.
    """
    near, far = (float(np.nanmedian((v[h:] - v[:-h]) ** 2)) / 0.455 for h in (1, 2))
    return float(np.sqrt(max(near - 0.5 * far, 0.0)))


def act(v: FloatArray, values: Values, scene: Scene) -> FloatArray:
    """Return the mean position of the plug over the draws."""
    band, jump = values[0], min(values[1], values[0])
    noise = _noise_of(v) * np.random.default_rng(_SEED).standard_normal(len(v))
    total, path = np.zeros(len(v)), np.empty(len(v))
    for draw in range(_DRAWS):
        kernels.stick_slip(v + np.roll(noise, draw * _SHIFT), band, jump, path)
        total += path
    return np.asarray(total / _DRAWS)


def starts(bench: Bench) -> Sequence[Start]:
    """Try some bands; round the best of them look closely, since the path forgives little."""
    slack = bench.best(backlash.CAUSE, [(s,) for s in _BANDS])
    if not slack or slack[0].gain < _LIKE_SLACK:
        return []  # a valve that sticks looks loose first of all
    band = bench.best(CAUSE, [(s, 0.6 * s) for s in _BANDS])
    if not band or band[0].gain < _WORTH_A_LOOK:
        return band
    near = band[0].values[0]
    return bench.best(CAUSE, [(near * f, near * f * j) for f in _FACTORS for j in _SHARES])


def sentence(values: dict[str, float]) -> str:
    """Say it."""
    return (
        f'The valve sticks and slips: it stays until pulled by {values["s_percent"]:.2g} % of '
        f'opening and then jumps by {values["j_percent"]:.2g} %.'
    )


CAUSE = Cause(
    'stiction', 'slack', Stage.OPENING,
    (
        Unknown('s_percent', '%', 0.1, 0.02, 20.0, Kind.LINE),
        Unknown('j_percent', '%', 0.1, 0.0, 20.0, Kind.LINE),
    ),
    act, starts, sentence, ('backlash',),
    'A slow ramp below 0.05 %/s, with the position logged to 0.01 %: slipping shows as stairs.',
    order=1,
)  # fmt: skip
