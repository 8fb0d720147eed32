# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The events of the engine, each with the time of its row."""

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


@dataclass(frozen=True, slots=True)
class DiagnosisTask:
    """All inputs of a diagnosis."""

    request_ns: int  # time of the last row before the request; its name
    contents: WindowContents
    settings: Settings
    curve: Characteristic  # the current one, used as the initial model
    window_end_ns: int  # time of the newest row in the window

    def without_data(self) -> DiagnosisTask:
        """Return a copy without rows, to identify the request."""
        return replace(self, contents=NO_ROWS)


@dataclass(frozen=True, slots=True)
class DiagnosisContent:
    """The result of a diagnosis: newest row of the window, and the content of `diagnosis.json`."""

    window_end_ns: int
    text: str


class JournalKind(enum.IntEnum):
    """Reasons for changes of the engine state other than rows; numbers as in the message."""

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
    """One decision after ``rows`` rows; a replay repeats it at the same place."""

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
    """A fit is requested; the caller computes ``task`` and returns the outcome."""

    task: FitTask


@dataclass(frozen=True, slots=True)
class CurveAdopted:
    """A fit gave a new curve. If there is no reference, it predicts from the next row on.

    ``shift`` is the judgement against the reference, None without one. ``provisional`` says why
    the curve does not show the healthy plant; empty if there is no fault.
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
    """A diagnosis is requested; the caller computes ``task`` and returns the outcome."""

    task: DiagnosisTask


@dataclass(frozen=True, slots=True)
class Diagnosed:
    """A diagnosis has ended: with the ``content`` of `diagnosis.json`, or without for a reason."""

    task: DiagnosisTask
    content: str
    reason: str


Event = (
    PredictionBlock | SegmentClosed | FitRequested | CurveAdopted | ReferenceSet
    | DiagnosisRequested | Diagnosed | AlarmChange | JournalEntry
)  # fmt: skip
