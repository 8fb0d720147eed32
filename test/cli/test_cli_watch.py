"""``valveflow watch``: the verb around the terminal view."""

from __future__ import annotations

import os
import re

from monitor_recording import recording

from valveflow_ros.cli import watch as verb


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
