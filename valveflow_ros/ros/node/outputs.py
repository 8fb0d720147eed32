# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The output topics, and their messages as a pure function of the engine's events.

The node publishes and records the messages; `verify` compares them with those of a replay.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import tzinfo
from typing import Any, NamedTuple

from std_msgs.msg import Float64MultiArray
from valveflow_msgs.msg import (
    Alarm,
    Diagnosis,
    FlowCharacteristic,
    JournalEntry,
    Prediction,
    SpecialSegment,
)

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.shift import Shift
from valveflow_ros.monitoring import events as engine
from valveflow_ros.monitoring.alarm_state import BURIED, Priority
from valveflow_ros.monitoring.alarms import (
    AlarmChange,
    AlarmState,
    ResidualAlarm,
    ShiftAlarm,
)
from valveflow_ros.monitoring.curves import NO_CURVE_YET, CurveStatus
from valveflow_ros.monitoring.events import JournalKind
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.prediction import PredictionBlock
from valveflow_ros.ros import encoding
from valveflow_ros.ros.decoding import type_name
from valveflow_ros.signals.static_form import OPENING
from valveflow_ros.signals.units import in_unit

ALARMS = (ResidualAlarm.NAME, ShiftAlarm.NAME)


@dataclass(frozen=True, slots=True)
class OutputTopic:
    """A topic under the node's name."""

    message_type: type
    latched: bool
    kept: int = 1  # messages that a late subscriber gets, if latched

    @property
    def type_name(self) -> str:
        """Return the name of the message type, as in a recording."""
        return type_name(self.message_type)


# A frequent alarm must not displace the last message of another active alarm. That one is
# announced again after `BURIED` announcements, and one or two may come before it.
_ALARMS_KEPT = BURIED + 2
OUTPUTS: Mapping[str, OutputTopic] = {
    'characteristic': OutputTopic(FlowCharacteristic, True),
    'breakpoints': OutputTopic(Float64MultiArray, True),
    'slopes': OutputTopic(Float64MultiArray, True),
    'prediction': OutputTopic(Prediction, False),
    'segments': OutputTopic(SpecialSegment, False),
    'alarms': OutputTopic(Alarm, True, _ALARMS_KEPT),
    'diagnosis': OutputTopic(Diagnosis, True),
    'journal': OutputTopic(JournalEntry, False),
}


# Services of a running monitor; each is a `std_srvs/Trigger` of the node.
SERVICES: tuple[str, ...] = (
    'refit',
    'acknowledge_alarms',
    'shelve_alarms',
    'unshelve_alarms',
    'set_reference',
    'diagnose',
)


def _never(name: str, time_ns: int) -> AlarmChange:
    """Return the initial message of an alarm that has not occurred yet."""
    normal = AlarmState.NORMAL
    return AlarmChange(
        time_ns, name, normal, normal, Priority.MEDIUM, math.nan, math.nan, '',
        'Not raised since the monitor started.', 0, 0, '',
    )  # fmt: skip


class Output(NamedTuple):
    """A message to publish: the topic's name in `OUTPUTS`, its bytes, the time of its data."""

    name: str
    data: bytes
    time_ns: int


class Outputs:
    """Converts events to messages.

    Parameters
    ----------
    tag : str
        The unit's tag, the frame_id of every message.
    output_unit : str
        Unit that replaces MW in sentences.
    zone : tzinfo, optional
        Time zone of times in sentences.
    begun_ns : int
        Start time of the run, or of the first of several continued runs. It is the time of
        messages before the first data. If 0 (unknown), they are sent again with the first row.

    Notes
    -----
    The status of the curve is derived from the events alone, so that the
    messages depend only on the events and their order.
    """

    def __init__(
        self, tag: str, output_unit: str = 'MW', zone: tzinfo | None = None, begun_ns: int = 0
    ) -> None:
        self._tag, self._unit, self._zone = tag, output_unit, zone
        self.begun_ns = begun_ns
        self.curve: Characteristic | None = None
        self.status = CurveStatus.UNKNOWN
        self.cause = NO_CURVE_YET
        self.reference_id = ''
        self.shift: Shift | None = None
        self._diagnosed: engine.Diagnosed | None = None
        self._alarms: dict[str, AlarmChange] = {}

    def of(self, events: Sequence[engine.Event]) -> Iterator[Output]:
        """Yield the messages of the events of one call of the engine.

        A block of predictions and the alarm changes among its rows are yielded in
        the order of the rows, so that the result does not depend on the block size.
        """
        k = 0
        while k < len(events):
            event = events[k]
            k += 1
            if isinstance(event, PredictionBlock):
                changes: list[AlarmChange] = []
                while k < len(events) and isinstance(change := events[k], AlarmChange):
                    changes.append(change)
                    k += 1
                yield from self._rows(event, changes)
            else:
                yield from self._single(event)

    def _rows(self, block: PredictionBlock, changes: list[AlarmChange]) -> Iterator[Output]:
        if not self.begun_ns:
            # No time was known at the start, since /clock had no message yet.
            self.begun_ns = int(block.time_ns[0])
            yield from self.latched()
        left = iter(changes)
        change = next(left, None)
        for time_ns, data in encoding.prediction_bytes(block, self._tag):
            yield Output('prediction', data, max(0, time_ns))
            while change is not None and change.time_ns <= time_ns:
                yield from self._single(change)
                change = next(left, None)

    def _single(self, event: engine.Event) -> Iterator[Output]:
        tag = self._tag
        if isinstance(event, engine.SegmentClosed):
            message = encoding.segment_message(event.segment, tag)
            yield self._output('segments', message, event.segment.end_ns)
        elif isinstance(event, AlarmChange):
            self._alarms[event.name] = event
            yield self._output('alarms', encoding.alarm_message(event, tag), event.time_ns)
        elif isinstance(event, engine.CurveAdopted):
            self.curve, self.cause = event.characteristic, event.provisional
            self.status = CurveStatus.PROVISIONAL if self.cause else CurveStatus.FRESH
            self.shift = event.shift
            yield from self._curve_messages()
        elif isinstance(event, engine.ReferenceSet):
            self.reference_id, self.shift = event.characteristic.model_id, None
            yield from self._curve_messages()
        elif isinstance(event, engine.Diagnosed):
            self._diagnosed = event
            yield self._diagnosis()
        elif isinstance(event, engine.JournalEntry):
            yield self._output('journal', encoding.journal_message(event, tag), event.time_ns)
            if event.kind == JournalKind.RESUMED:
                # New subscribers to the restarted process need all latched messages.
                self.shift = None
                yield from self._current(event.time_ns or self.begun_ns)
            elif self._note(event):
                yield from self._curve_messages(event.time_ns)

    def restore(self, monitor: Monitor) -> None:
        """Continue from the state of a restored monitor."""
        reference = monitor.reference.curve
        self.curve, self.status, self.cause = monitor.characteristic, monitor.status, monitor.cause
        self.reference_id = '' if reference is None else reference.model_id
        self.shift, self._diagnosed = None, monitor.diagnosing.last
        told = (monitor.alarm.last, monitor.reference.alarm.last)
        self._alarms = {change.name: change for change in told if change is not None}

    def latched(self) -> Iterator[Output]:
        """Yield the current messages of the latched topics."""
        return self._current(self.begun_ns)

    def _current(self, time_ns: int) -> Iterator[Output]:
        """Yield the current messages; those without data have the given time."""
        yield from self._curve_messages(time_ns)
        yield self._diagnosis(time_ns)
        # A message for every alarm, so that no alarm differs from no monitor.
        told = {name: _never(name, time_ns) for name in ALARMS} | self._alarms
        for change in sorted(told.values(), key=lambda a: (a.time_ns, a.name)):
            if change.state == AlarmState.NORMAL:
                change = replace(change, previous=change.state)  # nothing new
            yield self._output('alarms', encoding.alarm_message(change, self._tag), change.time_ns)

    def _diagnosis(self, time_ns: int = 0) -> Output:
        event, tag = self._diagnosed, self._tag
        if event is None:
            message = encoding.no_diagnosis_message(encoding.NOT_YET, tag)
            message.header.stamp = encoding.to_time(time_ns)
            return self._output('diagnosis', message, time_ns)
        task = event.task
        if event.content:
            message = encoding.diagnosis_message(json.loads(event.content), task, tag)
        else:
            message = encoding.no_diagnosis_message(event.reason, tag, task)
        return self._output('diagnosis', message, task.window_end_ns)

    def _note(self, entry: engine.JournalEntry) -> bool:
        """Update the curve's status from a journal entry; return True if it has changed."""
        if entry.kind == JournalKind.FIT_REFUSED:
            self.status = CurveStatus.STALE if self.curve else CurveStatus.REFUSED
        elif entry.kind == JournalKind.RESET and self.curve:
            self.status = CurveStatus.STALE
        else:
            return False
        self.cause = entry.text
        return True

    def _curve_messages(self, time_ns: int = 0) -> Iterator[Output]:
        curve = self.curve
        message = encoding.curve_message(
            curve, self.status, self.cause, self._tag, self.reference_id, self.shift
        )
        if curve is None:
            message.header.stamp = encoding.to_time(time_ns)
        else:
            time_ns = curve.source.window_end_ns
        yield self._output('characteristic', message, time_ns)
        knots = [] if curve is None else curve.breakpoints
        slopes = [] if curve is None else [p.slope for p in curve.pieces]
        what, unit, rise = 'integrated input u', '% MPa^e', 'MW / (% MPa^e)'
        if curve is not None and curve.axis == OPENING:
            what, unit, rise = 'valve opening', '%', 'MW / (% MPa^s)'
        for name, values, label in (
            ('breakpoints', knots, f'{what} at the ends of the pieces [{unit}]'),
            ('slopes', slopes, in_unit(f'slope of each piece [{rise}]', self._unit)),
        ):
            yield self._output(name, encoding.array_message(values, label), time_ns)

    def _output(self, name: str, message: Any, time_ns: int) -> Output:
        encoding.tell_in(message, self._unit, self._zone)
        return Output(name, encoding.encode(message), max(0, time_ns))
