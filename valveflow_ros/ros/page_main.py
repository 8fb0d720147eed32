# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The executable `page`: shows monitors in the browser and serves metrics for Prometheus."""

from __future__ import annotations

import argparse
import contextlib
import queue
import sys
import time
from collections.abc import Sequence
from concurrent.futures import Future
from concurrent.futures import TimeoutError as NoAnswer
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.utilities import remove_ros_args
from valveflow_msgs.srv import OperateAlarm

from valveflow_ros.page.notices import Notices
from valveflow_ros.page.server import PageServer, check_installed, page_arguments, read_token
from valveflow_ros.page.unit import MOST_UNITS, AlarmChange, Shown, Snapshot, Unit
from valveflow_ros.records import zone_of
from valveflow_ros.report.terminal.text import zone_argument
from valveflow_ros.ros.domain import run, spinning
from valveflow_ros.ros.listening import Listener, full_name, hear_health, monitors, waiting_for
from valveflow_ros.ros.process import Parser, StopFlag

# Period of updates of the page, and of the search for monitors.
_SHOW_S, _LOOK_S = 0.5, 2.0
_ANSWER_S = 10.0


class PageNode(Node):
    """Subscribes to all running monitors, or to the named ones.

    Without names these are all that are found, at most `MOST_UNITS`.
    """

    def __init__(self, wanted: Sequence[str] = ()) -> None:
        super().__init__('valveflow_page', enable_rosout=False)
        self._wanted = tuple(dict.fromkeys(map(full_name, wanted)))
        self._units: dict[str, Unit] = {}
        self._listeners: dict[str, Listener] = {}
        self._asked: queue.Queue[tuple[str, str, Future[tuple[bool, str]]]] = queue.Queue(8)
        self._by_monitor: dict[str, Any] = {}
        self._left_out = 0
        hear_health(self, self._listeners)

    def look(self) -> None:
        """Look for monitors; a monitor that has ended is kept, because it may come back."""
        found = [name for name in monitors(self) if not self._wanted or name in self._wanted]
        for name in found:
            if name not in self._listeners and len(self._listeners) < MOST_UNITS:
                self._units[name] = Unit(name)
                self._listeners[name] = Listener(self, name, self._units[name])
        self._left_out = sum(name not in self._listeners for name in found)

    def show(self, shown: Shown) -> list[AlarmChange]:
        """Update ``shown``; return the changes of alarms since the last call."""
        units: list[Snapshot] = []
        changes: list[AlarmChange] = []
        for name in sorted(self._listeners):
            listener, unit = self._listeners[name], self._units[name]
            listener.tell()
            frame = unit.frame(name, listener.note)
            units.append(unit.snapshot(frame, listener.present))
            changes += unit.changes()
        shown.put(units, self._note())
        return changes

    def ask(self, monitor: str, asked: str) -> tuple[bool, str]:
        """Request an action on an alarm from a monitor; return success and a sentence.

        ``asked`` is action and alarm, such as 'shelve residual'. May be called from any thread.
        """
        answer: Future[tuple[bool, str]] = Future()
        try:
            self._asked.put_nowait((monitor, asked, answer))
            return answer.result(timeout=_ANSWER_S)
        except (queue.Full, NoAnswer):
            return False, (
                f'{monitor} does not answer; it is unknown whether the request was carried out.'
            )

    def pass_on(self) -> None:
        """Send the waiting requests to the monitors; the answers arrive while the node spins."""
        while not self._asked.empty():
            monitor, asked, answer = self._asked.get_nowait()
            action, _, name = asked.partition(' ')
            client = self._by_monitor.get(monitor)
            if client is None:
                client = self.create_client(OperateAlarm, f'{monitor}/operate_alarm')
                self._by_monitor[monitor] = client
            if not client.service_is_ready() and not client.wait_for_service(timeout_sec=0.5):
                answer.set_result((False, f'{monitor} is not there to be asked.'))
                continue

            def done(future: rclpy.Future, answer=answer) -> None:
                with contextlib.suppress(Exception):  # client or monitor may have gone
                    response = future.result()
                    answer.set_result((response.success, response.message))

            request = OperateAlarm.Request(name=name, action=action)
            client.call_async(request).add_done_callback(done)

    def _note(self) -> str:
        missing = [name for name in self._wanted if name not in self._listeners]
        if missing or not self._listeners:
            return waiting_for(' and '.join(missing))
        if self._left_out:
            return (
                f'{self._left_out} further monitors run; a page shows {MOST_UNITS} at most. '
                'Choose with --node NAME.'
            )
        return ''


def parser() -> argparse.ArgumentParser:
    """Return the command-line parser."""
    made = Parser(
        prog='page',
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description='Show running monitors on a page in the browser: curve, prediction against '
        'measurement,\nalarms, diagnosis, inputs, the last 24 hours. /metrics has the same for '
        'Prometheus.\n\nexamples:\n  ros2 run valveflow_ros page\n'
        '  ros2 run valveflow_ros page --node /unit1/valveflow_monitor --port 8351',
        epilog='ROS arguments follow --ros-args.',
    )
    made.add_argument(
        '--node', metavar='NAME', action='append', default=[],
        help='a monitor to show; may be given several times (default: every one that runs)',
    )  # fmt: skip
    page_arguments(made)
    zone_argument(made)
    return made


def main(args: Sequence[str] | None = None) -> int:
    """Serve the page until the process is asked to stop; return the exit status."""
    arguments = list(sys.argv if args is None else ['page', *args])
    options = parser().parse_args(remove_ros_args(arguments)[1:])
    stop = StopFlag().install()
    return run('page', arguments, lambda: _run(options, stop))


def _say(sentence: str) -> None:
    print(sentence, file=sys.stderr, flush=True)


def _run(options: argparse.Namespace, stop: StopFlag) -> int:
    check_installed()
    shown = Shown()
    shown.put((), waiting_for(' and '.join(map(full_name, options.node))))
    node = PageNode(options.node)
    with contextlib.ExitStack() as stack:
        executor = stack.enter_context(spinning(node))
        notices = stack.enter_context(
            contextlib.closing(Notices(options.on_alarm, options.webhook, _say))
        )
        asking = None
        if options.token_file is not None:
            from valveflow_ros.page.view import Asking

            asking = Asking(read_token(options.token_file), node.ask)
        server = stack.enter_context(contextlib.closing(PageServer(
            shown, options.host, options.port, options.name, asking, notices.counters, _say,
            zone_of(options.time_zone),
        )))  # fmt: skip
        _say(f'The page is at {server.address}')
        looked_s = -_LOOK_S
        while not stop:
            if time.monotonic() - looked_s >= _LOOK_S:
                node.look()
                looked_s = time.monotonic()
            end_s = time.monotonic() + _SHOW_S
            while not stop and (left_s := end_s - time.monotonic()) > 0.0:
                executor.spin_once(timeout_sec=min(left_s, 0.1))
                node.pass_on()
            notices.tell(node.show(shown))
    return 0


if __name__ == '__main__':
    sys.exit(main())
