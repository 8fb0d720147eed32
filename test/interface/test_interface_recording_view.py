# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a recording of a monitor tells, as frames of the terminal view."""

import json
from pathlib import Path

from monitor_recording import START_NS, Monitor, alarm, cdr, recording

from valveflow_ros.interface.recording_view import LogWatch
from valveflow_ros.report.terminal.frame import OK, STALE, WARN

SECOND = 10**9


def frame_of(path: Path):
    watch = LogWatch(path)
    for _ in watch.read():
        pass
    return watch.frame()


def test_a_frame_says_what_the_messages_said(tmp_path):
    frame = frame_of(recording(tmp_path / 'r'))
    assert frame.unit == 'U1'
    assert frame.now_ns == START_NS + 60 * SECOND
    assert frame.curve is not None
    assert frame.curve.breakpoints == (1000.0, 1500.0, 2200.0)
    assert frame.last is not None
    assert (frame.last.u, frame.last.measured_mw, frame.last.residual_mw) == (1450.0, 240.0, 0.5)
    assert (frame.last.low_mw, frame.last.high_mw) == (-3.0, 3.0)
    assert len(frame.samples) == 60
    (shown,) = frame.alarms
    assert (shown.name, shown.state, shown.sentence) == ('residual', 1, 'The unit gives less.')
    assert frame.diagnosis is not None
    assert (frame.diagnosis.verdict, frame.diagnosis.causes) == (2, ('curve_step',))
    assert [(i.name, i.level) for i in frame.inputs] == [
        ('valve_opening', OK), ('main_steam_pressure', OK), ('main_steam_temperature', OK),
        ('generated_power', OK),
    ]  # fmt: skip
    assert frame.recorder is not None
    assert frame.recorder.sentence.startswith('finished, ')


def test_a_later_word_of_an_alarm_takes_the_place_of_the_earlier(tmp_path):
    monitor = Monitor(tmp_path / 'r')
    for state in (1, 2, 0):
        monitor.say('alarms', alarm(monitor.now_ns, state, 'Once.'))
        monitor.say('alarms', alarm(monitor.now_ns, 1, 'Shift.', 'curve_shift'))
        monitor.seconds(1)
    monitor.writer.close()
    assert {a.name: a.state for a in frame_of(tmp_path / 'r').alarms} == {
        'residual': 0,
        'curve_shift': 1,
    }


def test_an_input_that_stops_is_silent_and_one_that_cannot_be_is_rejected(tmp_path):
    monitor = Monitor(tmp_path / 'r')
    monitor.seconds(5)
    for _ in range(30):
        monitor.now_ns += SECOND
        monitor.say('/valve_opening', cdr('std_msgs/msg/Float64', {'data': 700.0}))
        monitor.say('/main_steam_pressure', cdr('std_msgs/msg/Float64', {'data': 16.0}))
    monitor.writer.close()
    found = {i.name: i for i in frame_of(tmp_path / 'r').inputs}
    assert found['valve_opening'].level == WARN
    assert '30 readings rejected, the last 700.0 %' in found['valve_opening'].sentence
    assert found['main_steam_pressure'].level == OK
    assert found['generated_power'].level == STALE
    assert found['generated_power'].sentence == (
        'the recording has ended; no value in its last 30 s.'
    )


def test_inputs_that_were_remapped_are_found(tmp_path):
    # One of them has the usual name of another.
    theirs = {
        '/valve_opening': '/gw/HV101', '/main_steam_pressure': '/gw/PT101',
        '/generated_power': '/gw/main_steam_pressure',
    }  # fmt: skip
    told = {name[1:]: topic for name, topic in theirs.items()}
    told |= {'valve_command': '/gw/never_came', 'vacuum': '/gw/vacuum'}
    topics = {'topics.json': json.dumps({'inputs': told}).encode()}
    monitor = Monitor(tmp_path / 'r', theirs, **topics)
    monitor.seconds(5)
    monitor.writer.close()
    usual = frame_of(recording(tmp_path / 'usual', 5)).inputs
    assert frame_of(tmp_path / 'r').inputs == usual


def test_a_clock_that_goes_back_begins_the_residuals_anew(tmp_path):
    monitor = Monitor(tmp_path / 'r')
    monitor.seconds(20)
    monitor.now_ns = START_NS
    monitor.seconds(3)
    monitor.writer.close()
    assert len(frame_of(tmp_path / 'r').samples) == 3
