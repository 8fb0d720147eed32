# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The recorder's account against what is found on the disk, whatever the disk does."""

import errno
import os
import sys
import threading
import time
from dataclasses import replace

import pytest
import yaml
from fault_points import Faults
from log_files import FLOAT64, START_NS, STOCK, float64, write_chunks

from valveflow_ros.errors import InputError, RecordingError
from valveflow_ros.logs import (
    LATCHED,
    Recorder,
    RecorderSettings,
    RecorderState,
    open_log,
)
from valveflow_ros.logs.part_file import PartFile, is_held

QUICK = RecorderSettings(
    flush_period_s=0.002, sync_period_s=0.01, retry_s=0.002, retry_max_s=0.01, free_floor_bytes=0
)
LIMIT_S = float(os.environ.get('VALVEFLOW_TEST_PATIENCE_S', 20.0))


def wait_for(condition):
    end = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < end, 'waited in vain'
        time.sleep(0.001)


class Disk:
    """Opens files that fail as they are told, counting every call."""

    def __init__(self, fails=lambda call: None):
        self.fails = fails
        self.calls = 0
        self.lock = threading.Lock()

    def __call__(self, path):
        self.count('open', b'')
        return FailingFile(self, PartFile(path))

    def count(self, name, data):
        with self.lock:
            self.calls += 1
            call = self.calls
        error = self.fails(call)
        if error is not None:
            raise OSError(error, 'no luck')
        return data


class FailingFile:
    def __init__(self, disk, file):
        self.disk = disk
        self.file = file

    def write(self, data):
        try:
            self.disk.count('write', data)
        except OSError:
            # As a full disk does, take a part before saying so.
            self.file.write(data[: len(data) // 2])
            raise
        return self.file.write(data)

    def sync(self):
        self.disk.count('sync', b'')
        self.file.sync()

    @property
    def touched(self):
        return self.file.touched

    def check(self, size):
        self.file.check(size)

    def check_content(self, size, crc):
        self.file.check_content(size, crc)

    def publish(self):
        self.disk.count('publish', b'')
        self.file.publish()

    def close(self):
        self.file.close()

    def discard(self):
        self.file.discard()


class ShortFile(FailingFile):
    """Takes at most seven bytes at once."""

    def write(self, data):
        return self.file.write(data[:7])


def recorder_of(folder, settings=QUICK, **options):
    recorder = Recorder(folder, settings, definitions=STOCK, **options)
    recorder.add_topic('/valve_opening', FLOAT64)
    return recorder


def record(recorder, first, count, topic='/valve_opening'):
    for number in range(first, first + count):
        time_ns = START_NS + number
        recorder.record(topic, float64(number), time_ns, time_ns)


def values_on_disk(folder):
    try:
        return open_log(folder).readings.value.tolist()
    except RecordingError:
        return []


def is_balanced(status):
    columns = status.written + status.queued + status.lost + status.removed
    columns += sum(status.dropped.values())
    return status.received == columns


def test_all_that_is_handed_in_is_on_disk(tmp_path):
    recorder = recorder_of(tmp_path / 'log', attachments={'parameters.yaml': b'a: 1\n'})
    record(recorder, 0, 5000)
    status = recorder.close()
    assert (status.state, status.reason) == (RecorderState.STOPPED, '')
    assert status.received == status.written == 5000
    assert (status.queued, status.lost, status.dropped) == (0, 0, {})
    assert (status.files_finished, status.recovered) == (1, ())
    assert values_on_disk(tmp_path / 'log') == list(range(5000))
    contents = open_log(tmp_path / 'log')
    assert contents.attachments == {'parameters.yaml': b'a: 1\n'}
    assert contents.metadata['valveflow_recorder'] == {'received': '5000'}
    path = tmp_path / 'log' / 'log_0.mcap'
    assert status.bytes_written == path.stat().st_size


def test_what_was_flushed_is_readable_while_recording(tmp_path):
    recorder = recorder_of(tmp_path / 'log')
    record(recorder, 0, 100)
    wait_for(lambda: recorder.status().written == 100)
    assert recorder.status().file == 'log_0.mcap.part'
    assert (tmp_path / 'log' / recorder.status().file).is_file()
    assert values_on_disk(tmp_path / 'log') == list(range(100))
    assert recorder.close().written == 100


def test_what_somebody_waits_for_is_on_disk_before_its_time(tmp_path):
    recorder = recorder_of(tmp_path / 'log', replace(QUICK, flush_period_s=600.0))
    for first in (0, 100, 200):
        record(recorder, first, 100)
        assert recorder.flush(20.0)
        assert values_on_disk(tmp_path / 'log') == list(range(first + 100))
    assert recorder.flush(0.0)
    assert recorder.close().written == 300
    # There is nobody left to write what comes now.
    record(recorder, 300, 1)
    assert not recorder.flush(20.0)


def test_nobody_waits_longer_for_a_disk_than_told(tmp_path):
    disk = Disk(lambda number: errno.ENOSPC)
    recorder = recorder_of(tmp_path / 'log', open_file=disk)
    record(recorder, 0, 10)
    begun_s = time.monotonic()
    assert not recorder.flush(0.2)
    assert 0.2 <= time.monotonic() - begun_s < 20.0
    recorder.close()


@pytest.mark.parametrize('error', [errno.ENOSPC, errno.EIO])
@pytest.mark.parametrize('call', range(1, 26))
def test_one_failing_call_loses_nothing(tmp_path, call, error):
    disk = Disk(lambda number: error if number == call else None)
    recorder = recorder_of(tmp_path / 'log', open_file=disk)
    for part in range(8):
        record(recorder, 20 * part, 20)
        wait_for(lambda part=part: recorder.status().written == 20 * (part + 1))
        assert is_balanced(recorder.status())
        if part % 3 == 2:
            recorder.rotate()
    status = recorder.close()
    assert disk.calls >= call
    assert (status.written, status.lost) == (160, 0)
    assert values_on_disk(tmp_path / 'log') == list(range(160))


def test_a_disk_that_often_fails_keeps_an_exact_account(tmp_path):
    disk = Disk(lambda number: errno.EIO if number % 7 == 0 else None)
    recorder = recorder_of(tmp_path / 'log', open_file=disk)
    for part in range(30):
        record(recorder, 10 * part, 10)
        wait_for(lambda part=part: recorder.status().written == 10 * (part + 1))
    status = recorder.close()
    assert is_balanced(status)
    assert (status.written, status.lost) == (300, 0)
    assert values_on_disk(tmp_path / 'log') == list(range(300))


def test_a_disk_that_always_fails_loses_what_it_says(tmp_path):
    disk = Disk(lambda number: errno.ENOSPC)
    recorder = recorder_of(tmp_path / 'log', open_file=disk)
    record(recorder, 0, 50)
    wait_for(lambda: recorder.status().state == RecorderState.DEGRADED)
    status = recorder.status()
    assert 'cannot be written' in status.reason
    assert (status.received, status.written, status.queued) == (50, 0, 50)
    status = recorder.close()
    assert (status.state, status.lost, status.written) == (RecorderState.STOPPED, 50, 0)
    assert is_balanced(status)
    assert list((tmp_path / 'log').glob('*.mcap*')) == []


def test_a_file_begins_anew_when_space_returns(tmp_path):
    full = threading.Event()
    disk = Disk(lambda number: errno.ENOSPC if full.is_set() else None)
    recorder = recorder_of(tmp_path / 'log', open_file=disk)
    record(recorder, 0, 40)
    wait_for(lambda: recorder.status().written == 40)
    full.set()
    record(recorder, 40, 40)
    wait_for(lambda: recorder.status().state == RecorderState.DEGRADED)
    full.clear()
    wait_for(lambda: recorder.status().written == 80)
    wait_for(lambda: recorder.status().state == RecorderState.RECORDING)
    assert recorder.close().lost == 0
    names = sorted(p.name for p in (tmp_path / 'log').glob('*.mcap*'))
    assert names == ['log_0.mcap.part', 'log_1.mcap']
    assert values_on_disk(tmp_path / 'log') == list(range(80))


@pytest.mark.parametrize('call', range(1, 61))
def test_whatever_call_fails_every_whole_file_is_listed(tmp_path, call):
    """A file that has its name is named in metadata.yaml, and a lock is never kept."""
    folder = tmp_path / 'log'
    faults = Faults('recorder', call, errno.EIO)
    with faults.active():
        recorder = recorder_of(folder)
        for part in range(6):
            record(recorder, 5 * part, 5)
            recorder.rotate()

            def settled(part=part):
                done = recorder.status().written == 5 * part + 5
                return done and not recorder.is_rotating

            wait_for(lambda settled=settled: faults.failed_at_s is not None or settled())
            if faults.failed_at_s is not None:
                faults.heal()
            wait_for(settled)
        status = recorder.close()
    assert (status.state, status.reason, status.written) == (RecorderState.STOPPED, '', 30)
    listed = yaml.safe_load((folder / 'metadata.yaml').read_text())
    names = listed['rosbag2_bagfile_information']['relative_file_paths']
    assert sorted(names) == sorted(p.name for p in folder.glob('*.mcap'))
    assert not any(is_held(part) for part in folder.glob('*.part'))
    assert values_on_disk(folder) == list(range(30))


def test_writes_of_a_few_bytes_are_put_together(tmp_path):
    disk = Disk()
    recorder = recorder_of(tmp_path / 'log', open_file=lambda p: ShortFile(disk, PartFile(p)))
    record(recorder, 0, 100)
    assert recorder.close().written == 100
    assert open_log(tmp_path / 'log').warnings == ()
    assert values_on_disk(tmp_path / 'log') == list(range(100))


def test_too_many_waiting_messages_are_dropped_by_topic_and_counted(tmp_path):
    gate = threading.Event()

    def slow(path):
        gate.wait(LIMIT_S)
        return PartFile(path)

    settings = RecorderSettings(queue_limit=30, flush_period_s=0.002, free_floor_bytes=0)
    recorder = recorder_of(tmp_path / 'log', settings, open_file=slow)
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
    status = recorder.close()
    assert is_balanced(status)
    assert values_on_disk(tmp_path / 'log') == list(range(30))
    notes = open_log(tmp_path / 'log').metadata['valveflow_recorder']
    assert notes == {
        'received': '43',
        'dropped /generated_power': '5',
        'dropped /valve_opening': '8',
    }


def test_asking_for_a_split_of_nothing_does_nothing(tmp_path):
    recorder = recorder_of(tmp_path / 'log')
    recorder.rotate()
    wait_for(lambda: not recorder.is_rotating)
    record(recorder, 0, 5)
    wait_for(lambda: recorder.status().written == 5)
    record(recorder, 5, 5)
    assert recorder.close().files_finished == 1


def test_a_hundred_rotations_lose_nothing(tmp_path):
    recorder = recorder_of(tmp_path / 'log')
    for part in range(100):
        record(recorder, 10 * part, 10)
        recorder.rotate()
        wait_for(lambda part=part: recorder.status().files_finished == part + 1)
    status = recorder.close()
    assert status.files_finished == 100
    assert values_on_disk(tmp_path / 'log') == list(range(1000))


def test_rotation_by_size_and_by_age(tmp_path):
    for name, limits in (('size', {'rotate_bytes': 1}), ('age', {'rotate_s': 0.0})):
        settings = RecorderSettings(flush_period_s=0.002, free_floor_bytes=0, **limits)
        recorder = recorder_of(tmp_path / name, settings)
        for part in range(3):
            record(recorder, part, 1)
            wait_for(lambda part=part, r=recorder: r.status().files_finished == part + 1)
        recorder.close()
        assert len(list((tmp_path / name).glob('*.mcap'))) == 3
        assert values_on_disk(tmp_path / name) == [0.0, 1.0, 2.0]


def test_latched_messages_head_every_later_split(tmp_path):
    recorder = recorder_of(tmp_path / 'log')
    recorder.add_topic('/curve', FLOAT64, qos=(LATCHED,), latched=True)
    record(recorder, 0, 2, '/curve')
    for part in range(3):
        record(recorder, 10 + 10 * part, 2)
        wait_for(lambda part=part: recorder.status().queued == 0)
        recorder.rotate()
        wait_for(lambda part=part: recorder.status().files_finished == part + 1)
    record(recorder, 50, 1)
    status = recorder.close()
    assert status.written == 9
    for number in (1, 2, 3):
        first = next(open_log(tmp_path / 'log' / f'log_{number}.mcap').iter_messages())
        assert (first.topic, first.data) == ('/curve', float64(1))
    curves = list(open_log(tmp_path / 'log').iter_messages(['/curve']))
    assert [m.data for m in curves] == [float64(0), float64(1)]


def test_the_oldest_files_go_when_told_so(tmp_path):
    folder = tmp_path / 'log'
    settings = RecorderSettings(flush_period_s=0.002, free_floor_bytes=0, keep_files=2)
    folder.mkdir()
    whole, _, _ = write_chunks(tmp_path / 'other', chunks=1)
    for name in ('other.mcap', 'other_0.mcap', 'log_x.mcap', 'xlog_0.mcap'):
        (folder / name).write_bytes(whole.read_bytes())
    bystanders = {p.name for p in folder.iterdir()}
    recorder = recorder_of(folder, settings)
    for part in range(5):
        record(recorder, part, 1)
        wait_for(lambda part=part: recorder.status().queued == 0)
        recorder.rotate()
        wait_for(lambda part=part: recorder.status().files_finished == part + 1)
    recorder.close()
    left = {p.name for p in folder.glob('*.mcap')}
    assert left - bystanders == {'log_4.mcap', 'log_5.mcap'}
    assert left >= bystanders
    found = open_log(folder, columns={'valve_opening': '/valve_opening'})
    assert found.warnings == ()
    assert found.readings.value[found.readings.signal == 0].tolist()[-2:] == [3.0, 4.0]


def test_it_stops_before_the_disk_is_full_and_goes_on_afterwards(tmp_path):
    free = [10**12]
    settings = RecorderSettings(
        flush_period_s=0.002, retry_s=0.002, retry_max_s=0.01, free_floor_bytes=10**9
    )
    recorder = recorder_of(tmp_path / 'log', settings, free_bytes=lambda folder: free[0])
    record(recorder, 0, 10)
    wait_for(lambda: recorder.status().written == 10)
    free[0] = 10**8
    wait_for(lambda: recorder.status().state == RecorderState.DEGRADED)
    assert 'MiB must stay free' in recorder.status().reason
    assert [p.name for p in (tmp_path / 'log').glob('*.mcap*')] == ['log_0.mcap']
    record(recorder, 10, 10)
    free[0] = 10**12
    wait_for(lambda: recorder.status().written == 20)
    recorder.close()
    assert values_on_disk(tmp_path / 'log') == list(range(20))


def test_leftovers_are_finished_at_the_start(tmp_path):
    part, wanted, writer = write_chunks(tmp_path / 'log', close=False)
    writer.abandon()
    assert part.exists()
    recorder = Recorder(tmp_path / 'log', QUICK, definitions=STOCK)
    wait_for(lambda: recorder.status().recovered)
    recorder.add_topic('/unit1/valve_opening', FLOAT64)
    record(recorder, 0, 3, '/unit1/valve_opening')
    status = recorder.close()
    assert status.recovered[0].messages == len(wanted)
    names = sorted(p.name for p in (tmp_path / 'log').iterdir())
    assert names == ['log_0.mcap', 'log_1.mcap', 'metadata.yaml']
    assert len(open_log(tmp_path / 'log').readings) == len(wanted) + 3


@pytest.mark.parametrize('problem', [PermissionError(13, 'no'), OSError(errno.EIO, 'bad sector')])
def test_a_leftover_that_cannot_be_read_holds_up_nothing(tmp_path, monkeypatch, problem):
    """It may be another user's, or lie on a bad sector."""
    folder = tmp_path / 'log'
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


def test_closing_takes_a_bounded_time_and_later_messages_are_counted(tmp_path):
    gate = threading.Event()

    def stuck(path):
        gate.wait(LIMIT_S)
        return PartFile(path)

    recorder = recorder_of(tmp_path / 'log', open_file=stuck)
    record(recorder, 0, 10)
    begin = time.monotonic()
    status = recorder.close(timeout_s=0.05)
    assert time.monotonic() - begin < 2.0
    assert (status.queued, status.written) == (10, 0)
    assert not recorder.record('/valve_opening', float64(0), START_NS, START_NS)
    gate.set()
    status = recorder.close(LIMIT_S)
    assert (status.written, status.lost, status.dropped) == (10, 0, {'/valve_opening': 1})
    assert is_balanced(status)


def test_an_error_nobody_thought_of_stops_it_visibly(tmp_path):
    def broken(path):
        raise ZeroDivisionError('a mistake')

    recorder = recorder_of(tmp_path / 'log', open_file=broken)
    record(recorder, 0, 1)
    wait_for(lambda: recorder.status().state == RecorderState.STOPPED)
    status = recorder.status()
    assert 'ZeroDivisionError' in status.reason
    assert (status.lost, is_balanced(status)) == (1, True)
    assert not recorder.record('/valve_opening', float64(0), START_NS, START_NS)


def test_misuse_is_one_sentence(tmp_path):
    recorder = recorder_of(tmp_path / 'log')
    with pytest.raises(InputError, match="'/gone' was not made known"):
        recorder.record('/gone', b'', 0, 0)
    with pytest.raises(InputError, match='impossible time'):
        recorder.record('/valve_opening', float64(0), -1, 0)
    with pytest.raises(InputError, match='is recorded as'):
        recorder.add_topic('/valve_opening', 'std_msgs/msg/Bool')
    with pytest.raises(RecordingError, match='was not found'):
        recorder.add_topic('/other', 'std_msgs/msg/Nothing')
    assert recorder.close().received == 0
    (tmp_path / 'file').write_text('')
    with pytest.raises(RecordingError, match='cannot be made'):
        Recorder(tmp_path / 'file' / 'log')
