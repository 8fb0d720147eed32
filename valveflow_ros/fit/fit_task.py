"""What a fit is asked to do."""

from __future__ import annotations

from dataclasses import dataclass

from valveflow_ros.config import Settings
from valveflow_ros.curve.characteristic import HeldCause
from valveflow_ros.segments.window import WindowContents


@dataclass(frozen=True, slots=True)
class FitTask:
    """Everything a fit depends on.

    Attributes
    ----------
    request_ns : int
        Time of the row after which the fit was asked for; its name.
    contents : WindowContents
    settings : Settings
    input_noise, power_noise_mw : float
        The segmenter's noise levels at that moment.
    held : tuple of HeldCause
        Causes that were taken out of the rows.
    """

    request_ns: int
    contents: WindowContents
    settings: Settings
    input_noise: float
    power_noise_mw: float
    held: tuple[HeldCause, ...] = ()
