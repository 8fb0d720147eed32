# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from valveflow_msgs.msg import PlantSample

from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S, SIGNALS, Quality, Signal
from valveflow_ros.ros.decoding import (
    INPUT_ORDER,
    PLANT_SAMPLE,
    Decoder,
    header_time_ns,
    sample_warnings,
)
from valveflow_ros.ros.encoding import clock_bytes, encode, float64_bytes, to_time
from valveflow_ros.ros.node.intake import (
    LONGEST_WAIT_S,
    MAX_WAITING,
    Arrival,
    ClockTrack,
    Intake,
    LogClock,
    TopicStatistics,
)
from valveflow_ros.ros.node.polled_subscription import DEPTH, RawMessage

T0 = 1_700_000_000 * NS_PER_S
NOW = T0 + NS_PER_S  # later than anything was received


class Queue:
    """A source that gives what was put in."""

    def __init__(self):
        self.waiting = []

    def put(self, data, sent, received=None, number=0):
        self.waiting.append(RawMessage(data, sent, sent if received is None else received, number))

    def take(self, most=DEPTH):
        taken, self.waiting = self.waiting[:most], self.waiting[most:]
        return taken


def intake_of(names, clock=None, **values
              ):  # fmt: skip
    settings = Settings(values)
    queues = {name: Queue() for name in names}
    made = Intake(queues, Decoder(settings), LogClock(), settings.text('stamp_source'), clock)
    return queues, made


def sample(time_ns, **values):
    message = PlantSample()
    message.header.stamp = to_time(time_ns)
    for info in SIGNALS:
        if info.required:
            setattr(message, f'{info.topic}_quality', PlantSample.QUALITY_GOOD)
    for name, value in values.items():
        setattr(message, name, value)
        setattr(message, f'{name}_quality', PlantSample.QUALITY_GOOD)
    return message


@given(st.lists(st.integers(-(10**12), 10**12), max_size=50))
def test_log_times_increase_strictly_and_are_never_before_the_receipt(offsets):
    clock, last = LogClock(), -1
    for offset in offsets:
        stamp = clock.stamp(T0 + offset)
        assert stamp > last
        assert stamp >= T0 + offset
        last = stamp


def test_the_time_of_a_plain_value():
    for source, sent, received, time_ns in (
        ('source', T0, T0 + 5, T0),
        ('source', 0, T0 + 5, T0 + 5),
        ('receive', T0, T0 + 5, T0 + 5),
        ('receive', T0, 0, NOW),
        ('source', 0, 0, NOW),
    ):
        queues, intake = intake_of(['valve_opening'], stamp_source=source)
        queues['valve_opening'].put(float64_bytes(50.0), sent, received)
        (arrival,) = intake.collect(0.0, NOW, last=True)
        assert arrival.time_ns == time_ns
        assert intake.rows([arrival]) == [(time_ns, Signal.VALVE_OPENING, 50.0, Quality.GOOD)]


def test_a_value_gets_the_clock_that_was_sent_before_it_however_late_that_is_taken():
    clock = Queue()
    queues, intake = intake_of(['valve_opening', 'generated_power'], clock)
    # Three instants are taken at once; two clock messages are still on their way.
    for k in range(3):
        queues['valve_opening'].put(float64_bytes(k), T0 + 10 * k + 1)
        queues['generated_power'].put(float64_bytes(k), T0 + 10 * k + 2)
    clock.put(clock_bytes(100 * NS_PER_S), T0)
    assert intake.collect(0.0, NOW) == []
    clock.put(clock_bytes(101 * NS_PER_S), T0 + 10)
    found = intake.collect(0.1, NOW)
    assert [(a.name, a.time_ns // NS_PER_S) for a in found] == [
        ('valve_opening', 100), ('generated_power', 100),
    ]  # fmt: skip
    clock.put(clock_bytes(102 * NS_PER_S), T0 + 20)
    found = intake.collect(0.11, NOW)
    # The last instant waits for the clock after it, but not for ever.
    assert intake.collect(0.19, NOW) == []
    found += intake.collect(0.21, NOW)
    assert [(a.name, a.time_ns // NS_PER_S) for a in found] == [
        ('valve_opening', 101), ('generated_power', 101),
        ('valve_opening', 102), ('generated_power', 102),
    ]  # fmt: skip


@given(
    st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 3)), max_size=200),
    st.lists(st.integers(1, 400), max_size=12),
    st.booleans(),
)
def test_however_the_looks_fall_the_order_is_that_of_receipt(sent, steps, with_clock):
    names = ['valve_command', 'valve_opening', 'generated_power', 'main_steam_pressure']
    queues, intake = intake_of(names, Queue() if with_clock else None)
    waiting = sorted((at * 10_000, which) for at, which in sent)
    now, order = 0, []
    for step in [*steps, 10**6]:
        # A look begins at `now`; what is received while it lasts is found by the later topics.
        now += step * 10_000
        for k, name in enumerate(names):
            visible = now + k * 20_000
            for at, which in [w for w in waiting if w[0] <= visible and w[1] == k]:
                queues[name].put(float64_bytes(1.0), T0 + at)
                waiting.remove((at, which))
        found = intake.collect(0.0, T0 + now + 200_000)
        order += [(a.log_ns, INPUT_ORDER[a.name]) for a in found]
    order += [(a.log_ns, INPUT_ORDER[a.name]) for a in intake.collect(0.0, NOW, last=True)]
    assert len(order) == len(sent)
    expected = sorted((T0 + at * 10_000, INPUT_ORDER[names[which]]) for at, which in sent)
    assert [topic for _, topic in order] == [topic for _, topic in expected]


def test_more_than_a_look_can_take_keeps_the_other_topics_waiting():
    queues, intake = intake_of(['valve_opening', 'generated_power'])
    for k in range(DEPTH + 50):
        for name in queues:
            queues[name].put(float64_bytes(k), T0 + 2 * k + INPUT_ORDER[name])
    del queues['generated_power'].waiting[: DEPTH // 2]
    found = intake.collect(0.0, NOW) + intake.collect(0.0, NOW)
    times = [a.time_ns for a in found]
    assert times == sorted(times)
    assert len(times) == 2 * DEPTH + 100 - DEPTH // 2


def test_a_clock_set_back_holds_nothing_for_long():
    queues, intake = intake_of(['valve_opening'])
    queues['valve_opening'].put(float64_bytes(1.0), T0 + 3600 * NS_PER_S)
    found = [len(intake.collect(0.02 * k, T0 + k)) for k in range(5)]
    assert found == [0, 0, 1, 0, 0]


def test_what_is_sent_before_the_first_clock_waits_for_it_and_stands_before_its_time():
    clock = Queue()
    queues, intake = intake_of(['valve_opening', 'generated_power', PLANT_SAMPLE], clock)
    for k in range(4):
        queues['valve_opening'].put(float64_bytes(k), T0 + k * NS_PER_S)
    queues[PLANT_SAMPLE].put(encode(sample(T0 + 7, valve_opening=50.0)), T0 + 1)
    # What has a time of its own does not wait for a clock.
    (own,) = intake.collect(0.0, NOW) + intake.collect(4.0, NOW)
    assert (own.name, own.time_ns) == (PLANT_SAMPLE, T0 + 7)
    assert intake.statistics['valve_opening'].waiting == 4
    shown = 90 * NS_PER_S
    queues['generated_power'].put(float64_bytes(5.0), T0 + 11 * NS_PER_S)
    clock.put(clock_bytes(shown), T0 + 10 * NS_PER_S)
    clock.put(clock_bytes(shown + 1), T0 + 12 * NS_PER_S)
    found = intake.collect(4.1, NOW + 20 * NS_PER_S)
    assert [a.data for a in found[:4]] == [float64_bytes(k) for k in range(4)]
    assert [a.time_ns for a in found] == [*(shown - (10 - k) * NS_PER_S for k in range(4)), shown]
    assert [a.log_ns for a in found] == sorted(a.log_ns for a in found)
    statistics = intake.statistics['valve_opening']
    assert (statistics.waiting, statistics.before_clock, statistics.without_time) == (0, 4, 0)
    assert len(intake.rows(found)) == 5


def test_not_too_many_wait_for_a_clock_that_never_comes():
    queues, intake = intake_of(['valve_opening'], Queue())
    found = []
    for k in range(MAX_WAITING + 2000):
        queues['valve_opening'].put(float64_bytes(k), T0 + k)
        if k % 500 == 499:
            found += intake.collect(1e-6 * k, NOW)
    found += intake.collect(1.0, NOW)
    assert intake.statistics['valve_opening'].waiting == MAX_WAITING
    found += intake.collect(2.0, NOW, last=True)
    assert [a.data for a in found] == [float64_bytes(k) for k in range(MAX_WAITING + 2000)]
    assert {a.time_ns for a in found} == {0}


def test_nothing_waits_long_for_a_clock_that_never_comes():
    queues, intake = intake_of(['valve_opening'], Queue())
    found = []
    for k in range(100):
        queues['valve_opening'].put(float64_bytes(k), T0 + k)
        found += intake.collect(float(k), NOW + k)
        assert len(found) >= k - LONGEST_WAIT_S - 1.0
    assert [a.data for a in found] == [float64_bytes(k) for k in range(len(found))]
    assert intake.rows(found) == []
    assert intake.statistics['valve_opening'].without_time == len(found)


def test_what_cannot_be_read_is_counted_and_not_fed():
    for name, data in (
        ('valve_opening', b''),
        ('valve_opening', b'\x00\x01\x00\x00\x01'),
        ('valve_opening', b'\x07\x07\x00\x00' + bytes(8)),
        (PLANT_SAMPLE, encode(sample(T0))[:40]),
    ):
        _, intake = intake_of([name])
        assert intake.rows([Arrival(name, data, T0, T0)]) == []
        assert intake.statistics[name].malformed == 1


def test_units_are_converted_at_the_door():
    units = {
        'valve_opening_unit': 'fraction', 'main_steam_pressure_unit': 'bar',
        'main_steam_temperature_unit': 'K', 'generated_power_unit': 'kW',
        'valve_command_unit': 'percent',
    }  # fmt: skip
    decoder = Decoder(Settings(units))
    sent = {
        'valve_opening': (0.5, 50.0), 'main_steam_pressure': (160.0, 16.0),
        'main_steam_temperature': (813.15, 540.0), 'generated_power': (3e5, 300.0),
        'valve_command': (50.0, 50.0),
    }  # fmt: skip
    for info in SIGNALS:
        value, expected = sent[info.topic]
        ((time_ns, signal, found, quality),) = decoder.rows(info.topic, float64_bytes(value), T0)
        assert (time_ns, signal, quality) == (T0, info.signal, Quality.GOOD)
        assert found == pytest.approx(expected, rel=1e-15)


def test_both_byte_orders_are_read():
    big = b'\x00\x00\x00\x00' + float64_bytes(1.5)[4:][::-1]
    assert Decoder(Settings()).rows('valve_opening', big, T0)[0][2] == 1.5
    assert header_time_ns(
        b'\x00\x00\x00\x00' + (7).to_bytes(4, 'big') + (9).to_bytes(4, 'big')
    ) == (7 * NS_PER_S + 9)


def test_a_sample_gives_a_reading_a_signal_the_optional_one_first():
    decoder = Decoder(Settings())
    message = sample(T0, valve_opening=50.0, generated_power=math.nan, valve_command=51.0)
    message.main_steam_pressure_quality = PlantSample.QUALITY_UNCERTAIN
    message.main_steam_temperature_quality = 200
    rows = decoder.rows(PLANT_SAMPLE, encode(message), T0)
    assert rows[0][1] == Signal.VALVE_COMMAND
    by_signal = {Signal(row[1]): row for row in rows}
    assert len(by_signal) == 5
    assert by_signal[Signal.VALVE_COMMAND][2] == 51.0
    assert by_signal[Signal.MAIN_STEAM_PRESSURE][3] == Quality.UNCERTAIN
    assert by_signal[Signal.MAIN_STEAM_TEMPERATURE][3] == Quality.BAD
    assert math.isnan(by_signal[Signal.GENERATED_POWER][2])


def test_parameters_that_do_not_agree_with_a_sample_are_told():
    given = {'main_steam_pressure_unit': 'bar', 'valve_command_unit': 'fraction', 'unit_tag': 'U1'}
    message = sample(T0)
    message.header.frame_id = 'U2'
    assert sample_warnings(encode(message), Settings(given)) == [
        'main_steam_pressure_unit bar does not apply to PlantSample, which is taken in MPa.',
        "PlantSample has the frame_id 'U2', but unit_tag is 'U1'. Check that the samples are of "
        'this unit.',
    ]
    # The command may come on its own topic, in its unit.
    message = sample(T0, valve_command=50.0)
    assert sample_warnings(encode(message), Settings(given))[1].startswith('valve_command_unit')
    message = sample(T0)
    message.header.frame_id = 'U1'
    fitting = Settings({'unit_tag': 'U1', 'generated_power_unit': 't/h'})
    assert sample_warnings(encode(message), fitting) == []


def test_a_value_whose_quality_was_not_set_is_not_used():
    message = PlantSample(valve_opening=50.0, main_steam_pressure=13.0, valve_command=50.0)
    rows = Decoder(Settings()).rows(PLANT_SAMPLE, encode(message), T0)
    # A command that is not sent is no reading.
    assert {row[1]: row[3] for row in rows} == {
        info.signal: Quality.BAD for info in SIGNALS if info.required
    }


@given(st.lists(st.tuples(st.integers(0, 1000), st.integers(1, 10**6)), max_size=60))
def test_the_clock_track_answers_as_a_search_through_all_would(noted):
    track = ClockTrack()
    for sent, shown in noted:
        track.note(sent, shown)
    for asked in range(0, 1001, 37):
        before = [(sent, k) for k, (sent, _) in enumerate(noted) if sent <= asked]
        expected = noted[max(before)[1]][1] if before else 0
        assert track.at(asked) == expected


def test_the_clock_track_stays_bounded_and_forgets_the_beginning():
    track = ClockTrack()
    assert (track.first_ns, track.lead_ns(5)) == (0, 0)
    for k in range(100_000):
        track.note(10 + k, 1000 + k)
        if k < 100:
            assert (track.first_ns, track.lead_ns(3), track.lead_ns(10 + k)) == (1000, 7, 0)
    assert len(track._sent_ns) <= 2 * 16384
    assert (track.at(100_009), track.lead_ns(3)) == (100_999, 0)


def test_gaps_in_the_numbers_are_losses_but_not_before_the_first():
    for numbers, lost, missed in (((1, 2, 5, 6, 10), 5, 0), ((8,), 0, 7)):
        statistics = TopicStatistics()
        for number in numbers:
            statistics.note_number(number)
        assert (statistics.received, statistics.lost) == (len(numbers), lost)
        assert statistics.missed_at_start == missed


@settings(max_examples=100, deadline=None)
@given(
    st.integers(1, 5000), st.integers(1, 5000), st.floats(0.0, 1.0), st.integers(1, 40),
    st.integers(0, 2**32 - 1),
)  # fmt: skip
def test_two_publishers_never_invent_a_loss(first, second, share, seconds, seed):
    """Nothing is lost; whoever sends, at whatever rate, in whatever bursts."""
    rng = np.random.default_rng(seed)
    statistics, numbers = TopicStatistics(), [first, second]
    for _ in range(seconds):
        for who in (rng.random(int(rng.integers(0, 30))) < share).astype(int):
            statistics.note_number(numbers[who])
            numbers[who] += 1
        statistics.note_publishers(2)
        assert statistics.lost == 0


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 20), st.integers(0, 30), st.integers(0, 2**32 - 1))
def test_losses_are_counted_again_when_one_publisher_is_left(alone, both, seed):
    rng = np.random.default_rng(seed)
    statistics, numbers = TopicStatistics(), [1, 900]
    for _ in range(alone):
        statistics.note_number(numbers[0])
        numbers[0] += 1 + int(rng.integers(0, 2))
    before = statistics.lost
    statistics.note_publishers(1)
    for who in rng.integers(0, 2, both):
        statistics.note_number(numbers[who])
        numbers[who] += 1
    statistics.note_publishers(2)
    assert statistics.lost == before
    statistics.note_publishers(1)
    statistics.note_publishers(1)
    statistics.note_number(numbers[0])
    assert statistics.lost == before
    statistics.note_publishers(1)
    statistics.note_publishers(1)
    statistics.note_number(numbers[0] + 1)
    statistics.note_number(numbers[0] + 5)
    assert statistics.lost == before + 3


def test_another_publisher_after_a_pause_invents_no_loss():
    statistics = TopicStatistics()
    for number in (1, 2, 3):
        statistics.note_number(number)
    for publishers in (0, 1):
        statistics.note_publishers(publishers)
    statistics.note_number(40)
    assert statistics.lost == 0


def test_a_restarted_publisher_is_one_irregularity():
    statistics = TopicStatistics()
    for number in (5, 6, 7, 1, 2, 3):
        statistics.note_number(number)
    assert (statistics.irregular, statistics.lost) == (1, 0)
    statistics.note_publishers(1)
    statistics.note_number(number + 9)
    assert statistics.lost == 0, 'it may be another one that goes'
    statistics.note_publishers(1)
    statistics.note_number(number + 19)
    assert statistics.lost == 9


def test_silence_is_told_by_the_topics_own_period_however_often_is_looked():
    for period, limit in ((0.01, 2.0), (1.0, 2.5), (30.0, 75.0)):
        statistics, rarely = TopicStatistics(), TopicStatistics()
        assert statistics.age_s(0.0) is None
        for k in range(100):
            statistics.note_arrival(1, k * period)
            if k % 10 == 9:
                rarely.note_arrival(10, k * period)
        last = 99 * period
        assert statistics.rate_hz() == pytest.approx(1.0 / period)
        assert rarely.rate_hz() == pytest.approx(1.0 / period)
        assert not statistics.stale(last + 0.98 * limit)
        assert statistics.stale(last + 1.02 * limit)
