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
    """The samples of one minute; NaN if unknown."""

    start_ns: int
    measured_mw: float  # mean
    predicted_mw: float  # mean
    low_mw: float  # lowest measured power
    high_mw: float


class Day:
    """The last 24 hours, one point per minute, with bounded memory."""

    def __init__(self) -> None:
        self._closed: deque[Minute] = deque(maxlen=MINUTES)
        self._view: tuple[Minute, ...] = ()
        self._begin(-1)

    def _begin(self, start_ns: int) -> None:
        self._start_ns = start_ns
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

    def _close(self) -> None:
        known, nan = self._n_predicted, math.nan
        predicted = self._sum_predicted / known if known else nan
        numbers = (
            (self._sum / self._n, predicted, self._low, self._high) if self._n else (nan,) * 4
        )
        if self._start_ns >= 0:
            self._closed.append(Minute(self._start_ns, *numbers))


@dataclass(frozen=True, slots=True)
class AlarmChange:
    """A change of the state of an alarm; states are indices in `frame.ALARM_STATES`."""

    unit: str  # its tag
    monitor: str  # name of the monitor's node, or of the recording
    alarm: AlarmView  # its present state
    previous: int | None  # its state before; None if unknown: the page was started later
    time_ns: int  # of the change


@dataclass(frozen=True, slots=True)
class Snapshot:
    """A unit at one time; it is immutable, so any thread may read it."""

    key: str  # name of the monitor's node, or of the recording
    frame: Frame
    # The last 24 hours without the current minute; the same object while unchanged.
    day: tuple[Minute, ...] = ()
    items: tuple[ItemView, ...] = ()  # the health
    present: bool = True  # the monitor is there

    @property
    def title(self) -> str:
        """Return the displayed name of the unit."""
        return self.frame.unit or self.key


class Unit(MonitorState):
    """The state of one monitor for the page, with bounded memory."""

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
        if self._settled:
            return told
        self._calls += self._tag is not None
        last = {change.alarm.name: change for change in told}
        return [change for change in last.values() if change.alarm.state != NORMAL]

    @property
    def _settled(self) -> bool:  # the latched messages have arrived
        return self._calls >= _FIRST_CALLS

    def _note_change(self, name: str, stamp: Mapping[str, Any]) -> None:
        alarm, before = self._alarms.get(name), self._states.get(name)
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
        self.units: tuple[Snapshot, ...] = ()
        self.note = ''  # a sentence for the top of the page

    def put(self, units: Iterable[Snapshot], note: str = '') -> None:
        """Replace everything; at most `MOST_UNITS` units are kept."""
        self.units, self.note = tuple(units)[:MOST_UNITS], note
