"""What the executables say when they are asked, or typed wrongly: without a running ROS."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from valveflow_ros.ros import demo, replay_main, watch_main

_MODULES = ('monitor_main', 'simulator_main', 'replay_main', 'watch_main', 'demo')


@pytest.mark.parametrize('module', _MODULES)
def test_help_that_nobody_reads_to_its_end_is_no_accident(module):
    """As by ``monitor --help | head -1``: the pipe is closed before a letter is written."""
    reader, writer = os.pipe()
    os.close(reader)
    words = [sys.executable, '-m', f'valveflow_ros.ros.{module}', '--help']
    with os.fdopen(writer, 'w') as closed:
        ended = subprocess.run(
            words, stdout=closed, stderr=subprocess.PIPE, text=True, timeout=120, check=False
        )
    assert ended.returncode == 0, ended.stderr
    assert ended.stderr == ''


@pytest.mark.parametrize(
    ('parser', 'words', 'said'),
    [
        (
            replay_main.parser,
            ['x.mcap', '--rate', 'fast'],
            '--rate must be a number of seconds of the log',
        ),
        (replay_main.parser, ['x.mcap', '--wait', 'nan'], "such as --wait 60; 'nan' is not"),
        (watch_main.parser, ['--interval', '0'], "from 0.1 to 3600, such as --interval 5; '0' is"),
        (
            demo.parser,
            ['--output', 'd', '--days', '-1'],
            '--days must be a number of days',
        ),
        (demo.parser, ['--output', 'd', '--seed', 'x'], "'x' is no whole number"),
    ],
)
def test_what_is_no_number_is_refused_in_words(parser, words, said, capsys):
    with pytest.raises(SystemExit) as ended:
        parser().parse_args(words)
    assert ended.value.code == 2
    assert said in capsys.readouterr().err
