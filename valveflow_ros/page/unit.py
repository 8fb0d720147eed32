# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The state of one unit for the page: its `MonitorState`, the last 24 hours, alarm changes."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from valveflow_ros.records import NS_PER_S
from valveflow_ros.report.terminal.board import ALARM, PREDICTION, ItemView, MonitorState
from valveflow_ros.report.terminal.frame import NORMAL, AlarmView, Frame, SampleView

MINUTE_NS = 60 * NS_PER_S
MINUTES = 24 * 60
# Maximum number of waiting changes; it is reached only if nobody reads them.
_MOST_CHANGES = 256
# Calls of `Unit.changes` after the first message, during which latched messages may arrive.
_FIRST_CALLS = 4
# Maximum number of monitors on a page, limited by its size and its processor load.
MOST_UNITS = 16


@dataclass(frozen=True, slots=True)
class Minute:
    """The samples of one minute.

    Attributes
    ----------
    start_ns : int
        Begin of the minute, ns since 1970.
    measured_mw, predicted_mw : float
        Means, MW; NaN if unknown.
    low_mw, high_mw : float
        Lowest and highest measured power, MW; NaN if unknown.
    """

    start_ns: int
    measured_mw: float
    predicted_mw: float
    low_mw: float
    high_mw: float


class Day:
    """The last 24 hours, one point per minute, with bounded memory."""

    def __init__(self) -> None:
        self._closed: deque[Minute] = deque(maxlen=MINUTES)
        self._view: tuple[Minute, ...] = ()
        self._start_ns = -1
        self._n = self._n_predicted = 0
        self._sum = self._sum_predicted = 0.0
        self._low, self._high = math.inf, -math.inf

    def add(self, sample: SampleView) -> None:
        """Add a sample; if the clock went back, the earlier ones are dropped."""
        start_ns = sample.time_ns - sample.time_ns % MINUTE_NS
        if start_ns < self._start_ns:
            self._closed.clear()
            self._begin(start_ns)
        elif start_ns > self._start_ns:
            self._close()
            self._begin(start_ns)
        if math.isfinite(sample.measured_mw):
            self._n += 1
            self._sum += sample.measured_mw
            self._low = min(self._low, sample.measured_mw)
            self._high = max(self._high, sample.measured_mw)
            if math.isfinite(sample.residual_mw):
                self._n_predicted += 1
                self._sum_predicted += sample.measured_mw - sample.residual_mw

    def view(self) -> tuple[Minute, ...]:
        """Return the complete minutes, oldest first; the same object until one is added."""
        while self._closed and self._closed[0].start_ns <= self._start_ns - MINUTES * MINUTE_NS:
            self._closed.popleft()
        ends = (self._closed[0], self._closed[-1]) if self._closed else None
        if ends != ((self._view[0], self._view[-1]) if self._view else None):
            self._view = tuple(self._closed)
        return self._view

    def _begin(self, start_ns: int) -> None:
        self._start_ns = start_ns
        self._n = self._n_predicted = 0
        self._sum = self._sum_predicted = 0.0
        self._low, self._high = math.inf, -math.inf

    def _close(self) -> None:
        if self._start_ns < 0:
            return
        if not self._n:
            nothing = Minute(self._start_ns, math.nan, math.nan, math.nan, math.nan)
            self._closed.append(nothing)
            return
        known = self._n_predicted
        predicted = self._sum_predicted / known if known else math.nan
        self._closed.append(
            Minute(self._start_ns, self._sum / self._n, predicted, self._low, self._high)
        )


@dataclass(frozen=True, slots=True)
class AlarmChange:
    """A change of the state of an alarm; states are indices in `frame.ALARM_STATES`.

    Attributes
    ----------
    unit, monitor : str
        Tag of the unit; name of the monitor's node, or of the recording.
    alarm : AlarmView
        Its present state.
    previous : int or None
        Its state before; None if unknown, because the page was started later.
    time_ns : int
        Time of the change, ns since 1970.
    """

    unit: str
    monitor: str
    alarm: AlarmView
    previous: int | None
    time_ns: int


@dataclass(frozen=True, slots=True)
class Snapshot:
    """A unit at one time; it is immutable, so any thread may read it.

    Attributes
    ----------
    key : str
        Name of the monitor's node, or of the recording.
    frame : Frame
    day : tuple of Minute
        The last 24 hours without the current minute; the same object while unchanged.
    items : tuple of ItemView
        All health items with their values.
    present : bool
        False if the monitor is no longer present.
    """

    key: str
    frame: Frame
    day: tuple[Minute, ...] = ()
    items: tuple[ItemView, ...] = ()
    present: bool = True

    @property
    def title(self) -> str:
        """Return the displayed name of the unit."""
        return self.frame.unit or self.key


class Unit(MonitorState):
    """The state of one monitor for the page, with bounded memory.

    Parameters
    ----------
    key : str
        Name of the monitor's node, or of the recording.
    """

    def __init__(self, key: str) -> None:
        super().__init__()
        self.key = key
        self._day = Day()
        self._states: dict[str, int] = {}
        self._changes: deque[AlarmChange] = deque(maxlen=_MOST_CHANGES)
        self._calls = 0

    def take(self, type_name: str, fields: Mapping[str, Any]) -> None:
        """Process a message; messages of other types are ignored."""
        super().take(type_name, fields)
        if type_name == PREDICTION and self._samples:
            self._day.add(self._samples[-1])
        elif type_name == ALARM:
            self._note_change(str(fields['name']), fields['header']['stamp'])

    def snapshot(self, frame: Frame, present: bool = True) -> Snapshot:
        """Return the current state."""
        return Snapshot(self.key, frame, self._day.view(), self.items, present)

    def changes(self) -> list[AlarmChange]:
        """Return the alarm changes since the last call, oldest first.

        The first calls return only standing alarms: the first messages that arrive are history.
        """
        told = list(self._changes)
        self._changes.clear()
        if not self._settled:
            self._calls += bool(self._tag is not None)
            last = {change.alarm.name: change for change in told}
            return [change for change in last.values() if change.alarm.state != NORMAL]
        return told

    @property
    def _settled(self) -> bool:
        """Return True after the latched messages have arrived."""
        return self._calls >= _FIRST_CALLS

    def _note_change(self, name: str, stamp: Mapping[str, Any]) -> None:
        alarm = self._alarms.get(name)
        before = self._states.get(name)
        if alarm is None or alarm.state == before:
            return
        self._states[name] = alarm.state
        if before is None and alarm.state == NORMAL:
            # A starting monitor announces the normal state of each alarm; this needs no notice.
            return
        time_ns = int(stamp['sec']) * NS_PER_S + int(stamp['nanosec'])
        self._changes.append(
            AlarmChange(self._unit, self.key, alarm, before if self._settled else None, time_ns)
        )


class Shown:
    """The content of the page at this time: set by one thread, read by others."""

    def __init__(self) -> None:
        self._both: tuple[tuple[Snapshot, ...], str] = ((), '')

    def put(self, units: Iterable[Snapshot], note: str = '') -> None:
        """Replace everything; at most `MOST_UNITS` units are kept."""
        # A single assignment, so that readers always get a consistent pair.
        self._both = (tuple(units)[:MOST_UNITS], note)

    @property
    def units(self) -> tuple[Snapshot, ...]:
        """Return the units in their order."""
        return self._both[0]

    @property
    def note(self) -> str:
        """Return a sentence for the top of the page, empty if there is none."""
        return self._both[1]
