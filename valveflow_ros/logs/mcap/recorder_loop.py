"""The recorder's thread: wakes, writes what waits, rotates, and gets over a failing disk."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs.mcap.folder import is_split_of
from valveflow_ros.logs.mcap.ledger import Ledger
from valveflow_ros.logs.mcap.qos import Qos
from valveflow_ros.logs.mcap.recorder_status import MIB, RecorderSettings
from valveflow_ros.logs.mcap.recover import recover_leftovers
from valveflow_ros.logs.mcap.writer import Message, RecordingWriter

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
