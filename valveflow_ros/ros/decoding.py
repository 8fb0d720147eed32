# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Converts messages to the engine's records: readings of inputs, lines of the journal."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from builtin_interfaces.msg import Time
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Float64
from valveflow_msgs.msg import JournalEntry as JournalMessage
from valveflow_msgs.msg import PlantSample

from valveflow_ros.logs.names import qualities
from valveflow_ros.monitoring.events import JournalEntry, JournalKind
from valveflow_ros.parameters import Settings
from valveflow_ros.records import N_SIGNALS, NS_PER_S, SIGNALS, Quality
from valveflow_ros.signals.covariates import entries_of, parts
from valveflow_ros.signals.units import Unit, unit_of

Row = tuple[int, int, float, int]
"""A reading as ``(time_ns, signal, value, quality)``, as `Readings.of` takes it."""

PLANT_SAMPLE = 'plant_sample'
_STAMP = {b'\x00\x01': struct.Struct('<iI'), b'\x00\x00': struct.Struct('>iI')}
_VALUE = {b'\x00\x01': struct.Struct('<d'), b'\x00\x00': struct.Struct('>d')}
_HEAD = 4  # bytes of encapsulation before the data, which give the encoding


def type_name(kind: type) -> str:
    """Return the name of a message type, such as std_msgs/msg/Float64."""
    return f'{kind.__module__.partition(".")[0]}/msg/{kind.__name__}'


@dataclass(frozen=True, slots=True)
class InputTopic:
    """A topic to which the monitor subscribes; ``topic`` is its name before remapping."""

    name: str
    message_type: type
    topic: str

    @property
    def type_name(self) -> str:
        """Return the name of the message type, as in a recording."""
        return type_name(self.message_type)


# The optional signal comes first, so that it is known when the required ones are complete.
_IN_ORDER = tuple(sorted(SIGNALS, key=lambda info: info.required))
INPUTS: tuple[InputTopic, ...] = (
    *(InputTopic(info.topic, Float64, info.topic) for info in _IN_ORDER),
    InputTopic(PLANT_SAMPLE, PlantSample, PLANT_SAMPLE),
)
INPUT_BY_NAME = {topic.name: topic for topic in INPUTS}
INPUT_ORDER = {topic.name: k for k, topic in enumerate(INPUTS)}


def inputs_of(settings: Settings) -> tuple[InputTopic, ...]:
    """Return all topics to which the monitor subscribes: those of covariates come first."""
    beside = map(parts, entries_of(settings))
    found = (InputTopic(f'covariate {name}', Float64, topic) for name, topic, _ in beside)
    return (*found, *INPUTS)


def header_time_ns(data: bytes) -> int:
    """Return the stamp of a message that begins with a header; 0 if it cannot be read."""
    layout = _STAMP.get(data[:2])
    if layout is None or len(data) < _HEAD + layout.size:
        return 0
    seconds, nanoseconds = layout.unpack_from(data, _HEAD)
    return int(seconds) * NS_PER_S + int(nanoseconds)


def from_time(stamp: Time) -> int:
    """Return a stamp in ns since the epoch."""
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def journal_entry(data: bytes) -> JournalEntry:
    """Return a line of the journal as the engine's record; raises `ValueError` if it is none."""
    try:
        message = deserialize_message(data, JournalMessage)
        return JournalEntry(
            time_ns=from_time(message.header.stamp),
            kind=JournalKind(message.kind),
            request_ns=from_time(message.request),
            rows=int(message.samples),
            model_id=message.model_id,
            text=message.text,
        )
    except Exception as error:
        # rclpy passes on many kinds of exceptions from the middleware.
        raise ValueError(str(error)) from error


class Decoder:
    """Converts the bytes of an input message to readings.

    The settings give the unit in which each plain topic is sent; ``definition`` is the ros2msg
    text of a recorded PlantSample, empty for the current one.
    """

    def __init__(self, settings: Settings, definition: str = '') -> None:
        self._read: dict[str, Callable[[bytes, int], list[Row]]] = {
            PLANT_SAMPLE: _sample_reader(qualities(definition).tolist())
        }
        for info in SIGNALS:
            unit = unit_of(info.signal, settings.text(f'{info.topic}_unit'))
            self._read[info.topic] = _float_reader(info.signal, unit)
        beside = (topic for topic in inputs_of(settings) if topic.name not in INPUT_BY_NAME)
        for number, topic in enumerate(beside, start=N_SIGNALS):
            self._read[topic.name] = _float_reader(number, Unit(1.0))

    def time_ns(self, name: str, data: bytes, otherwise_ns: int) -> int:
        """Return the stamp of a message with a header, otherwise ``otherwise_ns``."""
        return header_time_ns(data) if name == PLANT_SAMPLE else otherwise_ns

    def rows(self, name: str, data: bytes, time_ns: int) -> list[Row]:
        """Return the readings in a message; raises `ValueError` if it is not of its type."""
        return self._read[name](data, time_ns)

    def recorded(self, name: str, data: bytes, publish_time_ns: int) -> list[Row]:
        """Return the readings in a recorded message as in the live run."""
        time_ns = self.time_ns(name, data, publish_time_ns)
        # A restart may have other covariates than the recording.
        if time_ns <= 0 or name not in self._read:
            return []
        try:
            return self.rows(name, data, time_ns)
        except ValueError:
            return []


def _float_reader(signal: int, unit: Unit) -> Callable[[bytes, int], list[Row]]:
    scale, offset = unit.scale, unit.offset
    number, good = int(signal), int(Quality.GOOD)

    def read(data: bytes, time_ns: int) -> list[Row]:
        layout = _VALUE.get(data[:2])
        if layout is None or len(data) < _HEAD + layout.size:
            raise ValueError('no std_msgs/Float64')
        (value,) = layout.unpack_from(data, _HEAD)
        return [(time_ns, number, value * scale + offset, good)]

    return read


def _sample(data: bytes) -> PlantSample:
    try:
        return deserialize_message(data, PlantSample)
    except Exception as error:
        # rclpy passes on many kinds of exceptions from the middleware.
        raise ValueError('no valveflow_msgs/PlantSample') from error


def _sample_reader(quality: Sequence[int]) -> Callable[[bytes, int], list[Row]]:
    unset = None if quality[0] == Quality.GOOD else PlantSample.QUALITY_UNKNOWN

    def read(data: bytes, time_ns: int) -> list[Row]:
        sample = _sample(data)
        rows: list[Row] = []
        for info in _IN_ORDER:
            value = float(getattr(sample, info.topic))
            code = int(getattr(sample, f'{info.topic}_quality'))
            if info.required or (math.isfinite(value) and code != unset):
                rows.append((time_ns, int(info.signal), value, quality[code]))
        return rows

    return read


def sample_warnings(data: bytes, settings: Settings) -> list[str]:
    """Return what in a PlantSample does not agree with the parameters; raises `ValueError`."""
    sample, found = _sample(data), []
    for info in SIGNALS:
        name, code = f'{info.topic}_unit', getattr(sample, f'{info.topic}_quality')
        named = settings.text(name)
        sent = info.required or code != PlantSample.QUALITY_UNKNOWN
        if sent and unit_of(info.signal, named) != unit_of(info.signal, info.unit):
            found.append(
                f'{name} {named} does not apply to PlantSample, which is taken in {info.unit}.'
            )
    tag, frame_id = settings.text('unit_tag'), sample.header.frame_id
    # Left empty, it names no unit.
    if frame_id not in ('', tag):
        found.append(
            f"PlantSample has the frame_id '{frame_id}', but unit_tag is '{tag}'. Check that the "
            'samples are of this unit.'
        )
    return found


def with_todays_codes(data: bytes) -> bytes:
    """Convert a PlantSample with earlier quality codes (0 is good) to the current codes."""
    sample = _sample(data)
    for info in _IN_ORDER:
        name = f'{info.topic}_quality'
        setattr(sample, name, min(getattr(sample, name) + 1, PlantSample.QUALITY_BAD))
    return serialize_message(sample)
