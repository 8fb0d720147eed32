# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Every legal kind of MCAP recording: reader, `info` and `recover` against the library `mcap`."""

import dataclasses
import itertools
from collections import Counter

import pytest
from hypothesis import example, given, settings
from log_files import FLOAT64, START_NS, float64, messages_of, numbered, records, stock
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from mcap_kinds import CHANNELS, KINDS, SCHEMA, TOPICS, UNTYPED, Kind

from valveflow_ros.cli.main import main
from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import open_log, recover
from valveflow_ros.logs.mcap import recover as recovery
from valveflow_ros.logs.mcap.chunk_file import CHUNK_BYTES
from valveflow_ros.logs.mcap.follow import Follower
from valveflow_ros.logs.mcap.records import pack

# The first byte of this value begins the first chunk of these files.
CHUNK = bytes([Opcode.CHUNK])


@pytest.fixture
def path(tmp_path):
    return tmp_path / 'a.mcap'


def read(path):
    return messages_of(open_log(path))


def in_file(raw):
    return numbered(raw, seek=False, sort=False)


def recovered(path):
    """Return the file that a recovery makes of one, and its report."""
    out = path.with_name('b.mcap')
    out.unlink(missing_ok=True)
    return out, recover(path, out)


def unchecked_sentence(kind):
    """Return what is told of parts without a checksum, unless one of the whole file is right."""
    chunks, messages = kind.unchecked()
    parts = []
    if chunks:
        one = 'chunk of the file was' if chunks == 1 else 'chunks of the file were'
        parts.append(f'{chunks} {one} written without a checksum')
    if messages:
        parts.append(
            f'{messages} messages of the file stand outside of chunks and without a checksum'
        )
    if not parts or kind.data_crc:
        return ()
    return (f'{" and ".join(parts)}; damage there cannot be seen.',)


@settings(max_examples=60)
@given(KINDS)
@example(Kind(topics='before'))
@example(Kind(topics='before', summary=False))
@example(Kind(topics='summary', summary_crc=False))
def test_every_kind_is_read_recovered_and_followed_as_stock_readers_read_it(
    tmp_path_factory, kind
):
    path = tmp_path_factory.mktemp('kinds') / 'a.mcap'
    raw, truth = kind.write(), kind.truth()
    path.write_bytes(raw)
    # What follows a file's own reader: without an index of chunks it goes from the beginning,
    # and with one it does not find the messages beside them.
    seek = kind.summary and kind.chunk_index and kind.summary_topics and kind.outside == 'none'
    if seek or kind.topics != 'summary':
        assert Counter(stock(raw, seek)) == Counter(truth)
    found = open_log(path)
    assert messages_of(found) == truth
    assert {t.name: t.count for t in found.topics.values()} == Counter(m.topic for m in truth)
    types = {**dict.fromkeys(TOPICS, FLOAT64), UNTYPED.topic: ''}
    assert {t.name: t.type for t in found.topics.values()} == types
    inputs = [m for m in truth if m.topic in TOPICS]
    assert found.log_time_ns.tolist() == [m.log_ns for m in inputs]
    assert [float64(value) for value in found.readings.value] == [m.data for m in inputs]
    assert (found.damaged_chunks, found.warnings) == (0, unchecked_sentence(kind))
    names = ['a', *(f'b{k % 2}' for k in range(kind.chunks))] if kind.extras else []
    assert found.attachments == {name: name.encode() for name in names}
    assert found.metadata == {name: {'of': name} for name in names}

    out, report = recovered(path)
    again = out.read_bytes()
    assert (report.messages, report.damaged_chunks) == (len(truth), 0)
    assert (report.bare_messages, report.warnings) == (kind.unchecked()[1], found.warnings)
    if kind.topics != 'summary':
        assert in_file(again) == in_file(raw)
    # The two stock readers differ in how they order equal times, and in what they need.
    assert Counter(stock(again)) == Counter(stock(again, seek=False)) == Counter(truth)
    assert read(out) == truth
    assert open_log(out).warnings == ()
    with out.open('rb') as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_summary().channels == {channel.id: channel for channel in CHANNELS}
        # One name may stand twice.
        assert [a.name for a in reader.iter_attachments()] == names
        assert [m.name for m in reader.iter_metadata() if m.name != 'rosbag2'] == names

    follower = Follower(path)
    batches = list(follower.read())
    assert (follower.damaged, follower.finished) == (0, True)
    times = [t for batch in batches for t in batch.messages.log_time.tolist()]
    assert sorted(times) == [m.log_ns for m in truth]
    if kind.topics != 'summary':
        told = {c.topic for c in batches[-1].topics.channels.values()}
        assert told == {channel.topic for channel in CHANNELS}


def test_info_says_where_there_is_no_reading(path, capsys):
    with path.open('wb') as stream:
        writer = Writer(stream)
        writer.start()
        number = writer.register_channel('/notes', 'json', 0)
        writer.add_message(number, START_NS, b'{}', START_NS)
        writer.finish()
    assert main(['info', str(path)]) == 0
    told = capsys.readouterr().out
    assert 'No reading was found.' in told
    assert 'Every reading' not in told


@pytest.mark.parametrize('compression', CompressionType)
@pytest.mark.parametrize('chunked', [True, False])
def test_every_two_options_of_the_stock_writer(path, compression, chunked):
    messages = Kind(chunks=4).truth()
    # In eight rows every two of the five options take all four values.
    for crcs, data_crcs, repeat in itertools.product([True, False], repeat=3):
        statistics, index = crcs != data_crcs, crcs != repeat
        with path.open('wb') as stream:
            writer = Writer(
                stream, chunk_size=900, compression=compression, use_chunking=chunked,
                index_types=IndexType.ALL if index else IndexType.NONE, repeat_channels=repeat,
                repeat_schemas=repeat, use_statistics=statistics, use_summary_offsets=statistics,
                enable_crcs=crcs, enable_data_crcs=data_crcs,
            )  # fmt: skip
            writer.start()
            schema = writer.register_schema(SCHEMA.name, SCHEMA.encoding, SCHEMA.data)
            numbers = {
                c.topic: writer.register_channel(
                    c.topic, c.message_encoding, schema if c.schema_id else 0
                )
                for c in CHANNELS
            }
            for m in messages:
                writer.add_message(numbers[m.topic], m.log_ns, m.data, m.publish_ns)
            writer.finish()
        raw = path.read_bytes()
        assert Counter(stock(raw, seek=False)) == Counter(messages)
        assert read(path) == messages
        assert bool(open_log(path).warnings) == (not (chunked and crcs) and not data_crcs)
        out, report = recovered(path)
        assert report.messages == len(messages)
        assert report.bare_messages == (0 if chunked else len(messages))
        assert read(out) == messages
        assert in_file(out.read_bytes()) == in_file(raw)
        assert open_log(out).warnings == ()


def ends_of_messages(raw):
    """Return where each message outside of chunks ends."""
    return [end for op, _, end in records(raw) if op == Opcode.MESSAGE]


@pytest.mark.parametrize('step', [31, pytest.param(1, marks=pytest.mark.long)])
@pytest.mark.parametrize('outside', ['none', 'some', 'all'])
def test_a_file_without_checksums_that_is_cut_anywhere_keeps_what_stands_before(
    path, outside, step
):
    raw = Kind(topics='before', outside=outside, chunk_crc=False, chunks=2).write()
    truth, each = in_file(raw), {Opcode.MESSAGE: 1, Opcode.CHUNK: 4 * len(CHANNELS)}
    ends = [end for op, _, end in records(raw) for _ in range(each.get(op, 0))]
    # Read and made whole around the ends of all records, and at some bytes between.
    borders = {end + off for _, _, end in records(raw) for off in (-1, 0, 1)}
    for size in sorted({*range(0, len(raw), step), *borders} - {len(raw), len(raw) + 1}):
        path.write_bytes(raw[:size])
        whole = sum(end <= size for end in ends)
        if not whole:
            with pytest.raises(RecordingError):
                open_log(path)
            continue
        assert len(read(path)) == whole, size
        if size in ends or size % 17 == 0:
            out, report = recovered(path)
            assert (report.messages, report.damaged_chunks) == (whole, 0), size
            assert in_file(out.read_bytes()) == truth[:whole]


@pytest.mark.parametrize('wrong', [0, 0x10, 0xFF])
@pytest.mark.parametrize('field', ['kind', 'length'])
def test_what_stands_before_the_first_record_that_cannot_be_one_is_kept(path, field, wrong):
    raw = bytearray(Kind(topics='before', outside='all').write())
    truth = in_file(bytes(raw))
    place = [begin for op, begin, _ in records(bytes(raw)) if op == Opcode.MESSAGE][17]
    if field == 'kind':
        raw[place] = wrong
    raw[place + 6 : place + 9] = bytes([1, 2, 3]) if field == 'kind' else bytes([wrong, 9, wrong])
    path.write_bytes(raw)
    out, report = recovered(path)
    assert in_file(out.read_bytes()) == truth[:17]
    assert report.damaged_chunks == 1
    assert any(f'breaks at byte {place})' in warning for warning in report.warnings)
    assert len(read(path)) == 17


@pytest.mark.parametrize('outside', ['some', 'all'])
def test_a_wrong_checksum_of_all_records_is_told(path, outside):
    raw = bytearray(Kind(topics='before', outside=outside, data_crc=True).write())
    path.write_bytes(raw)
    assert open_log(path).warnings == ()
    raw[ends_of_messages(bytes(raw))[3] - 1] ^= 1
    path.write_bytes(raw)
    [told] = open_log(path).warnings
    assert told.startswith('The checksum of all records of the file is wrong')
    assert recovered(path)[1].warnings == (told,)


def test_a_message_that_cannot_be_one_is_passed_over(path):
    raw = bytearray(Kind(topics='before', outside='all').write())
    truth = in_file(bytes(raw))
    place = ends_of_messages(bytes(raw))[7]
    # Its log time is beyond the year 2262.
    raw[place + 22] = 0xFF
    path.write_bytes(raw)
    out, report = recovered(path)
    assert f'(the message at byte {place} cannot be one)' in report.warnings[0]
    assert in_file(out.read_bytes()) == truth[:8] + truth[9:]


def test_a_wrong_bit_gives_no_message_where_all_messages_stand_in_chunks(path):
    """Of another record's kind, a message's may be one bit away."""
    kind = Kind(topics='before', extras=True, chunks=2)
    raw, truth = kind.write(), kind.truth()
    for (_, begin, _), bit in itertools.product(records(raw), range(8)):
        damaged = bytearray(raw)
        damaged[begin] ^= 1 << bit
        path.write_bytes(damaged)
        try:
            found = read(path)
        except RecordingError:
            found = []
        assert not Counter(found) - Counter(truth), (begin, bit)


def test_messages_outside_of_chunks_are_recovered_into_chunks_of_the_usual_size(path):
    size = [12, 16, 3000, 200_000]
    with path.open('wb') as stream:
        writer = Writer(stream, use_chunking=False)
        writer.start()
        numbers = [writer.register_channel(f'/t{k}', 'json', 0) for k in range(4)]
        for k in range(6_000):
            kind = 3 if k == 2500 else k // 100 % 3
            # Numbers as an index behind a chunk has them.
            data = bytes(size[kind])
            writer.add_message(numbers[kind], START_NS + k // 7, data, 0, len(data) + 16)
            if k % 1500 == 0:
                writer.add_metadata(f'm{k}', {})
        writer.finish()
    out, report = recovered(path)
    raw = out.read_bytes()
    assert in_file(raw) == in_file(path.read_bytes())
    assert report.bare_messages == report.messages == 6_000
    with out.open('rb') as stream:
        indexes = make_reader(stream).get_summary().chunk_indexes
    *_, second, first = sorted(index.uncompressed_size for index in indexes)
    assert first == 200_031
    assert second <= CHUNK_BYTES + 200
    assert len(indexes) < 2 * path.stat().st_size // CHUNK_BYTES
    assert Counter(read(path)) == Counter(stock(raw))


@pytest.mark.parametrize('summary', [True, False])
@pytest.mark.parametrize('topics', ['first', 'every'])
def test_a_record_outside_of_the_chunks_never_overrules_one_with_a_checksum(path, topics, summary):
    kind = Kind(topics=topics, summary=summary)
    raw = kind.write()
    liar = dataclasses.replace(CHANNELS[0], topic='/generated_power_of_another_unit')
    start = raw.index(CHUNK)
    path.write_bytes(raw[:start] + pack(liar) + raw[start:])
    found = open_log(path)
    assert messages_of(found) == kind.truth()
    assert found.damaged_chunks == 1
    assert liar.topic not in found.topics
    out, report = recovered(path)
    assert read(out) == kind.truth()
    assert report.messages == len(kind.truth())


def test_messages_of_topics_that_nothing_names_are_left_out_of_what_is_recovered(path):
    """Some channels are told in a chunk that is lost; the messages of the others stay."""
    raw = Kind(summary=False, chunk_index=False, topics='before').write()
    for lost in (CHANNELS[1], CHANNELS[2], UNTYPED):
        raw = raw.replace(pack(lost), b'', 1)
    path.write_bytes(raw)
    out, report = recovered(path)
    every = Kind().truth()
    truth = [m for m in every if m.topic in (TOPICS[0], TOPICS[3])]
    assert Counter(stock(out)) == Counter(stock(out, seek=False)) == Counter(truth)
    assert report.messages == len(truth)
    left_out = f'{len(every) - len(truth)} messages are on'
    assert any(w.startswith(left_out) for w in report.warnings)


def test_a_file_that_the_stock_reader_does_not_open_gets_no_name(path, monkeypatch, capsys):
    path.write_bytes(before := Kind().write())

    def refuses(*_args, **_options):
        raise McapError('no channel record found with id 1')

    monkeypatch.setattr(recovery, 'make_reader', refuses)
    assert main(['recover', str(path), '-o', str(path.with_name('b.mcap'))]) == 1
    said = capsys.readouterr()
    assert 'no channel record found with id 1); nothing was written.' in said.err
    assert 'Kept' not in said.out
    assert [p.name for p in path.parent.iterdir()] == ['a.mcap']
    assert path.read_bytes() == before


@pytest.mark.parametrize('bit', range(4, 8))
def test_a_chunk_whose_kind_was_damaged_is_no_record_of_a_later_version(path, bit):
    kind = Kind(topics='every', summary=False)
    raw = bytearray(kind.write())
    raw[raw.index(CHUNK)] ^= 1 << bit
    path.write_bytes(raw)
    out, report = recovered(path)
    assert report.damaged_chunks == 1
    rest = Counter(kind.truth())
    rest.subtract(read(out))
    assert sorted(set(rest.values())) == [0, 1]
    assert open_log(path).damaged_chunks == 1
