# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What we write is read by programs we did not write, with the right values."""

import json
import os
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from log_files import (
    FLOAT64,
    SAMPLE,
    START_NS,
    STOCK,
    float64,
    names_in,
    plant_sample,
    read_back,
    records,
    stock,
    wander,
    write_chunks,
    write_messages,
)
from mcap.opcode import Opcode
from mcap.reader import make_reader

from valveflow_ros.errors import DataError, InputError, RecordingError
from valveflow_ros.logs import Message, RecordingWriter, open_log, write_samples
from valveflow_ros.logs.mcap.importing import write_readings
from valveflow_ros.records import SIGNALS, SampleTable, table_to_readings

AnyReader = pytest.importorskip('rosbags.highlevel').AnyReader
DecoderFactory = pytest.importorskip('mcap_ros2.decoder').DecoderFactory

READ_IN_NODE = Path(__file__).with_name('read_mcap.mjs')


def by_rosbags(folder):
    with AnyReader([folder]) as reader:
        return [
            (connection.topic, time_ns, reader.deserialize(raw, connection.msgtype))
            for connection, time_ns, raw in reader.messages()
        ]


def by_mcap(path):
    with path.open('rb') as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        return [
            (channel.topic, message.log_time, message.publish_time, decoded)
            for _, channel, message, decoded in reader.iter_decoded_messages()
        ]


def information(folder):
    return yaml.safe_load((folder / 'metadata.yaml').read_text())['rosbag2_bagfile_information']


def modes_in(folder):
    return {stat.S_IMODE(p.stat().st_mode) for p in folder.iterdir()}


@pytest.fixture
def samples(tmp_path):
    folder = tmp_path / 'samples'
    rows = [(START_NS + k * 10**9, [k + 0.5, 12.0, 538.0, 600.0 + k, 41.0]) for k in range(50)]
    messages = [
        Message('/unit1/plant_sample', plant_sample(t, v, [1, 2, 1, 3, 1]), t + 5, t)
        for t, v in rows
    ]
    write_messages(folder, {'/unit1/plant_sample': SAMPLE}, messages)
    return folder, rows


def test_three_independent_readers_find_the_same(tmp_path):
    path, wanted, _ = write_chunks(tmp_path / 'log')
    found = by_rosbags(path.parent)
    assert [(t, m.data) for _, t, m in found] == [(w.log_time_ns, w.value) for w in wanted]
    assert {topic for topic, _, _ in found} == {f'/unit1/{info.topic}' for info in SIGNALS[:4]}
    expected = [(w.log_time_ns, w.time_ns, w.value) for w in wanted]
    assert [(log, publish, m.data) for _, log, publish, m in by_mcap(path)] == expected
    streamed = stock(path, seek=False)
    assert [(m.log_ns, m.publish_ns) for m in streamed] == [row[:2] for row in expected]


def test_own_messages_are_read_by_both_and_by_us(samples):
    folder, rows = samples
    for found in (by_rosbags(folder), by_mcap(folder / 'samples_0.mcap')):
        assert [m[-1].main_steam_pressure for m in found] == [v[1] for _, v in rows]
        assert [m[-1].generated_power for m in found] == [v[3] for _, v in rows]
        assert {m[-1].generated_power_quality for m in found} == {3}
        assert {m[-1].header.frame_id for m in found} == {'HV101'}
    found = read_back(open_log(folder))
    assert [r.time_ns for r in found] == [t for t, _ in rows for _ in range(5)]
    assert [r.value for r in found] == [v for _, values in rows for v in values]


def test_the_summary_is_right(tmp_path):
    path, wanted, _ = write_chunks(tmp_path / 'log')
    with path.open('rb') as stream:
        reader = make_reader(stream, validate_crcs=True)
        header, summary = reader.get_header(), reader.get_summary()
        attachments = [(a.name, a.data) for a in reader.iter_attachments()]
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
    assert header.profile == 'ros2'
    assert header.library.startswith('valveflow_ros ')
    statistics = summary.statistics
    assert statistics.message_count == len(wanted)
    assert statistics.message_start_time == wanted[0].log_time_ns
    assert statistics.message_end_time == wanted[-1].log_time_ns
    assert statistics.chunk_count == len(summary.chunk_indexes)
    assert {c.compression for c in summary.chunk_indexes} == {'zstd'}
    assert attachments == [('parameters.yaml', b'a: 1\n')]
    told = yaml.safe_load(metadata['rosbag2']['serialized_metadata'])
    assert told['message_count'] == len(wanted)
    channel = next(iter(summary.channels.values()))
    assert channel.message_encoding == 'cdr'
    assert channel.metadata['topic_type_hash'] == STOCK.type_hash(FLOAT64)
    assert yaml.safe_load(channel.metadata['offered_qos_profiles'])[0]['reliability'] == 'reliable'
    assert {s.encoding for s in summary.schemas.values()} == {'ros2msg'}


def test_the_metadata_file_says_what_is_there(tmp_path):
    path, wanted, writer = write_chunks(tmp_path / 'log')
    info = information(path.parent)
    assert (info['version'], info['storage_identifier']) == (9, 'mcap')
    assert info['message_count'] == writer.written == len(wanted)
    assert info['starting_time']['nanoseconds_since_epoch'] == wanted[0].log_time_ns
    assert info['duration']['nanoseconds'] == wanted[-1].log_time_ns - wanted[0].log_time_ns
    assert info['relative_file_paths'] == [path.name] == [f['path'] for f in info['files']]
    assert sum(t['message_count'] for t in info['topics_with_message_count']) == len(wanted)
    profile = info['topics_with_message_count'][0]['topic_metadata']['offered_qos_profiles'][0]
    assert profile['deadline'] == {'sec': 9223372036, 'nsec': 854775807}
    assert isinstance(info['custom_data'], dict)


def test_a_chunk_is_closed_by_the_message_that_fills_64_kib(tmp_path):
    """So much and no more is lost with a chunk, and so much is compressed at once."""
    for size in (1, 1000, 70_000):
        rows = [Message('/a', bytes(size), START_NS, START_NS)] * (250_000 // (31 + size))
        raw = write_messages(tmp_path / str(size), {'/a': FLOAT64}, rows).read_bytes()
        heads = [begin for op, begin, _ in records(raw) if op == Opcode.CHUNK]
        sizes = [int.from_bytes(raw[begin + 25 : begin + 33], 'little') for begin in heads]
        assert len(sizes) > 2
        # The tables of topics stand in some of them, too; they are small.
        assert all(65536 <= n < 65536 + 31 + size + 2000 for n in sizes[:-1])


def test_only_the_owner_may_look(tmp_path):
    before = os.umask(0)
    try:
        path, _, _ = write_chunks(tmp_path / 'deep' / 'log')
    finally:
        os.umask(before)
    assert modes_in(path.parent) == {0o600}
    assert modes_in(path.parent.parent) | modes_in(tmp_path) == {0o700}


def test_a_topic_has_one_type_and_perhaps_a_definition_of_the_caller(tmp_path):
    with RecordingWriter(tmp_path, definitions=STOCK) as writer:
        writer.add_topic('/x', 'demo_msgs/msg/One', definition='float64 data\n')
        writer.add_topic('/x', 'demo_msgs/msg/One')
        with pytest.raises(InputError, match=r"'/x' is recorded as demo_msgs/msg/One"):
            writer.add_topic('/x', 'std_msgs/msg/Bool')
        writer.write('/x', float64(3.0), 1, 1)
    contents = open_log(tmp_path)
    [message] = contents.iter_messages()
    assert contents.decoder('/x').decode(message.data) == {'data': 3.0}
    assert contents.topics['/x'].type_hash.startswith('RIHS01_')


def test_an_error_within_leaves_the_file_unfinished(tmp_path):
    def stumble():
        with RecordingWriter(tmp_path, name='log', definitions=STOCK) as writer:
            writer.add_topic('/x', FLOAT64)
            writer.write('/x', float64(1.0), 1, 1)
            writer.flush()
            writer.write('/unknown', b'', 1, 1)

    with pytest.raises(KeyError):
        stumble()
    assert names_in(tmp_path) == ['log_0.mcap.part']


def node_modules():
    folder = os.environ.get('VALVEFLOW_NODE_MODULES', '')
    return folder if folder and shutil.which('node') else None


@pytest.mark.skipif(not node_modules(), reason='VALVEFLOW_NODE_MODULES names no node modules')
def test_the_reader_of_foxglove_reads_the_file(tmp_path, samples):
    path, wanted, _ = write_chunks(tmp_path / 'log')
    folder, rows = samples
    for file, expected in (
        (path, [(w.log_time_ns, w.time_ns, w.value) for w in wanted]),
        (folder / 'samples_0.mcap', [(t + 5, t, v[3]) for t, v in rows]),
    ):
        command = ['node', str(READ_IN_NODE), node_modules(), str(file)]
        lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        found = [json.loads(line) for line in lines.splitlines()]
        assert [(int(f['log']), int(f['publish']), f['value']) for f in found] == expected


LOADS_NOTHING = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from log_files import FLOAT64, START_NS, STOCK, float64
from valveflow_ros.logs import RecordingWriter
writer = RecordingWriter(Path(sys.argv[2]), definitions=STOCK)
writer.add_topic('/valve_opening', FLOAT64)
writer.write('/valve_opening', float64(1.0), START_NS, START_NS)
before = set(sys.modules)
writer.flush()
writer.sync()
print(sorted(set(sys.modules) - before))
"""


def test_writing_begins_without_loading_anything(tmp_path):
    """Modules that load at the first chunk would hold up a recorder just when it begins."""
    here = Path(__file__).parent
    paths = os.pathsep.join([str(here.parents[1]), *sys.path])
    done = subprocess.run(
        [sys.executable, '-c', LOADS_NOTHING, str(here), str(tmp_path / 'log')],
        check=True, capture_output=True, text=True, env={**os.environ, 'PYTHONPATH': paths},
    )  # fmt: skip
    assert done.stdout.strip() == '[]'


# Samples ---------------------------------------------------------------------------------------


def test_samples_come_back_bit_for_bit_and_strangers_read_the_same(tmp_path):
    table = wander(3000, seed=11, command=True)
    # A recording of plain numbers has no place for doubts.
    readings = table_to_readings(table)
    written = write_samples(table, tmp_path / 'log.mcap', definitions=STOCK)
    contents = open_log(written.path)
    found, log_ns = contents.readings, contents.log_time_ns
    assert written.messages == len(readings) == len(found)
    assert np.array_equal(found.time_ns, readings.time_ns)
    assert np.array_equal(found.signal, readings.signal)
    assert np.array_equal(found.value, readings.value, equal_nan=True)
    assert not found.quality.any()
    assert (np.diff(log_ns) > 0).all()
    assert np.abs(log_ns - readings.time_ns).max() <= 4
    assert contents.warnings == ()
    told = [(m.log_ns, m.publish_ns) for m in stock(written.path)]
    assert told == list(zip(log_ns.tolist(), found.time_ns.tolist(), strict=True))
    with written.path.open('rb') as stream:
        counts = make_reader(stream).get_summary().statistics.channel_message_counts
    assert counts == {k + 1: int((readings.signal == k).sum()) for k in range(5)}
    values = [message.data for _, _, message in by_rosbags(tmp_path)]
    assert np.array_equal(values, found.value, equal_nan=True)


def test_a_folder_when_the_name_is_no_file(tmp_path):
    folder = tmp_path / 'ten'
    written = write_readings(
        [table_to_readings(wander(10, seed=1))], [], folder, definitions=STOCK, prefix='/u1/',
        attachments={'truth.json': b'{}'},
    )  # fmt: skip
    assert written.path == folder / 'ten_0.mcap'
    contents = open_log(folder)
    assert set(contents.topics) == {f'/u1/{info.topic}' for info in SIGNALS[:4]}
    assert contents.attachments == {'truth.json': b'{}'}
    assert information(folder)['message_count'] == written.messages
    assert modes_in(folder) == {0o600}


def test_nothing_is_overwritten_unless_asked(tmp_path):
    path, _, _ = write_chunks(tmp_path / 'log')
    before, told = path.read_bytes(), (path.parent / 'metadata.yaml').read_bytes()
    with pytest.raises(RecordingError, match='exists already'):
        write_samples(wander(20, seed=2), path, definitions=STOCK)
    assert path.read_bytes() == before
    # The description of another recording stays, that of a file that is replaced does not.
    write_samples(wander(10, seed=1), path.parent / 'other.mcap', definitions=STOCK)
    assert (path.parent / 'metadata.yaml').read_bytes() == told
    written = write_samples(wander(20, seed=2), path, definitions=STOCK, overwrite=True)
    assert len(open_log(path).readings) == written.messages
    assert (path.parent / 'metadata.yaml').read_bytes() != told


def test_what_cannot_be_written_is_one_sentence(tmp_path):
    early = SampleTable.from_columns(np.array([-5], dtype=np.int64), {})
    for table, why in ((wander(3, seed=1).part(0, 0), 'no samples'), (early, 'before 1970')):
        with pytest.raises(DataError, match=why):
            write_samples(table, tmp_path / 'log.mcap', definitions=STOCK)
    (tmp_path / 'file').write_text('')
    with pytest.raises(RecordingError, match='cannot be written'):
        write_samples(wander(3, seed=1), tmp_path / 'file' / 'log.mcap', definitions=STOCK)
    assert names_in(tmp_path) == ['file']
