# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
import math
import struct

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from rclpy.serialization import deserialize_message, serialize_message
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64, Float64MultiArray, MultiArrayDimension
from valveflow_msgs.msg import (
    Alarm,
    Diagnosis,
    DiagnosisCause,
    FlowCharacteristic,
    PlantSample,
    Prediction,
    SpecialSegment,
)
from valveflow_msgs.msg import JournalEntry as JournalMessage

from valveflow_ros.curve.shift import PieceShift, Shift
from valveflow_ros.logs.names import qualities
from valveflow_ros.monitoring.alarms import AlarmChange, AlarmState, Priority
from valveflow_ros.monitoring.curves import CurveStatus
from valveflow_ros.monitoring.events import JournalEntry, JournalKind
from valveflow_ros.monitoring.prediction import PredictionBlock, PredictionState
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S, Quality, SegmentKind, zone_of
from valveflow_ros.records import SpecialSegment as SegmentRecord
from valveflow_ros.ros import encoding
from valveflow_ros.ros.decoding import from_time, journal_entry, with_todays_codes
from valveflow_ros.ros.encoding import clock_bytes, encode, float64_bytes, prediction_bytes
from valveflow_ros.ros.node.engine import example_curve

times = st.integers(0, (1 << 31) * NS_PER_S - 1)
texts = st.text(st.characters(exclude_characters='\x00', exclude_categories=['Cs']), max_size=20)
reals = st.floats(allow_nan=True, allow_infinity=True)


def bits(value):
    return struct.pack('<d', value)


@given(times)
def test_times_survive_the_way_there_and_back(time_ns):
    assert from_time(encoding.to_time(time_ns)) == time_ns


def test_times_that_a_stamp_cannot_hold_become_the_nearest_one():
    for time_ns in (-1, -(10**18), 2**62, (1 << 31) * NS_PER_S):
        nearest = 0 if time_ns < 0 else (1 << 31) * NS_PER_S - 1
        assert from_time(encoding.to_time(time_ns)) == nearest


@given(times, st.sampled_from(JournalKind), times, st.integers(0, 2**63), texts, texts, texts)
def test_the_journal_survives_the_way_through_bytes(
    time_ns, kind, request_ns, rows, model, text, tag
):
    entry = JournalEntry(time_ns, kind, request_ns, rows, model, text)
    data = encode(encoding.journal_message(entry, tag))
    message = deserialize_message(data, JournalMessage)
    assert journal_entry(data) == entry
    assert message.header.frame_id == tag


def test_the_engine_and_the_messages_mean_the_same_by_a_number():
    for numbers, message in (
        (JournalKind, JournalMessage), (AlarmState, Alarm), (Priority, Alarm),
        (CurveStatus, FlowCharacteristic), (PredictionState, Prediction),
        (SegmentKind, SpecialSegment),
    ):  # fmt: skip
        for member in numbers:
            assert getattr(message, member.name) == member.value
    of_code = qualities()
    for quality in Quality:
        assert of_code[getattr(PlantSample, f'QUALITY_{quality.name}')] == quality
    assert of_code[PlantSample.QUALITY_UNKNOWN] == Quality.BAD
    assert set(of_code[4:]) == {Quality.BAD}


def test_a_sample_of_before_the_code_for_unknown_is_sent_with_the_codes_of_now():
    then = PlantSample(valve_opening=50.0, generated_power=200.0)
    then.generated_power_quality, then.valve_command_quality = 1, 2
    now = deserialize_message(with_todays_codes(encode(then)), PlantSample)
    assert (now.valve_opening, now.valve_opening_quality) == (50.0, PlantSample.QUALITY_GOOD)
    assert now.generated_power_quality == PlantSample.QUALITY_UNCERTAIN
    assert now.valve_command_quality == PlantSample.QUALITY_BAD
    with pytest.raises(ValueError, match='no valveflow_msgs/PlantSample'):
        with_todays_codes(b'none')


def test_every_field_of_a_segment_and_of_an_alarm_is_carried_over():
    segment = SegmentRecord(
        7, SegmentKind.SLOPE, 10**18 + 1, 10**18 + 5, 300, 1.5, 2.5, 0.25, 0.125, 100.0, 110.0,
        0.5, 538.25,
    )  # fmt: skip
    change = AlarmChange(
        10**18, 'residual', AlarmState.ACKNOWLEDGED, AlarmState.UNACKNOWLEDGED, Priority.HIGH,
        5.5, 4.5, 'MW', 'A sentence.', 3, 10**17, 'abc',
    )  # fmt: skip
    for record, message, others in (
        (segment, encoding.segment_message(segment, 'u'),
         {'header': 'end_ns', 'start': 'start_ns', 'end': 'end_ns'}),
        (change, encoding.alarm_message(change, 'u'),
         {'header': 'time_ns', 'raised': 'raised_ns', 'previous_state': 'previous'}),
    ):  # fmt: skip
        assert message.header.frame_id == 'u'
        for name in message.get_fields_and_field_types():
            found, expected = getattr(message, name), getattr(record, others.get(name, name))
            found = getattr(found, 'stamp', found)
            assert (from_time(found) if isinstance(found, Time) else found) == expected, name


def test_what_the_curve_says_of_its_reference():
    curve = example_curve(Settings()).with_id()
    ends = [(p.u_from, p.u_to) for p in curve.pieces]
    moved = tuple(
        PieceShift(*end, -5.0, -5.0, -5.0, 0.1, math.nan, math.nan, 200.0, 1e-6, True, 0.4)
        for end in ends
    )
    shift = Shift('then', 'now', 5, 4, moved, 6, 7, 8, 'It moved.')
    told = [
        encoding.curve_message(curve, CurveStatus.FRESH, '', 'u', *more)
        for more in ((), (curve.model_id,), ('another',), ('then', shift))
    ]
    assert [m.reference_model_id for m in told] == ['', curve.model_id, 'another', 'then']
    nan = pytest.approx([math.nan] * 2, nan_ok=True)
    assert [list(m.shift_mw) for m in told] == [[], [0.0, 0.0], nan, [-5.0, -5.0]]
    assert list(told[-1].shift_confidence) == [p.confidence for p in moved]
    assert told[-1].shift_sentence == 'It moved.'
    stamps = [getattr(told[-1], f'shift_since{x}') for x in ('', '_low', '_high')]
    since = [shift.since_ns, shift.since_low_ns, shift.since_high_ns]
    assert [from_time(stamp) for stamp in stamps] == since


def test_texts_are_told_in_unit_and_zone_but_names_stay():
    cause = DiagnosisCause(name='MW', sentence='5 MW', parameter_units=['MW', '%'])
    message = Diagnosis(sentence='since 2024-01-02 00:30 UTC', causes=[cause])
    encoding.tell_in(message, 't/h', zone_of('+05:00'))
    assert message.sentence == 'since 2024-01-02 05:30 UTC+05:00'
    assert (cause.name, cause.sentence) == ('MW', '5 t/h')
    assert list(cause.parameter_units) == ['t/h', '%']


def test_the_curve_is_drawn_by_arrays_that_fit_each_other():
    curve = example_curve(Settings()).with_id()
    message = encoding.curve_message(curve, CurveStatus.FRESH, '', 'u')
    j = len(curve.pieces)
    assert message.pieces == j
    assert list(message.breakpoints) == curve.breakpoints.tolist()
    assert list(message.values) == curve.values().tolist()
    for name in ('slopes', 'intercepts', 'slope_stderr', 'intercept_stderr'):
        assert list(getattr(message, name)) == [getattr(p, name.rstrip('s') if name in (
            'slopes', 'intercepts') else name) for p in curve.pieces]  # fmt: skip
    assert len(message.breakpoint_low) == len(message.breakpoint_high) == j - 1
    assert message.model_id == curve.model_id
    assert message.rmse_mw == curve.residuals.rmse_mw
    for u in (900.0, 1000.0, 1200.0, 1650.0):
        drawn = np.interp(u, message.breakpoints, message.values)
        assert drawn == pytest.approx(float(curve(np.array([u]))[0]))


def test_without_a_curve_the_message_says_why_and_gives_no_numbers():
    message = encoding.curve_message(None, CurveStatus.REFUSED, 'Too little.', 'u', 'another')
    assert (message.status, message.cause) == (FlowCharacteristic.REFUSED, 'Too little.')
    assert (message.reference_model_id, message.model_id) == ('another', '')
    assert not [*message.shift_mw, *message.breakpoints, *message.slopes]
    assert math.isnan(message.rmse_mw)
    assert math.isnan(message.pressure_exponent)


@given(times, st.integers(0, 255), texts, texts, st.lists(reals, min_size=8, max_size=8), reals)
def test_predictions_made_by_hand_are_what_the_encoder_makes(
    time_ns, state, model, tag, numbers, width
):
    columns = [np.array([x]) for x in numbers]
    kinds = np.array([state], dtype=np.uint8)
    block = PredictionBlock(np.array([time_ns]), *columns, kinds, width, model)
    ((found_ns, data),) = prediction_bytes(block, tag)
    message = deserialize_message(data, Prediction)
    assert found_ns == time_ns
    assert from_time(message.header.stamp) == time_ns
    assert (message.header.frame_id, message.model_id, message.state) == (tag, model, state)
    names = (
        'integrated_input', 'measured_mw', 'static_mw', 'dynamic_mw', 'residual_mw', 'average_mw',
        'alarm_evidence', 'shift_mw',
    )  # fmt: skip
    for name, value in zip(names, numbers, strict=True):
        assert bits(getattr(message, name)) == bits(value), name
    with np.errstate(all='ignore'):
        expected = columns[1] - columns[4]
        assert bits(message.limit_high_mw) == bits(float((expected + width)[0]))
        assert bits(message.limit_low_mw) == bits(float((expected - width)[0]))
    assert encode(message) == data


MESSAGES = [
    Alarm(name='residual', sentence='äöü', unit='MW', value=math.nan, occurrence=7),
    Clock(clock=encoding.to_time(5 * NS_PER_S + 7)),
    Diagnosis(
        causes=[DiagnosisCause(name='backlash', parameter_names=['a', 'bcd'],
                               parameter_values=[1.0, 2.0], parameter_units=['', '%'])],
        not_told_apart=['x'], verdict=2,
    ),
    DiagnosticArray(status=[
        DiagnosticStatus(level=b'\x02', name='n', message='m', hardware_id='h',
                         values=[KeyValue(key='k', value='v'), KeyValue(key='k2', value='')]),
        DiagnosticStatus(level=b'\x00'),
    ]),
    Float64(data=-0.0),
    Float64MultiArray(data=[1.0, 2.0]),
    encoding.array_message([1.0, 2.0, 3.0], 'label'),
    encoding.curve_message(example_curve(Settings()), CurveStatus.STALE, 'Why.', 'tag'),
    FlowCharacteristic(),
    JournalMessage(samples=2**63, text='t'),
    MultiArrayDimension(label='l', size=1, stride=2),
    PlantSample(valve_opening=1.5, valve_command_quality=2),
    Prediction(model_id='m', state=3),
    SpecialSegment(number=2**40, kind=1),
]  # fmt: skip


def test_our_encoding_is_read_by_the_middleware_as_its_own_is():
    for message in MESSAGES:
        kind = type(message)
        ours = deserialize_message(encode(message), kind)
        theirs = deserialize_message(serialize_message(message), kind)
        assert repr(ours) == repr(theirs) == repr(message)
        assert encode(ours) == encode(message)


def test_a_field_of_an_unknown_kind_is_refused():
    class Odd:
        @classmethod
        def get_fields_and_field_types(cls):
            return {'text': 'wstring'}

    with pytest.raises(TypeError, match='wstring'):
        encode(Odd())


@given(reals, times)
def test_the_short_ways_of_two_types_are_those_of_all(value, time_ns):
    assert float64_bytes(value) == encode(Float64(data=value))
    assert clock_bytes(time_ns) == encode(Clock(clock=encoding.to_time(time_ns)))


@given(arrays.arrays(np.float64, st.integers(0, 50)))
def test_plain_arrays_say_how_long_they_are(values):
    message = encoding.array_message(values, 'what')
    assert bits(0.0).join(map(bits, message.data)) == bits(0.0).join(map(bits, values.tolist()))
    (dimension,) = message.layout.dim
    assert (dimension.label, dimension.size, dimension.stride) == (
        'what', len(values), len(values),
    )  # fmt: skip
