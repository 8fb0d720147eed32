# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Bags in sqlite3 are read as the same messages in MCAP are."""

import os
import sqlite3
import tempfile
from contextlib import closing

import pytest
from log_files import same_arrays
from monitor_recording import recording

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import open_log

bags = pytest.importorskip('rosbags.rosbag2')
ALARMS = '/valveflow_monitor/alarms'


@pytest.fixture(scope='module')
def mcap(tmp_path_factory):
    return open_log(recording(tmp_path_factory.mktemp('log') / 'said'))


@pytest.fixture(scope='module', params=[8, 9])
def bag(mcap, tmp_path_factory, request):
    """Return the same messages as a stock writer puts them into a bag."""
    folder = tmp_path_factory.mktemp('bag') / 'said'
    with bags.Writer(folder, version=request.param) as writer:
        topics = {
            t.name: writer.add_connection(t.name, t.type, msgdef=t.definition, rihs01=t.type_hash)
            for t in mcap.topics.values()
        }
        for message in mcap.iter_messages():
            writer.write(topics[message.topic], message.log_time_ns, message.data)
    return folder


def said(log):
    return [(m.topic, m.type, m.log_time_ns, m.data) for m in log.iter_messages()]


@pytest.mark.parametrize('whole', [True, False], ids=['folder', 'file'])
def test_a_bag_holds_what_the_recording_holds(mcap, bag, whole):
    found = open_log(bag if whole else next(bag.glob('*.db3')))
    assert said(found) == said(mcap)
    assert found.signals == mcap.signals
    assert same_arrays(found.readings, mcap.readings)
    data = next(m.data for m in found.iter_messages([ALARMS]))
    # As text: NaN is not equal to itself.
    assert repr(found.decoder(ALARMS).decode(data)) == repr(mcap.decoder(ALARMS).decode(data))
    assert any('no times of sending' in w for w in found.warnings)


def test_nothing_is_left_behind(bag, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, 'tempdir', str(tmp_path))
    log = open_log(bag)
    assert os.listdir(tmp_path)
    del log
    assert os.listdir(tmp_path) == []
    (bag.parent / 'broken.db3').write_bytes(b'SQLite format 3\0')
    with pytest.raises(RecordingError, match='is no whole bag in sqlite3'):
        open_log(bag.parent / 'broken.db3')
    assert os.listdir(tmp_path) == []


def test_a_bag_without_definitions_or_messages(mcap, bag, tmp_path):
    copy = tmp_path / 'old.db3'
    source = next(bag.glob('*.db3'))
    with closing(sqlite3.connect(source)) as one, closing(sqlite3.connect(copy)) as other:
        one.backup(other)
        other.execute('DROP TABLE IF EXISTS message_definitions')
        other.execute("UPDATE topics SET type = 'a_msgs/msg/B' WHERE name LIKE '%alarms'")
        other.commit()
        log = open_log(copy)
        assert said(log)[0][2] == said(mcap)[0][2]
        assert log.topics[ALARMS].definition == ''
        other.execute('DELETE FROM messages')
        other.commit()
    with pytest.raises(RecordingError, match='holds no messages'):
        open_log(copy)
