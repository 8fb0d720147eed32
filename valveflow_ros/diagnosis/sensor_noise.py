"""The noise of the position sensor: what it adds to an opening that wanders."""

from __future__ import annotations

import numpy as np

from valveflow_ros.records import FloatArray

_KEPT = 0.95  # share of the increments that are no pulses of the frequency control
_OF_NORMAL = 0.7587  # their mean square in units of the whole, for a normal law


def sensor_noise(v: FloatArray) -> float:
    """Return the sd of the white noise of a position in its own unit.

    Rows apart by h differ by D(h) = E (v[t + h] - v[t])^2, which noise lifts by twice its
    variance however small h is. A parabola through D(1), D(2), D(3), at h = 0, is that lift.

    Parameters
    ----------
    v : float64 (n,)
        Positions at a constant step, NaN where there is none.
    """
    lifted = []
    for h in (1, 2, 3):
        apart = np.abs(v[h:] - v[:-h])
        apart = apart[np.isfinite(apart)]
        if not len(apart):
            return 0.0
        kept = apart[apart <= np.quantile(apart, _KEPT)]
        lifted.append(float(np.mean(kept**2)) / _OF_NORMAL)
    return float(np.sqrt(max(3.0 * lifted[0] - 3.0 * lifted[1] + lifted[2], 0.0) / 2.0))
