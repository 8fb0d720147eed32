"""The executable `monitor`: one loop, own signals, an orderly end."""

from __future__ import annotations

import gc
import os
import sys
import time
from collections.abc import Sequence

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.signals import SignalHandlerOptions

from valveflow_ros.config import TABLE
from valveflow_ros.errors import ValveflowError
from valveflow_ros.logs import RecorderStatus
from valveflow_ros.ros.monitor_node import MonitorNode
from valveflow_ros.ros.secure_start import check_security
from valveflow_ros.ros.sentences import one_line, with_place
from valveflow_ros.ros.stops import StopFlag
from valveflow_ros.ros.transport import ask_again, choose_transport
from valveflow_ros.ros.usage import show, usage, wants_help
from valveflow_ros.ros.watchdog import Watchdog

# A look costs the same for one message as for ten, and a plant is in no hurry. Where much
# comes, as from a replay, the next look follows at once.
_PERIOD_S = 0.02
_MUCH = 50
# Services may wait that long; a look of the executor costs as much as forty messages.
_SPIN_EVERY_S = 0.1
# The compiler works when a configuration runs for the first time, and an activation may go
# through what an earlier run recorded.
_LONGEST_START_S = 600.0


_ABOUT = """usage: monitor [--ros-args ...]

Watches valve opening, main steam pressure and temperature and generated power, and keeps the
flow characteristic of the main steam valve. It runs until it is asked to end (Ctrl-C)."""
_EXAMPLE = (
    'ros2 run valveflow_ros monitor --ros-args -p unit_tag:=U1 -p main_steam_pressure_unit:=bar'
)


class _Supervised(MonitorNode):
    """The node, telling its supervisor when it is to be patient."""

    def __init__(self, stop: StopFlag, watchdog: Watchdog) -> None:
        super().__init__(lambda: bool(stop))
        self._watchdog = watchdog

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        with self._watchdog.patient(_LONGEST_START_S):
            return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        with self._watchdog.patient(_LONGEST_START_S):
            return super().on_activate(state)

    def recorder_status(self) -> RecorderStatus | None:
        """Return the account of the recorder, None where none is at work."""
        return None if self.session is None else self.session.recording.status()


def main(args: Sequence[str] | None = None) -> int:
    """Run the monitor until it is asked to stop; return the exit status."""
    if wants_help(args):
        show(usage(_ABOUT, _EXAMPLE, TABLE))
        return 0
    # Recordings, logs and compiled code are nobody else's business, whatever the shell allowed.
    before = os.umask(0o077)
    try:
        return _main(args)
    finally:
        os.umask(before)


def _main(args: Sequence[str] | None) -> int:
    stop = StopFlag().install()
    try:
        choose_transport()
        check_security(args)
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    except ValveflowError as error:
        return _complain(str(error))
    except Exception as error:  # noqa: BLE001 - rclpy raises what its C++ gave it
        return _complain(f'ROS could not be started: {one_line(error)}')
    try:
        return _run(stop)
    except ValveflowError as error:
        return _complain(str(error))
    except Exception as error:  # noqa: BLE001 - a person is owed a sentence, not a trace
        return _complain(f'The monitor failed unexpectedly: {with_place(error)}')
    finally:
        stop.last()
        rclpy.try_shutdown()


def _run(stop: StopFlag) -> int:
    watchdog = Watchdog()
    node = _Supervised(stop, watchdog)
    ask_again()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        watchdog.status('Loading and compiling.')
        if node.settings.flag('autostart') and not _start(node):
            return 0 if stop else 1
        watchdog.ready('Listening.' if node.session else 'Waits to be configured.')
        # What is there now stays: the collector need not go through the compiler's objects again
        # and again.
        gc.collect()
        gc.freeze()
        _loop(node, executor, stop, watchdog)
        return 0
    finally:
        watchdog.stopping('Finishing the recording.')
        node.end_session()
        executor.shutdown(timeout_sec=0.5)
        node.destroy_node()


def _start(node: MonitorNode) -> bool:
    """Configure and activate."""
    for transition in (node.trigger_configure, node.trigger_activate):
        if transition() != TransitionCallbackReturn.SUCCESS:
            return False
    return True


def _loop(
    node: _Supervised, executor: SingleThreadedExecutor, stop: StopFlag, watchdog: Watchdog
) -> None:
    spin_s = 0.0
    while not stop and not node.finalized and rclpy.ok():
        begun_s = time.monotonic()
        found = node.step()
        if begun_s >= spin_s:
            spin_s = begun_s + _SPIN_EVERY_S
            executor.spin_once(timeout_sec=0)
        # Taken, fed, handed to the recorder: only a whole cycle counts.
        watchdog.completed(node.recorder_status)
        if found < _MUCH:
            time.sleep(max(0.0, begun_s + _PERIOD_S - time.monotonic()))


def _complain(sentence: str) -> int:
    print(f'valveflow monitor: {sentence}', file=sys.stderr)
    return 1


if __name__ == '__main__':
    sys.exit(main())
