# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Reads a recording of one or several MCAP files into `LogContents`."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.errors import RecordingError, counted
from valveflow_ros.logs.contents import LogContents, LoggedMessage, TopicInfo
from valveflow_ros.logs.mcap.folder import Split, recording_files
from valveflow_ros.logs.mcap.gather import FileContents, Group, Rows, gather
from valveflow_ros.logs.mcap.records import HEAD_SIZE, LayoutError, MessageTable, walk
from valveflow_ros.logs.mcap.scan import Scanner, scan_warnings, why_empty
from valveflow_ros.logs.names import (
    PLANT_SAMPLE_TOPIC,
    TopicChoice,
    is_input,
    last_part,
    misfits,
    told_inputs,
)
from valveflow_ros.logs.source import OverBudgetError, Source
from valveflow_ros.records import IntArray, Readings, Signal

_END = np.iinfo(np.int64).max
_BLOCK = 1 << 14
# Chunks of a recorder overlap little in time; only a malicious file exceeds this limit.
MAX_WAITING_BYTES = 96 << 20


class _Batch(NamedTuple):
    """Messages of one group that are not yielded yet; ``rows`` are their places in ``table``."""

    file: int
    place: int
    content: bytes
    table: MessageTable
    rows: IntArray

    def columns(self) -> tuple[NDArray[np.generic], ...]:
        """Return times, channel, sequence number, and begin and end in the content."""
        t, rows = self.table, self.rows
        starts = t.offset[rows] + HEAD_SIZE
        heads = (column[rows] for column in (t.log_time, t.publish_time, t.channel, t.sequence))
        return *heads, starts, starts + t.size[rows]


class MessageReader:
    """Yields the raw messages of gathered files; keeps only groups that overlap in time."""

    def __init__(self, files: list[FileContents]) -> None:
        self._files = files

    def messages(self, topics: Collection[str] | None) -> Iterator[LoggedMessage]:
        """Yield messages; see `LogContents.iter_messages`."""
        plan = sorted(
            (group.first_ns, number, place)
            for number, file in enumerate(self._files)
            for place, group in enumerate(file.groups)
            if group.channels & _channels(file, topics).keys()
        )
        waiting: list[_Batch] = []
        last: dict[str, tuple[int, LoggedMessage]] = {}
        met: set[tuple[int, str]] = set()
        for index, (_, number, place) in enumerate(plan):
            waiting.append(self._load(number, place, topics))
            # All groups that are still to be read begin at this time or later.
            until = plan[index + 1][0] if index + 1 < len(plan) else _END
            due = self._release(waiting, until)
            if len(self._files) == 1:
                yield from (message for _, _, message in due)
                continue
            for file, sequence, message in due:
                # The first message of a topic in a split may be a latched message that the
                # recorder repeated. An equal new message has another sequence number.
                before, first = last.get(message.topic), (file, message.topic) not in met
                last[message.topic] = (sequence, message)
                met.add((file, message.topic))
                if not (before is not None and first and _repeats(before, sequence, message)):
                    yield message

    def _load(self, number: int, place: int, topics: Collection[str] | None) -> _Batch:
        file = self._files[number]
        content = self._content(file, file.groups[place])
        table, _ = walk(content)
        wanted = np.isin(table.channel, list(_channels(file, topics)))
        return _Batch(number, place, content, table, np.flatnonzero(wanted))

    def _release(
        self, waiting: list[_Batch], until: int
    ) -> Iterator[tuple[int, int, LoggedMessage]]:
        """Yield file, sequence number and message of all messages before ``until``, in order."""
        waiting.sort(key=lambda batch: (batch.file, batch.place))
        due = [(batch, batch.table.log_time[batch.rows] < until) for batch in waiting]
        out = [batch._replace(rows=batch.rows[now]) for batch, now in due]
        waiting[:] = [b._replace(rows=b.rows[~now]) for b, now in due if not now.all()]
        if sum(len(batch.content) for batch in waiting) > MAX_WAITING_BYTES:
            problem = 'holds too much of the same time side by side to be put in order'
            raise RecordingError(self._files[out[0].file].path, problem)
        names = [_channels(self._files[batch.file], None) for batch in out]
        parts = zip(*(batch.columns() for batch in out), strict=True)
        columns = [np.concatenate(part) for part in parts]
        sizes = [len(batch.rows) for batch in out]
        columns.append(np.repeat(np.arange(len(out)), sizes))
        # A stable sort keeps messages of equal time in the order of the files.
        order = np.argsort(columns[0], kind='stable')
        for begin in range(0, len(order), _BLOCK):
            picked = order[begin : begin + _BLOCK]
            lists = [column[picked].tolist() for column in columns]
            for log_ns, publish_ns, channel, sequence, start, end, k in zip(*lists, strict=True):
                topic, kind = names[k][channel]
                data = out[k].content[start:end]
                message = LoggedMessage(topic, kind, log_ns, publish_ns, data)
                yield out[k].file, sequence, message

    def _content(self, file: FileContents, group: Group) -> bytes:
        try:
            with Source.open(file.path) as source:
                scanner = Scanner(source)
                return b''.join(scanner.chunk_at(offset).content for offset in group.chunks)
        except (LayoutError, OverBudgetError):
            raise RecordingError(file.path, 'has changed while it was read') from None


def _repeats(before: tuple[int, LoggedMessage], sequence: int, message: LoggedMessage) -> bool:
    return (
        sequence == before[0]
        and message.publish_time_ns == before[1].publish_time_ns
        and message.data == before[1].data
    )


def _channels(file: FileContents, topics: Collection[str] | None) -> dict[int, tuple[str, str]]:
    """Return topic and type by channel, for ``topics`` or, if None, for all topics."""
    return {
        number: (channel.topic, file.table.type_of(channel))
        for number, channel in file.table.channels.items()
        if topics is None or channel.topic in topics
    }


def read_recording(paths: list[Path], name: str, columns: Mapping[str, str]) -> LogContents:
    """Return the joint contents of the files, in this order.

    Raises `RecordingError` if no message can be read, and `InputError` if it is unclear which
    topic holds a signal.
    """
    choice = TopicChoice(columns)
    files, warnings = _gathered(paths, choice, name)
    types = _types(files, name)
    attachments: dict[str, bytes] = {}
    for file in files:
        attachments |= {found.name: found.data for found in file.findings.attachments}
    remapped = {
        signal: topic for signal, topic in told_inputs(attachments).items()
        if is_input(signal) and topic in types and last_part(topic) != signal
        and signal not in columns and topic not in columns.values()
    }  # fmt: skip
    if remapped:
        # What these topics hold was not kept at the first reading.
        choice = TopicChoice({**remapped, **columns})
        files, warnings = _gathered(paths, choice, name)
    chosen = choice.signals(types, name)
    stamped = choice.plant_sample(types, name)
    for file in files:
        what = 'file' if len(paths) == 1 else f'file {Path(file.path).name}'
        warnings += [*scan_warnings(file.findings, what), *_file_warnings(file, what)]
    warnings += _choice_warnings(types, chosen, stamped, name)
    found, told = _timed(_readings(files, chosen))
    groups = [group for file in files for group in file.groups]
    signals = {signal: topic for topic, signal in chosen.items()}
    if stamped is not None:
        for number in np.unique(found[0].signal).tolist():
            signals.setdefault(Signal(number), stamped)
    metadata: dict[str, dict[str, str]] = {}
    for file in files:
        metadata |= dict(file.findings.metadata)
    times = min(group.first_ns for group in groups), max(group.last_ns for group in groups)
    damaged = sum(file.findings.damaged for file in files)
    return LogContents(
        name, *found, _topics(files, types, chosen), signals, (*warnings, *told), attachments,
        metadata, *times, damaged, MessageReader(files).messages,
    )  # fmt: skip


def _gathered(
    paths: list[Path], choice: TopicChoice, name: str
) -> tuple[list[FileContents], list[str]]:
    """Return the contents of the files that can be read, and why others cannot."""
    files: list[FileContents] = []
    warnings: list[str] = []
    for path in paths:
        try:
            with Source.open(path) as source:
                contents = gather(source, choice)
            if not contents.messages:
                raise RecordingError(path, why_empty(contents.findings))
            files.append(contents)
        except RecordingError as error:
            if len(paths) == 1:
                raise
            warnings.append(str(error))
    if not files:
        raise RecordingError(name, f'none of its files can be read ({warnings[0]})')
    return files, warnings


def _types(files: list[FileContents], name: str) -> dict[str, str]:
    types: dict[str, str] = {}
    for file in files:
        for channel in file.table.channels.values():
            kind = file.table.type_of(channel)
            if types.setdefault(channel.topic, kind) != kind:
                both = f'{types[channel.topic]} and {kind}'
                raise RecordingError(name, f"its topic '{channel.topic}' has two types, {both}")
    return types


def _topics(
    files: list[FileContents], types: dict[str, str], chosen: dict[str, Signal]
) -> dict[str, TopicInfo]:
    counts = dict.fromkeys(types, 0)
    texts: dict[str, tuple[str, str]] = {}
    for file in files:
        for number, channel in file.table.channels.items():
            counts[channel.topic] += file.counts[number]
            hash_text = channel.metadata.get('topic_type_hash', '')
            texts[channel.topic] = file.table.definition_of(channel), hash_text
    return {
        topic: TopicInfo(topic, kind, counts[topic], chosen.get(topic), *texts[topic])
        for topic, kind in types.items()
    }


def _file_warnings(file: FileContents, what: str) -> list[str]:
    sentences = []
    if file.announced is not None and file.announced > file.messages:
        missing = file.announced - file.messages
        sentences.append(
            f'The {what} was written with {counted(file.announced, "message")}, '
            f'{missing} of them {"is" if missing == 1 else "are"} lost.'
        )
    if file.orphans:
        many = 'is on a topic' if file.orphans == 1 else 'are on topics'
        sentences.append(
            f'{counted(file.orphans, "message")} of the {what} {many} that it does not name any '
            'more.'
        )
    for channel, count in file.misfits.items():
        topic = file.table.channels[channel].topic
        fit = 'does not fit its type and was' if count == 1 else 'do not fit their type and were'
        sentences.append(f"{counted(count, 'message')} on '{topic}' {fit} left out.")
    return sentences


def _choice_warnings(
    types: dict[str, str], chosen: dict[str, Signal], stamped: str | None, name: str
) -> list[str]:
    wrong = misfits(types)
    if not chosen and stamped is None:
        if wrong:
            raise RecordingError(name, wrong[0])
        return [
            'None of its topics is an input of the monitor; '
            'name one with --column valve_opening=TOPIC.'
        ]
    sentences = [f'{clause[0].upper()}{clause[1:]}; it was left out.' for clause in wrong]
    if chosen and stamped is not None:
        both = ', '.join(f"'{topic}'" for topic in chosen)
        sentences.append(
            f"Values stand both in '{stamped}' ({PLANT_SAMPLE_TOPIC}) and in {both}; "
            'all of them were read.'
        )
    return sentences


def _timed(found: tuple[Readings, IntArray]) -> tuple[tuple[Readings, IntArray], list[str]]:
    """Leave out values without a time, which a monitor does not use either.

    If no value has a time, nothing is left out.
    """
    readings, log_time = found
    if not len(readings) or readings.time_ns.min() > 0 or readings.time_ns.max() <= 0:
        return found, []
    timed = readings.time_ns > 0
    kept = Readings(
        readings.time_ns[timed], readings.signal[timed], readings.value[timed],
        readings.quality[timed],
    )  # fmt: skip
    lost = counted(len(readings) - len(kept), 'value')
    told = f'{lost} recorded without a time, as before the first /clock, left out.'
    return (kept, log_time[timed]), [told]


def _readings(files: list[FileContents], chosen: dict[str, Signal]) -> tuple[Readings, IntArray]:
    parts: list[tuple[Rows, np.ndarray[tuple[int], np.dtype[np.int8]]]] = []
    for file in files:
        lookup = np.full(1 << 16, -1, dtype=np.int8)
        for number, channel in file.table.channels.items():
            if channel.topic in chosen:
                lookup[number] = chosen[channel.topic]
        for rows in file.rows:
            signal = np.where(rows.signal >= 0, rows.signal, lookup[rows.channel])
            parts.append((rows, signal))
    if not parts:
        return Readings.of([]), np.empty(0, dtype=np.int64)
    signal = np.concatenate([signal for _, signal in parts])
    log_time, time_ns, value, quality = (
        np.concatenate([getattr(rows, name) for rows, _ in parts])
        for name in ('log_time', 'time_ns', 'value', 'quality')
    )
    picked = [time_ns, signal, value, quality, log_time]
    # Indexing millions of values takes as long as reading them, and is hardly ever needed.
    keep = signal >= 0
    if not keep.all():
        picked = [column[keep] for column in picked]
    if (np.diff(picked[4]) < 0).any():
        order = np.argsort(picked[4], kind='stable')
        picked = [column[order] for column in picked]
    return Readings(*picked[:4]), picked[4]


_TRIES = 3


def messages_since(
    folder: str | Path, after_ns: int, definitions: dict[str, str] | None = None
) -> Iterator[LoggedMessage]:
    """Yield the messages in a recording's folder logged after ``after_ns``, in order.

    The time is in ns since the epoch. ``definitions`` receives the ros2msg text of each topic's
    type. Raises `RecordingError` if the files cannot be read; no files yield nothing.
    """
    found = _read(Path(folder), after_ns)
    if definitions is not None:
        definitions |= {topic: info.definition for topic, info in found.topics.items()}
    for message in found.iter_messages():
        if message.log_time_ns > after_ns:
            yield message


def _read(home: Path, after_ns: int) -> LogContents:
    """Return the contents of the last files; retries if a file is renamed meanwhile."""
    for left in reversed(range(_TRIES)):
        wanted = _wanted(home, after_ns)
        if not wanted:
            break
        try:
            found = read_recording(wanted, str(home), {})
            # If one of several files is missing, `read_recording` only warns.
            if not left or all(path.exists() for path in wanted):
                return found
        except RecordingError:
            if not left or all(path.exists() for path in wanted):
                raise
    return LogContents(str(home), Readings.of([]), np.empty(0, dtype=np.int64))


def _wanted(home: Path, after_ns: int) -> list[Path]:
    wanted: list[Path] = []
    for path in reversed([p for p in recording_files(home) if p.is_file()]):
        wanted.insert(0, path)
        split = Split.read(path) if path.suffix == '.mcap' else None
        # Splits are in time order: no earlier split than one that begins before this is needed.
        if split is not None and split.messages and split.start_ns <= after_ns:
            break
    return wanted
