# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The executable `watch`: shows the state of a running monitor on a terminal."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Sequence
from datetime import tzinfo

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.utilities import remove_ros_args
from std_srvs.srv import Trigger
from valveflow_msgs.srv import OperateAlarm

from valveflow_ros.logs.outputs import finite
from valveflow_ros.records import NS_PER_S, zone_of
from valveflow_ros.report.terminal.board import CURVE, HEALTH, PREDICTION, MonitorState
from valveflow_ros.report.terminal.frame import Frame
from valveflow_ros.report.terminal.screen import Screen
from valveflow_ros.report.terminal.text import number, zone_argument
from valveflow_ros.report.words import duration
from valveflow_ros.ros.domain import run, spinning
from valveflow_ros.ros.listening import Listener, full_name, hear_health, monitors, waiting_for
from valveflow_ros.ros.node.outputs import SERVICES
from valveflow_ros.ros.process import Parser, complain

_LOOK_S = 0.5
# For --once: maximum time to find a monitor, and then to receive its health.
_FIND_S, _HEAR_S = 8.0, 3.0
_ANSWER_S = 10.0
# A monitor is the only one if no other was discovered so long after it.
_ALONE_S = 2.0
# Suffix of the services that act on all alarms.
_OF_ALARMS = '_alarms'


class WatchNode(Node):
    """Finds the monitor, subscribes, and stores what the terminal view needs.

    ``monitor`` is the name of its node; empty for the only running monitor.
    """

    def __init__(self, monitor: str = '') -> None:
        super().__init__('valveflow_watch', enable_rosout=False)
        self._wanted = full_name(monitor)
        self.several: tuple[str, ...] = ()
        self._alone_since_s: dict[str, float] = {}
        self._heard: dict[str, Listener] = {}
        hear_health(self, self._heard)

    @property
    def monitor(self) -> str:
        """Return the full name of the monitor's node; empty until it is found."""
        return next(iter(self._heard), '')

    @property
    def heard(self) -> set[str]:
        """Return the types of the messages received so far."""
        return set().union(*(listener.heard for listener in self._heard.values()))

    def look(self) -> None:
        """Look for the monitor if it is not found yet; without a name it must be the only one."""
        if self._heard:
            return
        found, now_s = monitors(self), time.monotonic()
        self.several = tuple(found) if len(found) > 1 and not self._wanted else ()
        if self._wanted:
            chosen = [self._wanted] if self._wanted in found else []
        else:
            # Nodes are discovered one after the other: the first is no reason to act on it.
            alone = found if len(found) == 1 else []
            self._alone_since_s = {name: self._alone_since_s.get(name, now_s) for name in alone}
            chosen = [
                n for n, since_s in self._alone_since_s.items() if now_s - since_s >= _ALONE_S
            ]
        for name in chosen:
            self._heard[name] = Listener(self, name, MonitorState())

    def frame(self) -> Frame:
        """Return the current content of the view."""
        listener = self._heard.get(self.monitor)
        if listener is not None:
            listener.tell()
            return listener.board.frame(self.monitor, listener.note)
        if self.several:
            note = f'Several monitors run: {", ".join(self.several)}. Choose with --node NAME.'
            return Frame(source='ROS 2', note=note)
        return Frame(source='ROS 2', note=waiting_for(self._wanted))


def parser() -> argparse.ArgumentParser:
    """Return the command-line parser."""
    made = Parser(
        prog='watch',
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description='Show how a running monitor is doing, drawn anew once a second: the curve '
        "with today's\noperating point, residuals, alarms, inputs, recorder, diagnosis. Ctrl-C "
        'ends it. With --ask\nhave the monitor do something.\n\nexamples:\n'
        '  ros2 run valveflow_ros watch --node /unit1/valveflow_monitor\n'
        '  ros2 run valveflow_ros watch --ask acknowledge_alarms',
        epilog='The same as "valveflow watch"; ROS arguments follow --ros-args.',
    )
    made.add_argument(
        '--node', metavar='NAME', default='', help='which monitor, if there are several'
    )
    made.add_argument('--once', action='store_true', help='print one picture, then stop')
    made.add_argument(
        '--interval', default=1.0, metavar='S',
        type=number('a number of seconds', 0.1, 3600, '--interval 5'),
        help='seconds between two pictures (default: 1)',
    )  # fmt: skip
    made.add_argument(
        '--json', action='store_true', help='with --once: print the picture as JSON, for programs'
    )
    zone_argument(made)
    made.add_argument(
        '--ask', metavar='SERVICE', choices=SERVICES,
        help=f'have the monitor do one of {", ".join(SERVICES)}; print its answer, then stop',
    )  # fmt: skip
    made.add_argument(
        '--alarm', metavar='NAME', default='',
        help='with --ask for alarms: only this one, residual or curve_shift',
    )  # fmt: skip
    return made


def main(args: Sequence[str] | None = None) -> int:
    """Show the monitor until the process is asked to stop; return the exit status."""
    arguments = list(sys.argv if args is None else ['watch', *args])
    made = parser()
    options = made.parse_args(remove_ros_args(arguments)[1:])
    if options.json and not options.once:
        made.error('--json goes with --once: one picture is one object')
    if options.ask and options.once:
        made.error('--ask and --once do not go together')
    if options.alarm and not str(options.ask).endswith(_OF_ALARMS):
        made.error('--alarm goes with --ask acknowledge_alarms, shelve_alarms or unshelve_alarms')
    return run('watch', arguments, lambda: _shown(options))


def _shown(options: argparse.Namespace) -> int:
    try:
        return _run(options)
    except KeyboardInterrupt:
        # Ctrl-C is the normal end.
        return 0
    except BrokenPipeError:
        # The reader of the output has ended.
        sys.stdout = None  # type: ignore[assignment]
        return 0


def _run(options: argparse.Namespace) -> int:
    node, zone = WatchNode(options.node), zone_of(options.time_zone)
    with spinning(node) as executor:
        if options.ask:
            return _ask(node, executor, options.ask, options.alarm)
        if options.once:
            return _once(node, executor, options.json, zone)
        with Screen(sys.stdout, zone=zone) as screen:
            while True:
                _listen(node, executor, options.interval)
                screen.show(node.frame())


def _listen(node: WatchNode, executor: SingleThreadedExecutor, seconds: float) -> None:
    """Process messages for some seconds."""
    end_s = time.monotonic() + seconds
    node.look()
    while (left_s := end_s - time.monotonic()) > 0.0:
        executor.spin_once(timeout_sec=min(left_s, _LOOK_S))


def _find(node: WatchNode, executor: SingleThreadedExecutor) -> bool:
    """Wait until the monitor is found; return False if it is not."""
    begun_s = time.monotonic()
    while not node.monitor and time.monotonic() - begun_s < _FIND_S:
        _listen(node, executor, 0.1)
    return bool(node.monitor)


def _ask(node: WatchNode, executor: SingleThreadedExecutor, service: str, alarm: str) -> int:
    if not _find(node, executor):
        return complain('watch', node.frame().note)
    if alarm:
        client = node.create_client(OperateAlarm, f'{node.monitor}/operate_alarm')
        request = OperateAlarm.Request(name=alarm, action=service.removesuffix(_OF_ALARMS))
    else:
        client = node.create_client(Trigger, f'{node.monitor}/{service}')
        request = Trigger.Request()
    if client.wait_for_service(timeout_sec=_FIND_S):
        answer = client.call_async(request)
        executor.spin_until_future_complete(answer, timeout_sec=_ANSWER_S)
        if answer.done():
            response = answer.result()
            told = f'{node.monitor}: {response.message}'
            if not response.success:
                return complain('watch', told)
            print(told, flush=True)
            return 0
    return complain(
        'watch',
        f'{node.monitor} does not answer; it is unknown whether the request was carried out.',
    )


def _once(
    node: WatchNode, executor: SingleThreadedExecutor, as_json: bool, zone: tzinfo | None
) -> int:
    if not _find(node, executor):
        return complain('watch', node.frame().note)
    found_s = time.monotonic()
    # Health and samples are published once a second; latched messages arrive at once.
    wanted = {CURVE, HEALTH, PREDICTION}
    while not wanted <= node.heard and time.monotonic() - found_s < _HEAR_S:
        _listen(node, executor, 0.1)
    frame = node.frame()
    if frame.last is None and not frame.note:
        frame = dataclasses.replace(frame, note=_no_sample(frame.now_ns))
    if as_json:
        content = finite(dataclasses.asdict(frame))
        print(json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False))
    else:
        print(Screen(sys.stdout, zone=zone).text(frame), flush=True)
    return 0


def _no_sample(shown_ns: int) -> str:
    """Return what to say of a picture whose time is that of an older message."""
    told = f'No sample was received within {_HEAR_S:g} s.'
    age_ns = time.time_ns() - shown_ns
    if shown_ns and age_ns >= 0:
        told += f' The newest message shown is {duration(age_ns / NS_PER_S)} old.'
    return told


if __name__ == '__main__':
    sys.exit(main())
