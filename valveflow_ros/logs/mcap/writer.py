# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Writes a recording: a folder of MCAP splits that standard ROS 2 tools can read."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from mcap.records import Channel, Schema
from mcap.well_known import MessageEncoding, SchemaEncoding

from valveflow_ros.errors import InputError, counted
from valveflow_ros.logs.mcap import folder as splits
from valveflow_ros.logs.mcap.chunk_file import CHUNK_BYTES, ChunkBuilder, ChunkFile
from valveflow_ros.logs.mcap.definitions import Definitions, parse_all, type_hash
from valveflow_ros.logs.mcap.folder import METADATA_NAME, Split, finished_splits
from valveflow_ros.logs.mcap.records import LayoutError, TopicTable, pack
from valveflow_ros.logs.mcap.recover import intact_messages
from valveflow_ros.logs.part_file import PART_SUFFIX, AlteredError, PartFile, make_folder, mark_of
from valveflow_ros.logs.source import os_errors

# rosbag2 writes the longest duration of ROS 2 for "no limit".
_NO_LIMIT = ':\n    sec: 9223372036\n    nsec: 854775807'


@dataclass(frozen=True, slots=True)
class Qos:
    """QoS profile that the publisher of a topic offers, with the terms of rosbag2."""

    reliability: str = 'reliable'
    durability: str = 'volatile'
    history: str = 'keep_last'
    depth: int = 10

    def text(self) -> str:
        """Return this profile as an item of the YAML list in a channel's metadata."""
        return (
            f'- history: {self.history}\n'
            f'  depth: {self.depth}\n'
            f'  reliability: {self.reliability}\n'
            f'  durability: {self.durability}\n'
            f'  deadline{_NO_LIMIT}\n'
            f'  lifespan{_NO_LIMIT}\n'
            '  liveliness: automatic\n'
            f'  liveliness_lease_duration{_NO_LIMIT}\n'
            '  avoid_ros_namespace_conventions: false'
        )


LATCHED = Qos(durability='transient_local', depth=1)


@dataclass(slots=True)
class TopicRegistry:
    """Assigns ids to topics and types in the order in which they are added."""

    definitions: Definitions
    table: TopicTable = field(default_factory=TopicTable)
    ids: dict[str, int] = field(default_factory=dict)
    _schema_ids: dict[str, int] = field(default_factory=dict)
    _packed: bytes = b''

    def add(
        self,
        topic: str,
        type_name: str,
        qos: Sequence[Qos] = (Qos(),),
        definition: str | None = None,
    ) -> None:
        """Add a topic; adding it again changes nothing.

        Raises `InputError` if the topic was added before with another type. Raises
        `RecordingError` if the definition of the type is not found.
        """
        if topic in self.ids:
            have = self.table.type_of(self.table.channels[self.ids[topic]])
            if have != type_name:
                raise InputError(f"Topic '{topic}' is recorded as {have}, not as {type_name}.")
            return
        if type_name not in self._schema_ids:
            text = self.definitions.text(type_name) if definition is None else definition
            number = self._schema_ids[type_name] = len(self._schema_ids) + 1
            self.table.schemas[number] = Schema(
                id=number, name=type_name, encoding=SchemaEncoding.ROS2, data=text.encode()
            )
        offered = '\n'.join(profile.text() for profile in qos)
        number = self.ids[topic] = len(self.ids) + 1
        self.table.channels[number] = Channel(
            id=number, topic=topic, message_encoding=MessageEncoding.CDR,
            metadata={
                'offered_qos_profiles': offered,
                'topic_type_hash': self._hash(type_name, definition),
            },
            schema_id=self._schema_ids[type_name],
        )  # fmt: skip
        self._packed = b''

    def _hash(self, type_name: str, definition: str | None) -> str:
        if definition is None:
            return self.definitions.type_hash(type_name)
        try:
            return type_hash(type_name, parse_all(type_name, definition))
        except LayoutError:
            # Readers do not need the hash.
            return ''

    def packed(self) -> bytes:
        """Return the records of all topics."""
        if not self._packed:
            self._packed = pack(*self.table.schemas.values(), *self.table.channels.values())
        return self._packed


_SPLITS_APART, _NUMBERS_APART = 64, 1 << 26

OpenFile = Callable[[Path], PartFile]


class Message(NamedTuple):
    """A message to record: raw CDR bytes and its times."""

    topic: str
    data: bytes
    log_time_ns: int
    publish_time_ns: int


@dataclass(slots=True)
class _File:
    """A split that this writer wrote, with the `mark_of` its file.

    ``own`` messages came from `RecordingWriter.write`; ``messages`` is the total.
    """

    path: Path
    own: int = 0
    messages: int = 0
    mark: tuple[int, ...] | None = None


class RecordingWriter:
    """Writes to one recording folder, from one thread.

    An existing folder is continued: the numbers of the splits go on, and `metadata.yaml` covers
    all finished splits. A file is created with its first chunk. After a `RecordingError` the
    current file is abandoned. The messages that were not on disk are kept, and the next `flush`
    writes them to a new file. If another program removed the file or the folder, a new one is
    created, and the messages in it are counted as lost. Raises `RecordingError` if the folder
    cannot be created or used.

    Parameters
    ----------
    folder : str or Path
        The folder; created if absent, with access for the owner only.
    name : str, optional
        Splits are named ``NAME_0.mcap``, ...; by default the name of the folder.
    definitions : Definitions, optional
        Source of the message definitions.
    attachments : mapping of str
        Files to attach to every split, such as parameters and model.
    head_messages : callable
        Returns the latched messages that are repeated at the start of every split but the first.
    open_file : callable
        Opens a split for writing.
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        name: str | None = None,
        definitions: Definitions | None = None,
        attachments: Mapping[str, bytes] | None = None,
        head_messages: Callable[[], Iterable[Message]] = tuple,
        open_file: OpenFile = PartFile,
    ) -> None:
        self.folder = Path(folder)
        self.name = name or self.folder.resolve().name
        self.attachments: dict[str, bytes] = dict(attachments or {})
        # removed: messages in finished splits that were removed since, by `forget` or by another
        # program
        # lost: messages written to a file that was damaged, or that was removed before it was
        # finished
        self.lost = self.removed = self.bytes_finished = self.files_finished = 0
        self.loss = ''  # a sentence about the last loss; empty if nothing was lost
        self.path: Path | None = None
        self._open_file = open_file
        self._head_messages = head_messages
        self._files: list[_File] = []
        self._damaged: set[str] = set()
        self._listed: tuple[int, ...] | None = None
        self._at_hand = _File(Path())
        self._number, self._begun = -1, 0
        self._topics = TopicRegistry(definitions or Definitions())
        self._builder = ChunkBuilder()
        self._file: ChunkFile | None = None
        self._sequences: dict[int, int] = {}
        self._on_disk: dict[int, int] = {}  # the same, without waiting messages
        self._list_due = False
        with os_errors(self.folder, 'cannot be written'):
            make_folder(self.folder)
            self._splits = finished_splits(self.folder)
        # Sequence numbers start elsewhere in a continued folder, because a reader detects
        # repeated messages by them. No split holds enough messages for the ranges to overlap.
        self._before = (self._next_number() % _SPLITS_APART) * _NUMBERS_APART

    def add_topic(
        self,
        topic: str,
        type_name: str,
        *,
        qos: Sequence[Qos] = (Qos(),),
        definition: str | None = None,
    ) -> None:
        """Add a topic before its first message; see `TopicRegistry.add`."""
        self._topics.add(topic, type_name, qos, definition)

    def write(self, topic: str, data: bytes, log_time_ns: int, publish_time_ns: int) -> None:
        """Add a message of raw CDR bytes; every 64 KiB of messages are written as a chunk.

        Raises `RecordingError` if a chunk could not be written; the message is kept. Raises
        `KeyError` if the topic was not added.
        """
        channel = self._topics.ids[topic]
        sequence = self._sequences.get(channel, self._before) + 1
        self._sequences[channel] = sequence
        self._builder.add(channel, sequence, log_time_ns, publish_time_ns, data)
        if self._builder.size >= CHUNK_BYTES:
            self.flush()

    @property
    def written(self) -> int:
        """Number of messages from `write` that a reader finds in the folder."""
        return sum(file.own for file in self._files)

    @property
    def waiting(self) -> int:
        """Number of messages from `write` that are not on disk yet."""
        return len(self._builder)

    @property
    def finished(self) -> list[Split]:
        """The finished splits of the folder."""
        return list(self._splits.values())

    @property
    def file_bytes(self) -> int:
        """Bytes written to the current split."""
        return self._file.position if self._file is not None else 0

    def flush(self) -> None:
        """Pass waiting messages to the operating system, where they survive a killed process."""
        if len(self._builder):
            self.check()
            with self._writing():
                self._put(self._begin())

    def check(self) -> None:
        """Check that the folder and the current split are as they were written.

        If another program removed or replaced them, the folder is created again and the split is
        abandoned. Its messages are counted as lost, and the next `flush` begins a new split.
        Raises `RecordingError` if the check fails, or the folder cannot be created.
        """
        with os_errors(self.folder, 'cannot be made'):
            make_folder(self.folder)
        if self._file is not None:
            with self._writing():
                self._file.check()

    def check_finished(self, most_bytes: int = 64 << 20) -> bool:
        """Check that the finished splits are unchanged, and count the messages that are not there.

        `metadata.yaml` is updated. A changed split is read again, which takes time. After about
        ``most_bytes`` bytes the remaining splits are left for the next call.

        Returns
        -------
        bool
            True if all splits were checked.
        """
        changed, left = False, most_bytes
        for file in list(self._files):
            mark = mark_of(file.path)
            if file is self._at_hand or (mark is not None and file.mark == mark):
                continue
            size = 0 if mark is None else mark[2]
            if left > 0 or not size:
                left -= size
                changed = True
                self._recount(file)
        if changed or (self._splits and self._listed != mark_of(self.folder / METADATA_NAME)):
            self._list()
        return left > 0

    def sync(self) -> None:
        """Write what was flushed to the disk itself, where it survives a power cut."""
        if self._file is not None:
            with self._writing():
                self._file.sync()

    def note(self, name: str, items: Mapping[str, str]) -> None:
        """Write a metadata record to the current split, if there is one."""
        if self._file is not None:
            with self._writing():
                self._file.put_metadata(name, items)

    def rotate(self) -> None:
        """Finish the current split; the next flush begins a new one."""
        self.flush()
        self._finish()

    def close(self) -> None:
        """Finish the recording; a later `write` begins a new split."""
        self.rotate()

    def abandon(self) -> None:
        """Close the current split unfinished; `recover` can complete it."""
        if self._file is not None:
            self._file.abandon()
            at_hand, self._at_hand = self._at_hand, _File(Path())
            part = at_hand.path.with_name(f'{at_hand.path.name}{PART_SUFFIX}')
            # Its content is not verified: without a mark, `check_finished` counts it again.
            at_hand.path, at_hand.mark = part, None
            if not at_hand.own:
                self._files.remove(at_hand)
            self._file = self.path = None

    def forget(self, name: str) -> None:
        """Remove a deleted split from `metadata.yaml`."""
        self._splits.pop(name, None)
        for file in [file for file in self._files if file.path.name == name]:
            self._take_out(file)
        self._list()

    def __enter__(self) -> RecordingWriter:
        """Return itself."""
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        """Finish the recording, or leave it unfinished after an error."""
        if kind is None:
            self.close()
        else:
            self.abandon()

    def _put(self, file: ChunkFile) -> None:
        due = file.table_due(len(self._topics.ids))
        chunk = self._builder.build(self._topics.packed() if due else b'')
        before = file.messages
        try:
            file.put_chunk(chunk)
        finally:
            # A complete chunk is not written again, even if writing its index failed.
            if file.messages > before:
                self._at_hand.own += self.waiting
                self._at_hand.messages = file.messages
                self._on_disk = dict(self._sequences)
                self._builder.clear()

    def _begin(self) -> ChunkFile:
        if self._file is None:
            self.path = self._next_path()
            out = self._open_file(self.path)
            try:
                file = ChunkFile(out, splits.LIBRARY)
                file.put_all(self.attachments)
                if self._begun:
                    self._repeat(file)
            except OSError:
                out.discard()
                raise
            self._begun, self._file = self._begun + 1, file
            self._at_hand = _File(self.path)
            self._files.append(self._at_hand)
        return self._file

    def _repeat(self, file: ChunkFile) -> None:
        """Repeat latched messages with the log time of the new split's first message."""
        head = ChunkBuilder()
        for message in self._head_messages():
            channel = self._topics.ids[message.topic]
            # Not before the original, so that a reader sees the original first.
            times = max(self._builder.first_log_ns, message.log_time_ns), message.publish_time_ns
            # Number of the message on disk: a newer message of its topic may be waiting.
            head.add(channel, self._on_disk.get(channel, 0), *times, message.data)
        if len(head):
            file.put_chunk(head.build(self._topics.packed()))

    def _next_number(self) -> int:
        files = [*splits.finished_files(self.folder), *self.folder.glob(f'*.mcap{PART_SUFFIX}')]
        # Never reuse the number of a removed file: somebody may restore it.
        return max(map(splits.split_number, files), default=-1) + 1

    def _next_path(self) -> Path:
        self._number = max(self._next_number(), self._number + 1)
        return self.folder / f'{self.name}_{self._number}.mcap'

    def _finish(self) -> None:
        if self._file is not None and self.path is not None:
            # If this fails half-way, metadata.yaml may lack a file with a final name.
            self._list_due = True
            if os.path.lexists(self.path):
                # A file of another program has this name and is kept.
                self.path = self._at_hand.path = self._next_path()
                self._file.rename(self.path)
            with self._writing():
                split = splits.finish_split(self._file, self.path.name, self._topics.table)
                self.bytes_finished += self._file.position
                self.files_finished += 1
                self._splits[split.name] = split
                self._at_hand.mark = mark_of(self.path)
                self._at_hand = _File(Path())
                self._file = self.path = None
        elif not self._list_due:
            return
        self._list()

    def _recount(self, file: _File, what: str = '') -> None:
        """Count the messages of an earlier split again."""
        unfinished = file.path.suffix == PART_SUFFIX
        named = file.path.with_suffix('') if unfinished else file.path
        if named.exists() and not file.path.exists():
            # It was renamed before finishing failed, or it was recovered since.
            file.path = named
        file.mark = mark_of(file.path)
        self._splits.pop(file.path.name, None)
        if file.mark is None and not unfinished:
            # A finished file may have been moved to an archive, so it is not lost.
            self._take_out(file)
            return
        left = 0 if file.mark is None else intact_messages(file.path)
        lost = min(file.own, max(0, file.messages - left))
        file.own, file.messages = file.own - lost, left
        self.lost += lost
        if not file.own:
            self._files.remove(file)
        self._damaged.discard(file.path.name)
        if not lost and Split.read(file.path) is not None:
            return
        self._damaged.add(file.path.name)
        what = what or ('was not finished' if unfinished else 'was changed by another program')
        told = counted(lost, 'message in it is', 'messages in it are') if lost else 'nothing is'
        more = ' What is in it needs `valveflow recover`.' if left else ''
        self.loss = f"'{file.path}' {what}: {told} lost.{more}"

    def _take_out(self, file: _File) -> None:
        """Count the messages of a removed file and forget the file."""
        self.removed += file.own
        self._files.remove(file)

    def _list(self) -> None:
        """Write `metadata.yaml` for the finished splits on disk."""
        self._list_due = True
        with os_errors(self.path or self.folder, 'cannot be written'):
            # A file may have its final name although finishing it failed afterwards.
            found = finished_splits(self.folder, self._splits)
            self._splits = {n: split for n, split in found.items() if n not in self._damaged}
            splits.write_metadata(self.folder, self._splits.values())
            self._listed = mark_of(self.folder / METADATA_NAME)
        self._list_due = False

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Abandon the current split after an `OSError`, which becomes a `RecordingError`.

        If another program altered the split, its loss is counted instead.
        """
        file = self._at_hand
        try:
            yield
        except AlteredError as error:
            self.abandon()
            if file.own:
                self._recount(file, str(error))
        except OSError as error:
            self.abandon()
            with os_errors(self.path or self.folder, 'cannot be written'):
                raise error
