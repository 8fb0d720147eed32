"""The monitor at work: configure, activate, one loop, an orderly end."""

from __future__ import annotations

import gc
import time

from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn

from valveflow_ros.logs import RecorderStatus
from valveflow_ros.ros.node.monitor_node import MonitorNode
from valveflow_ros.ros.node.watchdog import Watchdog
from valveflow_ros.ros.presence import Presence
from valveflow_ros.ros.stops import StopFlag

# A look costs the same for one message as for ten, and a plant is in no hurry. Where much
# comes, as from a replay, the next look follows at once.
_PERIOD_S = 0.02
_MUCH = 50
# Services may wait that long; a look of the executor costs as much as forty messages.
_SPIN_EVERY_S = 0.1
# The compiler works when a configuration runs for the first time, and an activation may go
# through what an earlier run recorded.
_LONGEST_START_S = 600.0


class _Supervised(MonitorNode):
    """The node, telling its supervisor when it is to be patient."""

    def __init__(self, stop: StopFlag, watchdog: Watchdog, context: Context) -> None:
        super().__init__(lambda: bool(stop), context=context)
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


def run(stop: StopFlag, presence: Presence) -> int:
    """Watch until it is asked to stop; return the exit status."""
    if stop:
        return 0
    watchdog = Watchdog()
    node = _Supervised(stop, watchdog, presence.settle())
    presence.end()
    executor = SingleThreadedExecutor(context=node.context)
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
    while not stop and not node.finalized and node.context.ok():
        begun_s = time.monotonic()
        found = node.step()
        if begun_s >= spin_s:
            spin_s = begun_s + _SPIN_EVERY_S
            executor.spin_once(timeout_sec=0)
        # Taken, fed, handed to the recorder: only a whole cycle counts.
        watchdog.completed(node.recorder_status)
        if found < _MUCH:
            time.sleep(max(0.0, begun_s + _PERIOD_S - time.monotonic()))
