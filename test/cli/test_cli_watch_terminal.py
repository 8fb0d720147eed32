# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow watch`` on a terminal and to a pipe, while the recording grows."""

from __future__ import annotations

import os
import pty
import re
import select
import signal
import subprocess
import sys
import time

import pytest
from monitor_recording import Monitor, alarm, curve, diagnosis, recording


class Terminal:
    """A process on a terminal of its own."""

    def __init__(self, *words: str, **environment: str) -> None:
        self.text = ''
        self._master, slave = pty.openpty()
        self.process = subprocess.Popen(
            [sys.executable, '-m', 'valveflow_ros.cli', *words], stdin=slave, stdout=slave,
            stderr=slave, start_new_session=True,
            env={**os.environ, 'COLUMNS': '90', 'LINES': '26', 'TERM': 'xterm', **environment},
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )  # fmt: skip
        os.close(slave)

    def until(self, part: str, patience_s: float = 60.0) -> str:
        end_s = time.monotonic() + patience_s
        while part not in self.last():
            assert time.monotonic() < end_s, f'{part!r} did not come: {self.text[-2000:]!r}'
            self._take()
        return self.last()

    def last(self) -> str:
        """Return what was drawn last, without colours."""
        frame = self.text.rsplit('\x1b[H', 1)[-1]
        return re.sub(r'\r\n +', ' ', re.sub(r'\x1b\[[0-9;]*[A-Za-z]', '', frame))

    def end(self, number: int) -> int:
        self.process.send_signal(number)
        try:
            while self.process.poll() is None or select.select([self._master], [], [], 0)[0]:
                self._take()
        except OSError:
            pass
        os.close(self._master)
        return self.process.wait(timeout=30)

    def _take(self) -> None:
        if select.select([self._master], [], [], 0.1)[0]:
            self.text += os.read(self._master, 65536).decode(errors='replace')


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_what_happens_is_seen_until_ctrl_c(tmp_path, number):
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
    assert terminal.end(number) == 0
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
