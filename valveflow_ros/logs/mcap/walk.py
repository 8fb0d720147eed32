"""Finds the messages in the records of a chunk, without a Python step per message where it can.

Most chunks of a plant are one run of records of equal size (four Float64
topics: 43 bytes each); such a run is seen at once. Anything else is walked
record by record.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.logs.mcap.layout import MESSAGE_HEAD, RECORD_HEAD, LayoutError, Op
from valveflow_ros.records import IntArray

HEAD_SIZE = RECORD_HEAD.size + MESSAGE_HEAD.size
HEAD_DTYPE = np.dtype(
    [
        ('op', 'u1'),
        ('length', '<u8'),
        ('channel', '<u2'),
        ('sequence', '<u4'),
        ('log_time', '<i8'),
        ('publish_time', '<i8'),
    ]
)
RUN_PROBE = 64
_FEW_BREAKS = 64
MAX_TOPIC_RECORDS = 1 << 16


@dataclass(frozen=True, slots=True)
class MessageTable:
    """The messages of one run of records, in the order in which they stand there.

    Attributes
    ----------
    channel : uint16 (n,)
        Channel ids.
    sequence : uint32 (n,)
        As the writer counted them.
    log_time, publish_time : int64 (n,)
        Nanoseconds since the epoch.
    offset : int64 (n,)
        Where each message record begins.
    size : int64 (n,)
        Bytes of each payload, which begins `HEAD_SIZE` after the offset.
    """

    channel: NDArray[np.uint16]
    sequence: NDArray[np.uint32]
    log_time: IntArray
    publish_time: IntArray
    offset: IntArray
    size: IntArray

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.channel)

    def payload(self, content: bytes, row: int) -> bytes:
        """Return the raw payload of one message."""
        start = int(self.offset[row]) + HEAD_SIZE
        return content[start : start + int(self.size[row])]


def walk(content: bytes) -> tuple[MessageTable, list[tuple[Op, bytes]]]:
    """Return the messages and the schema and channel records of chunk contents.

    Raises
    ------
    LayoutError
        If a record is cut off or of a kind that has no place in a chunk.
    """
    starts, others = _boundaries(content)
    if not len(starts):
        return _EMPTY, others
    heads = rows(content, HEAD_DTYPE, 0, starts)
    table = MessageTable(
        np.ascontiguousarray(heads['channel']),
        np.ascontiguousarray(heads['sequence']),
        np.ascontiguousarray(heads['log_time']),
        np.ascontiguousarray(heads['publish_time']),
        starts,
        heads['length'].astype(np.int64) - MESSAGE_HEAD.size,
    )
    if table.log_time.min() < 0 or table.publish_time.min() < 0:
        raise LayoutError('a message claims a time after the year 2262')
    return table, others


def rows(
    content: bytes, dtype: np.dtype[np.void], shift: int, starts: IntArray
) -> NDArray[np.void]:
    """Return a structured row for each of ``starts + shift``.

    The caller knows that every row lies within ``content``.
    """
    if not len(starts):
        return np.empty(0, dtype)
    runs = _evenly(starts)
    if runs is not None:
        # Rows at even distances are a view; picking them one by one costs ten times as much.
        parts: list[NDArray[np.void]] = [
            np.ndarray((count,), dtype, content, first + shift, (step,))
            for first, step, count in runs
        ]
        return parts[0] if len(parts) == 1 else np.concatenate(parts, dtype=dtype)
    places = len(content) - shift - dtype.itemsize + 1
    view: NDArray[np.void] = np.ndarray((places,), dtype, content, shift, (1,))
    return view[starts]


def _evenly(starts: IntArray) -> list[tuple[int, int, int]] | None:
    """Return first, step and length of the few even runs of places, ``None`` if they are many."""
    if len(starts) < RUN_PROBE:
        return None
    steps = np.diff(starts)
    breaks = np.flatnonzero(steps != steps[0])
    if len(breaks) > _FEW_BREAKS:
        return None
    ends = np.r_[breaks + 1, len(starts)]
    begins = np.r_[0, ends[:-1]]
    return [
        (int(starts[begin]), int(steps[0]), int(end - begin))
        for begin, end in zip(begins, ends, strict=True)
        if end > begin
    ]


def _boundaries(content: bytes) -> tuple[IntArray, list[tuple[Op, bytes]]]:
    parts: list[IntArray] = []
    singles: list[int] = []
    others: list[tuple[Op, bytes]] = []
    position, end, probe = 0, len(content), True
    unpack = RECORD_HEAD.unpack_from
    while position < end:
        if end - position < RECORD_HEAD.size:
            raise LayoutError('a chunk ends in the middle of a record')
        op, length = unpack(content, position)
        after = position + RECORD_HEAD.size + length
        if after > end:
            raise LayoutError('a chunk ends in the middle of a record')
        if op == 5:
            if length < MESSAGE_HEAD.size:
                raise LayoutError('a message is shorter than its own head')
            count = _run(content, position, after - position) if probe else 1
            probe = count >= RUN_PROBE
            if count > 1:
                parts += [np.array(singles, dtype=np.int64)]
                parts += [position + (after - position) * np.arange(count, dtype=np.int64)]
                singles = []
                position += count * (after - position)
                continue
            singles.append(position)
        elif op in (Op.SCHEMA, Op.CHANNEL):
            others.append((Op(op), content[position + RECORD_HEAD.size : after]))
            if len(others) > MAX_TOPIC_RECORDS:
                raise LayoutError('a chunk mentions topics without end')
            probe = True
        else:
            raise LayoutError(f'a chunk holds a record of kind {op}')
        position = after
    return np.concatenate([*parts, np.array(singles, dtype=np.int64)]), others


def _run(content: bytes, position: int, stride: int) -> int:
    """Return how many records from ``position`` on have the same kind and length.

    The look-ahead doubles, so the work is in proportion to the run that is found.
    """
    count = (len(content) - position) // stride
    op, length = RECORD_HEAD.unpack_from(content, position)
    known, limit = 0, RUN_PROBE
    while known < count:
        taken = min(limit, count) - known
        first = position + known * stride
        ops: NDArray[np.uint8] = np.ndarray((taken,), 'u1', content, first, (stride,))
        lengths: NDArray[np.uint64] = np.ndarray((taken,), '<u8', content, first + 1, (stride,))
        same = (ops == op) & (lengths == length)
        if not same.all():
            return known + int(same.argmin())
        known, limit = known + taken, 2 * limit
    return count


_EMPTY = MessageTable(
    np.empty(0, dtype=np.uint16),
    np.empty(0, dtype=np.uint32),
    np.empty(0, dtype=np.int64),
    np.empty(0, dtype=np.int64),
    np.empty(0, dtype=np.int64),
    np.empty(0, dtype=np.int64),
)
