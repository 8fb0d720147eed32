"""The monitor at work: configure, activate, one loop, an orderly end."""

from __future__ import annotations

import contextlib
import gc
import os
import socket
import time
from collections.abc import Callable, Iterator, Mapping

from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn

from valveflow_ros.logs import RecorderState, RecorderStatus
from valveflow_ros.ros.domain import Presence
from valveflow_ros.ros.node.monitor_node import MonitorNode
from valveflow_ros.ros.process import StopFlag

# Tells systemd how the process is: ready, alive, ending. Silent where nobody listens.


# A recorder that has been at one step for longer is not counted on.
_STALL_S = 1.0


class Watchdog:
    """The service's end of the notify protocol, sd_notify(3).

    Where `NOTIFY_SOCKET` is not set nothing is ever sent. Pings are sent at
    twice the rate that `WATCHDOG_USEC` asks for, and only by `completed`: who
    calls it has just finished a cycle.

    Parameters
    ----------
    environ : mapping, optional
        Where the names of the protocol are looked up; the process's own by default.
    clock : callable
        Seconds by a clock that never goes back.
    """

    def __init__(
        self,
        environ: Mapping[str, str] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        environ = os.environ if environ is None else environ
        self._clock = clock
        self._address = _address(environ.get('NOTIFY_SOCKET', ''))
        self._usec = _interval_usec(environ) if self._address else 0
        self._next_s = 0.0

    @property
    def period_s(self) -> float:
        """Return the time between pings, 0 if none are asked for."""
        return self._usec / 2e6

    @property
    def stall_s(self) -> float:
        """Return how long a recorder may be at one step and still count as alive."""
        return min(_STALL_S, self.period_s)

    def ready(self, status: str) -> None:
        """Say that the start is done."""
        self._send(f'READY=1\nSTATUS={_line(status)}\nWATCHDOG=1')

    def status(self, status: str) -> None:
        """Say in a sentence what the process is at."""
        self._send(f'STATUS={_line(status)}')

    def stopping(self, status: str) -> None:
        """Say that the end has begun."""
        self._send(f'STOPPING=1\nSTATUS={_line(status)}')

    def completed(self, recorder: Callable[[], RecorderStatus | None]) -> None:
        """Ping, if it is time, after a cycle that came to its end.

        Parameters
        ----------
        recorder : callable
            Returns the account of the recorder, None where none is to be at work. It is asked
            only when a ping is due, and none is sent while the recorder is stuck.
        """
        now_s = self._clock()
        if not self._usec or now_s < self._next_s:
            return
        # What the manager did not take is sent again after the next cycle.
        if recorder_lives(recorder(), self.stall_s) and self._send('WATCHDOG=1'):
            self._next_s = now_s + self.period_s

    @contextlib.contextmanager
    def patient(self, limit_s: float) -> Iterator[None]:
        """Give one piece of work more time than a cycle has; afterwards the old limit holds."""
        if not self._usec:
            yield
            return
        self._send(f'WATCHDOG_USEC={max(self._usec, round(limit_s * 1e6))}\nWATCHDOG=1')
        try:
            yield
        finally:
            self._send(f'WATCHDOG_USEC={self._usec}\nWATCHDOG=1')

    def _send(self, text: str) -> bool:
        if self._address is None:
            return False
        # A manager that does not take a datagram at once must not hold up the loop.
        kind = socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK
        try:
            with socket.socket(socket.AF_UNIX, kind) as channel:
                channel.sendto(text.encode(), self._address)
        except OSError:
            return False
        return True


def recorder_lives(status: RecorderStatus | None, stall_s: float) -> bool:
    """Tell whether a recorder does what it is there for.

    One that keeps trying on a full disk does. One whose thread has ended, or has not come back
    from a step for longer than ``stall_s``, does not: only a new process can help it.
    """
    if status is None:
        return True
    return status.state != RecorderState.STOPPED and status.stalled_s <= stall_s


def _address(name: str) -> bytes | None:
    """Return the socket's address, None without one; an `@` stands for the abstract space."""
    if name.startswith('@') and len(name) > 1:
        return b'\0' + os.fsencode(name[1:])
    return os.fsencode(name) if name.startswith('/') else None


def _interval_usec(environ: Mapping[str, str]) -> int:
    """Return the interval asked for, 0 if none is or if it is another process's."""
    text = environ.get('WATCHDOG_USEC', '')
    meant_for = environ.get('WATCHDOG_PID', '') or str(os.getpid())
    usec = int(text) if text.isascii() and text.isdigit() and len(text) < 19 else 0
    return usec if meant_for == str(os.getpid()) else 0


def _line(text: str) -> str:
    """Return a text as one line: a line break would begin another assignment."""
    return ' '.join(text.split())


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
