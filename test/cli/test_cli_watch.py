# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow watch``: the verb around the terminal view."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request

import pytest
from monitor_recording import recording

from valveflow_ros.cli.verbs import watch as verb


def test_once_prints_a_picture_as_wide_as_the_terminal_and_no_sentence_is_cut(
    run, tmp_path, monkeypatch
):
    folder = recording(tmp_path / 'r')
    monkeypatch.setenv('COLUMNS', '80')
    monkeypatch.setenv('LINES', '24')
    ran = run('watch', folder, '--once')
    assert ran.status == 0
    assert max(map(len, ran.out.splitlines())) <= 80
    assert '…' not in ran.out
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
    assert taken[0][3:] == ['--interval', '1.0', '--once', '--node', '/a/b', '--time-zone=']
    run('watch', '--ask', 'shelve_alarms', '--alarm', 'residual', '--time-zone=-05:00')
    assert taken[1][5:] == [
        '--ask', 'shelve_alarms', '--alarm', 'residual', '--time-zone=-05:00',
    ]  # fmt: skip


def test_a_recording_on_a_page(tmp_path):
    """The page of a finished recording, as a process, until it is asked to end."""
    pytest.importorskip('dash', reason='the page is an extra')
    with socket.create_server(('127.0.0.1', 0)) as free:
        port = free.getsockname()[1]
    words = ['watch', '--page', '--port', str(port), str(recording(tmp_path / 'r'))]
    process = subprocess.Popen(
        [sys.executable, '-m', 'valveflow_ros.cli', *words], stderr=subprocess.PIPE, text=True
    )
    try:
        assert process.stderr.readline() == f'The page is at http://127.0.0.1:{port}/\n'
        deadline_s = time.monotonic() + 30.0
        while 'valveflow_curve_pieces{unit="U1"} 2.0' not in _metrics(port):
            assert time.monotonic() < deadline_s
            time.sleep(0.05)
        assert 'valveflow_monitor_up{unit="U1"} 0.0' in _metrics(port)
        process.send_signal(signal.SIGTERM)
        assert process.wait(20) in (0, 130)
        assert 'Traceback' not in process.stderr.read()
    finally:
        process.kill()
        process.wait()
        process.stderr.close()


def _metrics(port: int) -> str:
    with urllib.request.urlopen(f'http://127.0.0.1:{port}/metrics', timeout=10) as answer:
        return answer.read().decode()


@pytest.mark.parametrize(
    ('words', 'told'),
    [
        (['--page', '--once'], '--page does not go with --once'),
        (['--page', '--ask', 'refit'], '--page does not go with'),
        (['--page', '--token-file', 'x', 'LOG'], '--token-file is for a running monitor'),
        (['--webhook', 'http://a/'], 'go with --page'),
        (['--alarm', 'residual', 'LOG'], '--alarm goes with --ask'),
        (['--time-zone', 'Mars', 'LOG'], '--time-zone must be a time zone, such as'),
        (['--name', 'plant'], 'go with --page'),
        (['--page', '--port', '0'], '--port must be a port from 1 to 65535'),
    ],
)
def test_options_of_the_page_that_do_not_go_together(run, words, told):
    assert told in run('watch', *words).err


def test_without_its_libraries_the_page_is_told_of(run, monkeypatch, tmp_path):
    monkeypatch.setattr('valveflow_ros.page.server.find_spec', lambda name: None)
    sentence = run('watch', '--page', recording(tmp_path / 'r')).refused()
    assert 'pip install dash prometheus_client waitress' in sentence


def test_the_page_of_a_running_monitor_is_another_process(run, monkeypatch):
    taken = []
    monkeypatch.setattr(verb, 'find_spec', lambda name: name)
    monkeypatch.setattr(verb, 'check_installed', lambda: None)
    monkeypatch.setattr(os, 'execv', lambda path, words: taken.append(words) or _end())

    def _end():
        raise KeyboardInterrupt

    run('watch', '--page', '--node', '/a/b', '--webhook', 'http://a/', '--name', 'plant')
    assert taken[0][1:3] == ['-m', 'valveflow_ros.ros.page_main']
    assert taken[0][3:] == [
        '--host', '127.0.0.1', '--port', '8350', '--time-zone=', '--name', 'plant',
        '--node', '/a/b', '--webhook', 'http://a/',
    ]  # fmt: skip
