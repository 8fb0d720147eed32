# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What /diagnostics says of inputs, curve, reference and alarms."""

import math
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus

from valveflow_ros.curve.characteristic import Support
from valveflow_ros.curve.shift import judge_shift
from valveflow_ros.fit.result import NOT_REFINED
from valveflow_ros.monitoring.alarm_state import AlarmAction
from valveflow_ros.monitoring.alarms import Judged, ResidualAlarm
from valveflow_ros.monitoring.diagnosis_requests import FITS_AGAIN
from valveflow_ros.monitoring.events import Diagnosed, JournalEntry, JournalKind
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.offline import feed_rows
from valveflow_ros.parameters import Settings
from valveflow_ros.plant.simulator import simulate
from valveflow_ros.records import NS_PER_S, SIGNALS, Signal
from valveflow_ros.ros.decoding import INPUTS, PLANT_SAMPLE
from valveflow_ros.ros.node.diagnostics import (
    Changes,
    Item,
    Level,
    diagnostics_message,
    line_of,
)
from valveflow_ros.ros.node.health import (
    InputHealth,
    Publishers,
    alarm_item,
    fit_item,
    reference_item,
)
from valveflow_ros.ros.node.intake import TopicStatistics
from valveflow_ros.signals.align import REASONS

TOPICS = {topic.name: f'/plant/{topic.name}' for topic in INPUTS}
NOW = 1000.0
OPENING, PRESSURE, COMMAND = 'valve_opening', 'main_steam_pressure', 'valve_command'
STRING = Publishers(0, ('std_msgs/msg/String',))


class Scene:
    """An input's circumstances, healthy unless changed; or only a stamped sample is sent."""

    def __init__(self, stamped=False, **settings):
        self.health = InputHealth(Settings(settings), TOPICS)
        self.counts = {info.topic: dict.fromkeys(REASONS, 0) for info in SIGNALS}
        self.silence()
        names = [PLANT_SAMPLE] if stamped else [info.topic for info in SIGNALS]
        self.publishers = {name: Publishers(1) for name in names}
        for name in names:
            self.hear(name)

    def silence(self):
        self.statistics = {name: TopicStatistics() for name in TOPICS}
        self.publishers = {}

    def hear(self, name, at=NOW):
        found = self.statistics[name]
        for k in range(5, -1, -1):
            found.note_arrival(1, at - k)
            found.note_number(found.received + 1)

    def note(self, name, signal, value, time_ns=1):
        self.health.note(name, [(time_ns, signal, value, 0)])

    def stamp(self, off_s):
        """Receive an opening whose stamp is that far from this machine's clock."""
        self.note(OPENING, Signal.VALVE_OPENING, 50.0, time.time_ns() + round(off_s * NS_PER_S))

    def item(self, topic=OPENING, listening=100.0, at=NOW + 0.5,
             newest_ns=0):  # fmt: skip
        items = self.health.items(
            self.statistics, self.counts, self.publishers, at, listening, newest_ns
        )
        (found,) = [item for item in items if item.name == f'input {topic}']
        return found

    def says(self, level, words, topic=OPENING, **more):
        item = self.item(topic, **more)
        assert words in item.sentence, item.sentence
        assert item.level == level
        assert item.sentence.endswith(('.', '?'))


def test_a_healthy_input_says_its_rate_once_it_is_known():
    scene = Scene()
    scene.says(Level.OK, '1 Hz.')
    values = scene.item().values
    assert values['Topic'] == '/plant/valve_opening'
    assert values['Actual frequency (Hz)'] == pytest.approx(1.0)
    assert values['Age of the newest message (s)'] == pytest.approx(0.5)
    assert values['Publishers'] == 1
    assert {f'Readings {r.replace("_", " ")} in all runs' for r in REASONS} <= set(values)
    scene.statistics[OPENING] = TopicStatistics()
    scene.statistics[OPENING].note_arrival(1, NOW)
    scene.statistics[OPENING].note_number(1)
    scene.says(Level.OK, 'The first message has come.')
    assert scene.item().values['Actual frequency (Hz)'] is None


def test_stamps_off_this_machines_clock_are_told_once_and_only_without_a_clock():
    for off_s, level, words in (
        (10.0, Level.OK, '1 Hz.'),
        (-100.0, Level.OK, "1 Hz; stamps are 1 min 40 s behind this machine's clock."),
        (20.0, Level.WARN, "ahead of this machine's clock"),
        (1e7, Level.WARN, "ahead of this machine's clock"),
        (-130.0, Level.WARN, "behind this machine's clock; set both by one server"),
    ):
        scene = Scene()
        scene.stamp(off_s)
        scene.says(level, words)
        scene.stamp(0.0)
        scene.says(Level.OK, '1 Hz.')
        scene.health = InputHealth(Settings(), TOPICS, by_host=False)
        scene.stamp(off_s)
        scene.says(Level.OK, '1 Hz.')


def test_stamps_that_are_not_believed_are_told_by_how_far_they_are_off():
    for off_s, words in (
        (-7200.0, 'The last stamp is 2 h behind the newest one used.'),
        (86400.0, 'The last stamp is 1 d ahead of the newest one used.'),
    ):
        scene, newest_ns = Scene(), time.time_ns()
        scene.note(OPENING, 0, 50.0, newest_ns + round(off_s * NS_PER_S))
        scene.counts[OPENING]['time_outlier'] = 4
        scene.says(Level.WARN, words, newest_ns=newest_ns)
        scene.counts[OPENING]['time_outlier'] = 8
        scene.hear(OPENING, at=NOW + 20.0)
        scene.says(Level.ERROR, words, newest_ns=newest_ns, at=NOW + 20.0)


def test_silence_from_the_start_and_after_speech():
    scene = Scene()
    scene.silence()
    scene.says(Level.OK, 'Waiting for /plant/valve_opening', listening=1.0)
    scene.says(Level.STALE, 'Nobody publishes /plant/valve_opening or /plant/plant_sample;')
    scene.says(Level.OK, 'it is optional', COMMAND)
    scene.publishers = {OPENING: Publishers(1)}
    scene.says(Level.STALE, 'has a publisher, but nothing has come')
    scene.health.mismatched.add(OPENING)
    scene.says(Level.ERROR, 'set input_reliability, and qos_overrides if given, to best_effort')
    scene.hear(OPENING, NOW - 3.0)
    scene.says(Level.STALE, '/plant/valve_opening has been silent for 3.5 s')


def test_a_stamped_sample_speaks_for_all_its_signals():
    scene = Scene(stamped=True)
    # Its quality was left alone; that is no reading, and is not counted.
    scene.says(Level.OK, 'leaves valve_command_quality at 0, unknown', COMMAND)
    scene.counts[COMMAND]['accepted'] = 5
    for info in SIGNALS:
        scene.says(Level.OK, '1 Hz', info.topic)
        assert scene.item(info.topic).values['Topic'] == '/plant/plant_sample'


def test_a_command_that_was_never_sent_is_no_warning():
    """Not even where the sample that could bring it is silent, or comes from two."""
    for stamped in (True, False):
        scene = Scene(stamped=True)
        if stamped:
            scene.statistics[PLANT_SAMPLE].lost = 3
            scene.publishers = {PLANT_SAMPLE: Publishers(2)}
            scene.says(Level.STALE, 'has been silent for 60.0 s', at=NOW + 60.0)
        else:
            scene.silence()
        for at in (NOW, NOW + 60.0):
            scene.says(Level.OK, 'it is optional.', COMMAND, at=at)
        # Once it was sent, its silence is told.
        scene.counts[COMMAND]['accepted'] = 1
        scene.hear(COMMAND)
        scene.says(Level.STALE, 'has been silent', COMMAND, at=NOW + 60.0)


def test_a_silent_covariate_is_told_without_a_warning():
    scene, name, topic = Scene(), 'covariate vacuum', '/condenser/pressure'
    scene.health = InputHealth(Settings(), {name: topic, **TOPICS})
    scene.statistics[name] = TopicStatistics()
    scene.says(Level.OK, f'{topic} is not sent; it is optional.', name)
    scene.hear(name)
    scene.says(Level.OK, '1 Hz.', name)
    scene.says(Level.OK, f'{topic} has been silent for 60.0 s; it is optional.', name, at=NOW + 60)
    scene.note(name, len(SIGNALS), 5.0)
    scene.publishers[name] = STRING
    scene.says(Level.ERROR, 'which the monitor cannot take', name)


def test_a_signal_that_comes_in_two_ways_is_named():
    scene = Scene()
    scene.publishers[PLANT_SAMPLE] = Publishers(1)
    # Somebody could send samples and does not.
    scene.says(Level.OK, 'Hz')
    scene.hear(PLANT_SAMPLE, NOW - 1.0)
    scene.says(Level.WARN, '/plant/valve_opening and /plant/plant_sample are both published')
    # The command may come beside samples that do not hold it.
    scene.says(Level.OK, 'Hz', COMMAND)
    scene.publishers[PLANT_SAMPLE] = STRING
    scene.says(Level.OK, 'Hz')


def test_an_input_of_which_nothing_can_be_used_is_as_good_as_silent():
    scene, counts = Scene(), Scene().counts[OPENING]
    scene.counts[OPENING] = counts
    counts['accepted'] = 5
    scene.says(Level.OK, 'Hz')
    for second in (1, 10, 11, 29):
        scene.hear(OPENING, NOW + second)
        counts['impossible'] += 1
        level, words = Level.WARN, '1 new reading was rejected.'
        if second > 10:
            level = Level.ERROR
            words = f'Nothing usable has come for {second} s. Rejected in all runs so far: '
        scene.says(level, words, at=NOW + 0.5 + second)
    # One good one among them is enough.
    counts['accepted'] += 1
    counts['impossible'] += 1
    scene.hear(OPENING, NOW + 30)
    scene.says(Level.WARN, 'rejected', at=NOW + 30.5)


def test_losses_are_said_once_and_counted_on():
    scene = Scene()
    scene.statistics[OPENING].lost = 3
    scene.says(Level.WARN, '3 messages of /plant/valve_opening were lost')
    scene.says(Level.OK, 'Hz')
    assert scene.item().values['Messages lost on the way'] == 3


def test_an_impossible_value_is_told_as_sent_with_the_unit_it_would_fit():
    for stamped, settings, topic, value, words in (
        (False, {}, PRESSURE, 162.5,
         '1 new reading was rejected. The last one, 162.5 MPa, is impossible (accepted: 0.05 to '
         "40 MPa). It would be possible in bar: set main_steam_pressure_unit to 'bar'."),
        (False, {'valve_opening_unit': 'fraction'}, OPENING, 6500.0,
         'The last one, 65 fraction, is impossible'),
        (False, {'valve_opening_unit': 'fraction'}, OPENING, 6500.0,
         "possible in %: set valve_opening_unit to 'percent'."),
        (True, {'valve_opening_unit': 'fraction'}, OPENING, 650.0,
         '650 %, is impossible (accepted: -2 to'),
        (True, {'main_steam_pressure_unit': 'bar'}, PRESSURE, 124.86,
         'It would be possible in bar: convert to MPa before sending.'),
    ):  # fmt: skip
        scene = Scene(stamped, **settings)
        signal = next(info.signal for info in SIGNALS if info.topic == topic)
        scene.note(PLANT_SAMPLE if stamped else topic, signal, value)
        scene.counts[topic]['impossible'] = 1
        scene.says(Level.WARN, words, topic)
        scene.says(Level.OK, 'Hz', topic)


def test_other_rejections_are_told_by_reason_and_those_of_earlier_runs_are_no_news():
    scene = Scene()
    counts = scene.counts[OPENING]
    counts['duplicate'] = 40
    scene.health.begin(scene.counts)
    scene.says(Level.OK, '1 Hz.')
    counts['not_finite'] = 4
    told = (
        '4 new readings were rejected. Rejected in all runs so far: 4 not a number, '
        '40 with the same time as the one before.'
    )
    scene.says(Level.WARN, told)
    counts['bad_quality'] = 4
    scene.says(
        Level.WARN,
        '4 new readings were rejected. The sender marked them as bad quality, or does not set '
        'valve_opening_quality, which is then 0, unknown; 1 is good.',
    )


def test_a_topic_without_any_time_points_to_the_clock():
    for what in ('without_time', 'waiting'):
        scene = Scene()
        setattr(scene.statistics[OPENING], what, scene.statistics[OPENING].received)
        scene.says(Level.ERROR, 'is /clock published?')


def test_the_message_follows_rep_107():
    items = [
        Item('input valve_opening', Level.OK, 'Fine.', {'Rate (Hz)': 1.0, 'Age (s)': None}),
        Item('recorder', Level.ERROR, 'Broken.', {'On': False, 'Shift (MW)': math.nan}),
    ]
    message = diagnostics_message(items, 'unit_1/monitor', 'HV101', 5 * 10**9)
    assert message.header.stamp.sec == 5
    first, second = message.status
    assert first.name == 'unit_1/monitor: input valve_opening'
    assert (first.hardware_id, first.message) == ('HV101', 'Fine.')
    assert [(v.key, v.value) for v in first.values] == [('Rate (Hz)', '1'), ('Age (s)', 'unknown')]
    assert [v.value for v in second.values] == ['no', 'unknown']
    assert (first.level, second.level) == (DiagnosticStatus.OK, DiagnosticStatus.ERROR)
    for level in Level:
        assert bytes([level]) == getattr(DiagnosticStatus, level.name)


def test_changes_get_into_the_log_not_too_often_but_a_failure_at_once():
    well, ill = Item('a', Level.OK, 'Well.'), Item('a', Level.WARN, 'Ill.')
    dead = Item('a', Level.ERROR, 'Dead.')
    for course in (
        [(well, 0, False), (ill, 1, True), (ill, 2, False), (well, 3, False), (ill, 4, False),
         (well, 40, True)],
        [(ill, 0, True), (dead, 1, True), (well, 2, False), (dead, 3, False), (well, 29, False),
         (dead, 30, False), (well, 40, True)],
    ):  # fmt: skip
        changes = Changes(quiet_s=30.0)
        for item, at_s, told in course:
            assert changes.pick([item], float(at_s)) == [item] * told, (item, at_s)


def test_what_the_engine_says_gets_into_the_log():
    for kind, text, line in (
        (JournalKind.FIT_REFUSED, 'Why.', (Level.WARN, 'no new curve: Why.')),
        (JournalKind.RESET, 'Why.', (Level.WARN, 'Why.')),
        (JournalKind.MISMATCH, FITS_AGAIN, (Level.OK, FITS_AGAIN)),
        (JournalKind.MISMATCH, 'Why.', (Level.WARN, 'Why.')),
        (JournalKind.DIAGNOSE, 'nightly', (Level.OK, 'diagnosis started: nightly')),
        (JournalKind.SETTINGS, '', None),
    ):
        assert line_of(JournalEntry(0, kind, 0, 0, '', text)) == line
    found = '{"verdict": "named", "sentence": "It sticks."}'
    assert line_of(Diagnosed(None, '', 'Why.')) == (Level.WARN, 'no diagnosis: Why.')
    assert line_of(Diagnosed(None, found, '')) == (Level.WARN, 'diagnosis: It sticks.')


# The curve, its reference and its alarms

WORK = Settings({'refit_period': 3600.0, 'refit_segments': 0, 'alarm_limit': 500.0})
WORKER = SimpleNamespace(failures_in_a_row=0, busy_s=None, starts=1)
STRAIGHT = f'{NOT_REFINED}one straight piece, without dynamics.'
ALONE = 'Piece 1 (u 1000 to 1400) has no data in special segments, so its slope is uncertain.'


@pytest.fixture(scope='module')
def monitor():
    made = Monitor(WORK)
    feed_rows(made, simulate(0.3, 7).table)
    return made


def said_of(monitor, notes, identifiable=True):
    """Return what is said of the running curve with other notes."""
    curve = monitor.characteristic
    assert curve is not None
    support = (Support(1, 1, 100, (1200.0,), identifiable),)
    source = replace(curve.source, temperature_flag=False)
    other = replace(curve, notes=notes, support=support, source=source)
    seen = SimpleNamespace(
        characteristic=other, noise=monitor.noise, status=monitor.status, rows=monitor.rows,
        segments=1, special_samples=100, last_ns=monitor.last_ns, cause='',
    )  # fmt: skip
    item = fit_item(seen, WORKER, 1.0)
    assert item.values['Notes'] == ' '.join(notes)
    return item


def test_what_is_not_learnt_yet_is_unknown(monitor):
    for made, known in ((Monitor(WORK), False), (monitor, True)):
        values = fit_item(made, WORKER, None).values
        for name in ('Noise of the power (MW)', 'Temperature spread (K)'):
            assert (values[name] is not None) == known


def test_a_weak_curve_says_so(monitor):
    assert said_of(monitor, ('Manual step test: 19 of 19 levels count.',)).level == Level.OK
    for notes, identifiable in (((STRAIGHT,), True), ((ALONE,), False)):
        item = said_of(monitor, notes, identifiable)
        assert (item.level, item.sentence) == (Level.WARN, notes[0])
    both = said_of(monitor, ('Read so.', STRAIGHT, ALONE), identifiable=False)
    assert (both.level, both.sentence) == (Level.WARN, f'{STRAIGHT} Weak points in all: 2.')


def lifted(curve, by_mw):
    pieces = tuple(replace(p, intercept=p.intercept + by_mw) for p in curve.pieces)
    return replace(curve, pieces=pieces, model_id='lifted')


def test_an_alarm_whose_range_left_the_window_says_so(monitor):
    curve = monitor.characteristic
    assert curve is not None
    assert 'There is no reference curve yet' in reference_item(Monitor(WORK)).sentence
    monitor.set_reference(curve)
    reference, alarm = monitor.reference, monitor.reference.alarm
    assert 'The next curve is judged' in reference_item(monitor).sentence
    reference.shift = judge_shift(curve, lifted(curve, 9.0))
    assert 'if the next curve shows it too' in reference_item(monitor).sentence
    alarm.judge(reference.shift, 1, WORK)
    assert reference_item(monitor).sentence == reference.shift.sentence
    assert reference_item(monitor).values['Alarm'] == 'unacknowledged'
    reference.shift = judge_shift(curve, replace(curve, pieces=curve.pieces[-1:]))
    assert alarm.judge(reference.shift, 2, WORK) == []
    item = reference_item(monitor)
    assert item.level == Level.ERROR
    ends = curve.place_words(curve.pieces[-2].u_from, curve.pieces[-1].u_from)
    active = 'The alarm is still active: no later curve has confirmed the reference at '
    assert item.sentence.startswith(active)
    assert f'{ends}. ' in item.sentence


def after(values, shelved=False, curve='a curve'):
    """Return what diagnostics say after a second of each value."""
    nervous = {'alarm_on_delay': 0.0, 'alarm_off_delay': 0.0, 'alarm_suppress_time': 60.0}
    alarm = ResidualAlarm(Settings(nervous))
    time_ns = np.arange(1, len(values) + 1) * NS_PER_S
    column = np.array(values)
    alarm.feed(time_ns, column, column, 'm')
    if shelved:
        assert alarm.operate(AlarmAction.SHELVE, int(time_ns[-1]), 'm')[0]
    judged = Judged(0, values[-1], values[-1])
    return alarm_item(SimpleNamespace(alarm=alarm, judged=judged, characteristic=curve))


def test_diagnostics_tell_states_that_no_announcement_told():
    item = after([2.0, 0.0] * 5 + [2.0])
    assert (item.level, item.values['State']) == (Level.ERROR, 'unacknowledged')
    assert item.values['Occurrences in all runs'] == 6
    assert item.values['Announcements suppressed by alarm_flood'] == 4
    item = after([2.0], shelved=True)
    assert (item.level, item.values['State']) == (Level.WARN, 'shelved')
    assert item.values['Shelved until (s since 1970)'] == 1 + 28800
    item = after([2.0, 0.0])
    assert (item.level, 'acknowledge the alarm to clear it' in item.sentence) == (Level.WARN, True)
    blind = after([0.0] + [float('nan')] * 70)
    assert (blind.level, blind.values['State']) == (Level.WARN, 'suppressed')
    assert 'no alarm can come' in blind.sentence
    assert after([0.0]).level == Level.OK
    assert 'without a curve none can come' in after([0.0], curve=None).sentence
