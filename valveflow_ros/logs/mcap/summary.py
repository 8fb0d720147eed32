"""The summary at the end of a finished file, believed only if its checksum is right."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field

from valveflow_ros.logs.limits import DEFAULT_LIMITS
from valveflow_ros.logs.mcap.layout import (
    FOOTER,
    FOOTER_RECORD_SIZE,
    MAGIC,
    RECORD_HEAD,
    Cursor,
    LayoutError,
    Op,
)
from valveflow_ros.logs.mcap.seek import ends_well
from valveflow_ros.logs.mcap.topic_table import TopicTable
from valveflow_ros.logs.source import Source


@dataclass(slots=True)
class Summary:
    """What a finished file says about itself."""

    table: TopicTable = field(default_factory=TopicTable)
    messages: int = 0
    start_ns: int = 0
    end_ns: int = 0
    counts: dict[int, int] = field(default_factory=dict)


def read_summary(source: Source) -> Summary | None:
    """Return the summary, or ``None`` if there is none whose checksum is right."""
    if not ends_well(source):
        return None
    footer_at = source.size - len(MAGIC) - FOOTER_RECORD_SIZE
    footer = source.read(footer_at, FOOTER_RECORD_SIZE)
    start, _, crc = FOOTER.unpack_from(footer, RECORD_HEAD.size)
    size = footer_at - start
    if start == 0 or not 0 < size <= DEFAULT_LIMITS.record_bytes:
        return None
    raw = source.read(start, size)
    if zlib.crc32(footer[:-4], zlib.crc32(raw)) != crc:
        return None
    try:
        return _parse(raw)
    except LayoutError:
        return None


def _parse(raw: bytes) -> Summary:
    summary = Summary()
    cursor = Cursor(raw)
    while cursor.position < len(raw):
        op, length = RECORD_HEAD.unpack(cursor.take(RECORD_HEAD.size))
        content = cursor.take(length)
        if op in (Op.SCHEMA, Op.CHANNEL):
            summary.table.add(Op(op), content)
        elif op == Op.STATISTICS:
            _statistics(summary, content)
    return summary


def _statistics(summary: Summary, content: bytes) -> None:
    cursor = Cursor(content)
    summary.messages = cursor.u64()
    cursor.take(2 + 4 * 4)
    summary.start_ns, summary.end_ns = cursor.u64(), cursor.u64()
    inner = Cursor(cursor.take(cursor.u32()))
    while inner.position < len(inner.data):
        channel = inner.u16()
        summary.counts[channel] = inner.u64()
