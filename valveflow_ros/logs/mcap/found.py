"""What is found in a file: rows of values, groups of chunks, counts."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.logs.mcap.plant_sample import Samples
from valveflow_ros.logs.mcap.scan import Findings
from valveflow_ros.logs.mcap.topic_table import TopicTable
from valveflow_ros.logs.mcap.walk import HEAD_SIZE, MessageTable, rows
from valveflow_ros.records import SIGNALS, ByteArray, FloatArray, IntArray

_PAYLOAD = np.dtype([('mark', '>u2'), ('options', '<u2'), ('value', '<f8')])
# A Float64 takes 12 bytes; some middlewares pad to a multiple of 8.
_SIZES = (12, 16)


@dataclass(frozen=True, slots=True)
class Rows:
    """Values found in a group of chunks, in the order of the file.

    Attributes
    ----------
    log_time, time_ns : int64 (n,)
        Receipt time and the value's own time.
    channel : uint16 (n,)
        Where it was found.
    signal : int8 (n,)
        Which signal it is, -1 where the topic has yet to be chosen.
    value : float64 (n,)
        As it stands there.
    quality : uint8 (n,)
        As it stands there; good where nothing stands.
    """

    log_time: IntArray
    time_ns: IntArray
    channel: NDArray[np.uint16]
    signal: NDArray[np.int8]
    value: FloatArray
    quality: ByteArray


@dataclass(frozen=True, slots=True)
class Group:
    """Chunks that are read together: where they begin, their log times, their channels."""

    chunks: tuple[int, ...]
    first_ns: int
    last_ns: int
    channels: frozenset[int]


@dataclass(slots=True)
class FileContents:
    """What was found in one file."""

    path: str
    table: TopicTable
    findings: Findings
    groups: list[Group] = field(default_factory=list)
    rows: list[Rows] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)
    misfits: dict[int, int] = field(default_factory=dict)
    announced: int | None = None

    @property
    def messages(self) -> int:
        """Messages in intact chunks."""
        return sum(self.counts.values())

    @property
    def orphans(self) -> int:
        """Messages whose topic is not known."""
        return sum(n for channel, n in self.counts.items() if channel not in self.table.channels)


# Where each value stood in the group, to merge kinds in the order of the file.
Placed = tuple[IntArray, Rows]


def float_rows(content: bytes, table: MessageTable, mine: IntArray) -> tuple[Placed, IntArray]:
    """Return the values of the Float64 messages ``mine``, and those that are none."""
    size = table.size if len(mine) == len(table) else table.size[mine]
    fitting = (size == _SIZES[0]) | (size == _SIZES[1])
    picked = mine if fitting.all() else mine[fitting]
    payload = rows(content, _PAYLOAD, HEAD_SIZE, table.offset[picked])
    mark = payload['mark']
    value = np.ascontiguousarray(payload['value'])
    if (mark == 0).any():
        value = np.where(mark == 0, value.byteswap(), value)
    plain = mark <= 1
    wrong = np.concatenate([mine[~fitting], picked[~plain]])
    if len(wrong):
        picked, value = picked[plain], value[plain]
    n = len(picked)
    # Almost always every message of a group is picked, and in order.
    cut = slice(None) if n == len(table) else picked
    found = Rows(
        table.log_time[cut],
        table.publish_time[cut],
        table.channel[cut],
        np.full(n, -1, dtype=np.int8),
        value,
        np.zeros(n, dtype=np.uint8),
    )
    return (table.offset[cut], found), wrong


def sample_rows(table: MessageTable, picked: IntArray, samples: Samples) -> Placed:
    """Turn each sample into a reading per signal; an optional signal that is NaN is absent."""
    required = np.array([info.required for info in SIGNALS])
    keep = samples.good[:, None] & (np.isfinite(samples.values) | required)
    message, signal = np.nonzero(keep)
    source = picked[message]
    return table.offset[source], Rows(
        table.log_time[source],
        samples.time_ns[message],
        table.channel[source],
        signal.astype(np.int8),
        samples.values[message, signal],
        samples.quality[message, signal],
    )


def merged(parts: list[Placed]) -> Rows:
    """Join values of several kinds in the order in which they stood."""
    if len(parts) == 1:
        return parts[0][1]
    order = np.argsort(np.concatenate([offset for offset, _ in parts]), kind='stable')
    return Rows(
        *(
            np.concatenate([getattr(found, name) for _, found in parts])[order]
            for name in Rows.__dataclass_fields__
        )
    )
