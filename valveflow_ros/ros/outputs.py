"""What the monitor says, as bytes: a pure function of the engine's events.

The node publishes and records what comes out of here, and a verification
compares it with what comes out when a recording is fed again.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
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
from valveflow_ros.monitoring.alarm import BURIED
from valveflow_ros.monitoring.alarms import AlarmChange, AlarmState
from valveflow_ros.monitoring.curves import CurveStatus
from valveflow_ros.monitoring.events import JournalKind
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.prediction import PredictionBlock
from valveflow_ros.records import NS_PER_S
from valveflow_ros.ros import conversions
from valveflow_ros.ros.conversions import LAST_NS, encode

# Predictions as bytes, made without a message object.
#
# There is one for every sample, and with a plant running thousands of times
# faster than real time a message object a row would be the monitor's largest
# cost. What comes out equals `encoding.encode` of the message; a test holds the
# two, and the order of the fields in Prediction.msg, together.


_HEAD = b'\x00\x01\x00\x00'  # plain CDR, little endian


@functools.lru_cache(maxsize=16)
def _layout(tag_bytes: int, model_bytes: int) -> struct.Struct:
    """Return the layout of a row's message for texts of these lengths, zero bytes included."""
    size = 12 + tag_bytes + 1
    before_model = -size % 4
    size += before_model + 4 + model_bytes
    before_numbers = -size % 8
    return struct.Struct(f'<4siII{tag_bytes}sB{before_model}xI{model_bytes}s{before_numbers}x10d')


def prediction_bytes(block: PredictionBlock, tag: str) -> Iterator[tuple[int, bytes]]:
    """Yield the message of each row with the row's time in ns."""
    frame, model = tag.encode() + b'\x00', block.model_id.encode() + b'\x00'
    pack = _layout(len(frame), len(model)).pack
    expected = block.measured_mw - block.residual_mw
    columns = (
        block.time_ns, block.state, block.u, block.measured_mw, block.static_mw,
        block.dynamic_mw, block.residual_mw, block.average_mw, expected - block.width_mw,
        expected + block.width_mw, block.evidence, block.shift_mw,
    )  # fmt: skip
    for row in zip(*(column.tolist() for column in columns), strict=True):
        time_ns, state, *numbers = row
        sec, nanosec = divmod(min(max(time_ns, 0), LAST_NS), NS_PER_S)
        yield (
            time_ns,
            pack(
                _HEAD,
                sec,
                nanosec,
                len(frame),
                frame,
                state,
                len(model),
                model,
                *numbers,
            ),
        )


NO_CURVE_YET = 'No curve yet: not enough special segments.'


@dataclass(frozen=True, slots=True)
class OutputTopic:
    """A topic under the node's name."""

    message_type: type
    type_name: str
    latched: bool
    kept: int = 1  # messages that who comes late is given, if latched


# Of two alarms that stand, one that comes and goes must not take the place of the other, which
# is told again with the row after so many announcements; one or two may come before that row.
_ALARMS_KEPT = BURIED + 2
OUTPUTS: Mapping[str, OutputTopic] = {
    'characteristic': OutputTopic(
        FlowCharacteristic, 'valveflow_msgs/msg/FlowCharacteristic', True
    ),
    'breakpoints': OutputTopic(Float64MultiArray, 'std_msgs/msg/Float64MultiArray', True),
    'slopes': OutputTopic(Float64MultiArray, 'std_msgs/msg/Float64MultiArray', True),
    'prediction': OutputTopic(Prediction, 'valveflow_msgs/msg/Prediction', False),
    'segments': OutputTopic(SpecialSegment, 'valveflow_msgs/msg/SpecialSegment', False),
    'alarms': OutputTopic(Alarm, 'valveflow_msgs/msg/Alarm', True, _ALARMS_KEPT),
    'diagnosis': OutputTopic(Diagnosis, 'valveflow_msgs/msg/Diagnosis', True),
    'journal': OutputTopic(JournalEntry, 'valveflow_msgs/msg/JournalEntry', False),
}


class Output(NamedTuple):
    """A message to be sent: the topic's name in `OUTPUTS`, its bytes, the time it speaks of."""

    name: str
    data: bytes
    time_ns: int


class Outputs:
    """Turns events into messages, one after the other.

    Parameters
    ----------
    tag : str
        The unit's tag, the frame_id of every message.

    Notes
    -----
    The status of the curve is followed here by the events alone, so that the
    messages depend on nothing but their order.
    """

    def __init__(self, tag: str) -> None:
        self._tag = tag
        self.curve: Characteristic | None = None
        self.status = CurveStatus.UNKNOWN
        self.cause = NO_CURVE_YET
        self.reference_id = ''
        self.shift: Shift | None = None
        self._diagnosed: engine.Diagnosed | None = None
        self._alarms: dict[str, AlarmChange] = {}

    def first(self) -> Iterator[Output]:
        """Return what stands there before anything has happened."""
        return self.latched()

    def of(self, events: Sequence[engine.Event]) -> Iterator[Output]:
        """Yield the messages of the events of one call of the engine.

        A block of predictions and the changes of the alarm among its rows are
        put in the order of their rows, so that the cutting into blocks leaves no trace.
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
        left = iter(changes)
        change = next(left, None)
        for time_ns, data in prediction_bytes(block, self._tag):
            yield Output('prediction', data, max(0, time_ns))
            while change is not None and change.time_ns <= time_ns:
                yield from self._single(change)
                change = next(left, None)

    def _single(self, event: engine.Event) -> Iterator[Output]:
        tag = self._tag
        if isinstance(event, engine.SegmentClosed):
            message = conversions.segment(event.segment, tag)
            yield _output('segments', message, event.segment.end_ns)
        elif isinstance(event, AlarmChange):
            self._alarms[event.name] = event
            yield _output('alarms', conversions.alarm(event, tag), event.time_ns)
        elif isinstance(event, engine.CurveAdopted):
            self.curve, self.status, self.cause = event.characteristic, CurveStatus.FRESH, ''
            self.shift = event.shift
            yield from self._curve_messages()
        elif isinstance(event, engine.ReferenceSet):
            self.reference_id, self.shift = event.characteristic.model_id, None
            yield from self._curve_messages()
        elif isinstance(event, engine.Diagnosed):
            self._diagnosed = event
            yield self._diagnosis(event)
        elif isinstance(event, engine.JournalEntry):
            yield _output('journal', conversions.journal(event, tag), event.time_ns)
            if event.kind == JournalKind.RESUMED:
                # Who listens to a process that was started again finds everything there.
                self.shift = None
                yield from self.latched()
                yield from self._standing()
            elif self._note(event):
                yield from self._curve_messages()

    def take_up(self, monitor: Monitor) -> None:
        """Go on with what a monitor knows that was taken up where it was left."""
        reference = monitor.reference.curve
        self.curve, self.status, self.cause = monitor.characteristic, monitor.status, monitor.cause
        self.reference_id = '' if reference is None else reference.model_id
        self.shift, self._diagnosed = None, monitor.diagnosing.last
        told = (monitor.alarm.last, monitor.reference.alarm.last)
        self._alarms = {change.name: change for change in told if change is not None}

    def latched(self) -> Iterator[Output]:
        """Yield the messages that stand on the latched topics."""
        yield from self._curve_messages()
        if self._diagnosed is None:
            message = conversions.unknown(conversions.NOT_YET, self._tag)
            yield _output('diagnosis', message, 0)
        else:
            yield self._diagnosis(self._diagnosed)

    def _standing(self) -> Iterator[Output]:
        """Yield what was said last of the alarms that stand; nothing in it is new."""
        told = sorted(self._alarms.values(), key=lambda change: (change.time_ns, change.name))
        for change in told:
            if change.state != AlarmState.NORMAL:
                yield _output('alarms', conversions.alarm(change, self._tag), change.time_ns)

    def _diagnosis(self, event: engine.Diagnosed) -> Output:
        message = conversions.of(event, self._tag)
        return _output('diagnosis', message, event.task.window_end_ns)

    def _note(self, entry: engine.JournalEntry) -> bool:
        """Take what an entry says about the curve; tell whether it says anything."""
        if entry.kind == JournalKind.FIT_REFUSED:
            self.status = CurveStatus.STALE if self.curve else CurveStatus.REFUSED
        elif entry.kind == JournalKind.RESET and self.curve:
            self.status = CurveStatus.STALE
        else:
            return False
        self.cause = entry.text
        return True

    def _curve_messages(self) -> Iterator[Output]:
        curve = self.curve
        time_ns = 0 if curve is None else curve.source.window_end_ns
        message = conversions.characteristic(
            curve, self.status, self.cause, self._tag, self.reference_id, self.shift
        )
        yield _output('characteristic', message, time_ns)
        knots = [] if curve is None else curve.breakpoints
        slopes = [] if curve is None else [p.slope for p in curve.pieces]
        unit = '% MPa^e'
        for name, values, label in (
            ('breakpoints', knots, f'integrated input u at the ends of the pieces [{unit}]'),
            ('slopes', slopes, f'slope of each piece [MW / ({unit})]'),
        ):
            yield _output(name, conversions.plain_array(values, label), time_ns)


def _output(name: str, message: Any, time_ns: int) -> Output:
    return Output(name, encode(message), max(0, time_ns))


# Small messages as the bytes that go over the wire, made without a message object.


_LITTLE_ENDIAN = b'\x00\x01\x00\x00'
_FLOAT64 = struct.Struct('<d')
_TIME = struct.Struct('<iI')
_LAST_S = (1 << 31) - 1


def float64_bytes(value: float) -> bytes:
    """Return a std_msgs/Float64."""
    return _LITTLE_ENDIAN + _FLOAT64.pack(value)


def clock_bytes(time_ns: int) -> bytes:
    """Return a rosgraph_msgs/Clock; times before 1970 or after 2038 become the nearest one."""
    seconds, nanoseconds = divmod(max(time_ns, 0), NS_PER_S)
    return _LITTLE_ENDIAN + _TIME.pack(min(seconds, _LAST_S), nanoseconds)
