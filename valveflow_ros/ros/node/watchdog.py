"""Tells systemd how the process is: ready, alive, ending. Silent where nobody listens."""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Callable, Iterator, Mapping

from valveflow_ros.logs import RecorderState, RecorderStatus

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
