"""Runs the terminal view: over a recording here, over ROS in a process of its own."""

from __future__ import annotations

import dataclasses
import os
import sys
import time
from argparse import Namespace
from importlib.util import find_spec

from valveflow_ros.cli.console import Console, Outcome
from valveflow_ros.cli.usage import UsageError
from valveflow_ros.cli.watch_log import LogWatch
from valveflow_ros.errors import DataError
from valveflow_ros.report.terminal.screen import Screen

_MODULE = 'valveflow_ros.ros.watch_main'
_TABLES = ('.csv', '.tsv', '.txt', '.parquet', '.pq', '.xlsx')


def watch_log(options: Namespace, console: Console) -> Outcome:
    """Follow a recording; Ctrl-C is the usual end.

    Raises
    ------
    RecordingError, UsageError
        There is no recording to follow.
    """
    if options.log.suffix.lower() in _TABLES:
        raise UsageError(
            f'{options.log} is a table, which does not grow: look into it with '
            f'"valveflow info {options.log}".'
        )
    watch = LogWatch(options.log)
    if options.once:
        return _once(watch, options, console)
    if options.json:
        raise UsageError('--json goes with --once: one picture is one object.')
    with Screen(sys.stdout) as screen:
        try:
            _follow(watch, screen, options.interval)
        except KeyboardInterrupt:
            # How one stops looking.
            return Outcome('', {})
    return Outcome('', {})


def _once(watch: LogWatch, options: Namespace, console: Console) -> Outcome:
    for _ in watch.read():
        console.progress(watch.share, 'reading what was recorded so far')
    frame = watch.frame()
    return Outcome(Screen(sys.stdout).text(frame), dataclasses.asdict(frame), drawn=True)


def _follow(watch: LogWatch, screen: Screen, interval_s: float) -> None:
    drawn_s = -interval_s
    while True:
        for _ in watch.read():
            # A long recording takes a while to catch up with, and that is to be seen.
            if screen.in_place and time.monotonic() - drawn_s >= interval_s:
                screen.show(watch.frame())
                drawn_s = time.monotonic()
        screen.show(watch.frame())
        drawn_s = time.monotonic()
        if watch.finished and not screen.in_place:
            return
        time.sleep(interval_s)


def watch_ros(options: Namespace) -> Outcome:
    """Become the process that listens over ROS.

    Raises
    ------
    DataError
        There is no ROS in this environment.
    """
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
