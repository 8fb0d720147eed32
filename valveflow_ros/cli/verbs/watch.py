# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow watch``: display the state of a running monitor."""

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
from valveflow_ros.page.server import check_installed, page_arguments
from valveflow_ros.report.terminal.text import number, zone_argument

_MODULE, _PAGE_MODULE = 'valveflow_ros.ros.watch_main', 'valveflow_ros.ros.page_main'
# A day at one sample per second: the maximum that the page shows.
_DAY = 86_400
_TABLES = ('.csv', '.tsv', '.txt', '.parquet', '.pq', '.xlsx')

USAGE = '[LOG] [options]'
DESCRIPTION = """\
Show the state of a monitor, updated every second: the curve with today's operating point,
its age, the last residuals with their limits, alarms, inputs, recorder and diagnosis. With a
LOG it follows the recording of a monitor while it grows, also into further files; without one
it listens to a running monitor over ROS 2. Ctrl-C ends it.

example:
  valveflow watch valveflow_recordings

and over ROS 2, in a shell that has it:
  valveflow watch
  valveflow watch --ask acknowledge_alarms

If the output is no terminal, each change is written as a line. With --page it is shown on a page
in the browser, with metrics for Prometheus; that needs pip install dash
prometheus-client waitress."""


def arguments(parser: ArgumentParser) -> None:
    """Add the options."""
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
    for option, metavar, told in (
        ('node', 'NAME',
         'which monitor to listen to over ROS 2, such as /unit1/valveflow_monitor; found by '
         'itself where there is one'),
        ('ask', 'SERVICE',
         'call a service of the monitor: acknowledge_alarms, shelve_alarms, unshelve_alarms, '
         'set_reference, refit or diagnose; print its answer, then stop'),
        ('alarm', 'NAME', 'with --ask for alarms: only this one, residual or curve_shift'),
    ):  # fmt: skip
        parser.add_argument(f'--{option}', metavar=metavar, help=told)
    parser.add_argument(
        '--page', action='store_true', help='show it on a page in the browser; options for it:'
    )
    page_arguments(parser)
    zone_argument(parser)


def run(options: Namespace, console: Console) -> VerbResult:
    """Watch until the recording ends or the user stops."""
    _check_together(options)
    if options.log is None:
        _watch_ros(options)
    for option, told in (
        ('node', '--node chooses a running monitor and does not go with a LOG.'),
        ('alarm', '--alarm goes with --ask.'),
        ('ask', '--ask is for a running monitor and does not go with a LOG.'),
    ):
        if getattr(options, option) is not None:
            raise UsageError(told)
    if options.log.suffix.lower() in _TABLES:
        raise UsageError(
            f'{options.log} is a table, which does not grow: look into it with '
            f'"valveflow info {options.log}".'
        )
    return _page_of_log(options, console) if options.page else _watch_log(options, console)


def _check_together(options: Namespace) -> None:
    """Raise `UsageError` for options that exclude each other."""
    if options.page:
        if options.once or options.json or options.ask is not None or options.alarm is not None:
            raise UsageError('--page does not go with --once, --json, --ask or --alarm.')
        if options.log is not None and options.token_file is not None:
            raise UsageError('--token-file is for a running monitor and does not go with a LOG.')
        check_installed()
        return
    if (options.on_alarm, options.webhook, options.token_file) != (None,) * 3 or options.name:
        raise UsageError('--on-alarm, --webhook, --token-file and --name go with --page.')


def _page_of_log(options: Namespace, console: Console) -> VerbResult:
    """Show a growing recording on a page; it usually ends with Ctrl-C."""
    from valveflow_ros.interface.recording_view import LogWatch
    from valveflow_ros.page.notices import Notices
    from valveflow_ros.page.server import PageServer
    from valveflow_ros.page.unit import Shown, Unit
    from valveflow_ros.records import zone_of
    from valveflow_ros.report.terminal.screen import ending

    unit = Unit(str(options.log))
    watch = LogWatch(options.log, unit, _DAY)
    shown = Shown()
    shown.put((), 'Reading what was recorded so far.')
    notices = Notices(options.on_alarm, options.webhook, console.warn)
    server: PageServer | None = None
    try:
        with ending():
            server = PageServer(
                shown, options.host, options.port, options.name, counters=notices.counters,
                complain=console.warn, zone=zone_of(options.time_zone),
            )  # fmt: skip
            console.say(f'The page is at {server.address}')
            while True:
                for _ in watch.read():
                    percent = f'{100.0 * watch.share:.0f} %'
                    if not shown.units:
                        shown.put((), f'Reading what was recorded so far: {percent}.')
                shown.put((unit.snapshot(watch.frame(), present=not watch.finished),))
                notices.tell(unit.changes())
                time.sleep(options.interval)
    except KeyboardInterrupt:
        # The usual end.
        return VerbResult('', {})
    finally:
        if server is not None:
            server.close()
        notices.close()


def _watch_log(options: Namespace, console: Console) -> VerbResult:
    """Follow a growing recording; it usually ends with Ctrl-C."""
    from valveflow_ros.interface.recording_view import LogWatch
    from valveflow_ros.records import zone_of
    from valveflow_ros.report.terminal.screen import Screen

    watch, zone = LogWatch(options.log), zone_of(options.time_zone)
    if options.once:
        for _ in watch.read():
            console(watch.share, 'reading what was recorded so far')
        frame = watch.frame()
        return VerbResult(
            Screen(sys.stdout, zone=zone).text(frame), dataclasses.asdict(frame), drawn=True
        )
    if options.json:
        raise UsageError('--json goes with --once: one picture is one object.')
    drawn_s = -options.interval
    with Screen(sys.stdout, zone=zone) as screen:
        try:
            while True:
                for _ in watch.read():
                    # Reading a long recording takes time; show the progress.
                    if screen.in_place and time.monotonic() - drawn_s >= options.interval:
                        screen.show(watch.frame())
                        drawn_s = time.monotonic()
                screen.show(watch.frame())
                drawn_s = time.monotonic()
                if watch.finished and not screen.in_place:
                    break
                time.sleep(options.interval)
        except KeyboardInterrupt:
            pass  # the usual end
    return VerbResult('', {})


def _watch_ros(options: Namespace) -> NoReturn:
    """Replace this process by the one that listens to ROS."""
    missing = [name for name in ('rclpy', 'valveflow_msgs') if find_spec(name) is None]
    if missing:
        raise DataError(
            f'Listening to a running monitor needs ROS 2 ({" and ".join(missing)} not found). '
            'Source its setup first, or name the recording to follow: '
            'valveflow watch valveflow_recordings.'
        )
    if options.page:
        module, words = _PAGE_MODULE, ['--host', options.host, '--port', str(options.port)]
        words += [word for name in options.name for word in ('--name', name)]
        handed: tuple[str, ...] = ('node', 'token_file', 'on_alarm', 'webhook')
    else:
        module, words = _MODULE, ['--interval', str(options.interval)]
        words += [f'--{name}' for name in ('once', 'json') if getattr(options, name)]
        handed = ('node', 'ask', 'alarm')
    for option in handed:
        given = getattr(options, option)
        words += [] if given is None else [f'--{option.replace("_", "-")}', str(given)]
    sys.stdout.flush()
    sys.stderr.flush()
    words.append(f'--time-zone={options.time_zone}')
    os.execv(sys.executable, [sys.executable, '-m', module, *words])
