"""The power follows the time of day.

The pressure in the condenser follows the ambient air or the cooling water; auxiliary load
driven by the weather looks the same.

    x = F(u) (1 + a cos(2 pi (t - t_peak) / 24 h)),  t the time of day, UTC
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from valveflow_ros.diagnosis.bench import GAIN, Bench
from valveflow_ros.diagnosis.cause import Cause, Stage, Start, Unknown, Values
from valveflow_ros.diagnosis.causes._time import three_days
from valveflow_ros.diagnosis.scene import DAY_S, Scene
from valveflow_ros.records import FloatArray

_HOUR_S = 3600.0


def act(values: Values, scene: Scene, extra: Values) -> FloatArray:
    """Return the factor on x."""
    a, peak_h = values
    angle = 2.0 * np.pi * (scene.clock_s(scene.time_s) - peak_h * _HOUR_S) / DAY_S
    return np.asarray(1.0 + a * np.cos(angle))


def starts(bench: Bench) -> Sequence[Start]:
    """Regress on the power times a daily sine and cosine."""
    angle = 2.0 * np.pi * bench.scene.clock_s(bench.scene.sub_middle_s) / DAY_S
    _, found = bench.modulated([GAIN, GAIN], np.stack([np.cos(angle), np.sin(angle)]))
    peak_h = float(np.mod(np.arctan2(found[1], found[0]) / (2.0 * np.pi) * 24.0, 24.0))
    return bench.best(CAUSE, [(float(np.hypot(*found)), peak_h)])


def sentence(values: dict[str, float]) -> str:
    """Say it."""
    return (
        f'The power swings by ±{100.0 * abs(values["a"]):.2g} % every day, highest at '
        f'{values["peak_h"] % 24.0:.1f} h UTC (condenser and cooling water follow the day).'
    )


CAUSE = Cause(
    'diurnal', 'daily', Stage.GAIN,
    (Unknown('a', '', 5e-4, 0.0, 0.2), Unknown('peak_h', 'h', 0.5, -24.0, 48.0)),
    act, starts, sentence, ('intervals', 'temperature'),
    'Log the pressure in the condenser, or a week at constant load.',
    three_days, slow=True,
)  # fmt: skip
