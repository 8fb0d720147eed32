"""What a diagnosis is asked to do."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from valveflow_ros.config import Settings
from valveflow_ros.core.characteristic import Characteristic
from valveflow_ros.core.window import WindowContents


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
        empty = np.empty(0)
        none = WindowContents(
            np.empty(0, dtype=np.int64), empty, empty, empty, np.empty((0, 3), dtype=np.int64)
        )
        return replace(self, contents=none)


@dataclass(frozen=True, slots=True)
class DiagnosisContent:
    """What a diagnosis gave: the window's newest row, and what `diagnosis.json` would hold."""

    window_end_ns: int
    text: str
