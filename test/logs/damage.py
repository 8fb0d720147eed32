# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a damaged file should still give, found by an obvious walk over the intact one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mcap.opcode import Opcode

from valveflow_ros.logs.mcap.records import MAGIC, RECORD_HEAD


def records(raw: bytes) -> list[tuple[int, int, int]]:
    """Return kind, begin and end of every record of an intact file."""
    position, found = len(MAGIC), []
    while position < len(raw) - len(MAGIC):
        op, length = RECORD_HEAD.unpack_from(raw, position)
        end = position + RECORD_HEAD.size + length
        found.append((op, position, end))
        position = end
    return found


def chunk_ends(raw: bytes) -> list[int]:
    """Return where each chunk ends."""
    return [end for op, _, end in records(raw) if op == Opcode.CHUNK]


def record_heads(raw: bytes) -> list[int]:
    """Return every byte that belongs to the kind or the length of a record."""
    size = RECORD_HEAD.size
    return [place for _, begin, _ in records(raw) for place in range(begin, begin + size)]


def against_chunks(
    found: Sequence[Any], wanted: Sequence[Any], per_chunk: int
) -> tuple[int, list[Any]]:
    """Return how many whole chunks are missing, and what was found that is in no whole chunk."""
    left, missing = list(found), 0
    for first in range(0, len(wanted), per_chunk):
        chunk = list(wanted[first : first + per_chunk])
        if left[: len(chunk)] == chunk:
            left = left[len(chunk) :]
        else:
            missing += 1
    return missing, left
