"""Every legal kind of MCAP recording: reader, `info` and `recover` against the library `mcap`."""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections import Counter
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from log_files import FLOAT64, START_NS, float64
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from mcap_kinds import CHANNELS, KINDS, SCHEMA, TOPICS, UNTYPED, Kind, Told, stock

from valveflow_ros.cli.main import main
from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import open_log, recover
from valveflow_ros.logs.mcap import recover as recovery
from valveflow_ros.logs.mcap.follow import Follower
from valveflow_ros.logs.mcap.records import pack

# The first byte of this value begins the first chunk of these files.
CHUNK = bytes([Opcode.CHUNK])


def read(path: Path, unchecked: bool = True) -> list[Told]:
    found = open_log(path, unchecked=unchecked)
    return [Told(m.topic, m.log_time_ns, m.publish_time_ns, m.data) for m in found.iter_messages()]


def written(folder: Path, kind: Kind) -> Path:
    path = folder / 'a.mcap'
    path.write_bytes(kind.write())
    return path


@settings(max_examples=250, deadline=None)
@given(KINDS)
@example(Kind(topics='before'))
@example(Kind(topics='before', summary=False))
@example(Kind(topics='summary', summary_crc=False))
def test_every_kind_gives_the_messages_that_the_stock_reader_gives(tmp_path_factory, kind):
    path = written(tmp_path_factory.mktemp('kinds'), kind)
    raw, truth = path.read_bytes(), kind.truth()
    # What follows a file's own reader: without an index of chunks it goes from the beginning.
    seek = kind.summary and kind.chunk_index and kind.summary_topics
    if seek or kind.topics != 'summary':
        assert Counter(stock(raw, seek)) == Counter(truth)
    found = open_log(path, unchecked=True)
    assert read(path) == truth
    assert {t.name: t.count for t in found.topics.values()} == Counter(m.topic for m in truth)
    assert {t.name: t.type for t in found.topics.values()} == {
        **dict.fromkeys(TOPICS, FLOAT64), UNTYPED.topic: '',
    }  # fmt: skip
    inputs = [m for m in truth if m.topic in TOPICS]
    assert found.log_time_ns.tolist() == [m.log_ns for m in inputs]
    assert [float64(value) for value in found.readings.value] == [m.data for m in inputs]
    assert found.damaged_chunks == 0
    without = [f'{kind.chunks + (kind.topics == "own")} chunk']
    told = [] if kind.chunk_crc else without
    assert [w[: len(without[0])] for w in found.warnings] == told
    if kind.extras:
        names = ['a', *(f'b{k % 2}' for k in range(kind.chunks))]
        assert found.attachments == {name: name.encode() for name in names}
        assert found.metadata == {name: {'of': name} for name in names}


@settings(max_examples=250, deadline=None)
@given(KINDS)
@example(Kind(topics='before'))
@example(Kind(topics='before', summary=False))
@example(Kind(topics='summary', summary_crc=False))
def test_what_is_recovered_of_every_kind_is_read_by_the_stock_readers(tmp_path_factory, kind):
    folder = tmp_path_factory.mktemp('kinds')
    path, out = written(folder, kind), folder / 'b.mcap'
    if not kind.chunk_crc:
        with pytest.raises(RecordingError, match='was written without checksums'):
            recover(path, out)
        assert [p.name for p in folder.iterdir()] == ['a.mcap']
        return
    report = recover(path, out)
    raw, truth = out.read_bytes(), kind.truth()
    assert (report.messages, report.damaged_chunks, report.warnings) == (len(truth), 0, ())
    # The two stock readers differ in how they order equal times, and in what they need.
    assert Counter(stock(raw)) == Counter(stock(raw, seek=False)) == Counter(truth)
    assert read(out, unchecked=False) == truth
    with out.open('rb') as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_summary().channels == {channel.id: channel for channel in CHANNELS}
        # One name may stand twice.
        expected = [] if not kind.extras else ['a', *(f'b{k % 2}' for k in range(kind.chunks))]
        assert [a.name for a in reader.iter_attachments()] == expected
        assert [m.name for m in reader.iter_metadata() if m.name != 'rosbag2'] == expected


@settings(max_examples=80, deadline=None)
@given(KINDS.filter(lambda kind: kind.chunk_crc))
def test_every_kind_can_be_followed(tmp_path_factory, kind):
    path = written(tmp_path_factory.mktemp('kinds'), kind)
    follower = Follower(path)
    batches = list(follower.read())
    assert follower.damaged == 0
    assert follower.finished
    times = [t for batch in batches for t in batch.messages.log_time.tolist()]
    assert sorted(times) == [m.log_ns for m in kind.truth()]
    if kind.topics != 'summary':
        assert {c.topic for c in batches[-1].topics.channels.values()} == {
            channel.topic for channel in CHANNELS
        }


@pytest.mark.parametrize('kind', [Kind(topics=t) for t in ('before', 'between', 'own', 'summary')])
def test_info_lists_the_topics_of_every_kind(tmp_path, capsys, kind):
    path = written(tmp_path, kind)
    assert main(['info', str(path), '--json']) == 0
    told = json.loads(capsys.readouterr().out)
    expected = Counter(message.topic for message in kind.truth())
    assert {t['name']: t['messages'] for t in told['topics']} == expected
    assert {topic: s['readings'] for topic, s in told['signals'].items()} == {
        topic.lstrip('/'): 4 * kind.chunks for topic in TOPICS
    }


def test_info_says_where_there_is_no_reading(tmp_path, capsys):
    path = tmp_path / 'a.mcap'
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


@pytest.mark.parametrize(
    ('compression', 'chunked', 'repeat', 'statistics', 'offsets', 'crcs', 'data_crcs', 'index'),
    list(itertools.product(
        CompressionType, [True, False], [True, False], [True, False], [True, False],
        [True, False], [True, False], [IndexType.ALL, IndexType.NONE],
    )),
)  # fmt: skip
def test_every_option_of_the_stock_writer(
    tmp_path, compression, chunked, repeat, statistics, offsets, crcs, data_crcs, index
):
    path, messages = tmp_path / 'a.mcap', Kind(chunks=4).truth()
    with path.open('wb') as stream:
        writer = Writer(
            stream, chunk_size=900, compression=compression, index_types=index,
            repeat_channels=repeat, repeat_schemas=repeat, use_chunking=chunked,
            use_statistics=statistics, use_summary_offsets=offsets, enable_crcs=crcs,
            enable_data_crcs=data_crcs,
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
    assert Counter(stock(path.read_bytes(), seek=False)) == Counter(messages)
    out = tmp_path / 'b.mcap'
    if chunked:
        assert read(path) == messages
        if crcs:
            assert recover(path, out).messages == len(messages)
            assert read(out, unchecked=False) == messages
            return
    why = 'without checksums' if chunked else 'without chunks'
    with pytest.raises(RecordingError, match=why):
        open_log(path)
    with pytest.raises(RecordingError, match=why):
        recover(path, out)
    assert not out.exists()


def test_messages_beside_the_chunks_are_counted_and_told(tmp_path):
    raw = Kind(topics='before').write()
    bare = pack(*Kind().messages()[0][:3])
    head = raw.index(pack(CHANNELS[-1])) + len(pack(CHANNELS[-1]))
    path = tmp_path / 'a.mcap'
    path.write_bytes(raw[:head] + bare + raw[head:])
    said = '3 messages of the file stand outside of its chunks'
    assert any(said in warning for warning in open_log(path).warnings)
    assert any(said in warning for warning in recover(path, tmp_path / 'b.mcap').warnings)


@pytest.mark.parametrize('summary', [True, False])
@pytest.mark.parametrize('topics', ['first', 'every'])
def test_a_record_outside_of_the_chunks_never_overrules_one_with_a_checksum(
    tmp_path, topics, summary
):
    kind = Kind(topics=topics, summary=summary)
    raw = kind.write()
    liar = dataclasses.replace(CHANNELS[0], topic='/generated_power_of_another_unit')
    start = raw.index(CHUNK)
    path = tmp_path / 'a.mcap'
    path.write_bytes(raw[:start] + pack(liar) + raw[start:])
    assert read(path) == kind.truth()
    found = open_log(path)
    assert found.damaged_chunks == 1
    assert liar.topic not in found.topics
    report = recover(path, tmp_path / 'b.mcap')
    assert read(tmp_path / 'b.mcap') == kind.truth()
    assert report.messages == len(kind.truth())


def test_messages_of_topics_that_nothing_names_are_left_out_of_what_is_recovered(tmp_path):
    """Some channels are told in a chunk that is lost; the messages of the others stay."""
    first, second, third = Kind(chunks=3).messages()
    known = {CHANNELS[0].id, CHANNELS[3].id}
    file = Kind(chunks=3, summary=False, chunk_index=False, topics='before').write()
    lost = b''.join(pack(c) for c in CHANNELS if c.id not in known)
    path = tmp_path / 'a.mcap'
    path.write_bytes(file.replace(lost[: len(pack(CHANNELS[1]) + pack(CHANNELS[2]))], b'', 1)
                     .replace(pack(UNTYPED), b'', 1))  # fmt: skip
    report = recover(path, tmp_path / 'b.mcap')
    truth = [m for m in Kind(chunks=3).truth() if m.topic in (TOPICS[0], TOPICS[3])]
    assert Counter(stock((tmp_path / 'b.mcap').read_bytes())) == Counter(truth)
    assert Counter(stock((tmp_path / 'b.mcap').read_bytes(), seek=False)) == Counter(truth)
    every = len(first) + len(second) + len(third)
    assert report.messages == len(truth)
    assert any(w.startswith(f'{every - len(truth)} messages are on') for w in report.warnings)


def test_a_file_that_the_stock_reader_does_not_open_gets_no_name(tmp_path, monkeypatch, capsys):
    path = written(tmp_path, Kind())
    before = path.read_bytes()

    def refuses(*_args, **_options):
        raise McapError('no channel record found with id 1')

    monkeypatch.setattr(recovery, 'make_reader', refuses)
    out = tmp_path / 'b.mcap'
    assert main(['recover', str(path), '-o', str(out)]) == 1
    said = capsys.readouterr()
    assert 'no channel record found with id 1); nothing was written.' in said.err
    assert 'Kept' not in said.out
    assert [p.name for p in tmp_path.iterdir()] == ['a.mcap']
    assert path.read_bytes() == before


@pytest.mark.parametrize('bit', range(4, 8))
def test_a_chunk_whose_kind_was_damaged_is_no_record_of_a_later_version(tmp_path, bit):
    kind = Kind(topics='every', summary=False)
    raw = bytearray(kind.write())
    raw[raw.index(CHUNK)] ^= 1 << bit
    path = tmp_path / 'a.mcap'
    path.write_bytes(raw)
    report = recover(path, tmp_path / 'b.mcap')
    assert report.damaged_chunks == 1
    rest = Counter(kind.truth())
    rest.subtract(read(tmp_path / 'b.mcap'))
    assert sorted(set(rest.values())) == [0, 1]
    assert open_log(path).damaged_chunks == 1
