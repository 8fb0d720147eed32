"""The engine's records as messages, and the journal's messages as records."""

from __future__ import annotations

import math
from collections.abc import Sequence

from builtin_interfaces.msg import Time
from std_msgs.msg import Float64MultiArray, Header, MultiArrayDimension
from valveflow_msgs.msg import Alarm, FlowCharacteristic
from valveflow_msgs.msg import JournalEntry as JournalMessage
from valveflow_msgs.msg import SpecialSegment as SegmentMessage

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.shift import Shift
from valveflow_ros.monitoring.alarms import AlarmChange
from valveflow_ros.monitoring.curve_status import CurveStatus
from valveflow_ros.monitoring.events import JournalEntry, JournalKind
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
