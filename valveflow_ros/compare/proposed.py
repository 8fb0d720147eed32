"""What an identified characteristic predicts on other data, and where it may be judged."""

from __future__ import annotations

import numpy as np

from valveflow_ros.compare.judged import OtherData, Trial
from valveflow_ros.core.characteristic import Characteristic
from valveflow_ros.core.problem import Samples
from valveflow_ros.records import FloatArray, IntArray


def dynamic(characteristic: Characteristic, samples: Samples) -> FloatArray:
    """Return the power that curve and regional dynamics simulate, MW, shape (n,)."""
    model = characteristic.model
    return model.respond(samples.u, samples.usable, samples.step_s, samples.settle_s)[0]


def trial_of(other: OtherData, characteristic: Characteristic) -> Trial:
    """Return the measured data with the rows that can be judged.

    These are the same for every method: inside the range of u the proposed curve is known
    for, and as far behind a gap as the slowest dynamics allowed for.
    """
    samples = other.samples
    flat = characteristic.model
    age = _rows_since_gap(samples)
    good = samples.usable > 0
    good &= (samples.u >= flat.knots[0]) & (samples.u <= flat.knots[-1])
    good &= age > round(samples.settle_s / samples.step_s)
    return Trial(other.time_ns, samples.u, samples.power_mw, good, other.spans, samples.step_s)


def _rows_since_gap(samples: Samples) -> IntArray:
    """Return the number of usable rows in a row up to each row, 0 in a gap."""
    place = np.arange(1, len(samples.u) + 1)
    last = np.maximum.accumulate(np.where(samples.usable > 0, 0, place))
    return np.asarray(place - last)
