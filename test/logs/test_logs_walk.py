# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The quick walk through a chunk against a loop that takes one record at a time."""

import struct

import lz4.frame
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode

from valveflow_ros.logs.mcap.records import LayoutError, Unpacker, walk


def naive_walk(content):
    messages, others, position = [], [], 0
    while position < len(content):
        if len(content) - position < 9:
            return None
        op, length = struct.unpack_from('<BQ', content, position)
        body = content[position + 9 : position + 9 + length]
        if len(body) < length:
            return None
        if op == Opcode.MESSAGE:
            if length < 22:
                return None
            channel, _, log_ns, publish_ns = struct.unpack_from('<HIqq', body)
            if log_ns < 0 or publish_ns < 0:
                return None
            messages.append((channel, log_ns, publish_ns, position, body[22:]))
        elif op in (Opcode.SCHEMA, Opcode.CHANNEL):
            others.append((op, body))
        elif op < 16:
            return None
        position += 9 + length
    return messages, others


def message(channel, log_ns, data):
    head = struct.pack('<BQHIqq', Opcode.MESSAGE, 22 + len(data), channel, 0, log_ns, log_ns + 1)
    return head + data


def quick_walk(content):
    try:
        table, others = walk(content)
    except LayoutError:
        return None
    rows = range(len(table))
    columns = (table.channel, table.log_time, table.publish_time, table.offset)
    fields = [[int(column[row]) for column in columns] for row in rows]
    messages = [(*fields[row], table.payload(content, row)) for row in rows]
    return messages, [(int(op), body) for op, body in others]


RECORD = st.one_of(
    st.tuples(
        st.integers(0, 9), st.integers(0, 2**62), st.sampled_from([b'', bytes(8), bytes(30)])
    ).map(lambda parts: message(*parts)),
    st.binary(max_size=20).map(lambda body: struct.pack('<BQ', Opcode.CHANNEL, len(body)) + body),
)


@settings(max_examples=100)
@given(st.lists(st.tuples(RECORD, st.integers(1, 150)), max_size=6))
def test_runs_and_single_records_are_found_as_by_a_loop(runs):
    content = b''.join(record * count for record, count in runs)
    assert quick_walk(content) == naive_walk(content)


@settings(max_examples=100)
@given(st.lists(RECORD, min_size=1, max_size=80), st.data())
def test_broken_contents_are_refused_as_by_a_loop(records, data):
    content = bytearray(b''.join(records))
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    cut = bytes(content[: data.draw(st.integers(0, len(content)))])
    assert quick_walk(cut) == naive_walk(cut)


def test_a_chunk_within_a_chunk_is_refused_and_kinds_of_a_later_format_are_passed_over():
    for kind in (0, 1, 2, 6, 7, 15, 16, 127, 128, 255):
        parts = [message(1, 1, b''), struct.pack('<BQ', kind, 3) + b'new', message(1, 2, b'')]
        if kind >= 16:
            assert walk(b''.join(parts))[0].log_time.tolist() == [1, 2]
        else:
            with pytest.raises(LayoutError, match=f'kind {kind}'):
                walk(b''.join(parts))


PACKED = zstandard.compress(bytes(100))
UNSIZED = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(100))


def test_a_wrong_claim_of_the_unpacked_size_is_never_believed():
    for compression, packed, sizes in (
        ('zstd', PACKED, (99, 101)),
        ('zstd', UNSIZED, (99, 101)),
        ('zstd', b'no frame', (100,)),
        ('lz4', lz4.frame.compress(bytes(100)), (99, 101)),
        ('lz4', b'no frame', (100,)),
        ('', bytes(99), (100,)),
        ('bz2', bytes(100), (100,)),
    ):
        for size in sizes:
            with pytest.raises(LayoutError):
                Unpacker().unpack(compression, packed, size)
