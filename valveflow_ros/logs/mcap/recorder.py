# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Records in a separate thread, so that callers never wait for the disk."""

from __future__ import annotations

import enum
import math
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

from valveflow_ros.errors import InputError, RecordingError
from valveflow_ros.logs.mcap.definitions import Definitions
from valveflow_ros.logs.mcap.folder import is_split_of
from valveflow_ros.logs.mcap.recover import RecoveryReport, recover_leftovers
from valveflow_ros.logs.mcap.writer import Message, OpenFile, Qos, RecordingWriter
from valveflow_ros.logs.part_file import PART_SUFFIX, PartFile, make_folder
from valveflow_ros.logs.source import os_errors

# The state reports drops for this long, so that a reader that polls once a second sees them.
DROPS_SHOWN_S = 2.0
# Period of the check of finished files.
_LOOK_S = 2.0
_FLUSH_LOOK_S = 0.001
# Limit on the last check, so that `close` does not take long.
_LAST_LOOK_BYTES = 256 * 1024 * 1024
# This many waiting messages wake the thread early.
_WAKE_AT = 4000
MIB = 1 << 20


class RecorderState(enum.Enum):
    """State of a recorder."""

    RECORDING = 'recording'
    DEGRADED = 'degraded'
    STOPPED = 'stopped'


@dataclass(frozen=True, slots=True)
class RecorderSettings:
    """Settings of a recorder; every time is in seconds."""

    # Maximum number of messages not yet on disk; further messages are dropped and counted.
    queue_limit: int = 200_000
    flush_period_s: float = 0.5  # maximum time of messages that a killed process loses
    # Maximum time of messages that a power cut loses; 0 leaves it to the operating system.
    sync_period_s: float = 5.0
    # rotate_s, rotate_bytes: a new split is begun after this time or size
    rotate_s: float = 3600.0
    rotate_bytes: int = 256 * MIB
    # Nothing is written if the disk has less free space than this.
    free_floor_bytes: int = 500 * MIB
    # Number of finished splits to keep; older ones are deleted. None keeps all.
    keep_files: int | None = None
    # retry_s, retry_max_s: first and maximum wait after a failure; the wait doubles with every
    # failure
    retry_s: float = 1.0
    retry_max_s: float = 10.0


@dataclass(slots=True)
class RecorderStatus:
    """State and counters of a recorder.

    Always ``received == written + queued + lost + removed + sum of dropped``.
    """

    # state, reason: state of the recorder, and why it is not recording; empty if it is
    state: RecorderState
    reason: str = ''
    file: str = ''  # name of the current split on disk; empty if none
    received: int = 0  # messages passed to the recorder
    # written, queued: of these, messages in complete chunks of existing files, and that wait to be
    # written
    written: int = 0
    queued: int = 0
    # Of these, messages that waited when the recorder had to stop, or in files that another
    # program removed or changed while they were written, or damaged afterwards.
    lost: int = 0
    loss: str = ''  # a sentence about the last loss from a file; empty if there was none
    # Of these, messages in finished files deleted since, by ``keep_files`` or another program.
    removed: int = 0
    # Of these, messages refused because too many were waiting or the recorder was closed.
    dropped: dict[str, int] = field(default_factory=dict)
    # files_finished, bytes_written: splits finished and bytes written since the start
    files_finished: int = 0
    bytes_written: int = 0
    # Unfinished files of an earlier recorder that were recovered at the start.
    recovered: tuple[RecoveryReport, ...] = ()
    # Time since the thread began its current step; 0 while it waits for work. It stays small if
    # the disk returns errors, and grows if the disk does not respond.
    stalled_s: float = 0.0


class RecorderCounters:
    """Counts every message in exactly one counter of `RecorderStatus`.

    It is shared by the recorder's thread and its callers; its lock is held only briefly.
    """

    def __init__(self, limit: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._limit = clock, limit
        self._lock = threading.Lock()
        self._open, self._dropped_at = True, -math.inf
        self._now = RecorderStatus(RecorderState.RECORDING)
        self._drops = self._lost_in_files = 0
        self._working_since_s: float | None = None

    def working(self) -> None:
        """Note that the thread begins its next step; called for every message."""
        # A single assignment needs no lock, so that a stuck thread cannot hold one.
        self._working_since_s = self._clock()

    def resting(self) -> None:
        """Note that the thread waits for work, or does a step of unlimited duration."""
        self._working_since_s = None

    def admit(self, topic: str) -> bool:
        """Count a new message; return False if it must be dropped."""
        with self._lock:
            now = self._now
            now.received += 1
            if self._open and now.queued < self._limit:
                now.queued += 1
                return True
            now.dropped[topic] = now.dropped.get(topic, 0) + 1
            self._drops += 1
            self._dropped_at = self._clock()
            return False

    def refuse(self) -> None:
        """Drop all messages from now on."""
        with self._lock:
            self._open = False

    def on_disk(self, writer: RecordingWriter) -> None:
        """Copy the counters of a writer."""
        with self._lock:
            now = self._now
            before = now.written + now.removed + self._lost_in_files
            now.written, now.removed, now.loss = writer.written, writer.removed, writer.loss
            now.lost += writer.lost - self._lost_in_files
            self._lost_in_files = writer.lost
            now.queued -= now.written + now.removed + writer.lost - before
            # As it stands on disk until it is finished.
            now.file = f'{writer.path.name}{PART_SUFFIX}' if writer.path is not None else ''
            now.files_finished = writer.files_finished
            now.bytes_written = writer.bytes_finished + writer.file_bytes

    def healthy(self) -> None:
        """Set the state after all waiting messages were written."""
        with self._lock:
            self._now.state, self._now.reason = RecorderState.RECORDING, ''
            if self._clock() - self._dropped_at < DROPS_SHOWN_S:
                self._now.state = RecorderState.DEGRADED
                self._now.reason = f'{self._drops} messages were dropped, too many were waiting'

    def failing(self, reason: str) -> None:
        """Set the state while nothing can be written."""
        with self._lock:
            self._now.state, self._now.reason = RecorderState.DEGRADED, reason

    def recovered(self, reports: tuple[RecoveryReport, ...]) -> None:
        """Set the reports of recovered files."""
        self._now.recovered = reports

    def stopped(self, reason: str = '') -> None:
        """Set the final state; messages that still wait are counted as lost."""
        self.resting()
        with self._lock:
            self._open = False
            now = self._now
            now.lost, now.queued = now.lost + now.queued, 0
            now.state, now.reason, now.file = RecorderState.STOPPED, reason, ''

    def as_metadata(self) -> dict[str, str]:
        """Return the counters in the form written to the recording."""
        status = self.status()
        items = {f'dropped {topic}': str(count) for topic, count in status.dropped.items()}
        return {'received': str(status.received), **items}

    def status(self) -> RecorderStatus:
        """Return all counters at one moment."""
        since_s = self._working_since_s
        stalled_s = 0.0 if since_s is None else max(0.0, self._clock() - since_s)
        with self._lock:
            return replace(self._now, dropped=dict(self._now.dropped), stalled_s=stalled_s)


class NewTopic(NamedTuple):
    """A new topic for the writer, queued together with the messages."""

    topic: str
    type_name: str
    qos: Sequence[Qos]
    latched: bool


def free_bytes_of(folder: Path) -> int:
    """Return the free bytes on a folder's disk; raises `OSError`."""
    return shutil.disk_usage(folder).free


class Recorder:
    """Writes messages to a recording folder in a separate thread.

    Unfinished files of a recorder that died are recovered first. After a disk error the current
    file is left for `recover`, and a new one is begun when writing works again. Meanwhile messages
    wait; if too many wait, the newest are dropped and counted. Raises `RecordingError` if the
    folder cannot be created.

    Parameters
    ----------
    folder : str or Path
        The recording's folder; created if absent, otherwise continued.
    settings : RecorderSettings
        Periods and limits.
    name, definitions, attachments, open_file
        As in `RecordingWriter`.
    free_bytes : callable
        Returns the free bytes on the disk of a folder.
    """

    def __init__(
        self,
        folder: str | Path,
        settings: RecorderSettings | None = None,
        *,
        name: str | None = None,
        definitions: Definitions | None = None,
        attachments: Mapping[str, bytes] | None = None,
        open_file: OpenFile = PartFile,
        free_bytes: Callable[[Path], int] = free_bytes_of,
    ) -> None:
        self.folder = Path(folder)
        with os_errors(self.folder, 'cannot be made'):
            make_folder(self.folder)
        self._settings = settings or RecorderSettings()
        self._definitions = definitions or Definitions()
        self._topics: dict[str, str] = {}
        self._counters = RecorderCounters(self._settings.queue_limit)
        self._free_bytes = free_bytes
        self._queue: deque[NewTopic | Message] = deque()
        self._latching: set[str] = set()
        self._fresh: dict[str, Message] = {}
        self._latched: dict[str, Message] = {}
        self._make_writer = partial(
            RecordingWriter, self.folder, name=name, definitions=self._definitions,
            attachments=attachments, head_messages=self._latched.values, open_file=open_file,
        )  # fmt: skip
        self._writer: RecordingWriter | None = None
        self._path: Path | None = None
        self._begun_at = self._synced_at = self._retry_at = self._looked_at = 0.0
        self._retry_wait = self._settings.retry_s
        self._rotation_asked = self._stopping = False
        self._wake = threading.Event()
        self._thread = threading.Thread(target=self._run, name='recorder', daemon=True)
        self._thread.start()

    def add_topic(
        self,
        topic: str,
        type_name: str,
        *,
        qos: Sequence[Qos] = (Qos(),),
        latched: bool = False,
    ) -> None:
        """Add a topic before its first message; adding it again changes nothing.

        Raises `InputError` if the topic is already recorded with another type. Raises
        `RecordingError` if the definition of the type is not found or cannot be parsed.

        Parameters
        ----------
        topic, type_name : str
            Its full name and ``package/msg/Type``.
        qos : sequence of Qos
            QoS profile of each of its publishers.
        latched : bool
            If True, its last message is repeated at the start of every later split.
        """
        known = self._topics.get(topic)
        if known is not None:
            if known != type_name:
                raise InputError(f"Topic '{topic}' is recorded as {known}, not as {type_name}.")
            return
        # Read here, so that the caller hears of a problem; the thread then has it at hand.
        self._definitions.text(type_name)
        self._topics[topic] = type_name
        self._put(NewTopic(topic, type_name, qos, latched))

    def record(self, topic: str, data: bytes, log_time_ns: int, publish_time_ns: int) -> bool:
        """Queue a message of raw CDR bytes; never waits for the disk.

        Raises `InputError` if the topic was not added, or a time is outside of the range of a
        recording.

        Returns
        -------
        bool
            False if it was dropped and counted as such, because too many
            messages are waiting or the recorder was closed.
        """
        if topic not in self._topics:
            raise InputError(f"Topic '{topic}' was not made known to the recorder.")
        if not (0 <= log_time_ns < 1 << 63 and 0 <= publish_time_ns < 1 << 63):
            raise InputError(f"A message on '{topic}' has an impossible time.")
        if not self._counters.admit(topic):
            return False
        self._put(Message(topic, data, log_time_ns, publish_time_ns))
        return True

    def flush(self, timeout_s: float) -> bool:
        """Write all messages recorded so far to the file, where they survive a killed process.

        Returns
        -------
        bool
            False if they were not written within ``timeout_s`` or the recorder has stopped.
        """
        received = self.status().received
        until_s = time.monotonic() + timeout_s
        self._wake.set()
        while (status := self.status()).received - status.queued < received:
            if time.monotonic() >= until_s:
                return False
            time.sleep(_FLUSH_LOOK_S)
        return status.state != RecorderState.STOPPED

    def rotate(self) -> None:
        """Request a new split; returns immediately."""
        self._rotation_asked = True
        self._wake.set()

    @property
    def is_rotating(self) -> bool:
        """Return True if a requested split has not been begun yet."""
        return self._rotation_asked

    def status(self) -> RecorderStatus:
        """Return all counters at one moment."""
        return self._counters.status()

    def close(self, timeout_s: float = 2.0) -> RecorderStatus:
        """Write waiting messages and finish the file, within ``timeout_s``.

        If the disk is too slow, the thread is left running and the status
        gives the number of messages that still wait.
        """
        self._counters.refuse()
        self._stopping = True
        self._wake.set()
        self._thread.join(timeout_s)
        return self._counters.status()

    def _put(self, item: NewTopic | Message) -> None:
        self._queue.append(item)
        if len(self._queue) >= _WAKE_AT:
            self._wake.set()

    # The following methods run in the thread.

    def _run(self) -> None:
        try:
            stopping = False
            while not stopping:
                # Read before the cycle, so that messages put before `stop` are still written.
                stopping = self._stopping
                begun = time.monotonic()
                self._cycle(stopping)
                if not stopping:
                    self._counters.resting()
                    # The period counts from the start of the cycle, not from its end.
                    left = begun + self._settings.flush_period_s - time.monotonic()
                    self._wake.wait(max(0.0, left))
                    self._wake.clear()
            self._counters.stopped(self._finish())
        except Exception as error:  # noqa: BLE001
            # Report any error, so that a dead thread is not taken for a running one.
            self._counters.stopped(f'the recorder failed: {type(error).__name__}: {error}')

    def _cycle(self, stopping: bool) -> None:
        now = time.monotonic()
        if now < self._retry_at and not stopping:
            return
        try:
            writer = self._ready()
            self._counters.working()
            writer.check()
            if now - self._looked_at >= _LOOK_S:
                self._looked_at = now
                # A changed file is read again, which may take long and is not a stall.
                self._counters.resting()
                writer.check_finished()
                self._counters.working()
            self._check_space(writer)
            self._drain(writer)
            self._counters.working()
            writer.flush()
            # Only messages already written may be repeated in the next split.
            self._latched.update(self._fresh)
            self._fresh = {}
            self._counters.working()
            if 0 < self._settings.sync_period_s <= now - self._synced_at:
                writer.sync()
                self._synced_at = now
            self._counters.working()
            self._rotate(writer, now)
        except RecordingError as error:
            self._counters.failing(str(error))
            self._retry_at = time.monotonic() + self._retry_wait
            self._retry_wait = min(2 * self._retry_wait, self._settings.retry_max_s)
        else:
            self._retry_at, self._retry_wait = 0.0, self._settings.retry_s
            self._counters.healthy()
        finally:
            self._count()

    def _ready(self) -> RecordingWriter:
        if self._writer is None:
            # Recovering a large file takes long. It must not count as a stall: a watchdog that
            # ends the node for it would do so again at every start.
            self._counters.resting()
            self._counters.recovered(recover_leftovers(self.folder))
            self._writer = self._make_writer()
        return self._writer

    def _check_space(self, writer: RecordingWriter) -> None:
        floor = self._settings.free_floor_bytes
        try:
            free = self._free_bytes(self.folder)
        except OSError as error:
            raise RecordingError(self.folder, f'cannot be asked for space ({error})') from None
        if free < floor:
            # Finish the current file while there is still space for its index.
            if writer.file_bytes:
                writer.close()
            problem = f'only {free // MIB} MiB are free, {floor // MIB} MiB must stay free'
            raise RecordingError(self.folder, problem)

    def _drain(self, writer: RecordingWriter) -> None:
        for _ in range(len(self._queue)):
            self._counters.working()
            item = self._queue.popleft()
            if isinstance(item, NewTopic):
                writer.add_topic(item.topic, item.type_name, qos=item.qos)
                if item.latched:
                    self._latching.add(item.topic)
                continue
            if item.topic in self._latching:
                self._fresh[item.topic] = item
            writer.write(*item)

    def _rotate(self, writer: RecordingWriter, now: float) -> None:
        if writer.path != self._path:
            self._path, self._begun_at = writer.path, now
        old = now - self._begun_at >= self._settings.rotate_s
        large = writer.file_bytes >= self._settings.rotate_bytes
        asked, self._rotation_asked = self._rotation_asked, False
        if writer.file_bytes and (old or large or asked):
            writer.rotate()
            self._remove_old(writer)

    def _remove_old(self, writer: RecordingWriter) -> None:
        keep = self._settings.keep_files
        if keep is None:
            return
        # Splits of another recording in the same folder are kept.
        own = [split for split in writer.finished if is_split_of(split.name, writer.name)]
        for split in own[: max(0, len(own) - keep)]:
            try:
                (self.folder / split.name).unlink(missing_ok=True)
            except OSError as error:
                problem = f'cannot be removed ({error.strerror})'
                raise RecordingError(self.folder / split.name, problem) from None
            writer.forget(split.name)

    def _count(self) -> None:
        if self._writer is not None:
            self._counters.on_disk(self._writer)

    def _finish(self) -> str:
        """Finish the file; return why it could not be finished, empty if it was."""
        writer = self._writer
        if writer is None:
            return 'nothing could be recorded'
        reason = ''
        try:
            writer.note('valveflow_recorder', self._counters.as_metadata())
            writer.close()
        except RecordingError as error:
            writer.abandon()
            reason = str(error)
        try:
            if not writer.check_finished(_LAST_LOOK_BYTES):
                reason = reason or (
                    'Files that another program changed were not all read again; '
                    '`valveflow info` counts what is in them.'
                )
        except RecordingError as error:
            reason = reason or str(error)
        self._count()
        return reason
