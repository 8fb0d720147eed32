"""``valveflow watch``: look on while a monitor works."""

from __future__ import annotations

import dataclasses
import os
import sys
import time
from argparse import ArgumentParser, Namespace
from importlib.util import find_spec
from pathlib import Path
from typing import NoReturn

from valveflow_ros.cli.command import Console, VerbResult
from valveflow_ros.errors import DataError, UsageError
from valveflow_ros.report.terminal.text import number

_MODULE = 'valveflow_ros.ros.watch_main'
_TABLES = ('.csv', '.tsv', '.txt', '.parquet', '.pq', '.xlsx')

_DESCRIPTION = """\
Show how a monitor is doing, drawn anew once a second: the curve with today's operating point,
its age, the last residuals with their limits, alarms, inputs, recorder and diagnosis. With a
LOG it follows the recording of a monitor while it grows, also into further files; without one
it listens to a running monitor over ROS 2. Ctrl-C ends it.

example:
  valveflow watch valveflow_recordings

and over ROS 2, in a shell that has it:
  valveflow watch
  valveflow watch --ask acknowledge_alarms

Where the output is no terminal, each change is a line instead."""


def arguments(parser: ArgumentParser) -> None:
    """Add description, example and options."""
    parser.description = _DESCRIPTION
    parser.usage = 'valveflow watch [LOG] [options]'
    parser.add_argument(
        'log', metavar='LOG', type=Path, nargs='?',
        help='an .mcap or .mcap.part file, the folder of a recording, or a folder of recordings',
    )  # fmt: skip
    parser.add_argument('--once', action='store_true', help='print one picture, then stop')
    parser.add_argument(
        '--interval', metavar='S', default=1.0,
        type=number('a number of seconds', 0.1, 3600, '--interval 5'),
        help='seconds between two pictures (default 1)',
    )  # fmt: skip
    parser.add_argument(
        '--node', metavar='NAME',
        help='which monitor to listen to over ROS 2, such as /unit1/valveflow_monitor; '
        'found by itself where there is one',
    )  # fmt: skip
    parser.add_argument(
        '--ask', metavar='SERVICE',
        help='have the monitor do something: acknowledge_alarms, shelve_alarms, unshelve_alarms, '
        'set_reference, refit or diagnose; print its answer, then stop',
    )  # fmt: skip


def run(options: Namespace, console: Console) -> VerbResult:
    """Watch until there is nothing more to see."""
    if options.log is None:
        _watch_ros(options)
    if options.node is not None:
        raise UsageError('--node chooses a running monitor and does not go with a LOG.')
    if options.ask is not None:
        raise UsageError('--ask is for a running monitor and does not go with a LOG.')
    if options.log.suffix.lower() in _TABLES:
        raise UsageError(
            f'{options.log} is a table, which does not grow: look into it with '
            f'"valveflow info {options.log}".'
        )
    return _watch_log(options, console)


def _watch_log(options: Namespace, console: Console) -> VerbResult:
    """Follow a recording; Ctrl-C is the usual end."""
    from valveflow_ros.interface.recording_view import LogWatch
    from valveflow_ros.report.terminal.screen import Screen

    watch = LogWatch(options.log)
    if options.once:
        for _ in watch.read():
            console(watch.share, 'reading what was recorded so far')
        frame = watch.frame()
        return VerbResult(Screen(sys.stdout).text(frame), dataclasses.asdict(frame), drawn=True)
    if options.json:
        raise UsageError('--json goes with --once: one picture is one object.')
    drawn_s = -options.interval
    with Screen(sys.stdout) as screen:
        try:
            while True:
                for _ in watch.read():
                    # A long recording takes a while to catch up with, and that is to be seen.
                    if screen.in_place and time.monotonic() - drawn_s >= options.interval:
                        screen.show(watch.frame())
                        drawn_s = time.monotonic()
                screen.show(watch.frame())
                drawn_s = time.monotonic()
                if watch.finished and not screen.in_place:
                    break
                time.sleep(options.interval)
        except KeyboardInterrupt:
            # How one stops looking.
            return VerbResult('', {})
    return VerbResult('', {})


def _watch_ros(options: Namespace) -> NoReturn:
    """Become the process that listens over ROS."""
    missing = [name for name in ('rclpy', 'valveflow_msgs') if find_spec(name) is None]
    if missing:
        raise DataError(
            f'Listening to a running monitor needs ROS 2 ({" and ".join(missing)} not found). '
            'Source its setup first, or name the recording to follow: '
            'valveflow watch valveflow_recordings.'
        )
    words = ['--interval', str(options.interval)]
    words += ['--once'] if options.once else []
    words += ['--json'] if options.json else []
    words += ['--node', options.node] if options.node else []
    words += ['--ask', options.ask] if options.ask else []
    sys.stdout.flush()
    sys.stderr.flush()
    os.execv(sys.executable, [sys.executable, '-m', _MODULE, *words])
