# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the engine says: events, each with the time of the row at which it happened."""

from __future__ import annotations

import enum
from dataclasses import dataclass, replace

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.shift import Shift
from valveflow_ros.fit.task import FitTask
from valveflow_ros.monitoring.alarms import AlarmChange
from valveflow_ros.monitoring.prediction import PredictionBlock
from valveflow_ros.parameters import Settings
from valveflow_ros.records import SpecialSegment
from valveflow_ros.segments.window import NO_ROWS, WindowContents

# What a diagnosis is asked to do.


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


class JournalKind(enum.IntEnum):
    """Why the engine's state changed other than by a row; numbers as in the message."""

    FIT_REQUESTED = 1
    FIT_ADOPTED = 2
    FIT_REFUSED = 3
    ACKNOWLEDGE = 4
    SET_REFERENCE = 5
    RESET = 6
    DIAGNOSE = 7
    SETTINGS = 8
    DIAGNOSED = 9
    DIAGNOSIS_FAILED = 10
    MISMATCH = 11
    SHELVE = 12
    UNSHELVE = 13
    RESUMED = 14


@dataclass(frozen=True, slots=True)
class JournalEntry:
    """One decision, at the boundary after ``rows`` rows; a replay repeats it there."""

    time_ns: int
    kind: JournalKind
    request_ns: int
    rows: int
    model_id: str
    text: str


@dataclass(frozen=True, slots=True)
class SegmentClosed:
    """A special segment has ended."""

    segment: SpecialSegment


@dataclass(frozen=True, slots=True)
class FitRequested:
    """A fit is wanted; somebody has to compute ``task`` and hand the outcome back."""

    task: FitTask


@dataclass(frozen=True, slots=True)
class CurveAdopted:
    """A fit gave a new curve. It predicts from the next row on if there is no reference.

    ``shift`` is the judgement against the reference, None without one; ``provisional`` says what
    it is no curve of health for, empty if nothing is wrong.
    """

    characteristic: Characteristic
    shift: Shift | None = None
    provisional: str = ''


@dataclass(frozen=True, slots=True)
class ReferenceSet:
    """Later curves are judged against this one."""

    characteristic: Characteristic


@dataclass(frozen=True, slots=True)
class DiagnosisRequested:
    """A diagnosis is wanted; somebody has to compute ``task`` and hand the outcome back."""

    task: DiagnosisTask


@dataclass(frozen=True, slots=True)
class Diagnosed:
    """A diagnosis has ended.

    Attributes
    ----------
    task : DiagnosisTask
        What was diagnosed.
    content : str
        What `diagnosis.json` would hold; empty if there is no result.
    reason : str
        Why there is none.
    """

    task: DiagnosisTask
    content: str
    reason: str


Event = (
    PredictionBlock
    | SegmentClosed
    | FitRequested
    | CurveAdopted
    | ReferenceSet
    | DiagnosisRequested
    | Diagnosed
    | AlarmChange
    | JournalEntry
)
