# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
import stat

import numpy as np
import pytest
import yaml
from log_files import STOCK, same_readings, wander, write_chunks
from mcap.reader import make_reader

from valveflow_ros.errors import DataError, RecordingError
from valveflow_ros.logs import open_log, write_samples
from valveflow_ros.logs.tables.words import of_gauge, spelling
from valveflow_ros.records import SIGNALS, SampleTable, table_to_readings

AnyReader = pytest.importorskip('rosbags.highlevel').AnyReader


@pytest.mark.parametrize('command', [False, True])
def test_samples_come_back_bit_for_bit(tmp_path, command):
    table = wander(3000, seed=11, command=command)
    # A recording of plain numbers has no place for doubts.
    readings = table_to_readings(table)
    written = write_samples(table, tmp_path / 'log.mcap', definitions=STOCK)
    contents = open_log(written.path)
    assert written.messages == len(readings) == len(contents.readings)
    assert np.array_equal(contents.readings.time_ns, readings.time_ns)
    assert np.array_equal(contents.readings.signal, readings.signal)
    assert np.array_equal(contents.readings.value, readings.value, equal_nan=True)
    assert not contents.readings.quality.any()
    assert (np.diff(contents.log_time_ns) > 0).all()
    assert np.abs(contents.log_time_ns - readings.time_ns).max() <= 4
    assert contents.warnings == ()


def test_strangers_read_the_same(tmp_path):
    table = wander(2000, seed=12)
    contents = open_log(write_samples(table, tmp_path / 'log.mcap', definitions=STOCK).path)
    with (tmp_path / 'log.mcap').open('rb') as stream:
        reader = make_reader(stream, validate_crcs=True)
        found = [(m.log_time, m.publish_time) for _, _, m in reader.iter_messages()]
        counts = reader.get_summary().statistics.channel_message_counts
    times = [contents.log_time_ns.tolist(), contents.readings.time_ns.tolist()]
    assert found == list(zip(*times, strict=True))
    assert set(counts.values()) == {2000}
    with AnyReader([tmp_path]) as reader:
        values = [reader.deserialize(raw, c.msgtype).data for c, _, raw in reader.messages()]
    assert np.array_equal(values, contents.readings.value, equal_nan=True)


def test_a_folder_when_the_name_is_no_file(tmp_path):
    written = write_samples(wander(10, seed=1), tmp_path / 'ten', definitions=STOCK, prefix='/u1/')
    assert written.path == tmp_path / 'ten' / 'ten_0.mcap'
    assert set(open_log(tmp_path / 'ten').topics) == {f'/u1/{info.topic}' for info in SIGNALS[:4]}
    info = yaml.safe_load((tmp_path / 'ten' / 'metadata.yaml').read_text())
    assert info['rosbag2_bagfile_information']['message_count'] == written.messages
    assert {stat.S_IMODE(p.stat().st_mode) for p in (tmp_path / 'ten').iterdir()} == {0o600}


def test_nothing_is_overwritten_unless_asked(tmp_path):
    path = tmp_path / 'log.mcap'
    write_samples(wander(10, seed=1), path, definitions=STOCK)
    before = path.read_bytes()
    with pytest.raises(RecordingError, match='exists already'):
        write_samples(wander(20, seed=2), path, definitions=STOCK)
    assert path.read_bytes() == before
    written = write_samples(wander(20, seed=2), path, definitions=STOCK, overwrite=True)
    assert len(open_log(path).readings) == written.messages


def test_the_description_of_another_recording_stays(tmp_path):
    path, _, _ = write_chunks(tmp_path / 'log')
    before = (path.parent / 'metadata.yaml').read_bytes()
    write_samples(wander(10, seed=1), path.parent / 'other.mcap', definitions=STOCK)
    assert (path.parent / 'metadata.yaml').read_bytes() == before


def test_attachments_and_notes_are_kept(tmp_path):
    written = write_samples(
        wander(10, seed=1),
        tmp_path / 'log.mcap',
        definitions=STOCK,
        attachments={'truth.json': b'{}'},
        metadata={'simulation': {'seed': '1'}},
    )
    contents = open_log(written.path)
    assert contents.attachments == {'truth.json': b'{}'}
    assert contents.metadata['simulation'] == {'seed': '1'}


def test_what_cannot_be_written_is_one_sentence(tmp_path):
    empty = wander(3, seed=1).part(0, 0)
    with pytest.raises(DataError, match='no samples'):
        write_samples(empty, tmp_path / 'log.mcap', definitions=STOCK)
    early = SampleTable.from_columns(np.array([-5], dtype=np.int64), {})
    with pytest.raises(DataError, match='before 1970'):
        write_samples(early, tmp_path / 'log.mcap', definitions=STOCK)
    (tmp_path / 'file').write_text('')
    with pytest.raises(RecordingError, match='cannot be written'):
        write_samples(wander(3, seed=1), tmp_path / 'file' / 'log.mcap', definitions=STOCK)
    assert [p.name for p in tmp_path.iterdir()] == ['file']


def test_readings_are_the_same_from_any_kind_of_file(tmp_path):
    table = wander(500, seed=21)
    plain = SampleTable(
        table.time_ns, table.values, np.where(np.isnan(table.values), 2, 0).astype(np.uint8)
    )
    from valveflow_ros.logs import write_table

    write_table(plain, tmp_path / 'table.csv')
    write_samples(plain, tmp_path / 'log.mcap', definitions=STOCK)
    first = open_log(tmp_path / 'table.csv').readings
    second = open_log(tmp_path / 'log.mcap').readings
    assert np.array_equal(first.time_ns, second.time_ns)
    assert np.array_equal(first.value, second.value, equal_nan=True)
    assert not same_readings(first, second), 'a table knows which values are missing'


@pytest.mark.parametrize(
    ('told', 'unit', 'expected'),
    [
        ('Frischdampfdruck (Überdruck)', 'bar', 'barg'),
        ('Main steam pressure gauge', 'MPa', 'MPag'),
        ('main_steam_pressure_gauge_bar', 'bar', 'barg'),
        ('Druck rel.', 'kPa', 'kPag'),
        ('Frischdampfdruck (Ü)', 'bar', 'barg'),
        ('steam gage pressure', 'psi', 'psig'),
        ('Frischdampfdruck', 'bar', 'bar'),
        ('Frischdampfdruck relativ', 'bara', 'bar'),
        ('pressure, gauge range, absolute', 'bar', 'bar'),
        ('Brennstoffdruck Brüden', 'bar', 'bar'),
        ('Dampfdruck Ü', 'barg', 'barg'),
        ('Temperatur rel.', '°C', 'degC'),
    ],
)
def test_a_gauge_is_known_by_the_words_beside_its_unit(told, unit, expected):
    found = of_gauge(spelling(unit), told)
    assert found.unit == expected
    assert found.written == unit
