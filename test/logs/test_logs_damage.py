# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A damaged file yields fewer values and never wrong ones."""

import random

import pytest
from log_files import (
    against_chunks,
    chunk_ends,
    read_back,
    record_heads,
    records,
    write_chunks,
    write_part,
)
from mcap.opcode import Opcode

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import open_log, recover
from valveflow_ros.logs.mcap.chunk_file import REPEAT_CHUNKS
from valveflow_ros.logs.mcap.scan import Scanner
from valveflow_ros.logs.source import Source

PER_CHUNK = 20
SEED = 20240117


@pytest.fixture(scope='module')
def small(tmp_path_factory):
    """Return a file of 20 chunks of 20 messages each, about 24 kB, and what is in it."""
    path, wanted, _ = write_chunks(tmp_path_factory.mktemp('small') / 'log')
    return path.read_bytes(), wanted


@pytest.fixture
def path(tmp_path):
    return tmp_path / 'damaged.mcap'


def readings_of(path, raw):
    path.write_bytes(raw)
    try:
        return read_back(open_log(path))
    except RecordingError:
        return []


def lost_chunks(found, wanted):
    """Return how many whole chunks are missing; fails if anything else is."""
    missing, wrong = against_chunks(found, wanted, PER_CHUNK)
    assert wrong == []
    return missing


def test_a_file_cut_anywhere_gives_all_whole_chunks(path, small):
    raw, wanted = small
    ends = chunk_ends(raw)
    edges = {end + step for end in ends for step in (-1, 0, 1, 9)}
    for size in sorted(edges | set(range(1, len(raw), 97))):
        whole = sum(end <= size for end in ends)
        assert readings_of(path, raw[:size]) == wanted[: whole * PER_CHUNK]


def test_a_cut_file_says_so_in_one_sentence(path, small):
    raw, _ = small
    end = chunk_ends(raw)[7]
    for size, told in (
        (end + 30, 'The file was not finished and ends at byte '),
        (end, 'The file was not finished; everything in it was read.'),
    ):
        path.write_bytes(raw[:size])
        [warning] = open_log(path).warnings
        assert warning.startswith(told)


def test_what_stands_before_a_cut_chunk_is_kept(path, small):
    raw, _ = small
    begin = next(begin for op, begin, _ in records(raw) if op == Opcode.CHUNK)
    end = chunk_ends(raw)[0]
    for size in range(end, end + 400, 3):
        path.write_bytes(raw[:size])
        assert open_log(path).attachments == {'parameters.yaml': b'a: 1\n'}
    for size in range(begin, end, 7):
        path.write_bytes(raw[:size])
        with Source.open(path) as source:
            scanner = Scanner(source)
            assert list(scanner.chunks()) == []
        assert [a.name for a in scanner.findings.attachments] == ['parameters.yaml'], size
        assert scanner.findings.cut_off_at in (begin, None if size == begin else begin)


@pytest.mark.parametrize(
    ('where', 'count'),
    [('anywhere', 250), ('heads', 150), pytest.param('anywhere', 5000, marks=pytest.mark.long)],
)
def test_flipped_bits_cost_at_most_a_chunk_and_never_change_a_value(path, small, where, count):
    raw, wanted = small
    places = range(len(raw)) if where == 'anywhere' else record_heads(raw)
    generator = random.Random(SEED)
    for place in generator.choices(places, k=count):
        damaged, bit = bytearray(raw), generator.randrange(8)
        damaged[place] ^= 1 << bit
        lost = lost_chunks(readings_of(path, damaged), wanted)
        assert lost <= 1, f'seed {SEED}, byte {place}, bit {bit}'


def test_noise_and_pieces_taken_out_or_put_in_leave_only_whole_chunks(path, small):
    raw, wanted = small
    generator = random.Random(SEED + 2)
    for _ in range(50):
        start, size = generator.randrange(len(raw)), generator.randrange(1, 3000)
        noise, rest = generator.randbytes(size), raw[start + size :]
        for middle in (noise[: len(raw) - start], bytes(size)[: len(raw) - start], b''):
            lost_chunks(readings_of(path, raw[:start] + middle + rest), wanted)
        lost_chunks(readings_of(path, raw[:start] + noise + raw[start:]), wanted)


def test_without_its_first_chunk_a_file_still_knows_its_topics(path, small):
    raw, wanted = small
    ends = chunk_ends(raw)
    for size in (len(raw), ends[-1]):
        damaged = bytearray(raw[:size])
        damaged[ends[0] - 20] ^= 255
        path.write_bytes(damaged)
        contents = open_log(path)
        assert read_back(contents) == wanted[PER_CHUNK:]
        assert contents.damaged_chunks == 1


def test_chunks_before_the_first_table_that_is_left_are_read(tmp_path):
    part, wanted = write_part(tmp_path / 'log', chunks=3 * REPEAT_CHUNKS)
    raw = bytearray(part.read_bytes())
    # Two tables stand at the beginning, the next one REPEAT_CHUNKS later.
    for begin, end in [place for op, *place in records(raw) if op == Opcode.CHUNK][:2]:
        raw[begin + 20 : end] = bytes(end - begin - 20)
    part.write_bytes(raw)
    assert read_back(open_log(part)) == wanted[2 * 20 :]


def test_losses_are_told(path, small):
    raw, wanted = small
    ends = chunk_ends(raw)
    damaged = bytearray(raw)
    for end in (ends[3], ends[9]):
        damaged[end - 5] ^= 4
    path.write_bytes(damaged)
    contents = open_log(path)
    assert len(contents.readings) == len(wanted) - 2 * PER_CHUNK
    assert contents.damaged_chunks == 2
    text = ' '.join(contents.warnings)
    assert 'The file is damaged in 2 places' in text
    assert f'was written with {len(wanted)} messages, {2 * PER_CHUNK} of them are lost' in text


def test_recovering_damaged_files_gives_whole_ones(path, small):
    raw, wanted = small
    generator = random.Random(SEED + 4)
    for number in range(40):
        damaged = bytearray(raw)
        for _ in range(3):
            damaged[generator.randrange(len(raw))] ^= 1 << generator.randrange(8)
        size = generator.randrange(len(raw) // 2, len(raw) + 1)
        before = readings_of(path, damaged[:size])
        out = path.with_name(f'{number}.mcap')
        report = recover(path, out)
        contents = open_log(out)
        assert contents.warnings == ()
        assert read_back(contents) == before
        assert report.messages == len(before)
        lost_chunks(before, wanted)
