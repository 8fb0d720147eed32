# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""From a monitor's recording to the history its page tells, by the recording's own schemas."""

from __future__ import annotations

from dataclasses import replace

import pytest
from monitor_recording import stamp
from report_stories import HOUR_NS, START_NS, history

from valveflow_ros.interface.monitor import recorded_history
from valveflow_ros.logs import Definitions, open_log
from valveflow_ros.monitoring.alarm_state import AlarmState
from valveflow_ros.report.history import AlarmMoment

Writer = pytest.importorskip('mcap_ros2.writer').Writer


def header(time_ns):
    return {'stamp': stamp(time_ns), 'frame_id': 'unit 1'}


# What a message does not name is zero, empty or false.


def curve_message(c, **changes):
    return {
        'header': header(c.time_ns), 'model_id': c.model_id, 'status': 1,
        'window_start': stamp(START_NS), 'window_end': stamp(c.time_ns),
        'breakpoints': c.u.tolist(), 'values': c.power_mw.tolist(), 'pieces': len(c.u) - 1,
        'breakpoint_low': c.low.tolist(), 'breakpoint_high': c.high.tolist(),
        'pressure_exponent': c.exponent, 'rmse_mw': c.rmse_mw, **changes,
    }  # fmt: skip


def alarm_message(a, before=None):
    if before is None:
        before = (a.state + 1) % len(AlarmState)
    return {
        'header': header(a.time_ns), 'name': a.name, 'state': int(a.state),
        'previous_state': before, 'sentence': a.sentence, 'raised': stamp(a.time_ns),
    }  # fmt: skip


def diagnosis_message(d, verdict=2):
    return {'header': header(d.time_ns), 'verdict': verdict, 'sentence': d.sentence}


class Tape:
    """A recording to be written message by message."""

    def __init__(self, path):
        self.path = path
        self._file = path.open('wb')
        self._writer = Writer(self._file)
        self._known = {}

    def add(self, topic, kind, time_ns, message, definition=''):
        if kind not in self._known:
            text = definition or Definitions().text(kind)
            self._known[kind] = self._writer.register_msgdef(kind, text)
        self._writer.write_message(topic, self._known[kind], message, time_ns, time_ns)

    def done(self):
        self._writer.finish()
        self._file.close()
        return open_log(self.path)


@pytest.fixture
def tape(tmp_path):
    made = Tape(tmp_path / 'log.mcap')
    for k in range(3):
        made.add('/valve_opening', 'std_msgs/msg/Float64', START_NS + k * HOUR_NS, {'data': 50.0})
    return made


CURVE = 'valveflow_msgs/msg/FlowCharacteristic'
ALARM, DIAGNOSIS = 'valveflow_msgs/msg/Alarm', 'valveflow_msgs/msg/Diagnosis'


def test_what_was_published_comes_back_under_any_name_of_the_node(tape):
    told = history()
    for c in told.curves:
        tape.add('/boiler/watch/curve', CURVE, c.time_ns, curve_message(c))
        # Latched ones are published again when the status changes.
        tape.add('/boiler/watch/curve', CURVE, c.time_ns + 1, curve_message(c, status=2))
    for a in told.alarms:
        tape.add('/boiler/watch/alarms', ALARM, a.time_ns, alarm_message(a))
    for d in told.diagnoses:
        tape.add('/boiler/watch/why', DIAGNOSIS, d.time_ns - 1, diagnosis_message(d, verdict=0))
        tape.add('/boiler/watch/why', DIAGNOSIS, d.time_ns, diagnosis_message(d))
    found = recorded_history(tape.done())
    assert [c.model_id for c in found.curves] == [c.model_id for c in told.curves]
    for mine, theirs in zip(found.curves, told.curves, strict=True):
        assert mine.time_ns == theirs.time_ns
        assert mine.u.tolist() == theirs.u.tolist()
        assert mine.power_mw.tolist() == theirs.power_mw.tolist()
        assert mine.high.tolist() == theirs.high.tolist()
    assert found.alarms == told.alarms
    assert found.diagnoses == told.diagnoses
    assert found.notes == ()
    assert (found.start_ns, found.end_ns) == (START_NS, told.alarms[-1].time_ns)


def test_what_is_told_again_is_no_change(tape):
    """A new start publishes all that stands, and what stands is told again every day."""
    day = 24 * 3600 * 10**9
    raised = AlarmMoment(START_NS + 1, 'residual', AlarmState.UNACKNOWLEDGED, 'Less.')
    again = replace(raised, time_ns=START_NS + day, sentence='It stands.')
    old = replace(again, time_ns=START_NS, name='curve_shift')
    for a in (old, raised, raised, again, again, replace(old, time_ns=START_NS + 2 * day)):
        tape.add('/m/alarms', ALARM, a.time_ns, alarm_message(a, 0 if a is raised else 1))
    d = history().diagnoses[0]
    for _ in range(3):
        tape.add('/m/diagnosis', DIAGNOSIS, d.time_ns, diagnosis_message(d))
    found = recorded_history(tape.done())
    # That which stood when the recording began is known by its first word alone.
    assert found.alarms == (old, raised)
    assert found.diagnoses == (d,)


def test_a_plants_log_is_no_monitors(tape):
    assert recorded_history(tape.done()) is None


def test_no_curve_yet_is_no_curve(tape):
    c = history().curves[0]
    none = curve_message(c, breakpoints=[], values=[], breakpoint_low=[], breakpoint_high=[])
    tape.add('/m/characteristic', CURVE, c.time_ns, none)
    assert recorded_history(tape.done()) is None


def test_two_monitors_in_one_log_are_said(tape):
    c = history().curves[0]
    tape.add('/b/characteristic', CURVE, c.time_ns, curve_message(c, model_id='b'))
    tape.add('/a/characteristic', CURVE, c.time_ns, curve_message(c, model_id='a'))
    found = recorded_history(tape.done())
    assert [x.model_id for x in found.curves] == ['a']
    (note,) = found.notes
    assert '/a/characteristic and /b/characteristic; only /a/characteristic is shown' in note


def test_a_schema_of_another_day_is_said_and_nothing_is_lost(tape):
    old = 'string name\nstring sentence\n'
    tape.add('/m/alarms', ALARM, START_NS, {'name': 'x', 'sentence': 'y'}, old)
    found = recorded_history(tape.done())
    assert found.alarms == ()
    (note,) = found.notes
    assert 'What the monitor published on /m/alarms cannot be shown' in note
    assert "'header'" in note


def test_a_state_nobody_knows_is_said(tape):
    a = history().alarms[0]
    tape.add('/m/alarms', ALARM, a.time_ns, {**alarm_message(a), 'state': 77})
    (note,) = recorded_history(tape.done()).notes
    assert '77' in note
    assert 'lacks' not in note
