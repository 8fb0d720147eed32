# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Recovers a complete file from what a crash, a full disk or a bad sector left.

Intact chunks are copied unchanged and get a new index. A chunk with a wrong
checksum is left out and counted; its content is never guessed. Messages
outside of chunks are written to new chunks, and chunks without a checksum
get one.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Schema
from mcap.records import Chunk as ChunkRecord
from mcap.stream_reader import get_chunk_data_stream

from valveflow_ros.errors import RecordingError, counted
from valveflow_ros.logs.mcap import folder as splits
from valveflow_ros.logs.mcap import scan
from valveflow_ros.logs.mcap.chunk_file import (
    CHUNK_BYTES,
    ChunkBuilder,
    ChunkFile,
    PackedChunk,
    compressor,
    pack_content,
)
from valveflow_ros.logs.mcap.records import (
    RECORD_HEAD,
    LayoutError,
    MessageTable,
    TopicTable,
    pack,
    read_summary,
    walk,
)
from valveflow_ros.logs.mcap.scan import Chunk, Scanner
from valveflow_ros.logs.part_file import PART_SUFFIX, PartFile, new_file, taken
from valveflow_ros.logs.source import Source, os_errors
from valveflow_ros.records import IntArray


@dataclass(frozen=True, slots=True)
class RecoveryReport:
    """Result of a recovery.

    ``messages`` and ``chunks`` were written. ``bare_messages`` of the source are outside of its
    chunks. ``damaged_chunks`` counts the places where data were lost, apart from a cut-off end.
    ``warnings`` are sentences for the user.
    """

    source: Path
    out: Path
    messages: int
    bare_messages: int
    chunks: int
    damaged_chunks: int
    bytes_read: int
    bytes_written: int
    warnings: tuple[str, ...]


Progress = Callable[[int, int], None]
# What the library raises for a file that it cannot read.
_UNREADABLE = (
    McapError, ValueError, KeyError, EOFError, RuntimeError, struct.error, zstandard.ZstdError,
)  # fmt: skip


def recover(
    path: str | Path, out: str | Path, *, progress: Progress | None = None
) -> RecoveryReport:
    """Copy the intact chunks of ``path`` into a finished file ``out``.

    It gets its final name after the library `mcap` has read its summary and every chunk and
    verified the checksums. Raises `RecordingError` if ``path`` holds no message, ``out`` exists or
    cannot be written, or other programs could not read it.

    Parameters
    ----------
    path : str or Path
        An MCAP file in any state.
    out : str or Path
        The new file, which must not exist; its name should end in ``.mcap``.
    progress : callable, optional
        Called with the bytes done and the total bytes.
    """
    target = Path(out)
    if target.exists():
        raise RecordingError(target, 'exists already; choose another name for the recovered file')
    return _recover(Path(path), target, target.name, progress, proven=True)


def intact_messages(path: Path) -> int:
    """Return the number of messages in the intact chunks of a file; 0 if it cannot be read."""
    try:
        with Source.open(path) as source:
            return sum(map(len, _Copier(source, Scanner(source)).chunks(None)))
    except RecordingError:
        return 0


def recover_leftovers(folder: str | Path) -> tuple[RecoveryReport, ...]:
    """Finish every ``.part`` file in a folder that no living recorder holds.

    The ``.part`` file is removed when its finished file is in place, or if it has no complete
    chunk. It is kept if it cannot be read, or has damaged chunks only. The folder's
    `metadata.yaml` is updated. Raises `RecordingError` if the folder cannot be read.
    """
    home = Path(folder)
    with os_errors(home, 'leftovers cannot be recovered'):
        parts = sorted(home.glob(f'*.mcap{PART_SUFFIX}'))
        reports = [report for part in parts if (report := _leftover(part)) is not None]
        if reports:
            splits.write_metadata(home, splits.finished_splits(home).values())
    return tuple(reports)


def _leftover(part: Path) -> RecoveryReport | None:
    """Finish one ``.part`` file; it is kept if it cannot be read or finished now."""
    if part.is_symlink() or not part.is_file():
        return None
    try:
        # The lock keeps other recoveries from working on it at the same time.
        with taken(part) as free:
            return _made_whole(part) if free else None
    except (OSError, RecordingError):
        return None


def _made_whole(part: Path) -> RecoveryReport | None:
    if part.stat().st_size == 0:
        part.unlink()
        return None
    target = part.with_name(part.name[: -len(PART_SUFFIX)])
    # The new file is written under another name, since its own .part is the source.
    # That name does not end in .mcap, so a draft left by a crash is not read as a recording.
    draft = target.with_name(f'.{target.stem}.recovering')
    try:
        report = _recover(part, draft, target.name)
    except RecordingError:
        if _holds_nothing(part):
            part.unlink()
        return None
    draft.replace(target)
    part.unlink()
    return replace(report, out=target)


def _holds_nothing(part: Path) -> bool:
    """Return True if a file holds at most the beginning of its first chunk."""
    with Source.open(part) as source:
        scanner = Scanner(source)
        chunks = sum(1 for _ in scanner.chunks())
        cut_at = scanner.findings.cut_off_at
        if chunks or scanner.findings.damaged:
            return False
        if cut_at is None or source.size - cut_at < scan.SHAPE_SIZE:
            return True
        # The fields of this chunk head agree, so the rest of the chunk was never written.
        return scan.has_chunk_at(source, cut_at)


def _recover(
    path: Path, target: Path, name: str, progress: Progress | None = None, proven: bool = False
) -> RecoveryReport:
    with Source.open(path) as source:
        scanner = Scanner(source)
        copier = _Copier(source, scanner)
        chunks = copier.chunks(progress)
        first = next(chunks, None)
        if first is None:
            why = scan.why_empty(scanner.findings)
            raise RecordingError(path, f'{why}; nothing was recovered')
        kind: Callable[..., PartFile] = PartFile
        if proven:
            kind = partial(_ProvenFile, source=path)
        with os_errors(target, 'cannot be written'), new_file(target, kind) as out:
            file = ChunkFile(out, splits.LIBRARY)
            for chunk in chain([first], chunks):
                file.put_chunk(chunk)
            copier.complete()
            for attachment in scanner.findings.attachments:
                file.put_attachment(attachment)
            for key, items in scanner.findings.metadata:
                if key != 'rosbag2':
                    file.put_metadata(key, items)
            splits.finish_split(file, name, copier.table)
        findings = scanner.findings
        warnings = (*scan.scan_warnings(findings, 'file'), *copier.warnings())
    return RecoveryReport(
        path, target, file.messages, findings.bare_messages, file.chunks, findings.damaged,
        source.size, file.position, warnings,
    )  # fmt: skip


class _ProvenFile(PartFile):
    """A file that is published only if the library `mcap` can read all of it."""

    def __init__(self, path: Path, replace: bool, source: Path) -> None:
        super().__init__(path, replace)
        self._source = source

    def publish(self) -> None:
        """Read every chunk, then rename the file; raises `RecordingError`."""
        try:
            with self.part.open('rb') as stream:
                summary = make_reader(stream, validate_crcs=True).get_summary()
                if summary is None:
                    raise McapError('it has no summary')
                # Messages are not read one by one: a chunk of 100 kB may hold a million of them.
                for index in summary.chunk_indexes:
                    stream.seek(index.chunk_start_offset + RECORD_HEAD.size)
                    get_chunk_data_stream(
                        ChunkRecord.read(ReadDataStream(stream)), validate_crc=True
                    )
                    if not index.message_index_offsets.keys() <= summary.channels.keys():
                        raise McapError('its summary does not name all topics')
        except _UNREADABLE as error:
            reason = str(error) or type(error).__name__
            problem = f'what is intact in it makes no file that other programs read ({reason})'
            raise RecordingError(self._source, f'{problem}; nothing was written') from None
        super().publish()


class _Copier:
    """Yields the intact chunks of a file, each after the topic records that are still missing."""

    def __init__(self, source: Source, scanner: Scanner) -> None:
        # The topics found so far; after `complete`, all topics of the file.
        self.table = TopicTable()
        self._source = source
        self._scanner = scanner
        self._told: set[tuple[int, int]] = set()
        self._whole = False
        self._left_out = 0
        self._packer = compressor()

    def chunks(self, progress: Progress | None) -> Iterator[PackedChunk]:
        """Yield the chunks; one that contradicts an earlier one is omitted, counted as damage."""
        for chunk in _joined(self._scanner.chunks()):
            if not chunk.content:
                continue
            try:
                yield from self._copied(chunk)
            except LayoutError as error:
                self._scanner.findings.add_damage(f'the chunk at byte {chunk.offset}: {error}')
                continue
            if progress is not None:
                progress(chunk.end, self._source.size)

    def complete(self) -> None:
        """Read the topic records of the whole file, also those outside of chunks.

        Raises `RecordingError` if the summary contradicts the chunks.
        """
        if self._whole:
            return
        self._whole = True
        scanner = Scanner(self._source)
        for chunk in scanner.chunks():
            with suppress(LayoutError):
                for op, content in walk(chunk.content)[1]:
                    self.table.add(op, content, chunk.checked)
        summary = read_summary(self._source)
        if summary is not None:
            try:
                self.table.take_over(summary.table)
            except LayoutError as error:
                problem = f'contradicts itself: {error}'
                raise RecordingError(self._source.path, problem) from None
        for record in scanner.outside:
            try:
                self.table.take(record, checked=False)
            except LayoutError as error:
                self._scanner.findings.add_damage(f'a record outside of the chunks: {error}')

    def warnings(self) -> list[str]:
        """Return a sentence if messages were left out because their topic is unknown."""
        if not self._left_out:
            return []
        one = self._left_out == 1
        return [
            f'{counted(self._left_out, "message")} {"is on a topic" if one else "are on topics"} '
            f'that the file does not name any more, and {"was" if one else "were"} left out.'
        ]

    def _copied(self, chunk: Chunk) -> Iterator[PackedChunk]:
        messages, others = walk(chunk.content)
        for op, content in others:
            self.table.add(op, content, chunk.checked)
        # Each of these records begins with its id.
        here = {(op, int.from_bytes(content[:2], 'little')) for op, content in others}
        present = np.flatnonzero(np.bincount(messages.channel)).tolist()
        if any(self._records(number) is None for number in present):
            self.complete()
        known = {n: records for n in present if (records := self._records(n)) is not None}
        needed = {key: r for records in known.values() for key, r in records.items()}
        missing = {key: r for key, r in needed.items() if key not in self._told | here}
        self._told |= here | missing.keys()
        if missing:
            yield ChunkBuilder().build(pack(*missing.values()))
        named = np.isin(messages.channel, list(known))
        self._left_out += len(messages) - int(named.sum())
        columns = messages.channel, messages.log_time, messages.offset
        if named.all() and not chunk.record:
            yield pack_content(chunk.content, *columns, self._packer)
        elif named.all():
            yield PackedChunk(chunk.record, *columns, len(chunk.content), chunk.compression)
        elif named.any():
            yield _rebuilt(chunk.content, messages, np.flatnonzero(named), others)

    def _records(self, number: int) -> dict[tuple[int, int], Schema | Channel] | None:
        """Return the channel and schema records of a channel; None if one of them is lost."""
        channel = self.table.channels.get(number)
        if channel is None:
            return None
        own: dict[tuple[int, int], Schema | Channel] = {(Opcode.CHANNEL, number): channel}
        if not channel.schema_id:
            return own
        schema = self.table.schemas.get(channel.schema_id)
        return None if schema is None else {(Opcode.SCHEMA, schema.id): schema, **own}


def _joined(chunks: Iterator[Chunk]) -> Iterator[Chunk]:
    """Join messages outside of chunks up to the usual size of a chunk."""
    run: list[Chunk] = []
    size = 0
    for chunk in chain(chunks, [None]):
        if run and (chunk is None or chunk.record or size + len(chunk.content) > CHUNK_BYTES):
            content = b''.join(part.content for part in run)
            yield replace(run[0], content=content, end=run[-1].end)
            run, size = [], 0
        if chunk is not None and not chunk.record:
            run.append(chunk)
            size += len(chunk.content)
        elif chunk is not None:
            yield chunk


def _rebuilt(
    content: bytes, messages: MessageTable, kept: IntArray, others: list[tuple[int, bytes]]
) -> PackedChunk:
    """Return a chunk with the messages ``kept``."""
    builder = ChunkBuilder()
    m = messages
    for k in kept.tolist():
        channel, sequence, log_ns, publish_ns = (
            int(column[k]) for column in (m.channel, m.sequence, m.log_time, m.publish_time)
        )
        builder.add(channel, sequence, log_ns, publish_ns, m.payload(content, k))
    return builder.build(b''.join(RECORD_HEAD.pack(op, len(raw)) + raw for op, raw in others))
