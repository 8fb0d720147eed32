# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""From a monitor's recording, by its own schemas, to the history its page tells."""

import html
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from monitor_recording import stamp
from report_stories import HOUR_NS, KNOTS, START_NS, STEP_MW, history

from valveflow_ros.interface.monitor import recorded_history
from valveflow_ros.logs import Definitions, open_log
from valveflow_ros.monitoring.alarm_state import AlarmState
from valveflow_ros.report.drawing import figure_files
from valveflow_ros.report.figure import Figure, numbers
from valveflow_ros.report.history import (
    AlarmMoment,
    History,
    evidence_figure,
    history_of,
    history_sections,
    largest_evidence,
)
from valveflow_ros.report.words import moment

# The states that have a bar, as the picture names them; in the first two the condition stands.
BARS = {
    'stands, nobody acknowledged': AlarmState.UNACKNOWLEDGED,
    'stands, acknowledged': AlarmState.ACKNOWLEDGED,
    'gone, nobody acknowledged': AlarmState.RETURNED_UNACKNOWLEDGED,
    'shelved': AlarmState.SHELVED,
    'cannot be judged': AlarmState.SUPPRESSED,
    'out of service': AlarmState.OUT_OF_SERVICE,
}


def words_of(told):
    return ' '.join(p for s in history_sections(told) for p in s.parts if isinstance(p, str))


def figure_of(told, name):
    figures = [p for s in history_sections(told) for p in s.parts if isinstance(p, Figure)]
    return next(f for f in figures if f.name == name)


def bars_of(told):
    """Return (alarm, state, begin, end) of every bar, in hours."""
    found = []
    for trace in figure_of(told, 'alarms').traces:
        if trace.get('mode') == 'lines':
            x = [None if v is None else (v * 1e6 - told.start_ns) / HOUR_NS for v in trace['x']]
            for k in range(0, len(x), 3):
                assert trace['y'][k] == trace['y'][k + 1]
                assert x[k + 2] is None
                found.append((trace['y'][k], BARS[trace['name']], x[k], x[k + 1]))
    return found


def largest_move(told):
    """Return the input and the MW that the words give."""
    said = re.search(
        r'the earlier ones at [−\d.]+ MW \(u = ([\d.]+)\), by ([−\d.]+) MW', words_of(told)
    )
    return float(said[1]), float(said[2].replace('−', '-'))


def test_the_story_is_told_in_two_sections_and_a_log_of_no_monitor_has_none():
    assert history_sections(None) == history_sections(History(0, 1)) == []
    assert [s.title for s in history_sections(history())] == [
        'How the curve moved', 'What the monitor said',
    ]  # fmt: skip
    words = words_of(history())
    # The condition stood from hour 14 to hour 20.
    for part in (
        '5 curves', '5 changes of 1 alarm and 1 diagnosis',
        'Some alarm was active for 6 h in all.',
        html.escape('6 MW less & it <lasts>'),
    ):  # fmt: skip
        assert part in words, part
    assert '&lt;why&gt;' in words_of(History(0, 1, notes=('Cannot be shown: <why>.',)))


def test_a_step_shows_at_its_hour_and_only_where_it_was():
    figure = figure_of(history(), 'history')
    lines = [t for t in figure.traces if t['name'].startswith('u = ')]
    u = np.linspace(KNOTS[0], KNOTS[-1], len(lines) + 2)[1:-1]
    lifted = np.interp(u, KNOTS, [0.0, 0.0, STEP_MW])
    for line, expected in zip(lines, lifted, strict=True):
        y = np.array(line['y'], dtype=float)
        assert y[4] - y[2] == pytest.approx(expected, abs=1e-3)
        assert y[-1] == y[-2], 'the last curve holds to the end'
        hours = [(t * 1e6 - START_NS) / HOUR_NS for t in line['x']]
        assert hours == pytest.approx([4, 8, 12, 16, 20, 24])
    # The first curve ends at the first breakpoint: beyond it nothing is claimed.
    assert [line['y'][0] is None for line in lines] == [bool(v > KNOTS[1]) for v in u]
    knees = figure.traces[-1]
    assert knees['y'] == [KNOTS[1]] * 4
    assert knees['error_y']['array'] == [10.0] * 4


def test_what_has_no_time_is_no_part_of_the_story_and_a_repetition_has_its_own_time():
    normal, stands = AlarmState.NORMAL, AlarmState.UNACKNOWLEDGED
    told = [
        AlarmMoment(0, 'curve_shift', normal, 'It has not come.', again=True),
        AlarmMoment(START_NS, 'curve_shift', stands, '3 MW less.'),
        AlarmMoment(START_NS + 1, 'residual', stands, '9 MW less.'),
        AlarmMoment(START_NS + HOUR_NS, 'curve_shift', stands, '8 MW less.', again=True),
        AlarmMoment(START_NS + HOUR_NS, 'residual', stands, 'Not known.', again=True),
        AlarmMoment(START_NS + 2 * HOUR_NS, 'curve_shift', stands, '8 MW less.', again=True),
    ]
    story = history_of(told, (), ())
    assert story.start_ns == START_NS
    assert [(a.time_ns, a.sentence) for a in story.alarms] == [
        (START_NS, '3 MW less.'), (START_NS + 1, '9 MW less.'),
    ]  # fmt: skip
    later = f'3 MW less. Repeated at {moment(START_NS + HOUR_NS)}: 8 MW less.'
    assert [a.words for a in story.alarms] == [later, '9 MW less.']
    assert later in words_of(story)


@settings(max_examples=25)
@given(st.lists(st.floats(-50.0, 50.0), min_size=3, max_size=3))
def test_the_largest_move_is_that_of_the_last_curve_and_lies_at_a_knot(change):
    told = history()
    first, *others = told.curves[:4]
    # One young curve that jumped does not change what is usual.
    jumped = replace(first, power_mw=first.power_mw + 50.0)
    for young in (first, jumped):
        assert largest_move(replace(told, curves=(young, *others))) == (KNOTS[-1], STEP_MW)
    base = told.curves[-1]
    other = replace(base, power_mw=base.power_mw + np.array(change))
    _, moved = largest_move(replace(told, curves=(base, other)))
    assert abs(moved) == pytest.approx(np.abs(change).max(), abs=0.0051)


def test_the_name_and_the_sentence_of_an_alarm_are_no_markup():
    alarm = AlarmMoment(0, '<b>x</b>&', AlarmState.UNACKNOWLEDGED, 'a <i>')
    told = History(0, HOUR_NS, alarms=(alarm,))
    figure = figure_of(told, 'alarms')
    name = '&lt;b&gt;x&lt;/b&gt;&amp;'
    assert figure.layout['yaxis']['categoryarray'] == [name]
    assert {cell for t in figure.traces for cell in t['y']} == {name, None}
    (hover,) = figure.traces[-1]['hovertext']
    assert f'<br>{name}: ' in hover
    assert 'a &lt;i&gt;' in hover
    assert words_of(told).count(name) == 1


@settings(max_examples=40)
@given(
    st.lists(
        st.tuples(st.integers(0, 99), st.sampled_from('ab'), st.sampled_from(AlarmState)),
        min_size=1, max_size=30,
    )
)  # fmt: skip
def test_every_moment_has_one_state_for_each_alarm(changes):
    """Slow truth: stepping hour by hour, the state in force is that of the last change."""
    changes = sorted(changes, key=lambda c: c[0])
    alarms = tuple(AlarmMoment(h * HOUR_NS, name, state, '') for h, name, state in changes)
    told = History(0, 100 * HOUR_NS, alarms=alarms)
    bars, hours = bars_of(told), 0
    for hour in range(100):
        states = []
        for name in 'ab':
            before = [s for h, n, s in changes if n == name and h <= hour]
            now = [s for n, s, a, b in bars if n == name and a <= hour < b]
            assert now == [s for s in before[-1:] if s != AlarmState.NORMAL]
            states += now
        hours += bool({AlarmState.UNACKNOWLEDGED, AlarmState.ACKNOWLEDGED} & set(states))
    days = f'{hours // 24} d' * (hours >= 24) + ' ' * (hours > 24 and hours % 24 > 0)
    days += f'{hours % 24} h' * (hours % 24 > 0)
    said = f'Some alarm was active for {days} in all.' if hours else 'No alarm was ever active.'
    assert said in words_of(told)


def test_the_evidence_that_belongs_to_an_alarm_is_no_nearness():
    # Calm, a rise without an alarm, calm, the rise to an alarm, the alarm, its fall, calm.
    evidence = np.array([0.1, -0.6, 0.1, 0.7, 1.2, 1.25, 0.8, np.nan, 0.3, 0.1, 0.4])
    time_ns = START_NS + HOUR_NS * np.arange(len(evidence))
    alarm = [(int(time_ns[5]), int(time_ns[6]))]
    assert largest_evidence(time_ns, evidence, alarm) == (int(time_ns[1]), 0.6)
    assert largest_evidence(time_ns, evidence, []) == (int(time_ns[5]), 1.25)
    assert largest_evidence(time_ns[5:7], evidence[5:7], alarm) is None


def test_the_picture_of_the_evidence_is_thin_keeps_every_peak_and_becomes_a_file():
    n = 86_400
    time_ns = START_NS + np.arange(n) * (HOUR_NS // 3600)
    average, evidence = np.zeros(n), np.zeros(n)
    average[40_000], average[50_000] = 7.0, -3.0
    evidence[40_000], evidence[50_000] = 3.0, -0.9
    evidence[60_000:70_000] = np.nan
    alarm = [(int(time_ns[70_000]), int(time_ns[80_000]))]
    figure = evidence_figure(time_ns, average, evidence, alarm, HOUR_NS // 3600, limit_mw=5.0)
    residual, share, fixed, limit = figure.traces
    for trace, low, high in ((residual, -3.0, 7.0), (share, -90.0, 125.0)):
        y, at_ns = numbers(trace, 'y'), numbers(trace, 'x') * 1e6
        assert len(y) <= 2000
        assert (np.nanmin(y), np.nanmax(y)) == (low, high)
        assert at_ns[np.nanargmax(y)] == pytest.approx(time_ns[40_000], abs=HOUR_NS / 20)
        assert at_ns[np.nanargmin(y)] == pytest.approx(time_ns[50_000], abs=HOUR_NS / 20)
    assert np.isnan(numbers(share, 'y')).sum() == pytest.approx(2000 * 10_000 / n, abs=4)
    assert [sorted({*numbers(t, 'y')[[0, 1, 3, 4]]}) for t in (fixed, limit)] == [
        [-5.0, 5.0], [-100.0, 100.0],
    ]  # fmt: skip
    (stripe,) = figure.layout['shapes']
    assert (stripe['x0'] * 1e6, stripe['x1'] * 1e6) == alarm[0]
    # Without a fixed limit there is no line in MW.
    free = evidence_figure(time_ns, average, evidence, alarm, HOUR_NS // 3600)
    assert [t['yaxis'] for t in free.traces] == ['y', 'y2', 'y2']
    pytest.importorskip('matplotlib')
    assert figure_files(figure)['evidence.png'].startswith(b'\x89PNG')


# From the recording. What a message does not name is zero, empty or false.

CURVE = 'valveflow_msgs/msg/FlowCharacteristic'
ALARM, DIAGNOSIS = 'valveflow_msgs/msg/Alarm', 'valveflow_msgs/msg/Diagnosis'


def header(time_ns):
    return {'stamp': stamp(time_ns), 'frame_id': 'unit 1'}


class Tape:
    """A recording to be written message by message."""

    def __init__(self, path):
        self.path = path
        self._file = path.open('wb')
        self._writer = pytest.importorskip('mcap_ros2.writer').Writer(self._file)
        self._known = {}

    def add(self, topic, kind, time_ns, message, definition=''):
        if kind not in self._known:
            text = definition or Definitions().text(kind)
            self._known[kind] = self._writer.register_msgdef(kind, text)
        self._writer.write_message(topic, self._known[kind], message, time_ns, time_ns)

    def curve(self, c, topic='/boiler/watch/curve', later_ns=0, **changes):
        self.add(topic, CURVE, c.time_ns + later_ns, {
            'header': header(c.time_ns), 'model_id': c.model_id, 'status': 1,
            'window_start': stamp(START_NS), 'window_end': stamp(c.time_ns),
            'breakpoints': c.u.tolist(), 'values': c.power_mw.tolist(), 'pieces': len(c.u) - 1,
            'breakpoint_low': c.low.tolist(), 'breakpoint_high': c.high.tolist(),
            'pressure_exponent': c.exponent, 'rmse_mw': c.rmse_mw, **changes,
        })  # fmt: skip

    def alarm(self, a, before=None, **changes):
        before = (a.state + 1) % len(AlarmState) if before is None else before
        self.add('/boiler/watch/alarms', ALARM, a.time_ns, {
            'header': header(a.time_ns), 'name': a.name, 'state': int(a.state),
            'previous_state': before, 'sentence': a.sentence, 'raised': stamp(a.time_ns),
            **changes,
        })  # fmt: skip

    def diagnosis(self, d, verdict=2):
        message = {'header': header(d.time_ns), 'verdict': verdict, 'sentence': d.sentence}
        self.add('/boiler/watch/why', DIAGNOSIS, d.time_ns - (verdict == 0), message)

    def history(self):
        self._writer.finish()
        self._file.close()
        return recorded_history(open_log(self.path))


@pytest.fixture
def tape(tmp_path):
    made = Tape(tmp_path / 'log.mcap')
    for k in range(3):
        made.add('/valve_opening', 'std_msgs/msg/Float64', START_NS + k * HOUR_NS, {'data': 50.0})
    return made


def test_what_was_published_comes_back_under_any_name_of_the_node(tape):
    told = history()
    for c in told.curves:
        tape.curve(c)
        # Latched ones are published again when the status changes.
        tape.curve(c, later_ns=1, status=2)
    for a in told.alarms:
        tape.alarm(a)
    for d in told.diagnoses:
        tape.diagnosis(d, verdict=0)
        tape.diagnosis(d)
    found = tape.history()
    for mine, theirs in zip(found.curves, told.curves, strict=True):
        assert (mine.model_id, mine.time_ns) == (theirs.model_id, theirs.time_ns)
        for name in ('u', 'power_mw', 'high'):
            np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name))
    assert (found.alarms, found.diagnoses, found.notes) == (told.alarms, told.diagnoses, ())
    assert (found.start_ns, found.end_ns) == (START_NS, told.alarms[-1].time_ns)


def test_what_is_told_again_is_no_change(tape):
    """A new start publishes all that stands, and what stands is told again every day."""
    day = 24 * HOUR_NS
    raised = AlarmMoment(START_NS + 1, 'residual', AlarmState.UNACKNOWLEDGED, 'Less.')
    again = replace(raised, time_ns=START_NS + day, sentence='It stands.')
    old = replace(again, time_ns=START_NS, name='curve_shift')
    for a in (old, raised, raised, again, again, replace(old, time_ns=START_NS + 2 * day)):
        tape.alarm(a, 0 if a is raised else 1)
    d = history().diagnoses[0]
    for _ in range(3):
        tape.diagnosis(d)
    found = tape.history()
    # That which stood when the recording began is known by its first word alone.
    assert (found.alarms, found.diagnoses) == ((old, raised), (d,))


def test_a_plants_log_is_no_monitors_and_no_curve_yet_is_no_curve(tape):
    c = history().curves[0]
    tape.curve(c, breakpoints=[], values=[], breakpoint_low=[], breakpoint_high=[])
    assert tape.history() is None


def test_what_cannot_be_shown_is_said_and_nothing_else_is_lost(tape):
    c, a = history().curves[0], history().alarms[0]
    tape.curve(c, '/b/characteristic', model_id='b')
    tape.curve(c, '/a/characteristic', model_id='a')
    tape.alarm(a, state=77)
    found = tape.history()
    assert [x.model_id for x in found.curves] == ['a']
    two, unknown = sorted(found.notes, key=lambda note: '77' in note)
    assert '/a/characteristic and /b/characteristic; only /a/characteristic is shown' in two
    assert '77' in unknown
    assert 'lacks' not in unknown


def test_a_schema_of_another_day_is_said(tape):
    old = 'string name\nstring sentence\n'
    tape.add('/m/alarms', ALARM, START_NS, {'name': 'x', 'sentence': 'y'}, old)
    found = tape.history()
    assert found.alarms == ()
    (note,) = found.notes
    assert 'What the monitor published on /m/alarms cannot be shown' in note
    assert "'header'" in note
