# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A damaged file yields fewer values and never wrong ones."""

import random
import struct

import pytest
from damage import against_chunks, chunk_ends, record_heads, records
from log_files import START_NS, Reading, read_back, write_chunks
from mcap.opcode import Opcode

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import open_log
from valveflow_ros.logs.mcap.records import RECORD_HEAD
from valveflow_ros.logs.mcap.recover import recover
from valveflow_ros.logs.mcap.scan import Scanner
from valveflow_ros.logs.source import Source

PER_CHUNK = 20
SEED = 20240117
FLIPS = 2000


@pytest.fixture(scope='module')
def small(tmp_path_factory):
    """Return a file of 20 chunks of 20 messages each, about 24 kB, and what is in it."""
    path, wanted, _ = write_chunks(tmp_path_factory.mktemp('small') / 'log')
    return path.read_bytes(), wanted


def readings_of(path):
    try:
        return read_back(open_log(path))
    except RecordingError:
        return []


def lost_chunks(found, wanted):
    """Return how many whole chunks are missing; fails if anything else is."""
    missing, wrong = against_chunks(found, wanted, PER_CHUNK)
    assert wrong == []
    return missing


def test_a_file_cut_anywhere_gives_all_whole_chunks(tmp_path, small):
    raw, wanted = small
    ends = chunk_ends(raw)
    path = tmp_path / 'cut.mcap'
    edges = {end + step for end in ends for step in (-1, 0, 1, 9)}
    for size in sorted(edges | set(range(1, len(raw), 37))):
        path.write_bytes(raw[:size])
        whole = sum(end <= size for end in ends)
        assert readings_of(path) == wanted[: whole * PER_CHUNK]


def test_a_cut_file_says_so_in_one_sentence(tmp_path, small):
    raw, _ = small
    path = tmp_path / 'cut.mcap'
    path.write_bytes(raw[: chunk_ends(raw)[7] + 30])
    [warning] = open_log(path).warnings
    assert warning.startswith('The file was not finished and ends at byte ')
    path.write_bytes(raw[: chunk_ends(raw)[7]])
    assert open_log(path).warnings == ('The file was not finished; everything in it was read.',)


def test_what_stands_before_a_cut_chunk_is_kept(tmp_path, small):
    raw, _ = small
    begin = next(begin for op, begin, _ in records(raw) if op == Opcode.CHUNK)
    end = chunk_ends(raw)[0]
    path = tmp_path / 'cut.mcap'
    for size in range(end, end + 400):
        path.write_bytes(raw[:size])
        assert open_log(path).attachments == {'parameters.yaml': b'a: 1\n'}
    for size in range(begin, end, 7):
        path.write_bytes(raw[:size])
        with Source.open(path) as source:
            scanner = Scanner(source)
            assert list(scanner.chunks()) == []
        assert [a.name for a in scanner.findings.attachments] == ['parameters.yaml'], size
        assert scanner.findings.cut_off_at in (begin, None if size == begin else begin)


def test_flipped_bits_cost_at_most_a_chunk_and_never_change_a_value(tmp_path, small):
    raw, wanted = small
    generator = random.Random(SEED)
    path = tmp_path / 'flipped.mcap'
    for _ in range(FLIPS):
        bit = generator.randrange(8 * len(raw))
        damaged = bytearray(raw)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        assert lost_chunks(readings_of(path), wanted) <= 1, f'seed {SEED}, bit {bit}'


def test_flips_in_heads_of_records_cost_at_most_a_chunk(tmp_path, small):
    raw, wanted = small
    generator = random.Random(SEED + 1)
    path = tmp_path / 'flipped.mcap'
    for place in generator.sample(record_heads(raw), 300):
        bit = generator.randrange(8)
        damaged = bytearray(raw)
        damaged[place] ^= 1 << bit
        path.write_bytes(damaged)
        assert lost_chunks(readings_of(path), wanted) <= 1, f'byte {place}, bit {bit}'


def test_bursts_of_noise_leave_only_whole_chunks(tmp_path, small):
    raw, wanted = small
    generator = random.Random(SEED + 2)
    path = tmp_path / 'noisy.mcap'
    for _ in range(150):
        start = generator.randrange(len(raw))
        size = generator.randrange(1, 3000)
        noise = generator.randbytes(size) if generator.random() < 0.5 else bytes(size)
        path.write_bytes((raw[:start] + noise + raw[start + size :])[: len(raw)])
        lost_chunks(readings_of(path), wanted)


def test_pieces_taken_out_or_put_in_leave_only_whole_chunks(tmp_path, small):
    raw, wanted = small
    generator = random.Random(SEED + 3)
    path = tmp_path / 'pieces.mcap'
    for _ in range(150):
        start, size = generator.randrange(len(raw)), generator.randrange(1, 2000)
        without = raw[:start] + raw[start + size :]
        with_more = raw[:start] + generator.randbytes(size) + raw[start:]
        for changed in (without, with_more):
            path.write_bytes(changed)
            lost_chunks(readings_of(path), wanted)


def test_without_its_first_chunk_a_file_still_knows_its_topics(tmp_path, small):
    raw, wanted = small
    ends = chunk_ends(raw)
    for size in (len(raw), ends[-1]):
        damaged = bytearray(raw[:size])
        damaged[ends[0] - 20] ^= 255
        path = tmp_path / 'headless.mcap'
        path.write_bytes(damaged)
        contents = open_log(path)
        assert read_back(contents) == wanted[PER_CHUNK:]
        assert contents.damaged_chunks == 1


def test_losses_are_told(tmp_path, small):
    raw, wanted = small
    ends = chunk_ends(raw)
    damaged = bytearray(raw)
    for end in (ends[3], ends[9]):
        damaged[end - 5] ^= 4
    path = tmp_path / 'damaged.mcap'
    path.write_bytes(damaged)
    contents = open_log(path)
    assert len(contents.readings) == len(wanted) - 2 * PER_CHUNK
    assert contents.damaged_chunks == 2
    text = ' '.join(contents.warnings)
    assert 'The file is damaged in 2 places' in text
    assert f'was written with {len(wanted)} messages, {2 * PER_CHUNK} of them are lost' in text


def test_a_chunk_hidden_by_a_wrong_kind_is_missed_in_the_count(tmp_path, small):
    raw, wanted = small
    damaged = bytearray(raw)
    position = raw.rindex(struct.pack('<Q', START_NS + 50 * 10**9 + 1000), 0, chunk_ends(raw)[10])
    damaged[position - RECORD_HEAD.size] = Opcode.METADATA
    path = tmp_path / 'hidden.mcap'
    path.write_bytes(damaged)
    contents = open_log(path)
    assert lost_chunks(read_back(contents), wanted) == 1
    assert any(f'{PER_CHUNK} of them are lost' in warning for warning in contents.warnings)


def test_recovering_damaged_files_gives_whole_ones(tmp_path, small):
    raw, wanted = small
    generator = random.Random(SEED + 4)
    path = tmp_path / 'damaged.mcap'
    for number in range(60):
        damaged = bytearray(raw)
        for _ in range(3):
            damaged[generator.randrange(len(raw))] ^= 1 << generator.randrange(8)
        path.write_bytes(damaged[: generator.randrange(len(raw) // 2, len(raw) + 1)])
        out = tmp_path / f'{number}.mcap'
        before = readings_of(path)
        report = recover(path, out)
        contents = open_log(out)
        assert contents.warnings == ()
        assert read_back(contents) == before
        assert report.messages == len(before)
        lost_chunks(before, wanted)


def test_one_value_is_told_from_another():
    """The comparisons above would see a wrong value."""
    wanted = [Reading(k, k, 0, float(k), 0) for k in range(2 * PER_CHUNK)]
    wrong = [*wanted[:-1], wanted[-1]._replace(value=-1.0)]
    with pytest.raises(AssertionError):
        lost_chunks(wrong, wanted)
