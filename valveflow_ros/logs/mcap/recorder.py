"""Records in a thread of its own; whoever hands messages in never waits for a disk."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

from valveflow_ros.errors import InputError, RecordingError
from valveflow_ros.logs.mcap.definitions import Definitions, full_name, parse_all
from valveflow_ros.logs.mcap.definitions import type_hash as hash_of
from valveflow_ros.logs.mcap.recorder_loop import (
    HeadMessages,
    Ledger,
    NewTopic,
    RecorderLoop,
    RecorderSettings,
    RecorderStatus,
)
from valveflow_ros.logs.mcap.records import LayoutError
from valveflow_ros.logs.mcap.writer import Message, Metadata, OpenFile, Qos, RecordingWriter
from valveflow_ros.logs.part_file import PartFile, make_folder


def free_bytes_of(folder: Path) -> int:
    """Return the free space of a folder's disk; raises `OSError`."""
    return shutil.disk_usage(folder).free


class Recorder:
    """Writes messages to a recording folder from a thread of its own.

    Leftovers of a recorder that died are finished first. After an error of
    the disk the file at hand is left for `recover`, and a new one is begun
    when writing works again; meanwhile messages wait, and when too many wait
    the newest are dropped and counted.

    Parameters
    ----------
    folder : str or Path
        The recording's folder; made if absent, continued if not.
    settings : RecorderSettings
        Periods and limits.
    name, definitions, attachments, metadata, open_file
        As in `RecordingWriter`.
    free_bytes : callable
        Tells the free space of a folder.

    Raises
    ------
    RecordingError
        If the folder cannot be made.
    """

    def __init__(
        self,
        folder: str | Path,
        settings: RecorderSettings | None = None,
        *,
        name: str | None = None,
        definitions: Definitions | None = None,
        attachments: Mapping[str, bytes] | None = None,
        metadata: Metadata | None = None,
        open_file: OpenFile = PartFile,
        free_bytes: Callable[[Path], int] = free_bytes_of,
    ) -> None:
        self.folder = Path(folder)
        try:
            make_folder(self.folder)
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            raise RecordingError(self.folder, f'cannot be made ({reason})') from None
        self._settings = settings or RecorderSettings()
        self._definitions = definitions or Definitions()
        self._topics: dict[str, str] = {}
        self._ledger = Ledger(self._settings.queue_limit)

        def make_writer(head_messages: HeadMessages) -> RecordingWriter:
            return RecordingWriter(
                self.folder,
                name=name,
                definitions=self._definitions,
                attachments=attachments,
                metadata=metadata,
                head_messages=head_messages,
                open_file=open_file,
            )

        self._loop = RecorderLoop(
            self.folder, self._settings, make_writer, self._ledger, free_bytes
        )
        self._loop.start()

    def add_topic(
        self,
        topic: str,
        type_name: str,
        *,
        qos: Qos | None = None,
        type_hash: str | None = None,
        definition: str | None = None,
        latched: bool = False,
    ) -> None:
        """Make a topic known before its first message; doing it again changes nothing.

        Parameters
        ----------
        topic, type_name : str
            Its full name and ``package/msg/Type``.
        qos : Qos, optional
            What its publisher offers.
        type_hash, definition : str, optional
            If the caller knows them better than `Definitions`.
        latched : bool
            Its last message is repeated at the head of every later split.

        Raises
        ------
        InputError
            If the topic is recorded with another type already.
        RecordingError
            If the definition of the type is not found or not understood.
        """
        known = self._topics.get(topic)
        if known is not None:
            if known != type_name:
                raise InputError(f"Topic '{topic}' is recorded as {known}, not as {type_name}.")
            return
        text = self._definitions.text(type_name) if definition is None else definition
        if type_hash is None:
            try:
                type_hash = hash_of(full_name(type_name), parse_all(type_name, text))
            except LayoutError as error:
                raise RecordingError(f"message type '{type_name}'", str(error)) from None
        self._topics[topic] = type_name
        self._loop.put(NewTopic(topic, type_name, qos or Qos(), type_hash, text, latched))

    def record(self, topic: str, data: bytes, log_time_ns: int, publish_time_ns: int) -> bool:
        """Hand in a message of raw CDR bytes.

        Returns
        -------
        bool
            False if it was dropped, because too many are waiting or the
            recorder was closed; it is counted.

        Raises
        ------
        InputError
            If the topic was not added, or a time lies outside of what a recording can hold.
        """
        if topic not in self._topics:
            raise InputError(f"Topic '{topic}' was not made known to the recorder.")
        if not (0 <= log_time_ns < 1 << 63 and 0 <= publish_time_ns < 1 << 63):
            raise InputError(f"A message on '{topic}' has an impossible time.")
        if not self._ledger.admit(topic):
            return False
        self._loop.put(Message(topic, data, log_time_ns, publish_time_ns))
        return True

    def rotate(self) -> None:
        """Ask for a new split; returns at once."""
        self._loop.ask_rotation()

    @property
    def is_rotating(self) -> bool:
        """Whether a split that was asked for has yet to be begun."""
        return self._loop.rotation_asked

    def status(self) -> RecorderStatus:
        """Return the account as it is now."""
        return self._ledger.status()

    def close(self, timeout_s: float = 2.0) -> RecorderStatus:
        """Write what is waiting and finish the file, within a bound.

        If the disk does not let it finish in time, the thread is left behind
        and the status says how many messages are still waiting.
        """
        self._ledger.refuse()
        self._loop.stop(timeout_s)
        return self._ledger.status()
