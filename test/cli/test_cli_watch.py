"""``valveflow watch``: what a recording tells, and the verb around it."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest
from monitor_recording import START_NS, Monitor, alarm, cdr, recording

from valveflow_ros.cli import watch as verb
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
    assert found['generated_power'].sentence == 'silent for 30 s.'


def test_a_clock_that_goes_back_begins_the_residuals_anew(tmp_path):
    monitor = Monitor(tmp_path / 'r')
    monitor.seconds(20)
    monitor.now_ns = START_NS
    monitor.seconds(3)
    monitor.writer.close()
    assert len(frame_of(tmp_path / 'r').samples) == 3


def test_once_prints_a_picture_that_fits(run, tmp_path, monkeypatch):
    folder = recording(tmp_path / 'r')
    monkeypatch.setenv('COLUMNS', '80')
    monkeypatch.setenv('LINES', '24')
    ran = run('watch', folder, '--once')
    assert ran.status == 0
    lines = ran.out.splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 80
    assert 'fresh, 2 pieces' in ran.out
    assert '\x1b' not in ran.out
    data = run('watch', folder, '--once', '--json').json
    assert data['curve']['breakpoints'] == [1000.0, 1500.0, 2200.0]
    assert data['alarms'][0]['name'] == 'residual'


def test_a_finished_recording_is_told_line_by_line(run, tmp_path):
    ran = run('watch', recording(tmp_path / 'r'))
    assert ran.status == 0
    kinds = [re.match(r'\S+ \S+ UTC  (\w+): ', line)[1] for line in ran.out.splitlines()]
    assert kinds.count('curve') == kinds.count('alarm') == kinds.count('diagnosis') == 1


def test_a_log_without_a_monitor_is_told_what_to_do(run, logs):
    ran = run('watch', logs / 'plant.mcap', '--once')
    assert ran.status == 0
    assert '"valveflow identify" finds its curve' in re.sub(r'\n +', ' ', ran.out)
    assert 'opening ' in ran.out


def test_the_newest_recording_of_a_folder_is_taken(run, tmp_path):
    recording(tmp_path / 'old')
    recording(tmp_path / 'new')
    os.utime(tmp_path / 'old', (1, 1))
    assert 'new' in run('watch', tmp_path, '--once').out.splitlines()[0]


@pytest.mark.parametrize(('words', 'status', 'part'), [
    (['x.csv'], 2, 'valveflow info'),
    (['nothing.mcap'], 1, 'is not there'),
    (['.'], 1, 'has no recording in it'),
    (['x.mcap', '--node', 'a'], 2, '--node'),
    (['x.mcap', '--ask', 'refit'], 2, '--ask'),
    (['x', '--interval', '0'], 2, '0.1 to 3600'),
])  # fmt: skip
def test_what_cannot_be_watched(run, tmp_path, monkeypatch, words, status, part):
    monkeypatch.chdir(tmp_path)
    assert part in run('watch', *words).refused(status)


def test_without_ros_it_says_so_and_what_else_there_is(run, monkeypatch):
    monkeypatch.setattr(verb, 'find_spec', lambda name: None)
    sentence = run('watch').refused()
    assert 'rclpy and valveflow_msgs' in sentence
    assert 'valveflow watch valveflow_recordings' in sentence


def test_with_ros_another_process_takes_over(run, monkeypatch):
    taken = []
    monkeypatch.setattr(verb, 'find_spec', lambda name: name)
    monkeypatch.setattr(os, 'execv', lambda path, words: taken.append(words) or _end())

    def _end():
        raise KeyboardInterrupt

    run('watch', '--once', '--node', '/a/b')
    assert taken[0][1:3] == ['-m', 'valveflow_ros.ros.watch_main']
    assert taken[0][3:] == ['--interval', '1.0', '--once', '--node', '/a/b']
    run('watch', '--ask', 'shelve_alarms')
    assert taken[1][3:] == ['--interval', '1.0', '--ask', 'shelve_alarms']
