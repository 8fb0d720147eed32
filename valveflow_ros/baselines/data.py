"""Rows of a log in the form every method of the comparison takes them."""

from __future__ import annotations

import numpy as np

from valveflow_ros.baselines.judged import OtherData
from valveflow_ros.config import Settings
from valveflow_ros.fit.problem import Samples
from valveflow_ros.segments.window import WindowContents


def samples_of(contents: WindowContents, settings: Settings) -> Samples:
    """Return the rows of a window.

    A row without opening, pressure or power is not usable; a jump in time is a
    gap even where no row stands in it.
    """
    usable = (np.isfinite(contents.u) & np.isfinite(contents.power_mw)).astype(np.uint8)
    step_s = settings.real('sample_period')
    usable[1:][np.diff(contents.time_ns) > 1.5e9 * step_s] = 0
    return Samples(
        u=np.where(usable > 0, contents.u, 0.0),
        power_mw=np.where(usable > 0, contents.power_mw, 0.0),
        usable=usable,
        step_s=step_s,
        settle_s=settings.settle_s,
        group=max(1, round(settings.real('block') / step_s)),
    )


def other_data(contents: WindowContents, settings: Settings) -> OtherData:
    """Return the rows of a window with its special segments, to judge by."""
    return OtherData(samples_of(contents, settings), contents.time_ns, contents.spans)
