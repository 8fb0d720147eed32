# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow watch``: the verb around the terminal view and the page."""

import os
import pty
import re
import select
import signal
import socket
import subprocess
import sys
import time
import urllib.request

import pytest
from monitor_recording import Monitor, alarm, curve, diagnosis, recording

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


@pytest.mark.parametrize(('words', 'module', 'handed_on'), [
    (['--once', '--node', '/a/b'], 'watch_main',
     ['--interval', '1.0', '--once', '--node', '/a/b', '--time-zone=']),
    (['--ask', 'shelve_alarms', '--alarm', 'residual', '--time-zone=-05:00'], 'watch_main',
     ['--interval', '1.0', '--ask', 'shelve_alarms', '--alarm', 'residual',
      '--time-zone=-05:00']),
    (['--page', '--node', '/a/b', '--webhook', 'http://a/', '--name', 'plant'], 'page_main',
     ['--host', '127.0.0.1', '--port', '8350', '--name', 'plant', '--node', '/a/b',
      '--webhook', 'http://a/', '--time-zone=']),
])  # fmt: skip
def test_with_ros_another_process_takes_over(run, monkeypatch, words, module, handed_on):
    def become(path, given):
        taken.append(given)
        raise KeyboardInterrupt

    taken = []
    monkeypatch.setattr(verb, 'find_spec', lambda name: name)
    monkeypatch.setattr(verb, 'check_installed', lambda: None)
    monkeypatch.setattr(os, 'execv', become)
    run('watch', *words)
    assert taken[0][1:] == ['-m', f'valveflow_ros.ros.{module}', *handed_on]


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


def _metrics(port):
    with urllib.request.urlopen(f'http://127.0.0.1:{port}/metrics', timeout=10) as answer:
        return answer.read().decode()


def test_options_that_do_not_go_together(run):
    for words, told in (
        ('--page --once', '--page does not go with --once'),
        ('--page --ask refit', '--page does not go with'),
        ('--page --token-file x LOG', '--token-file is for a running monitor'),
        ('--webhook http://a/', 'go with --page'),
        ('--name plant', 'go with --page'),
        ('--alarm residual LOG', '--alarm goes with --ask'),
        ('--time-zone Mars LOG', '--time-zone must be a time zone, such as'),
        ('--page --port 0', '--port must be a port from 1 to 65535'),
    ):
        assert told in run('watch', *words.split()).refused(2), words


def test_without_its_libraries_the_page_is_told_of(run, monkeypatch, tmp_path):
    monkeypatch.setattr('valveflow_ros.page.server.find_spec', lambda name: None)
    sentence = run('watch', '--page', recording(tmp_path / 'r')).refused()
    assert 'pip install dash prometheus_client waitress' in sentence


class Terminal:
    def __init__(self, *words, **environment):
        self.text = ''
        self._master, slave = pty.openpty()
        self.process = subprocess.Popen(
            [sys.executable, '-m', 'valveflow_ros.cli', *words], stdin=slave, stdout=slave,
            stderr=slave, start_new_session=True,
            env={**os.environ, 'COLUMNS': '90', 'LINES': '26', 'TERM': 'xterm', **environment},
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )  # fmt: skip
        os.close(slave)

    def until(self, part, patience_s=60.0):
        end_s = time.monotonic() + patience_s
        while part not in self.last():
            assert time.monotonic() < end_s, f'{part!r} did not come: {self.text[-2000:]!r}'
            self._take()
        return self.last()

    def last(self):
        """Return what was drawn last, without colours."""
        frame = self.text.rsplit('\x1b[H', 1)[-1]
        return re.sub(r'\r\n +', ' ', re.sub(r'\x1b\[[0-9;]*[A-Za-z]', '', frame))

    def end(self, number):
        self.process.send_signal(number)
        try:
            while self.process.poll() is None or select.select([self._master], [], [], 0)[0]:
                self._take()
        except OSError:
            pass
        os.close(self._master)
        return self.process.wait(timeout=30)

    def _take(self):
        if select.select([self._master], [], [], 0.1)[0]:
            self.text += os.read(self._master, 65536).decode(errors='replace')


def test_what_happens_is_seen_until_it_is_told_to_end(tmp_path):
    monitor = Monitor(tmp_path / 'r')
    monitor.say('characteristic', curve(monitor.now_ns))
    monitor.seconds(5)
    terminal = Terminal('watch', str(tmp_path / 'r'), '--interval', '0.1')
    terminal.until('recording, r_0.mcap')
    assert '\x1b[?1049h' in terminal.text
    monitor.writer.rotate()
    monitor.say('alarms', alarm(monitor.now_ns, 1, 'The unit gives less.'))
    monitor.seconds(5, residual=-6.0)
    shown = terminal.until('ALARM, not acknowledged')
    assert 'r_1.mcap' in shown
    assert '−6.0 MW' in shown
    monitor.writer.close()
    terminal.until('finished, r_1.mcap')
    assert terminal.end(signal.SIGTERM) == 0
    # The terminal is as it was, and nothing was said.
    assert terminal.text.endswith('\x1b[?25h\x1b[?1049l')
    assert 'Traceback' not in terminal.text


@pytest.mark.parametrize(('name', 'value'), [('NO_COLOR', '1'), ('TERM', 'dumb')])
def test_plain_terminals(tmp_path, name, value):
    terminal = Terminal(
        'watch', str(recording(tmp_path / 'r')), '--interval', '0.1', **{name: value}
    )
    terminal.until('ALARM, not acknowledged')
    # Line by line, a finished recording has an end of its own.
    terminal.end(signal.SIGINT if name == 'NO_COLOR' else 0)
    assert terminal.process.returncode == 0
    assert not re.search(r'\x1b\[[0-9;]*m', terminal.text)
    assert ('\x1b' in terminal.text) == (name == 'NO_COLOR')
    assert terminal.text.endswith('\x1b[?25h\x1b[?1049l') == (name == 'NO_COLOR')


def test_lines_to_a_pipe_come_as_it_happens(tmp_path):
    monitor = Monitor(tmp_path / 'r')
    monitor.seconds(2)
    process = subprocess.Popen(
        [sys.executable, '-m', 'valveflow_ros.cli', 'watch', str(tmp_path / 'r')],
        stdout=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    assert process.stdout is not None
    while 'recorder: recording' not in process.stdout.readline():
        assert process.poll() is None
    monitor.say('diagnosis', diagnosis(monitor.now_ns, 1, 'All is well.'))
    monitor.seconds(1)
    line = process.stdout.readline()
    assert 'diagnosis: no cause found' in line
    assert 'All is well.' in line
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=30) == 0
    process.stdout.close()
