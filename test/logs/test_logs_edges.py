# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Corners that the broad tests do not reach."""

import lz4.frame
import mcap.records
import pytest
import zstandard
from damage import records
from log_files import (
    FLOAT64,
    START_NS,
    STOCK,
    float64,
    read_back,
    write_chunks,
    write_messages,
)
from mcap.opcode import Opcode

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import Decoder, RecordingWriter, open_log
from valveflow_ros.logs.mcap.chunk_file import REPEAT_CHUNKS, ChunkBuilder
from valveflow_ros.logs.mcap.records import MAGIC, LayoutError, Unpacker, pack
from valveflow_ros.logs.part_file import PartFile
from valveflow_ros.records import SIGNALS

PACKED = zstandard.ZstdCompressor().compress(bytes(100))
UNSIZED = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(100))


@pytest.mark.parametrize(
    ('compression', 'packed', 'size'),
    [
        ('zstd', PACKED, 99),
        ('zstd', PACKED, 101),
        ('zstd', UNSIZED, 99),
        ('zstd', UNSIZED, 101),
        ('zstd', b'no frame', 100),
        ('lz4', lz4.frame.compress(bytes(100)), 99),
        ('lz4', lz4.frame.compress(bytes(100)), 101),
        ('lz4', b'no frame', 100),
        ('', bytes(99), 100),
        ('bz2', bytes(100), 100),
    ],
)
def test_a_wrong_claim_is_never_believed(compression, packed, size):
    with pytest.raises(LayoutError):
        Unpacker().unpack(compression, packed, size)


def test_a_file_that_changes_while_it_is_read_is_one_sentence(tmp_path):
    path, _, _ = write_chunks(tmp_path / 'log')
    contents = open_log(path)
    path.write_bytes(bytes(path.stat().st_size))
    with pytest.raises(RecordingError, match='has changed while it was read'):
        list(contents.iter_messages())


def test_a_device_that_fails_while_flushing_is_one_sentence(tmp_path, monkeypatch):
    with RecordingWriter(tmp_path / 'log', definitions=STOCK) as writer:
        writer.add_topic('/x', FLOAT64)
        writer.write('/x', float64(1.0), START_NS, START_NS)
        writer.flush()

        def broken(self):
            raise OSError(5, 'Input/output error')

        monkeypatch.setattr(PartFile, 'sync', broken)
        with pytest.raises(RecordingError, match=r'cannot be written \(input/output error\)'):
            writer.sync()
        monkeypatch.undo()
        writer.write('/x', float64(2.0), START_NS + 1, START_NS)
    assert [m.data for m in open_log(tmp_path / 'log').iter_messages()] == [
        float64(1.0),
        float64(2.0),
    ]


def test_bytes_that_are_no_cdr_and_types_that_are_not_read():
    with pytest.raises(RecordingError, match='not plain CDR'):
        Decoder(FLOAT64, 'float64 data').decode(b'\x07\x00\x00\x00')
    with pytest.raises(RecordingError, match='wstring'):
        Decoder('a/msg/A', 'wstring text').decode(b'\0\1\0\0' + bytes(8))
    assert Decoder('a/msg/A', '').decode(b'\0\1\0\0\0') == {}


@pytest.mark.parametrize('schema_id', [0, 7])
def test_a_channel_without_a_schema_is_left_out_and_ends(tmp_path, schema_id):
    """Reading it again and again for its schema would never end."""
    schema = mcap.records.Schema(1, STOCK.text(FLOAT64).encode(), 'ros2msg', FLOAT64)
    lone = mcap.records.Channel(2, '/generated_power', 'cdr', {}, schema_id)
    good = mcap.records.Channel(1, '/valve_opening', 'cdr', {}, 1)
    builder = ChunkBuilder()
    for channel in (1, 2):
        builder.add(channel, 1, START_NS, START_NS, float64(channel))
    path = tmp_path / 'lone.mcap'
    head = MAGIC + pack(mcap.records.Header('ros2', 'x'))
    path.write_bytes(head + builder.build(pack(schema, good, lone)).record)
    contents = open_log(path)
    assert contents.readings.value.tolist() == [1.0]
    assert [m.data for m in contents.iter_messages(['/valve_opening'])] == [float64(1)]


def test_chunks_before_the_first_table_that_is_left_are_read(tmp_path):
    path, wanted, _ = write_chunks(tmp_path / 'log', chunks=3 * REPEAT_CHUNKS, close=False)
    raw = bytearray(path.read_bytes())
    chunks = [
        (begin, end) for op, begin, end in records(bytes(raw) + bytes(8)) if op == Opcode.CHUNK
    ]
    # Two tables stand at the beginning, the next one REPEAT_CHUNKS later.
    for begin, end in chunks[:2]:
        raw[begin + 20 : end] = bytes(end - begin - 20)
    path.write_bytes(raw)
    assert read_back(open_log(path)) == wanted[2 * 20 :]


def test_more_of_one_time_than_can_wait_is_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setattr('valveflow_ros.logs.mcap.reading.MAX_WAITING_BYTES', 1 << 20)
    with RecordingWriter(tmp_path / 'log', definitions=STOCK) as writer:
        writer.add_topic('/valve_opening', FLOAT64)
        writer.add_topic('/note', 'std_msgs/msg/String')
        for number in range(5):
            for step in (0, 5 - number):
                time_ns = START_NS + step
                writer.write('/valve_opening', float64(number), time_ns, time_ns)
                writer.write('/note', bytes(1 << 20), time_ns, time_ns)
            writer.flush()
    contents = open_log(tmp_path / 'log')
    assert len(contents.readings) == 10
    with pytest.raises(RecordingError, match='side by side'):
        list(contents.iter_messages())


def test_a_line_break_in_a_name_does_not_end_the_sentence(tmp_path):
    with pytest.raises(RecordingError) as caught:
        open_log(tmp_path / 'line\nbreak.mcap')
    assert '\n' not in str(caught.value)
    assert 'line?break.mcap' in str(caught.value)


def test_values_that_never_got_a_time_are_left_out_and_counted(tmp_path):
    """So a monitor records what came before the first /clock; it does not use it either."""
    topics = {f'/{info.topic}': FLOAT64 for info in SIGNALS if info.required}
    rows = [
        (topic, float64(float(k)), START_NS + k, 0 if k < 3 else START_NS + k)
        for k in range(10)
        for topic in topics
    ]
    log = open_log(write_messages(tmp_path, topics, rows))
    assert log.readings.time_ns.min() == START_NS + 3
    assert len(log.readings) == 7 * len(topics) == len(log.log_time_ns)
    assert any(f'{3 * len(topics)} values recorded without a time' in w for w in log.warnings)
