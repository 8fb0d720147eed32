"""A slow wander of the power that is no cause: coal, vacuum, ambient."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from valveflow_ros.diagnosis.bench import Bench
from valveflow_ros.records import FloatArray

LEAST_GAIN = 16.0
_WIDTHS_H = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
_SHRINK = (0.3, 1.0, 3.0)


@dataclass(frozen=True, slots=True)
class Wander:
    """How the level of the power wanders.

    Attributes
    ----------
    gain : float
        Log-likelihood gained on sub-blocks whose level was estimated from others.
    rms_mw, time_scale_s : float
    level : float64 (subs,)
        The relative level of each sub-block.
    """

    gain: float
    rms_mw: float
    time_scale_s: float
    level: FloatArray

    @property
    def there(self) -> bool:
        """Tell whether it is more than chance."""
        return self.gain > LEAST_GAIN


def wander(bench: Bench) -> Wander:
    """Estimate the level of each sub-block from its neighbours, and what that is worth.

    Kernels of several widths are tried; each sub-block is predicted without itself, so that
    what the noise does inside it cannot pay.
    """
    own, toward = bench.gain_by_sub()
    middle_h = bench.scene.sub_middle_s / 3600.0
    distance = np.abs(middle_h[:, None] - middle_h[None, :])
    np.fill_diagonal(distance, np.inf)
    usual = float(np.median(own[own > 0.0])) if np.any(own > 0.0) else 1.0
    best = Wander(0.0, 0.0, 0.0, np.zeros(len(own)))
    for width in _WIDTHS_H:
        weight = np.exp(-0.5 * (distance / width) ** 2)
        for shrink in _SHRINK:
            level = (weight @ toward) / (weight @ own + shrink * usual)
            gain = float(np.sum(2.0 * level * toward - level**2 * own)) / (2.0 * bench.variance)
            if gain > best.gain:
                power = float(np.mean(bench.here[bench.scene.scored]))
                rms = float(np.sqrt(np.mean(level[own > 0.0] ** 2))) * power
                best = Wander(gain, rms, width * 3600.0, level)
    return best
