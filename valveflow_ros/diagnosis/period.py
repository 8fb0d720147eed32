"""A hidden period: one line of the residual's spectrum far above its neighbours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

from valveflow_ros.diagnosis.extended import Extended
from valveflow_ros.diagnosis.fitting import Task

LARGEST_P = 1e-5
_MEAN_S = 60.0
_NEIGHBOURS = 101
_SHORTEST_S, _LONGEST_S = 240.0, 5.5 * 3600.0


@dataclass(frozen=True, slots=True)
class Period:
    """The strongest line: its period in s, the chance of one as strong, its variance in MW^2."""

    period_s: float
    p_value: float
    variance_mw2: float

    @property
    def there(self) -> bool:
        """Tell whether it is more than chance."""
        return self.p_value < LARGEST_P

    @property
    def words(self) -> str:
        """Return it as a variable to be named."""
        return f'time, with a period of {self.period_s / 60.0:.3g} min'


def period(task: Task, model: Extended) -> Period:
    """Test the largest ordinate of the periodogram (Fisher's test, on a floor of its own).

    Each ordinate is divided by the median of its neighbours, which flattens the spectrum
    of any smooth noise; then ordinates are exponential and the largest of n exceeds
    z by chance with probability n exp(-z).
    """
    scene = task.scene
    rows = max(1, round(_MEAN_S / scene.mean_s))
    m = len(scene.power) // rows
    rest = np.where(scene.scored, task.residual(model), 0.0)[: m * rows]
    rest = rest.reshape(m, rows).mean(axis=1)
    rest = rest - rest.mean()
    power = np.abs(np.fft.rfft(rest * np.hanning(m))) ** 2
    width = min(_NEIGHBOURS, max(5, len(power) // 8 * 2 + 1))
    floor = median_filter(power, width, mode='nearest') / np.log(2.0)
    ratio = power / np.maximum(floor, 1e-300)
    span = m * rows * scene.mean_s
    ratio[: int(span / _LONGEST_S) + 1] = 0.0
    ratio[int(span / _SHORTEST_S) :] = 0.0
    k = int(np.argmax(ratio))
    # The window makes neighbours alike; they count as one and a half each.
    chance = min(1.0, len(power) * float(np.exp(-min(ratio[k] / 1.3, 700.0))))
    near = slice(max(k - 2, 0), k + 3)
    share = float(np.maximum(power[near] - floor[near], 0.0).sum())
    variance = 2.0 * share / (m * float((np.hanning(m) ** 2).sum()))
    return Period(span / max(k, 1), chance, variance)
