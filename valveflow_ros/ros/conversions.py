"""The engine's records as messages, and the journal's messages as records."""

from __future__ import annotations

import functools
import json
import math
import struct
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from builtin_interfaces.msg import Time
from std_msgs.msg import Float64MultiArray, Header, MultiArrayDimension
from valveflow_msgs.msg import Alarm, Diagnosis, DiagnosisCause, FlowCharacteristic
from valveflow_msgs.msg import JournalEntry as JournalMessage
from valveflow_msgs.msg import SpecialSegment as SegmentMessage

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.shift import Shift
from valveflow_ros.monitoring.alarms import AlarmChange
from valveflow_ros.monitoring.curves import CurveStatus
from valveflow_ros.monitoring.events import Diagnosed, DiagnosisTask, JournalEntry, JournalKind
from valveflow_ros.records import NS_PER_S, FloatArray, SpecialSegment

# The latest time whose seconds a stamp can hold.
LAST_NS = (1 << 31) * NS_PER_S - 1


def to_time(time_ns: int) -> Time:
    """Return a stamp; times before 1970 or after 2038 become the nearest one there is."""
    sec, nanosec = divmod(min(max(time_ns, 0), LAST_NS), NS_PER_S)
    return Time(sec=sec, nanosec=nanosec)


def from_time(stamp: Time) -> int:
    """Return a stamp in ns since the epoch."""
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def header(time_ns: int, tag: str) -> Header:
    """Return the head of a message."""
    return Header(stamp=to_time(time_ns), frame_id=tag)


def segment(found: SpecialSegment, tag: str) -> SegmentMessage:
    """Return a special segment as a message."""
    return SegmentMessage(
        header=header(found.end_ns, tag),
        number=found.number,
        kind=int(found.kind),
        start=to_time(found.start_ns),
        end=to_time(found.end_ns),
        samples=found.samples,
        u_start=found.u_start,
        u_end=found.u_end,
        u_rate_per_s=found.u_rate_per_s,
        power_start_mw=found.power_start_mw,
        power_end_mw=found.power_end_mw,
        u_rms=found.u_rms,
        power_rms_mw=found.power_rms_mw,
        temperature_mean_degc=found.temperature_mean_degc,
    )


def alarm(change: AlarmChange, tag: str) -> Alarm:
    """Return a change of an alarm's state as a message."""
    return Alarm(
        header=header(change.time_ns, tag),
        name=change.name,
        state=int(change.state),
        previous_state=int(change.previous),
        priority=int(change.priority),
        value=change.value,
        limit=change.limit,
        unit=change.unit,
        sentence=change.sentence,
        occurrence=change.occurrence,
        raised=to_time(change.raised_ns),
        model_id=change.model_id,
        first_out=change.first_out,
    )


def journal(entry: JournalEntry, tag: str) -> JournalMessage:
    """Return a line of the journal as a message; `journal_entry` is the way back."""
    return JournalMessage(
        header=header(entry.time_ns, tag),
        kind=int(entry.kind),
        request=to_time(entry.request_ns),
        samples=entry.rows,
        model_id=entry.model_id,
        text=entry.text,
    )


def journal_entry(message: JournalMessage) -> JournalEntry:
    """Return a journal message as the engine's record."""
    return JournalEntry(
        time_ns=from_time(message.header.stamp),
        kind=JournalKind(message.kind),
        request_ns=from_time(message.request),
        rows=int(message.samples),
        model_id=message.model_id,
        text=message.text,
    )


def characteristic(
    curve: Characteristic | None,
    status: CurveStatus,
    cause: str,
    tag: str,
    reference_id: str = '',
    shift: Shift | None = None,
) -> FlowCharacteristic:
    """Return the running curve and what it is worth; without a curve, say why there is none."""
    nan = math.nan
    message = FlowCharacteristic(
        header=header(0, tag),
        status=int(status),
        cause=cause,
        pressure_exponent=nan,
        rmse_mw=nan,
        temperature_mean_degc=nan,
        temperature_spread_degc=nan,
        reference_model_id=reference_id,
    )
    if curve is None:
        return message
    source = curve.source
    message.header = header(source.window_end_ns, tag)
    message.model_id = curve.model_id
    message.window_start = to_time(source.window_start_ns)
    message.window_end = to_time(source.window_end_ns)
    message.breakpoints = curve.breakpoints.tolist()
    message.values = curve.values().tolist()
    message.pieces = len(curve.pieces)
    message.slopes = [p.slope for p in curve.pieces]
    message.intercepts = [p.intercept for p in curve.pieces]
    message.slope_stderr = [p.slope_stderr for p in curve.pieces]
    message.intercept_stderr = [p.intercept_stderr for p in curve.pieces]
    message.breakpoint_low = [low for low, _ in curve.breakpoint_intervals]
    message.breakpoint_high = [high for _, high in curve.breakpoint_intervals]
    message.region_power_from = [d.power_from for d in curve.dynamics]
    message.region_power_to = [d.power_to for d in curve.dynamics]
    message.time_constants = [d.time_constant_s for d in curve.dynamics]
    message.delays = [d.delay_s for d in curve.dynamics]
    message.time_constant_stderr = [d.time_constant_stderr_s for d in curve.dynamics]
    message.delay_stderr = [d.delay_stderr_s for d in curve.dynamics]
    message.power_to_stderr = [d.power_to_stderr_mw for d in curve.dynamics]
    message.cost, message.turning_angle = _selection(curve)
    likely = curve.choice.confidence
    message.confidence = [likely.get(j, 0.0) for j in range(1, max(likely, default=0) + 1)]
    message.pressure_exponent = curve.pressure_exponent
    message.samples = source.samples
    message.steady_segments = source.steady
    message.slope_segments = source.slope_response
    message.rmse_mw = curve.residuals.rmse_mw
    message.temperature_mean_degc = source.temperature_mean_degc
    message.temperature_spread_degc = source.temperature_spread_k
    message.temperature_flag = source.temperature_flag
    _put_shift(message, shift)
    return message


def _put_shift(message: FlowCharacteristic, shift: Shift | None) -> None:
    """Put the judgement against the reference into a message that has its curve."""
    if not message.reference_model_id:
        return
    if shift is None:
        # The reference itself has not moved; any other curve has not been judged.
        same = message.model_id == message.reference_model_id
        message.shift_mw = [0.0 if same else math.nan] * message.pieces
        message.shift_confidence = list(message.shift_mw)
        return
    message.shift_sentence = shift.sentence
    message.shift_mw = [p.shift_mw for p in shift.pieces]
    message.shift_confidence = [p.confidence for p in shift.pieces]
    message.shift_since = to_time(shift.since_ns)
    message.shift_since_low = to_time(shift.since_low_ns)
    message.shift_since_high = to_time(shift.since_high_ns)


def _selection(curve: Characteristic) -> tuple[list[float], list[float]]:
    """Return Omega(J) and Lambda(J) for J = 1, 2, ...; NaN where there is none."""
    most = max(curve.choice.cost, default=0)
    span = range(1, most + 1)
    cost = [curve.choice.cost.get(j, math.nan) for j in span]
    return cost, [curve.choice.turning_angle.get(j, math.nan) for j in span]


def plain_array(values: FloatArray | Sequence[float], label: str) -> Float64MultiArray:
    """Return numbers for clients without our messages; the label says what they are."""
    numbers = [float(value) for value in values]
    message = Float64MultiArray(data=numbers)
    message.layout.dim = [MultiArrayDimension(label=label, size=len(numbers), stride=len(numbers))]
    return message


# Messages as CDR bytes that depend on nothing but their fields.
#
# The middleware's own serialiser leaves whatever was in memory between fields
# that need alignment, so two equal messages may differ in their bytes. What is
# recorded here is to be compared byte for byte, and is to carry nothing of the
# process's memory; so the bytes between fields are zero.


_HEAD = b'\x00\x01\x00\x00'  # plain CDR, little endian
_LENGTH = struct.Struct('<I')
_CODES = {
    'boolean': '?', 'int8': 'b', 'uint8': 'B', 'int16': 'h', 'uint16': 'H', 'int32': 'i',
    'uint32': 'I', 'int64': 'q', 'uint64': 'Q', 'float': 'f', 'double': 'd',
}  # fmt: skip

_Writer = Callable[[bytearray, Any], None]


def encode(message: Any) -> bytes:
    """Return a message as it goes over the wire.

    Raises
    ------
    TypeError
        A field is of a kind that none of our messages has.
    """
    out = bytearray()
    _write_message(out, message)
    return _HEAD + out


def _write_message(out: bytearray, message: Any) -> None:
    for name, write in _plan(type(message)):
        write(out, getattr(message, name))


@functools.cache
def _plan(kind: type) -> tuple[tuple[str, _Writer], ...]:
    fields: dict[str, str] = kind.get_fields_and_field_types()  # type: ignore[attr-defined]
    return tuple((name, _writer(text)) for name, text in fields.items())


def _writer(text: str) -> _Writer:
    if text.startswith('sequence<') and ',' not in text:
        return _sequence_writer(text[len('sequence<') : -1])
    if text == 'string':
        return _write_string
    if text == 'octet':
        return _write_octet
    if text in _CODES:
        return _number_writer(_CODES[text])
    if '/' in text and '[' not in text and '<' not in text:
        return _write_message
    raise TypeError(f"fields of type '{text}' are not supported")


def _number_writer(code: str) -> _Writer:
    layout = struct.Struct(f'<{code}')
    size = layout.size

    def write(out: bytearray, value: Any) -> None:
        out += bytes(-len(out) % size)
        out += layout.pack(value)

    return write


def _sequence_writer(element: str) -> _Writer:
    write = _writer(element)
    code = _CODES.get(element)

    def one_by_one(out: bytearray, values: Any) -> None:
        out += bytes(-len(out) % 4)
        out += _LENGTH.pack(len(values))
        for value in values:
            write(out, value)

    def at_once(out: bytearray, values: Any) -> None:
        out += bytes(-len(out) % 4)
        out += _LENGTH.pack(len(values))
        if len(values):
            out += bytes(-len(out) % struct.calcsize(f'<{code}'))
            out += struct.pack(f'<{len(values)}{code}', *values)

    return one_by_one if code is None else at_once


def _write_string(out: bytearray, value: Any) -> None:
    data = value.encode()
    out += bytes(-len(out) % 4)
    out += _LENGTH.pack(len(data) + 1)
    out += data
    out.append(0)


def _write_octet(out: bytearray, value: Any) -> None:
    out += value


# A diagnosis as a message.


NOT_YET = 'Not diagnosed yet: a diagnosis needs a curve and a day of data.'
VERDICTS = {
    'nothing': Diagnosis.NOTHING,
    'named': Diagnosis.NAMED,
    'unexplained': Diagnosis.UNEXPLAINED,
}


def unknown(sentence: str, tag: str, task: DiagnosisTask | None = None) -> Diagnosis:
    """Return the message that says why there is no result."""
    nan = math.nan
    return Diagnosis(
        header=header(0 if task is None else task.window_end_ns, tag),
        model_id='' if task is None else task.curve.model_id,
        verdict=Diagnosis.UNKNOWN,
        sentence=sentence,
        disturbance_rms_mw=nan,
        disturbance_time_scale_s=nan,
        rmse_simulation=nan,
        rmse_extended=nan,
        rmse_noise_floor=nan,
    )


def of(event: Diagnosed, tag: str) -> Diagnosis:
    """Return what a diagnosis gave as a message."""
    if not event.content:
        return unknown(event.reason, tag, event.task)
    return diagnosis(json.loads(event.content), event.task, tag)


def diagnosis(content: Mapping[str, Any], task: DiagnosisTask, tag: str) -> Diagnosis:
    """Return what `diagnosis.json` would hold as a message.

    Raises
    ------
    KeyError, TypeError, ValueError, AssertionError
        It is not whole.
    """
    message = unknown(str(content['sentence']), tag, task)
    message.verdict = VERDICTS[content['verdict']]
    message.causes = [_cause(cause) for cause in content['causes']]
    message.not_told_apart = [str(name) for name in content['not_told_apart']]
    message.unexplained_by = [str(name) for name in content['unexplained_by']]
    message.rejected_names = [str(put_away['name']) for put_away in content['rejected']]
    message.rejected_reasons = [str(put_away['reason']) for put_away in content['rejected']]
    disturbance = content['disturbance']
    if disturbance is not None:
        message.disturbance_rms_mw = _number(disturbance['rms_mw'])
        message.disturbance_time_scale_s = _number(disturbance['time_scale_s'])
    message.rmse_simulation = _number(content['rmse_simulation'])
    message.rmse_extended = _number(content['rmse_extended'])
    message.rmse_noise_floor = _number(content['rmse_noise_floor'])
    return message


def _cause(cause: Mapping[str, Any]) -> DiagnosisCause:
    parameters, gain = cause['parameters'], cause['gain']
    return DiagnosisCause(
        name=str(cause['name']),
        sentence=str(cause['sentence']),
        parameter_names=[str(name) for name in parameters],
        parameter_values=[_number(p['value']) for p in parameters.values()],
        parameter_lows=[_number(p['low']) for p in parameters.values()],
        parameter_highs=[_number(p['high']) for p in parameters.values()],
        parameter_units=[str(p['unit']) for p in parameters.values()],
        rmse_before_mw=_number(gain['rmse_before']),
        rmse_after_mw=_number(gain['rmse_after']),
        reduction=_number(gain['reduction']),
        p_value=_number(gain['p_value']),
    )


def _number(value: float | None) -> float:
    """JSON's null is a number that is not known."""
    return math.nan if value is None else float(value)
