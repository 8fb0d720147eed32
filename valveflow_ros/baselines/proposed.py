"""What an identified characteristic predicts on other data, and where it may be judged."""

from __future__ import annotations

from valveflow_ros.baselines.holdout import settled_rows
from valveflow_ros.baselines.judged import OtherData, Trial
from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.fit.problem import Samples
from valveflow_ros.records import FloatArray


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
    good = samples.usable > 0
    good &= (samples.u >= flat.knots[0]) & (samples.u <= flat.knots[-1])
    good &= settled_rows(samples)
    return Trial(other.time_ns, samples.u, samples.power_mw, good, other.spans, samples.step_s)
