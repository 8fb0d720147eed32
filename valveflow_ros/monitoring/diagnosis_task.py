"""What a diagnosis is asked to do."""

from __future__ import annotations

from dataclasses import dataclass, replace

from valveflow_ros.config import Settings
from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.segments.window import NO_ROWS, WindowContents


@dataclass(frozen=True, slots=True)
class DiagnosisTask:
    """Everything a diagnosis depends on.

    Attributes
    ----------
    request_ns : int
        Time of the row after which it was asked for; its name.
    contents : WindowContents
    settings : Settings
    curve : Characteristic
        The curve in force, from which the diagnosis begins.
    window_end_ns : int
        Time of the newest row in the window.
    """

    request_ns: int
    contents: WindowContents
    settings: Settings
    curve: Characteristic
    window_end_ns: int

    def without_data(self) -> DiagnosisTask:
        """Return a copy that keeps no rows, for whoever only wants to know what was asked."""
        return replace(self, contents=NO_ROWS)


@dataclass(frozen=True, slots=True)
class DiagnosisContent:
    """What a diagnosis gave: the window's newest row, and what `diagnosis.json` would hold."""

    window_end_ns: int
    text: str
