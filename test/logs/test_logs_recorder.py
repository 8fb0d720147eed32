# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The recorder's account against what is found on the disk, whatever the disk does."""

import errno
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from fault_points import SHORT, Faults
from log_files import (
    FLOAT64,
    PATIENCE_S,
    QUICK,
    START_NS,
    STOCK,
    balanced,
    float64,
    names_in,
    put,
    record,
    recorder_of,
    rotate,
    values_in,
    wait_for,
    write_chunks,
    write_part,
)

from valveflow_ros.errors import InputError, RecordingError
from valveflow_ros.logs import LATCHED, Message, Recorder, RecorderState, RecordingWriter, open_log
from valveflow_ros.logs.part_file import PartFile, is_held


@pytest.fixture
def folder(tmp_path):
    return tmp_path / 'log'


def test_all_that_is_handed_in_is_on_disk(folder):
    recorder = recorder_of(folder, attachments={'parameters.yaml': b'a: 1\n'})
    record(recorder, 0, 5000)
    status = recorder.close()
    assert (status.state, status.reason) == (RecorderState.STOPPED, '')
    assert status.received == status.written == 5000
    assert (status.queued, status.lost, status.dropped) == (0, 0, {})
    assert (status.files_finished, status.recovered) == (1, ())
    assert values_in(folder) == list(range(5000))
    contents = open_log(folder)
    assert contents.attachments == {'parameters.yaml': b'a: 1\n'}
    assert contents.metadata['valveflow_recorder'] == {'received': '5000'}
    assert status.bytes_written == (folder / 'log_0.mcap').stat().st_size


def test_what_somebody_waits_for_is_on_disk_before_its_time(folder):
    recorder = recorder_of(folder, replace(QUICK, flush_period_s=600.0))
    for first in (0, 100, 200):
        record(recorder, first, 100)
        assert recorder.flush(PATIENCE_S)
        assert recorder.status().file == 'log_0.mcap.part'
        assert values_in(folder) == list(range(first + 100))
    assert recorder.flush(0.0)
    # A burst does not pile up until its time has come.
    record(recorder, 300, 10_000)
    wait_for(lambda: recorder.status().written >= 4000)
    assert recorder.close().written == 10_300
    # There is nobody left to write what comes now.
    record(recorder, 0)
    assert not recorder.flush(PATIENCE_S)


def recorded_with(faults, folder, parts):
    """Record five messages into each of some splits; a fault lasts until it has been seen."""
    with faults.active():
        recorder = recorder_of(folder)
        for part in range(parts):
            record(recorder, 5 * part, 5)
            recorder.rotate()

            def settled(part=part):
                done = recorder.status().written == 5 * part + 5
                return done and not recorder.is_rotating

            wait_for(lambda settled=settled: faults.failed_at_s is not None or settled())
            if faults.failed_at_s is not None:
                faults.heal()
            wait_for(settled)
            assert balanced(recorder.status())
        return recorder.close()


@pytest.mark.parametrize('once', [False, True])
def test_whatever_call_fails_nothing_is_lost_and_every_whole_file_is_listed(tmp_path, once):
    """A file that has its name is named in metadata.yaml, and a lock is never kept."""
    for call in range(1, 41):
        folder = tmp_path / f'{call}' / 'log'
        error = (errno.EIO, errno.ENOSPC, SHORT)[call % 3] if once else errno.EIO
        faults = Faults('recorder', call, error, once)
        status = recorded_with(faults, folder, parts=4)
        assert faults.failed_at_s is not None, call
        told = status.state, status.reason, status.written
        assert told == (RecorderState.STOPPED, '', 20), (call, faults.what)
        listed = yaml.safe_load((folder / 'metadata.yaml').read_text())
        names = listed['rosbag2_bagfile_information']['relative_file_paths']
        assert sorted(names) == sorted(p.name for p in folder.glob('*.mcap')), (call, faults.what)
        assert not any(is_held(part) for part in folder.glob('*.part')), (call, faults.what)
        assert values_in(folder) == list(range(20)), (call, faults.what)


def test_a_full_disk_keeps_all_waiting_until_space_returns(folder):
    recorder = recorder_of(folder)
    put(recorder, 0, 40)
    faults = Faults('recorder', 1, errno.ENOSPC)
    with faults.active():
        record(recorder, 40, 50)
        wait_for(lambda: recorder.status().state == RecorderState.DEGRADED)
        status = recorder.status()
        assert 'cannot be written' in status.reason
        assert (status.received, status.written, status.queued) == (90, 40, 50)
        begun_s = time.monotonic()
        assert not recorder.flush(0.1), 'nobody waits longer than told'
        assert 0.1 <= time.monotonic() - begun_s < PATIENCE_S
        faults.heal()
        wait_for(lambda: recorder.status().written == 90)
        wait_for(lambda: recorder.status().state == RecorderState.RECORDING)
    assert recorder.close().lost == 0
    # Each attempt takes a number of its own.
    first, second = sorted(p.name for p in folder.glob('*.mcap*'))
    assert (first, second.partition('_')[0]) == ('log_0.mcap.part', 'log')
    assert values_in(folder) == list(range(90))


def test_what_never_came_to_a_disk_is_lost_and_said(folder):
    with Faults('recorder', 1, errno.ENOSPC).active():
        recorder = recorder_of(folder)
        record(recorder, 0, 50)
        status = recorder.close()
    assert (status.state, status.lost, status.written) == (RecorderState.STOPPED, 50, 0)
    assert balanced(status)
    assert list(folder.glob('*.mcap*')) == []


def gated(gate):
    """Return what opens files only after a gate has."""

    def opened(path):
        gate.wait(PATIENCE_S)
        return PartFile(path)

    return opened


def test_too_many_waiting_messages_are_dropped_by_topic_and_counted(folder):
    gate = threading.Event()
    recorder = recorder_of(folder, replace(QUICK, queue_limit=30), open_file=gated(gate))
    recorder.add_topic('/generated_power', FLOAT64)
    record(recorder, 0, 25)
    record(recorder, 25, 10, '/generated_power')
    record(recorder, 35, 7)
    assert not recorder.record('/valve_opening', float64(0), START_NS, START_NS)
    status = recorder.status()
    assert status.dropped == {'/generated_power': 5, '/valve_opening': 8}
    assert (status.received, status.queued) == (43, 30)
    gate.set()
    wait_for(lambda: recorder.status().written == 30)
    assert balanced(recorder.close())
    assert values_in(folder) == list(range(30))
    notes = {'received': '43', 'dropped /generated_power': '5', 'dropped /valve_opening': '8'}
    assert open_log(folder).metadata['valveflow_recorder'] == notes


def test_closing_takes_a_bounded_time_and_later_messages_are_counted(folder):
    gate = threading.Event()
    recorder = recorder_of(folder, open_file=gated(gate))
    record(recorder, 0, 10)
    begun_s = time.monotonic()
    status = recorder.close(timeout_s=0.05)
    assert time.monotonic() - begun_s < 2.0
    assert (status.queued, status.written) == (10, 0)
    assert not recorder.record('/valve_opening', float64(0), START_NS, START_NS)
    gate.set()
    status = recorder.close(PATIENCE_S)
    assert (status.written, status.lost, status.dropped) == (10, 0, {'/valve_opening': 1})
    assert balanced(status)


def test_asking_for_a_split_of_nothing_does_nothing(folder):
    recorder = recorder_of(folder)
    recorder.rotate()
    wait_for(lambda: not recorder.is_rotating)
    put(recorder, 0, 5)
    record(recorder, 5, 5)
    assert recorder.close().files_finished == 1


@pytest.mark.parametrize('limits', [{'rotate_bytes': 1}, {'rotate_s': 0.0}, {}])
def test_rotations_by_size_by_age_and_on_request_lose_nothing(folder, limits):
    recorder = recorder_of(folder, replace(QUICK, **limits))
    for part in range(20):
        record(recorder, part)
        if not limits:
            rotate(recorder)
        wait_for(lambda part=part: recorder.status().files_finished == part + 1)
    recorder.close()
    assert len(list(folder.glob('*.mcap'))) == 20
    assert values_in(folder) == list(range(20))


def test_latched_messages_head_every_later_split(folder):
    recorder = recorder_of(folder)
    recorder.add_topic('/curve', FLOAT64, qos=(LATCHED,), latched=True)
    record(recorder, 0, 2, '/curve')
    for part in range(3):
        put(recorder, 2 + 2 * part, 2)
        rotate(recorder)
    record(recorder, 50)
    assert recorder.close().written == 9
    for number in (1, 2, 3):
        first = next(open_log(folder / f'log_{number}.mcap').iter_messages())
        assert (first.topic, first.data) == ('/curve', float64(1))
    curves = list(open_log(folder).iter_messages(['/curve']))
    assert [m.data for m in curves] == [float64(0), float64(1)]


@pytest.mark.parametrize('before', [0, 1])
def test_a_head_message_keeps_its_own_number_when_a_newer_one_waits(folder, before):
    """In the first flush of a split its latched topic speaks already: each message comes once."""
    latched = []
    with RecordingWriter(folder, definitions=STOCK, head_messages=lambda: latched) as writer:
        for topic in ('/latched', '/other'):
            writer.add_topic(topic, FLOAT64)
        first = Message('/latched', float64(0), START_NS, START_NS)
        writer.write(*first)
        writer.rotate()
        latched.append(first)
        numbers = [*range(1, 1 + before), 8, 9]
        for k in numbers:
            topic = '/latched' if k > 1 else '/other'
            writer.write(topic, float64(k), START_NS + k, START_NS + k)
    found = [m.data for m in open_log(folder).iter_messages()]
    assert found == [float64(k) for k in (0, *numbers)]


def test_the_oldest_files_go_when_told_so(folder):
    folder.mkdir()
    whole, _, _ = write_chunks(folder.parent / 'other', chunks=1)
    for name in ('other.mcap', 'other_0.mcap', 'log_x.mcap', 'xlog_0.mcap', 'log_000.mcap'):
        (folder / name).write_bytes(whole.read_bytes())
    bystanders = {p.name for p in folder.iterdir()}
    recorder = recorder_of(folder, replace(QUICK, keep_files=2))
    for part in range(5):
        record(recorder, part)
        rotate(recorder)
    status = recorder.close()
    assert (status.written, status.removed, balanced(status)) == (2, 3, True)
    left = {p.name for p in folder.glob('*.mcap')}
    assert left - bystanders == {'log_4.mcap', 'log_5.mcap'}
    assert left >= bystanders
    found = open_log(folder, columns={'valve_opening': '/valve_opening'})
    assert found.warnings == ()
    assert found.readings.value[found.readings.signal == 0].tolist()[-2:] == [3.0, 4.0]


def test_an_old_file_that_cannot_be_removed_is_said_and_recording_goes_on(folder, monkeypatch):
    # A retry so late that what is said can be seen.
    recorder = recorder_of(folder, replace(QUICK, keep_files=1, retry_s=0.5, retry_max_s=0.5))
    unlink, stuck = Path.unlink, [True]

    def sticky(path, missing_ok=False):
        if stuck and path.name == 'log_0.mcap':
            raise PermissionError(errno.EPERM, 'Operation not permitted')
        unlink(path, missing_ok)

    monkeypatch.setattr(Path, 'unlink', sticky)
    for k in range(2):
        record(recorder, k)
        rotate(recorder)
    wait_for(lambda: 'cannot be removed (Operation not permitted)' in recorder.status().reason)
    stuck.clear()
    record(recorder, 2)
    rotate(recorder)
    recorder.close()
    assert values_in(folder) == [2]


def test_it_stops_before_the_disk_is_full_and_goes_on_afterwards(folder):
    free = [10**12]
    settings = replace(QUICK, free_floor_bytes=10**9)

    def free_bytes(_):
        if not free:
            raise OSError(errno.EIO, 'Input/output error')
        return free[0]

    recorder = recorder_of(folder, settings, free_bytes=free_bytes)
    put(recorder, 0, 10)
    free[0] = 10**8
    wait_for(lambda: recorder.status().state == RecorderState.DEGRADED)
    assert 'MiB must stay free' in recorder.status().reason
    assert [p.name for p in folder.glob('*.mcap*')] == ['log_0.mcap']
    free.clear()
    wait_for(lambda: 'cannot be asked for space' in recorder.status().reason)
    record(recorder, 10, 10)
    free.append(10**12)
    wait_for(lambda: recorder.status().written == 20)
    recorder.close()
    assert values_in(folder) == list(range(20))


def test_leftovers_are_finished_at_the_start(folder):
    _, wanted = write_part(folder)
    recorder = Recorder(folder, QUICK, definitions=STOCK)
    wait_for(lambda: recorder.status().recovered)
    recorder.add_topic('/unit1/valve_opening', FLOAT64)
    record(recorder, 0, 3, '/unit1/valve_opening')
    assert recorder.close().recovered[0].messages == len(wanted)
    assert names_in(folder) == ['log_0.mcap', 'log_1.mcap', 'metadata.yaml']
    assert len(open_log(folder).readings) == len(wanted) + 3


@pytest.mark.parametrize('problem', [PermissionError(13, 'no'), OSError(errno.EIO, 'bad sector')])
def test_a_leftover_that_cannot_be_read_holds_up_nothing(folder, monkeypatch, problem):
    """It may be another user's, or lie on a bad sector."""
    folder.mkdir()
    part = folder / 'log_3.mcap.part'
    part.write_bytes(b'whatever')

    def fail(path):
        raise problem

    # The package's function of that name hides the module.
    monkeypatch.setattr(sys.modules['valveflow_ros.logs.mcap.recover'], 'taken', fail)
    recorder = recorder_of(folder)
    record(recorder, 0, 3)
    status = recorder.close()
    assert (status.written, status.lost) == (3, 0)
    assert part.exists()
    assert (folder / 'log_4.mcap').exists()


def test_an_error_nobody_thought_of_stops_it_visibly(folder):
    def broken(path):
        raise ZeroDivisionError('a mistake')

    recorder = recorder_of(folder, open_file=broken)
    record(recorder, 0)
    wait_for(lambda: recorder.status().state == RecorderState.STOPPED)
    status = recorder.status()
    assert 'ZeroDivisionError' in status.reason
    assert (status.lost, balanced(status)) == (1, True)
    assert not recorder.record('/valve_opening', float64(0), START_NS, START_NS)


def test_misuse_is_one_sentence(folder):
    recorder = recorder_of(folder)
    last = (1 << 63) - 1
    with pytest.raises(InputError, match="'/gone' was not made known"):
        recorder.record('/gone', b'', 0, 0)
    for times in ((-1, 0), (0, -1), (last + 1, 0), (0, last + 1)):
        with pytest.raises(InputError, match='impossible time'):
            recorder.record('/valve_opening', float64(0), *times)
    with pytest.raises(InputError, match='is recorded as'):
        recorder.add_topic('/valve_opening', 'std_msgs/msg/Bool')
    with pytest.raises(RecordingError, match='was not found'):
        recorder.add_topic('/other', 'std_msgs/msg/Nothing')
    for times in ((0, 5), (5, 0), (last, 5), (5, last)):
        assert recorder.record('/valve_opening', float64(0), *times)
    assert recorder.close().written == 4
    (folder.parent / 'file').write_text('')
    with pytest.raises(RecordingError, match='cannot be made'):
        Recorder(folder.parent / 'file' / 'log')


def test_only_what_was_asked_for_is_repeated(folder):
    deep = folder / 'deep'
    recorder = recorder_of(deep, name='mine')
    recorder.add_topic('/own', FLOAT64)
    # Again changes nothing, whatever else is said.
    recorder.add_topic('/own', FLOAT64, latched=True)
    topics = ['/own', '/valve_opening']
    for part in range(2):
        for topic in topics:
            assert recorder.record(topic, float64(part), START_NS + part, START_NS) is True
        rotate(recorder)
    status = recorder.close(PATIENCE_S)
    assert (status.state, status.written) == (RecorderState.STOPPED, 4)
    assert recorder.record('/own', float64(0), START_NS, START_NS) is False
    found = open_log(deep)
    assert [m.topic for m in found.iter_messages()] == topics * 2
    # The second split alone: nothing of the first stands at its head.
    second = list(open_log(deep / 'mine_1.mcap').iter_messages())
    assert [(m.topic, m.data) for m in second] == [(t, float64(1)) for t in topics]
    assert {t.type_hash for t in found.topics.values()} == {STOCK.type_hash(FLOAT64)}
    assert {t.definition for t in found.topics.values()} == {STOCK.text(FLOAT64)}
    assert all(p.name.startswith('mine_') for p in deep.glob('*.mcap'))
    assert deep.stat().st_mode & 0o777 == 0o700
    assert recorder.folder == deep


def test_numbers_of_a_continued_folder_are_others_than_before(folder):
    for k in range(3):
        with RecordingWriter(folder, name='log', definitions=STOCK) as writer:
            writer.add_topic('/a', FLOAT64)
            # Equal but for the number: three messages, not a message and two repetitions.
            writer.write('/a', float64(5), START_NS + k, START_NS)
    assert [m.data for m in open_log(folder).iter_messages()] == [float64(5)] * 3
