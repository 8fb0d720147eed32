# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Converts the engine's records to messages, and messages to bytes that depend only on the fields.

The middleware's serialiser leaves old memory content in the padding between fields, so the bytes
of two equal messages may differ. Recorded messages are compared byte for byte and must not
contain memory of the process, so the padding written here is zero.
"""

from __future__ import annotations

import functools
import math
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import tzinfo
from typing import Any

from builtin_interfaces.msg import Time
from std_msgs.msg import Float64MultiArray, Header, MultiArrayDimension
from valveflow_msgs.msg import (
    Alarm,
    Diagnosis,
    DiagnosisCause,
    FlowCharacteristic,
    JournalEntry,
    SpecialSegment,
)

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.shift import Shift
from valveflow_ros.monitoring import events as engine
from valveflow_ros.monitoring.alarms import AlarmChange
from valveflow_ros.monitoring.curves import CurveStatus
from valveflow_ros.monitoring.prediction import PredictionBlock
from valveflow_ros.records import NS_PER_S, FloatArray
from valveflow_ros.records import SpecialSegment as SegmentRecord
from valveflow_ros.report.words import in_zone
from valveflow_ros.signals.units import in_unit

# The latest time that fits into a stamp.
LAST_NS = (1 << 31) * NS_PER_S - 1
NOT_YET = 'Not diagnosed yet: a diagnosis needs a curve and a day of data.'
VERDICTS = {
    'nothing': Diagnosis.NOTHING,
    'named': Diagnosis.NAMED,
    'unexplained': Diagnosis.UNEXPLAINED,
}

# Records as messages


def to_time(time_ns: int) -> Time:
    """Return a stamp; times before 1970 or after 2038 are clipped to the nearest valid one."""
    sec, nanosec = _seconds(time_ns)
    return Time(sec=sec, nanosec=nanosec)


def header(time_ns: int, tag: str) -> Header:
    """Return the header of a message."""
    return Header(stamp=to_time(time_ns), frame_id=tag)


def _message(of: Any, record: object, **different: Any) -> Any:
    """Return a message with the equally named fields of a record, and the fields given here."""
    same = {n: getattr(record, n) for n in of.get_fields_and_field_types() if n not in different}
    return of(**same, **different)


def segment_message(found: SegmentRecord, tag: str) -> SpecialSegment:
    """Return a special segment as a message."""
    return _message(
        SpecialSegment, found, header=header(found.end_ns, tag), kind=int(found.kind),
        start=to_time(found.start_ns), end=to_time(found.end_ns),
    )  # fmt: skip


def alarm_message(change: AlarmChange, tag: str) -> Alarm:
    """Return a change of an alarm's state as a message."""
    return _message(
        Alarm, change, header=header(change.time_ns, tag), state=int(change.state),
        previous_state=int(change.previous), priority=int(change.priority),
        raised=to_time(change.raised_ns),
    )  # fmt: skip


def journal_message(entry: engine.JournalEntry, tag: str) -> JournalEntry:
    """Return a line of the journal as a message; the inverse is `decoding.journal_entry`."""
    return _message(
        JournalEntry, entry, header=header(entry.time_ns, tag), kind=int(entry.kind),
        request=to_time(entry.request_ns), samples=entry.rows,
    )  # fmt: skip


# Arrays of a curve's message: field, records of the curve, their field.
_COLUMNS = (
    ('slopes', 'pieces', 'slope'), ('intercepts', 'pieces', 'intercept'),
    ('slope_stderr', 'pieces', 'slope_stderr'), ('intercept_stderr', 'pieces', 'intercept_stderr'),
    ('region_power_from', 'dynamics', 'power_from'), ('region_power_to', 'dynamics', 'power_to'),
    ('time_constants', 'dynamics', 'time_constant_s'), ('delays', 'dynamics', 'delay_s'),
    ('time_constant_stderr', 'dynamics', 'time_constant_stderr_s'),
    ('delay_stderr', 'dynamics', 'delay_stderr_s'),
    ('power_to_stderr', 'dynamics', 'power_to_stderr_mw'),
)  # fmt: skip


def curve_message(
    curve: Characteristic | None,
    status: CurveStatus,
    cause: str,
    tag: str,
    reference_id: str = '',
    shift: Shift | None = None,
) -> FlowCharacteristic:
    """Return the current curve with its status; without a curve, the reason why."""
    nan = math.nan
    message = FlowCharacteristic(
        header=header(0 if curve is None else curve.source.window_end_ns, tag),
        status=int(status), cause=cause, pressure_exponent=nan, rmse_mw=nan,
        pressure_scale_exponent=nan, offset_mw=nan, reference_pressure_mpa=nan,
        temperature_mean_degc=nan, temperature_spread_degc=nan, reference_model_id=reference_id,
    )  # fmt: skip
    if curve is None:
        return message
    source, choice = curve.source, curve.choice
    message.breakpoints, message.values = curve.breakpoints.tolist(), curve.values().tolist()
    message.breakpoint_low = [low for low, _ in curve.breakpoint_intervals]
    message.breakpoint_high = [high for _, high in curve.breakpoint_intervals]
    for name, records, of in _COLUMNS:
        setattr(message, name, [getattr(record, of) for record in getattr(curve, records)])
    # Omega(J), Lambda(J) and the confidence of J, for J = 1, 2, ...
    numbers = range(1, max(choice.cost, default=0) + 1)
    message.cost = [choice.cost.get(j, nan) for j in numbers]
    message.turning_angle = [choice.turning_angle.get(j, nan) for j in numbers]
    likely = choice.confidence
    message.confidence = [likely.get(j, 0.0) for j in range(1, max(likely, default=0) + 1)]
    message.window_start = to_time(source.window_start_ns)
    message.window_end = to_time(source.window_end_ns)
    for name in ('model_id', 'pressure_exponent', 'axis', 'pressure_scale_exponent', 'offset_mw'):
        setattr(message, name, getattr(curve, name))
    for name in ('samples', 'temperature_mean_degc', 'temperature_flag'):
        setattr(message, name, getattr(source, name))
    message.pieces = pieces = len(curve.pieces)
    message.reference_pressure_mpa = curve.shown_at_mpa
    message.steady_segments = source.steady
    message.slope_segments = source.slope_response
    message.rmse_mw = curve.residuals.rmse_mw
    message.temperature_spread_degc = source.temperature_spread_k
    if reference_id and shift is None:
        # The shift of the reference itself is 0; that of an uncompared curve is NaN.
        message.shift_mw = [0.0 if curve.model_id == reference_id else nan] * pieces
        message.shift_confidence = list(message.shift_mw)
    elif reference_id and shift is not None:
        message.shift_sentence = shift.sentence
        message.shift_mw = [p.shift_mw for p in shift.pieces]
        message.shift_confidence = [p.confidence for p in shift.pieces]
        message.shift_since = to_time(shift.since_ns)
        message.shift_since_low = to_time(shift.since_low_ns)
        message.shift_since_high = to_time(shift.since_high_ns)
    return message


def array_message(values: FloatArray | Sequence[float], label: str) -> Float64MultiArray:
    """Return numbers with a label that describes them, for clients without our messages."""
    numbers = [float(value) for value in values]
    message = Float64MultiArray(data=numbers)
    message.layout.dim = [MultiArrayDimension(label=label, size=len(numbers), stride=len(numbers))]
    return message


# Fields with text for people; names and ids are not changed.
_WORDS = (
    'sentence', 'meaning', 'text', 'cause', 'shift_sentence', 'unit', 'rejected_reasons',
    'parameter_units',
)  # fmt: skip


def tell_in(message: Any, unit: str, zone: tzinfo | None = None) -> None:
    """Convert the texts of a message to the output unit and the time zone."""
    if isinstance(message, JournalEntry):
        zone = None  # a replay parses this text
    for name in _WORDS if unit != 'MW' or zone is not None else ():
        said = getattr(message, name, None)
        if isinstance(said, str):
            setattr(message, name, in_zone(in_unit(said, unit), zone))
        elif said is not None:
            setattr(message, name, [in_zone(in_unit(one, unit), zone) for one in said])
    for cause in getattr(message, 'causes', ()):
        tell_in(cause, unit, zone)


def no_diagnosis_message(
    sentence: str, tag: str, task: engine.DiagnosisTask | None = None
) -> Diagnosis:
    """Return the message that says why there is no result."""
    nan = math.nan
    return Diagnosis(
        header=header(0 if task is None else task.window_end_ns, tag),
        model_id='' if task is None else task.curve.model_id,
        verdict=Diagnosis.UNKNOWN, sentence=sentence, disturbance_rms_mw=nan,
        disturbance_time_scale_s=nan, rmse_simulation=nan, rmse_extended=nan, rmse_noise_floor=nan,
    )  # fmt: skip


def diagnosis_message(
    content: Mapping[str, Any], task: engine.DiagnosisTask, tag: str
) -> Diagnosis:
    """Return the content of a `diagnosis.json` as a message.

    Raises `KeyError`, `TypeError`, `ValueError` or `AssertionError` if the content is
    incomplete or invalid.
    """
    message = no_diagnosis_message(str(content['sentence']), tag, task)
    message.verdict = VERDICTS[content['verdict']]
    message.causes = [_cause_message(cause) for cause in content['causes']]
    message.not_told_apart = [str(name) for name in content['not_told_apart']]
    message.unexplained_by = [str(name) for name in content['unexplained_by']]
    message.rejected_names = [str(rejected['name']) for rejected in content['rejected']]
    message.rejected_reasons = [str(rejected['reason']) for rejected in content['rejected']]
    disturbance = content['disturbance']
    if disturbance is not None:
        message.disturbance_rms_mw = _number(disturbance['rms_mw'])
        message.disturbance_time_scale_s = _number(disturbance['time_scale_s'])
    for name in ('rmse_simulation', 'rmse_extended', 'rmse_noise_floor'):
        setattr(message, name, _number(content[name]))
    return message


def _cause_message(cause: Mapping[str, Any]) -> DiagnosisCause:
    parameters, gain = cause['parameters'], cause['gain']
    columns = {
        f'parameter_{name}s': [_number(p[name]) for p in parameters.values()]
        for name in ('value', 'low', 'high')
    }
    return DiagnosisCause(
        **{name: str(cause[name]) for name in ('name', 'sentence')},
        **{name: str(cause.get(name, '')) for name in ('meaning', 'to_do')},
        **columns,
        parameter_names=[str(name) for name in parameters],
        parameter_units=[str(p['unit']) for p in parameters.values()],
        rmse_before_mw=_number(gain['rmse_before']),
        rmse_after_mw=_number(gain['rmse_after']),
        **{name: _number(gain[name]) for name in ('reduction', 'p_value')},
    )


def _number(value: float | None) -> float:
    """Return a number from JSON, with NaN for null."""
    return math.nan if value is None else float(value)


# Messages as bytes

_HEAD = b'\x00\x01\x00\x00'  # plain CDR, little endian
_FLOAT64, _TIME = struct.Struct('<d'), struct.Struct('<iI')
_CODES = {
    'boolean': '?', 'int8': 'b', 'uint8': 'B', 'int16': 'h', 'uint16': 'H', 'int32': 'i',
    'uint32': 'I', 'int64': 'q', 'uint64': 'Q', 'float': 'f', 'double': 'd',
}  # fmt: skip
_Writer = Callable[[bytearray, Any], None]


def encode(message: Any) -> bytes:
    """Return a message serialised as CDR.

    Raises `TypeError` if a field has a type that is not supported.
    """
    out = bytearray()
    _write_message(out, message)
    return _HEAD + out


def float64_bytes(value: float) -> bytes:
    """Return a serialised std_msgs/Float64."""
    return _HEAD + _FLOAT64.pack(value)


def clock_bytes(time_ns: int) -> bytes:
    """Return a serialised rosgraph_msgs/Clock; the time is clipped to 1970 to 2038."""
    return _HEAD + _TIME.pack(*_seconds(time_ns))


def _seconds(time_ns: int) -> tuple[int, int]:
    return divmod(min(max(time_ns, 0), LAST_NS), NS_PER_S)


def prediction_bytes(block: PredictionBlock, tag: str) -> Iterator[tuple[int, bytes]]:
    """Yield the time in ns and the serialised valveflow_msgs/Prediction of each row.

    Creating a message object for every sample would be the largest cost of the monitor. The bytes
    equal those of `encode`; a test compares both, and the order of the fields.
    """
    frame, model = tag.encode() + b'\x00', block.model_id.encode() + b'\x00'
    pack = _prediction_layout(len(frame), len(model)).pack
    expected = block.measured_mw - block.residual_mw
    columns = (
        block.time_ns, block.state, block.u, block.measured_mw, block.static_mw,
        block.dynamic_mw, block.residual_mw, block.average_mw, expected - block.width_mw,
        expected + block.width_mw, block.evidence, block.shift_mw,
    )  # fmt: skip
    for row in zip(*(column.tolist() for column in columns), strict=True):
        time_ns, state, *numbers = row
        stamp = _seconds(time_ns)
        yield (
            time_ns,
            pack(_HEAD, *stamp, len(frame), frame, state, len(model), model, *numbers),
        )


@functools.lru_cache(maxsize=16)
def _prediction_layout(tag_bytes: int, model_bytes: int) -> struct.Struct:
    """Return the layout for texts of these lengths in bytes, with the final zero bytes."""
    size = 12 + tag_bytes + 1
    before_model = -size % 4
    size += before_model + 4 + model_bytes
    before_numbers = -size % 8
    return struct.Struct(f'<4siII{tag_bytes}sB{before_model}xI{model_bytes}s{before_numbers}x10d')


def _write_message(out: bytearray, message: Any) -> None:
    for name, write in _writers(type(message)):
        write(out, getattr(message, name))


@functools.cache
def _writers(kind: type) -> tuple[tuple[str, _Writer], ...]:
    fields: dict[str, str] = kind.get_fields_and_field_types()  # type: ignore[attr-defined]
    return tuple((name, _writer(text)) for name, text in fields.items())


def _writer(text: str) -> _Writer:
    """Return the function that writes a field of this type."""
    if text.startswith('sequence<') and ',' not in text:
        return functools.partial(_write_sequence, text[len('sequence<') : -1])
    if text == 'string':
        return _write_string
    if text == 'octet':
        return bytearray.extend
    if text in _CODES:
        return _number_writer(_CODES[text])
    if '/' in text and '[' not in text and '<' not in text:
        return _write_message
    raise TypeError(f"fields of type '{text}' are not supported")


def _number_writer(code: str) -> _Writer:
    layout = struct.Struct(f'<{code}')
    size = layout.size

    def write(out: bytearray, value: Any) -> None:
        out += bytes(-len(out) % size) + layout.pack(value)

    return write


_write_length = _number_writer('I')


def _write_sequence(element: str, out: bytearray, values: Any) -> None:
    _write_length(out, len(values))
    if element in _CODES:
        if len(values):
            code = _CODES[element]
            out += bytes(-len(out) % struct.calcsize(f'<{code}'))
            out += struct.pack(f'<{len(values)}{code}', *values)
        return
    write = _writer(element)
    for value in values:
        write(out, value)


def _write_string(out: bytearray, value: Any) -> None:
    data = value.encode()
    _write_length(out, len(data) + 1)
    out += data + b'\x00'
