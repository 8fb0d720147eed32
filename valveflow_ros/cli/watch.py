"""``valveflow watch``: look on while a monitor works."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from valveflow_ros.cli.console import Console, Outcome
from valveflow_ros.report.terminal.text import number

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


def run(options: Namespace, console: Console) -> Outcome:
    """Watch until there is nothing more to see."""
    from valveflow_ros.cli.usage import UsageError
    from valveflow_ros.cli.watch_run import watch_log, watch_ros

    if options.log is None:
        return watch_ros(options)
    if options.node is not None:
        raise UsageError('--node chooses a running monitor and does not go with a LOG.')
    if options.ask is not None:
        raise UsageError('--ask is for a running monitor and does not go with a LOG.')
    return watch_log(options, console)
