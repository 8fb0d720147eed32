"""Finds places in a file that look like the head of a chunk, and the end of a finished one."""

from __future__ import annotations

import re
from collections.abc import Iterator

from valveflow_ros.logs.mcap.layout import FOOTER_RECORD_SIZE, MAGIC, RECORD_HEAD, Op
from valveflow_ros.logs.source import Source

# A chunk's record: kind 6, a length below 64 GiB, four fixed fields, then the
# compression by name. The length is checked against the fields afterwards.
_SHAPE = re.compile(
    rb'\x06.{4}[\x00-\x0f]\x00{3}.{28}(?:\x00{4}|\x03\x00{3}lz4|\x04\x00{3}zstd)', re.DOTALL
)
# More than the head of a chunk takes.
SHAPE_SIZE = 64
_WINDOW = 1 << 22


def candidates(source: Source, start: int, end: int) -> Iterator[int]:
    """Yield places in ``[start, end)`` where the fields of a chunk's head agree."""
    while start < end:
        limit = min(_WINDOW, end - start)
        window = source.read(start, limit + SHAPE_SIZE)
        match = _SHAPE.search(window)
        while match is not None and match.start() < limit:
            if _fields_agree(window, match.start(), match.end()):
                yield start + match.start()
            # One byte on: a false head must not hide a true one that overlaps it.
            match = _SHAPE.search(window, match.start() + 1)
        start += _WINDOW


def _fields_agree(window: bytes, position: int, names_end: int) -> bool:
    length = RECORD_HEAD.unpack_from(window, position)[1]
    packed_at = names_end + 8
    if packed_at > len(window):
        return False
    packed = int.from_bytes(window[names_end:packed_at], 'little')
    return bool(packed_at - position - RECORD_HEAD.size + packed == length)


def ends_well(source: Source) -> bool:
    """Tell whether a file was finished: it ends in a footer and the magic."""
    start = source.size - len(MAGIC) - FOOTER_RECORD_SIZE
    if start < len(MAGIC):
        return False
    raw = source.read(start, FOOTER_RECORD_SIZE + len(MAGIC))
    op, length = RECORD_HEAD.unpack_from(raw)
    return op == Op.FOOTER and length == 20 and raw.endswith(MAGIC)
