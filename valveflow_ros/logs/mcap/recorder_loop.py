"""The recorder's thread: wakes, writes what waits, rotates, and gets over a failing disk."""

from __future__ import annotations

import enum
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs.mcap.folder import is_split_of
from valveflow_ros.logs.mcap.recover import RecoveryReport, recover_leftovers
from valveflow_ros.logs.mcap.writer import Message, Qos, RecordingWriter

# What a recorder is told and what it tells.

MIB = 1 << 20


class RecorderState(enum.Enum):
    """How a recorder is doing."""

    RECORDING = 'recording'
    DEGRADED = 'degraded'
    STOPPED = 'stopped'


@dataclass(frozen=True, slots=True)
class RecorderSettings:
    """How a recorder works; every time is in seconds.

    Attributes
    ----------
    queue_limit : int
        Messages held at most while they are not on disk; newer ones are dropped, and counted.
    flush_period_s : float
        A killed process loses at most what came in this time.
    sync_period_s : float
        A power cut loses at most what came in this time; 0: left to the system.
    rotate_s, rotate_bytes : float, int
        A new split is begun after this time or size.
    free_floor_bytes : int
        Below so much free space on the disk nothing is written.
    keep_files : int or None
        Finished splits that stay in the folder; the oldest go. None: all stay.
    retry_s, retry_max_s : float
        First and longest wait after a failure; it doubles.
    """

    queue_limit: int = 200_000
    flush_period_s: float = 0.5
    sync_period_s: float = 5.0
    rotate_s: float = 3600.0
    rotate_bytes: int = 256 * MIB
    free_floor_bytes: int = 500 * MIB
    keep_files: int | None = None
    retry_s: float = 1.0
    retry_max_s: float = 10.0


@dataclass(frozen=True, slots=True)
class RecorderStatus:
    """A recorder's account: ``received == written + queued + lost + sum of dropped``, always.

    Attributes
    ----------
    state : RecorderState
        How it is doing.
    reason : str
        Why it is not recording; empty if it is.
    file : str
        The split at hand, empty if none.
    received : int
        Messages handed in.
    written : int
        Of these, in whole chunks on disk.
    queued : int
        Of these, waiting.
    lost : int
        Of these, waiting when the recorder had to stop.
    dropped : dict[str, int]
        Of these, refused because too many were waiting, by topic.
    files_finished : int
        Splits finished since the start.
    bytes_written : int
        Bytes written since the start.
    recovered : tuple of RecoveryReport
        Leftovers of an earlier recorder that were finished at the start.
    stalled_s : float
        How long the thread has been at one and the same step; 0 while it waits for work. A disk
        that refuses keeps it small, one that does not answer lets it grow.
    """

    state: RecorderState
    reason: str = ''
    file: str = ''
    received: int = 0
    written: int = 0
    queued: int = 0
    lost: int = 0
    dropped: dict[str, int] = field(default_factory=dict)
    files_finished: int = 0
    bytes_written: int = 0
    recovered: tuple[RecoveryReport, ...] = ()
    stalled_s: float = 0.0


# The account of a recorder, kept so that every message is in exactly one column.


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


# More waiting messages than this wake the thread before its time.
_WAKE_AT = 4000


HeadMessages = Callable[[], Iterable[Message]]


class NewTopic(NamedTuple):
    """A topic on its way to the writer, in line with the messages."""

    topic: str
    type_name: str
    qos: Qos
    type_hash: str
    definition: str
    latched: bool


class RecorderLoop:
    """Runs the writer; `put`, `ask_rotation` and `stop` may be called from other threads."""

    def __init__(
        self,
        folder: Path,
        settings: RecorderSettings,
        make_writer: Callable[[HeadMessages], RecordingWriter],
        ledger: Ledger,
        free_bytes: Callable[[Path], int],
    ) -> None:
        self._folder = folder
        self._settings = settings
        self._make_writer = make_writer
        self._ledger = ledger
        self._free_bytes = free_bytes
        self._queue: deque[NewTopic | Message] = deque()
        self._latching: set[str] = set()
        self._fresh: dict[str, Message] = {}
        self._latched: dict[str, Message] = {}
        self._writer: RecordingWriter | None = None
        self._path: Path | None = None
        self._begun_at = self._synced_at = self._retry_at = 0.0
        self._retry_wait = settings.retry_s
        self.rotation_asked = False
        self._stopping = False
        self._wake = threading.Event()
        self._thread = threading.Thread(target=self._run, name='recorder', daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def latched(self) -> list[Message]:
        """Return the latched messages that a new split begins with."""
        return list(self._latched.values())

    def put(self, item: NewTopic | Message) -> None:
        """Hand in a topic or a message."""
        self._queue.append(item)
        if len(self._queue) >= _WAKE_AT:
            self._wake.set()

    def ask_rotation(self) -> None:
        """Begin a new split at the next opportunity."""
        self.rotation_asked = True
        self._wake.set()

    def stop(self, timeout_s: float) -> None:
        """Finish, and wait for it so long."""
        self._stopping = True
        self._wake.set()
        self._thread.join(timeout_s)

    def _run(self) -> None:
        try:
            stopping = False
            while not stopping:
                # Read before the cycle: what was put before `stop` is then in the queue.
                stopping = self._stopping
                begun = time.monotonic()
                self._cycle(stopping)
                if not stopping:
                    self._ledger.at_rest()
                    # What came while the disk was busy has waited long enough.
                    left = begun + self._settings.flush_period_s - time.monotonic()
                    self._wake.wait(max(0.0, left))
                    self._wake.clear()
            self._ledger.stopped(self._finish())
        except Exception as error:  # noqa: BLE001
            # Whatever it is, a dead thread must not look alive.
            self._ledger.stopped(f'the recorder failed: {type(error).__name__}: {error}')

    def _cycle(self, stopping: bool) -> None:
        now = time.monotonic()
        if now < self._retry_at and not stopping:
            return
        try:
            writer = self._ready()
            self._ledger.at_work()
            self._check_space(writer)
            self._drain(writer)
            self._ledger.at_work()
            writer.flush()
            # Only what stands in a split already is a repetition in the next.
            self._latched.update(self._fresh)
            self._fresh = {}
            self._ledger.at_work()
            self._keep_safe(writer, now)
            self._ledger.at_work()
            self._rotate(writer, now)
        except RecordingError as error:
            self._ledger.ill(str(error))
            self._retry_at = time.monotonic() + self._retry_wait
            self._retry_wait = min(2 * self._retry_wait, self._settings.retry_max_s)
        else:
            self._retry_at, self._retry_wait = 0.0, self._settings.retry_s
            self._ledger.well()
        finally:
            self._settle()

    def _ready(self) -> RecordingWriter:
        if self._writer is None:
            # A leftover takes as long as it is large; to be ended for that, again at each start,
            # would mean never to get past it.
            self._ledger.at_rest()
            self._ledger.recovered(recover_leftovers(self._folder))
            self._writer = self._make_writer(self.latched)
        return self._writer

    def _check_space(self, writer: RecordingWriter) -> None:
        floor = self._settings.free_floor_bytes
        try:
            free = self._free_bytes(self._folder)
        except OSError as error:
            raise RecordingError(self._folder, f'cannot be asked for space ({error})') from None
        if free < floor:
            # What is there becomes a whole file as long as that is possible.
            if writer.file_bytes:
                writer.close()
            problem = f'only {free // MIB} MiB are free, {floor // MIB} MiB must stay free'
            raise RecordingError(self._folder, problem)

    def _drain(self, writer: RecordingWriter) -> None:
        for _ in range(len(self._queue)):
            self._ledger.at_work()
            item = self._queue.popleft()
            if isinstance(item, NewTopic):
                self._add(writer, item)
                continue
            if item.topic in self._latching:
                self._fresh[item.topic] = item
            writer.write(item.topic, item.data, item.log_time_ns, item.publish_time_ns)

    def _add(self, writer: RecordingWriter, new: NewTopic) -> None:
        writer.add_topic(
            new.topic,
            new.type_name,
            qos=new.qos,
            type_hash=new.type_hash,
            definition=new.definition,
        )
        if new.latched:
            self._latching.add(new.topic)

    def _keep_safe(self, writer: RecordingWriter, now: float) -> None:
        period = self._settings.sync_period_s
        if period > 0 and now - self._synced_at >= period:
            writer.sync()
            self._synced_at = now

    def _rotate(self, writer: RecordingWriter, now: float) -> None:
        if writer.path != self._path:
            self._path, self._begun_at = writer.path, now
        old = now - self._begun_at >= self._settings.rotate_s
        large = writer.file_bytes >= self._settings.rotate_bytes
        asked, self.rotation_asked = self.rotation_asked, False
        if writer.file_bytes and (old or large or asked):
            writer.rotate()
            self._retire(writer)

    def _retire(self, writer: RecordingWriter) -> None:
        keep = self._settings.keep_files
        if keep is None:
            return
        # A recording of another name in the same folder is not ours to remove.
        own = [split for split in writer.finished if is_split_of(split.name, writer.name)]
        for split in own[: max(0, len(own) - keep)]:
            try:
                (self._folder / split.name).unlink(missing_ok=True)
            except OSError as error:
                problem = f'cannot be removed ({error.strerror})'
                raise RecordingError(self._folder / split.name, problem) from None
            writer.forget(split.name)

    def _settle(self) -> None:
        writer = self._writer
        if writer is not None:
            file = writer.path.name if writer.path is not None else ''
            size = writer.bytes_finished + writer.file_bytes
            self._ledger.settle(writer.written, file, writer.files_finished, size)

    def _finish(self) -> str:
        """Finish the file; return what kept it from being finished, empty if nothing did."""
        writer = self._writer
        if writer is None:
            return 'nothing could be recorded'
        try:
            writer.note('valveflow_recorder', self._ledger.counters())
            writer.close()
        except RecordingError as error:
            writer.abandon()
            return str(error)
        finally:
            self._settle()
        return ''
