"""Goes through the raw messages of a recording again, in the order of their log times."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs.contents import LoggedMessage
from valveflow_ros.logs.limits import OverBudgetError
from valveflow_ros.logs.mcap.found import FileContents, Group
from valveflow_ros.logs.mcap.layout import LayoutError
from valveflow_ros.logs.mcap.scan import Scanner
from valveflow_ros.logs.mcap.walk import HEAD_SIZE, MessageTable, walk
from valveflow_ros.logs.source import Source
from valveflow_ros.records import IntArray

_END = np.iinfo(np.int64).max
_BLOCK = 1 << 14
# Chunks of a recorder overlap by a moment; only a file made to hurt has more than this waiting.
MAX_WAITING_BYTES = 96 << 20


@dataclass(frozen=True, slots=True)
class _Batch:
    """Messages of one group that wait for their turn."""

    file: int
    place: int
    content: bytes
    table: MessageTable
    rows: IntArray


def _columns(batch: _Batch) -> tuple[NDArray[np.generic], ...]:
    table, rows = batch.table, batch.rows
    starts = table.offset[rows] + HEAD_SIZE
    return (
        table.log_time[rows],
        table.publish_time[rows],
        table.channel[rows],
        table.sequence[rows],
        starts,
        starts + table.size[rows],
    )


class Journal:
    """The raw messages of one or several files; holds only what overlaps in time.

    Parameters
    ----------
    files : list of FileContents
        What `gather` found, in the order of the splits.
    unchecked : bool
        As when they were found.
    """

    def __init__(self, files: list[FileContents], unchecked: bool = False) -> None:
        self._files = files
        self._unchecked = unchecked

    def messages(self, topics: Collection[str] | None) -> Iterator[LoggedMessage]:
        """Yield messages; see `LogContents.iter_messages`."""
        repeats = _Repeats()
        plan = sorted(
            (group.first_ns, number, place)
            for number, file in enumerate(self._files)
            for place, group in enumerate(file.groups)
            if group.channels & _channels(file, topics).keys()
        )
        waiting: list[_Batch] = []
        for index, (_, number, place) in enumerate(plan):
            waiting.append(self._load(number, place, topics))
            # Nothing that is still to be read can come before this.
            until = plan[index + 1][0] if index + 1 < len(plan) else _END
            yield from self._release(waiting, until, repeats)

    def _load(self, number: int, place: int, topics: Collection[str] | None) -> _Batch:
        file = self._files[number]
        content = self._content(file, file.groups[place])
        table, _ = walk(content)
        wanted = np.isin(table.channel, list(_channels(file, topics)))
        return _Batch(number, place, content, table, np.flatnonzero(wanted))

    def _release(
        self, waiting: list[_Batch], until: int, repeats: _Repeats
    ) -> Iterator[LoggedMessage]:
        """Yield what comes before ``until`` and keep the rest waiting."""
        waiting.sort(key=lambda batch: (batch.file, batch.place))
        due = [batch.table.log_time[batch.rows] < until for batch in waiting]
        out = [replace(b, rows=b.rows[part]) for b, part in zip(waiting, due, strict=True)]
        waiting[:] = [
            replace(batch, rows=batch.rows[~part])
            for batch, part in zip(waiting, due, strict=True)
            if not part.all()
        ]
        if sum(len(batch.content) for batch in waiting) > MAX_WAITING_BYTES:
            problem = 'holds too much of the same time side by side to be put in order'
            raise RecordingError(self._files[out[0].file].path, problem)
        single = len(self._files) == 1
        for file, sequence, message in self._in_order(out):
            if single or not repeats.seen(file, sequence, message):
                yield message

    def _in_order(self, out: list[_Batch]) -> Iterator[tuple[int, int, LoggedMessage]]:
        """Yield file, sequence number and message; payloads are cut out one at a time."""
        names = [_channels(self._files[batch.file], None) for batch in out]
        columns = [np.concatenate(parts) for parts in zip(*map(_columns, out), strict=True)]
        sizes = [len(batch.rows) for batch in out]
        columns.append(np.repeat(np.arange(len(out)), sizes))
        # A stable sort keeps messages of one time in the order of files and places.
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
                scanner = Scanner(source, unchecked=self._unchecked)
                return b''.join(scanner.chunk_at(offset).content for offset in group.chunks)
        except (LayoutError, OverBudgetError):
            raise RecordingError(file.path, 'has changed while it was read') from None


class _Repeats:
    """Knows the latched messages that a recorder wrote again at the head of a split."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[int, LoggedMessage]] = {}
        self._met: set[tuple[int, str]] = set()

    def seen(self, file: int, sequence: int, message: LoggedMessage) -> bool:
        """Tell whether the first message of a topic in a split is the last of those before.

        The number that the writer gave it tells a repetition from a message
        that happens to be equal.
        """
        last = self._last.get(message.topic)
        self._last[message.topic] = (sequence, message)
        if last is None or (file, message.topic) in self._met:
            self._met.add((file, message.topic))
            return False
        self._met.add((file, message.topic))
        before = last[1]
        return (
            sequence == last[0]
            and message.publish_time_ns == before.publish_time_ns
            and message.data == before.data
        )


def _channels(file: FileContents, topics: Collection[str] | None) -> dict[int, tuple[str, str]]:
    """Return topic and type by channel, of some or all topics that the file names."""
    return {
        number: (channel.topic, file.table.type_of(channel))
        for number, channel in file.table.channels.items()
        if topics is None or channel.topic in topics
    }
