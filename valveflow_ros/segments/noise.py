"""The signals' own noise, learnt while they stream by.

Each stretch of `WINDOW` block means gives one rms about its own straight line.
Those numbers go into a histogram on a log scale, and the noise is a low
quantile of it: stretches with moves in them only fill its upper end. A
stretch of seven minutes is long enough to hold the wander of a valve under
load control, which shorter ones mistake for a trend.
"""

from __future__ import annotations

import math

from valveflow_ros.jit import jit
from valveflow_ros.records import FloatArray

WINDOW = 42  # block means a stretch
BINS = 480
_PER_DECADE = 40.0
_LOWEST = -6.0  # log10 of the histogram's lower end
QUANTILE = 0.4
WARM_UP = 4  # stretches before the noise is believed
FORGET_AT = 4000.0  # stretches after which old ones count half (about three weeks)


@jit
def noise_add(histogram: FloatArray, rms: float) -> None:
    """Add one stretch's rms; halve everything when there is much of it.

    A signal that stood still to the last digit teaches nothing of its noise.
    """
    if not 10.0**_LOWEST < rms < 10.0 ** (_LOWEST + BINS / _PER_DECADE):
        return
    place = min(max(int((math.log10(rms) - _LOWEST) * _PER_DECADE), 0), BINS - 1)
    histogram[place] += 1.0
    if histogram.sum() >= FORGET_AT:
        histogram *= 0.5


@jit
def noise_level(histogram: FloatArray) -> float:
    """Return the noise sd: the quantile, interpolated inside its bin."""
    wanted = QUANTILE * histogram.sum()
    below = 0.0
    for k in range(histogram.size):
        count = histogram[k]
        if count > 0.0 and below + count >= wanted:
            inside = (wanted - below) / count
            return float(10.0 ** (_LOWEST + (k + inside) / _PER_DECADE))
        below += count
    return 0.0
