"""The account of a recorder, kept so that every message is in exactly one column."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable

from valveflow_ros.logs.mcap.recorder_status import RecorderState, RecorderStatus
from valveflow_ros.logs.mcap.recover import RecoveryReport

# So long after the last drop the state says so, for those who look once a second.
DROPS_SHOWN_S = 2.0


class Ledger:
    """Shared by the recorder's thread and everyone who asks; nobody holds it for long."""

    def __init__(self, limit: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._dropped_at = -math.inf
        self._lock = threading.Lock()
        self._limit = limit
        self._open = True
        self._received = self._written = self._queued = self._lost = 0
        self._dropped: dict[str, int] = {}
        self._drops = 0
        self._state, self._reason = RecorderState.RECORDING, ''
        self._file, self._files, self._bytes = '', 0, 0
        self._recovered: tuple[RecoveryReport, ...] = ()
        self._at_work_since_s: float | None = None

    def at_work(self) -> None:
        """Note that the thread has come to its next step; called for every message."""
        # One assignment, which needs no lock: a stuck thread must not be able to hold one either.
        self._at_work_since_s = self._clock()

    def at_rest(self) -> None:
        """Note that the thread waits, or does what takes as long as it takes."""
        self._at_work_since_s = None

    def admit(self, topic: str) -> bool:
        """Count a message in; False if it must be dropped."""
        with self._lock:
            self._received += 1
            if self._open and self._queued < self._limit:
                self._queued += 1
                return True
            self._dropped[topic] = self._dropped.get(topic, 0) + 1
            self._drops += 1
            self._dropped_at = self._clock()
            return False

    def refuse(self) -> None:
        """Drop whatever comes from now on."""
        with self._lock:
            self._open = False

    def settle(self, written: int, file: str, files: int, size: int) -> None:
        """Take note of how many messages are on disk in all, and where."""
        with self._lock:
            self._queued -= written - self._written
            self._written = written
            self._file, self._files, self._bytes = file, files, size

    def well(self) -> None:
        """All that waited could be written."""
        with self._lock:
            if self._clock() - self._dropped_at < DROPS_SHOWN_S:
                self._state = RecorderState.DEGRADED
                self._reason = f'{self._drops} messages were dropped, too many were waiting'
            else:
                self._state, self._reason = RecorderState.RECORDING, ''

    def ill(self, reason: str) -> None:
        """Say that nothing can be written for now."""
        with self._lock:
            self._state, self._reason = RecorderState.DEGRADED, reason

    def recovered(self, reports: tuple[RecoveryReport, ...]) -> None:
        """Take note of leftovers that were finished."""
        with self._lock:
            self._recovered = reports

    def stopped(self, reason: str = '') -> None:
        """Close the account: what waits now is lost."""
        self.at_rest()
        with self._lock:
            self._open = False
            self._lost += self._queued
            self._queued = 0
            self._state, self._reason, self._file = RecorderState.STOPPED, reason, ''

    def counters(self) -> dict[str, str]:
        """Return the account as it is written into the recording."""
        status = self.status()
        items = {f'dropped {topic}': str(count) for topic, count in status.dropped.items()}
        return {'received': str(status.received), **items}

    def status(self) -> RecorderStatus:
        """Return the account."""
        since_s = self._at_work_since_s
        stalled_s = 0.0 if since_s is None else max(0.0, self._clock() - since_s)
        with self._lock:
            return RecorderStatus(
                self._state,
                self._reason,
                self._file,
                self._received,
                self._written,
                self._queued,
                self._lost,
                dict(self._dropped),
                self._files,
                self._bytes,
                self._recovered,
                stalled_s,
            )
