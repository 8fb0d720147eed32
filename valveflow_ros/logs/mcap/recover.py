"""Makes a whole file of what a crash, a full disk or a bad sector left.

Intact chunks are copied as they are and get a new index. A chunk whose
checksum is wrong is left out and counted: nothing is repaired by guessing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs.mcap.chunk_file import ChunkFile, PackedChunk
from valveflow_ros.logs.mcap.folder import (
    LIBRARY,
    finish_split,
    finished_splits,
    write_metadata,
)
from valveflow_ros.logs.mcap.records import LayoutError, TopicTable, read_summary, walk
from valveflow_ros.logs.mcap.scan import SHAPE_SIZE, Scanner, candidates, scan_warnings
from valveflow_ros.logs.part_file import PART_SUFFIX, new_file, taken
from valveflow_ros.logs.source import Source, os_errors


@dataclass(frozen=True, slots=True)
class RecoveryReport:
    """What a recovery kept and what it had to leave.

    ``messages`` and ``chunks`` were copied; ``damaged_chunks`` counts the places where something
    was lost, apart from a cut-off end; ``warnings`` are sentences about what was met.
    """

    source: Path
    out: Path
    messages: int
    chunks: int
    damaged_chunks: int
    bytes_read: int
    bytes_written: int
    warnings: tuple[str, ...]


Progress = Callable[[int, int], None]


def recover(
    path: str | Path, out: str | Path, *, progress: Progress | None = None
) -> RecoveryReport:
    """Copy the intact chunks of ``path`` into a finished file ``out``.

    Parameters
    ----------
    path : str or Path
        An MCAP file in any state.
    out : str or Path
        The new file, which must not exist; its name should end in ``.mcap``.
    progress : callable, optional
        Called with bytes done and bytes in all.

    Raises
    ------
    RecordingError
        If ``path`` holds no intact chunk, or ``out`` exists or cannot be written.
    """
    target = Path(out)
    if target.exists():
        raise RecordingError(target, 'exists already; choose another name for the recovered file')
    return _recover(Path(path), target, target.name, progress)


def intact_messages(path: Path) -> int:
    """Return how many messages stand in the intact chunks of a file; 0 if it cannot be read."""
    try:
        with Source.open(path) as source:
            return sum(map(len, _intact(Scanner(source), TopicTable(), None, source.size)))
    except RecordingError:
        return 0


def recover_leftovers(folder: str | Path) -> tuple[RecoveryReport, ...]:
    """Finish every ``.part`` in a folder that no living recorder holds.

    The ``.part`` is removed when its finished file is in place, or if not one chunk
    was finished in it; one that cannot be read, or that holds damaged chunks only
    is left. The folder's `metadata.yaml` is brought up to date.

    Raises
    ------
    RecordingError
        If the folder cannot be read.
    """
    home = Path(folder)
    with os_errors(home, 'leftovers cannot be recovered'):
        parts = sorted(home.glob(f'*.mcap{PART_SUFFIX}'))
        reports = [report for part in parts if (report := _leftover(part)) is not None]
        if reports:
            write_metadata(home, finished_splits(home).values())
    return tuple(reports)


def _leftover(part: Path) -> RecoveryReport | None:
    """Finish one; what cannot be read or finished now stays, and nobody has to wait for it."""
    if part.is_symlink() or not part.is_file():
        return None
    try:
        # It is held meanwhile, so that no other recovery works on it at the same time.
        with taken(part) as free:
            return _made_whole(part) if free else None
    except (OSError, RecordingError):
        return None


def _made_whole(part: Path) -> RecoveryReport | None:
    if part.stat().st_size == 0:
        part.unlink()
        return None
    target = part.with_name(part.name[: -len(PART_SUFFIX)])
    # The new file is written under another name, since its own .part is the source;
    # a draft that a crash leaves is not taken for a recording.
    draft = target.with_name(f'.{target.stem}.recovering')
    try:
        report = _recover(part, draft, target.name, None)
    except RecordingError:
        if _holds_nothing(part):
            part.unlink()
        return None
    draft.replace(target)
    part.unlink()
    return replace(report, out=target)


def _holds_nothing(part: Path) -> bool:
    """Tell whether there is nothing in a file but the beginning of its first chunk, or less."""
    with Source.open(part) as source:
        scanner = Scanner(source)
        chunks = sum(1 for _ in scanner.chunks())
        cut_at = scanner.findings.cut_off_at
        if chunks or scanner.findings.damaged:
            return False
        if cut_at is None or source.size - cut_at < SHAPE_SIZE:
            return True
        # A head whose fields agree was not damaged: the rest of its chunk was never written.
        return next(candidates(source, cut_at, cut_at + 1), None) is not None


def _recover(path: Path, target: Path, name: str, progress: Progress | None) -> RecoveryReport:
    with Source.open(path) as source:
        scanner = Scanner(source)
        table = TopicTable()
        chunks = _intact(scanner, table, progress, source.size)
        first = next(chunks, None)
        if first is None:
            raise RecordingError(path, 'holds no intact chunk of messages, nothing to recover')
        with os_errors(target, 'cannot be written'), new_file(target) as out:
            file = ChunkFile(out, LIBRARY)
            for chunk in chain([first], chunks):
                file.put_chunk(chunk)
            _complete(table, source)
            for attachment in scanner.findings.attachments.values():
                file.put_attachment(attachment)
            for key, items in scanner.findings.metadata.items():
                if key != 'rosbag2':
                    file.put_metadata(key, items)
            finish_split(file, name, table)
        findings = scanner.findings
        warnings = scan_warnings(findings, 'file')
    return RecoveryReport(
        path,
        target,
        file.messages,
        file.chunks,
        findings.damaged,
        source.size,
        file.position,
        warnings,
    )


def _intact(
    scanner: Scanner, table: TopicTable, progress: Progress | None, size: int
) -> Iterator[PackedChunk]:
    for chunk in scanner.chunks():
        if not chunk.content:
            continue
        try:
            messages, others = walk(chunk.content)
            for op, content in others:
                table.add(op, content)
        except LayoutError as error:
            scanner.findings.add_damage(f'the chunk at byte {chunk.offset}: {error}')
            continue
        yield PackedChunk(
            chunk.record,
            messages.channel,
            messages.log_time,
            messages.offset,
            len(chunk.content),
            chunk.compression,
        )
        if progress is not None:
            progress(chunk.end, size)


def _complete(table: TopicTable, source: Source) -> None:
    """Add topics that only an intact summary still knows."""
    summary = read_summary(source)
    if summary is not None:
        try:
            table.take_over(summary.table)
        except LayoutError as error:
            raise RecordingError(source.path, f'contradicts itself: {error}') from None
