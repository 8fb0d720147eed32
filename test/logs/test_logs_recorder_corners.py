# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Corners of recorder and recovery that a day of recording does not come by."""

from __future__ import annotations

import errno
import fcntl
import gc
import os
import struct
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from damage import records
from log_files import FLOAT64, START_NS, STOCK, float64, write_chunks
from mcap.opcode import Opcode

from valveflow_ros.errors import InputError, RecordingError
from valveflow_ros.logs import (
    Recorder,
    RecorderSettings,
    RecorderState,
    RecorderStatus,
    RecordingWriter,
    open_log,
    part_file,
    recover_leftovers,
)
from valveflow_ros.logs.mcap.recorder import RecorderCounters
from valveflow_ros.logs.mcap.recover import recover
from valveflow_ros.logs.mcap.writer import Message
from valveflow_ros.logs.part_file import PartFile, taken

QUICK = RecorderSettings(flush_period_s=0.002, sync_period_s=0.0, retry_s=0.002, retry_max_s=0.01,
                         free_floor_bytes=0)  # fmt: skip
PATIENCE_S = float(os.environ.get('VALVEFLOW_TEST_PATIENCE_S', 20.0))


def until(recorder: Recorder, holds: Callable[[RecorderStatus], bool]) -> RecorderStatus:
    """Return the first status of which something holds."""
    waited = threading.Event()
    for _ in range(round(PATIENCE_S / 0.001)):
        if holds(status := recorder.status()):
            return status
        waited.wait(0.001)
    raise AssertionError(f'waited in vain: {recorder.status()}')


def recorder_of(folder: Path, settings: RecorderSettings = QUICK, **more: Any) -> Recorder:
    made = Recorder(folder, settings, definitions=STOCK, **more)
    made.add_topic('/a', FLOAT64)
    return made


def put(recorder: Recorder, *numbers: int, topic: str = '/a') -> None:
    for k in numbers:
        assert recorder.record(topic, float64(k), START_NS + k, START_NS + k)


def numbers_in(folder: Path) -> list[int]:
    messages = open_log(folder).iter_messages()
    return [round(struct.unpack('<d', m.data[4:])[0]) for m in messages]


# --- recorder -------------------------------------------------------------------------------


def test_a_topic_made_known_twice_is_there_once_and_a_given_hash_is_believed(
    tmp_path: Path,
) -> None:
    recorder = recorder_of(tmp_path)
    recorder.add_topic('/a', FLOAT64)
    recorder.add_topic('/b', FLOAT64, type_hash='RIHS01_' + '0' * 64)
    put(recorder, 0)
    put(recorder, 1, topic='/b')
    assert recorder.close().written == 2
    topics = open_log(tmp_path).topics
    assert sorted(topics) == ['/a', '/b']
    text = (tmp_path / 'metadata.yaml').read_text()
    assert text.count('RIHS01_' + '0' * 64) >= 1


def test_a_definition_that_makes_no_sense_is_a_sentence(tmp_path: Path) -> None:
    recorder = recorder_of(tmp_path)
    with pytest.raises(RecordingError, match="message type 'x_msgs/msg/Bad'"):
        recorder.add_topic('/bad', 'x_msgs/msg/Bad', definition='no_such_type[ value')
    recorder.close()


def test_many_waiting_messages_wake_the_thread_before_its_time(tmp_path: Path) -> None:
    """A flush an hour away does not let a burst pile up."""
    recorder = recorder_of(tmp_path, RecorderSettings(flush_period_s=3600.0, free_floor_bytes=0))
    put(recorder, *range(10_000))
    until(recorder, lambda status: status.written >= 4000)
    assert recorder.close().written == 10_000


@pytest.mark.parametrize('which', ['log', 'publish'])
def test_times_are_taken_up_to_the_last_that_a_recording_holds(tmp_path: Path, which: str) -> None:
    recorder = recorder_of(tmp_path)
    for wrong in (-1, 1 << 63):
        times = (wrong, 0) if which == 'log' else (0, wrong)
        with pytest.raises(InputError, match='impossible time'):
            recorder.record('/a', float64(0), *times)
    last = (1 << 63) - 1
    for right in (0, last):
        times = (right, 5) if which == 'log' else (5, right)
        assert recorder.record('/a', float64(right % 7), *times)
    assert recorder.close().written == 2


@pytest.mark.parametrize('period_s', [0.0, 1e-6])
def test_without_a_period_nothing_is_brought_to_the_disk_before_the_end(
    tmp_path: Path, period_s: float
) -> None:
    synced: list[Path] = []

    class Counting(PartFile):
        def sync(self) -> None:
            synced.append(self.path)
            super().sync()

    settings = RecorderSettings(flush_period_s=0.002, sync_period_s=period_s, free_floor_bytes=0)
    recorder = recorder_of(tmp_path, settings, open_file=Counting)
    put(recorder, 1)
    until(recorder, lambda status: status.written == 1 and (synced or not period_s))
    assert bool(synced) == (period_s > 0.0)
    recorder.close()
    assert synced, 'a file is on the disk before it gets its name'


def test_a_disk_that_does_not_tell_its_space_is_an_error_of_the_disk(tmp_path: Path) -> None:
    ill = [True]

    def free(_folder: Path) -> int:
        if ill:
            raise OSError(errno.EIO, 'Input/output error')
        return 1 << 40

    recorder = recorder_of(tmp_path, free_bytes=free)
    put(recorder, 1, 2)
    status = until(recorder, lambda status: status.state == RecorderState.DEGRADED)
    assert 'cannot be asked for space' in status.reason
    ill.clear()
    until(recorder, lambda status: status.written == 2)
    assert recorder.close().state == RecorderState.STOPPED
    assert numbers_in(tmp_path) == [1, 2]


def test_an_old_file_that_cannot_be_removed_is_said_and_recording_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = RecorderSettings(
        flush_period_s=0.002, retry_s=0.002, retry_max_s=0.01, free_floor_bytes=0, keep_files=1
    )
    recorder = recorder_of(tmp_path, settings)
    stuck = [True]
    said: list[str] = []
    unlink, ill = Path.unlink, RecorderCounters.failing
    # It is said for two milliseconds, which is long enough only for who listens.
    monkeypatch.setattr(
        RecorderCounters, 'failing', lambda counters, why: (said.append(why), ill(counters, why))
    )

    def sticky(path: Path, missing_ok: bool = False) -> None:
        if stuck and path.name.endswith('_0.mcap'):
            raise PermissionError(errno.EPERM, 'Operation not permitted')
        unlink(path, missing_ok)

    monkeypatch.setattr(Path, 'unlink', sticky)
    for k in range(2):
        put(recorder, k)
        until(recorder, lambda status, k=k: status.written == k + 1)
        recorder.rotate()
        until(recorder, lambda status, k=k: status.files_finished == k + 1)
    until(recorder, lambda _: bool(said))
    assert 'cannot be removed (Operation not permitted)' in said[0]
    put(recorder, 2)
    until(recorder, lambda status: status.written == 3)
    stuck.clear()
    recorder.rotate()
    until(recorder, lambda status: status.files_finished == 3)
    recorder.close()
    assert numbers_in(tmp_path) == [2]


@pytest.mark.parametrize('before', [0, 1])
def test_a_head_message_keeps_its_own_number_when_a_newer_one_waits(
    tmp_path: Path, before: int
) -> None:
    """In the first flush of a split its latched topic speaks already: each message comes once."""
    latched: list[Message] = []
    with RecordingWriter(tmp_path, definitions=STOCK, head_messages=lambda: latched) as writer:
        writer.add_topic('/latched', FLOAT64)
        writer.add_topic('/other', FLOAT64)
        first = Message('/latched', float64(0), START_NS, START_NS)
        writer.write(*first)
        writer.rotate()
        latched.append(first)
        for k in range(1, 1 + before):
            writer.write('/other', float64(k), START_NS + k, START_NS + k)
        writer.write('/latched', float64(8), START_NS + 8, START_NS + 8)
        writer.write('/latched', float64(9), START_NS + 9, START_NS + 9)
    assert numbers_in(tmp_path) == [0, *range(1, 1 + before), 8, 9]


# --- recovery -------------------------------------------------------------------------------


def test_only_files_are_taken_for_leftovers(tmp_path: Path) -> None:
    part, _, writer = write_chunks(tmp_path / 'log', close=False)
    writer.abandon()
    there = tmp_path / 'there'
    there.mkdir()
    (there / 'link_0.mcap.part').symlink_to(part)
    (there / 'folder_0.mcap.part').mkdir()
    assert recover_leftovers(there) == ()
    assert part.exists()
    assert sorted(p.name for p in there.iterdir()) == ['folder_0.mcap.part', 'link_0.mcap.part']


def test_what_the_recorder_noted_is_in_the_recovered_file_too(tmp_path: Path) -> None:
    writer = RecordingWriter(
        tmp_path / 'log', definitions=STOCK, attachments={'a.txt': b'kept'},
        metadata={'of the run': {'key': 'value'}},
    )  # fmt: skip
    writer.add_topic('/a', FLOAT64)
    writer.write('/a', float64(1), START_NS, START_NS)
    writer.flush()
    writer.note('counters', {'received': '1'})
    writer.abandon()
    (part,) = (tmp_path / 'log').glob('*.part')
    recover(part, tmp_path / 'whole.mcap')
    found = open_log(tmp_path / 'whole.mcap')
    assert found.metadata['of the run'] == {'key': 'value'}
    assert found.metadata['counters'] == {'received': '1'}
    assert found.attachments['a.txt'] == b'kept'


def test_progress_comes_to_the_end_of_each_chunk(tmp_path: Path) -> None:
    part, _, writer = write_chunks(tmp_path / 'log', chunks=4, close=False)
    writer.abandon()
    steps: list[tuple[int, int]] = []
    recover(part, tmp_path / 'whole.mcap', progress=lambda *step: steps.append(step))
    raw = part.read_bytes()
    ends = [end for op, _, end in records(raw) if op == Opcode.CHUNK]
    assert [done for done, _ in steps] == ends
    assert {total for _, total in steps} == {len(raw)}


# --- files ----------------------------------------------------------------------------------


def test_a_part_that_is_held_is_not_thrown_away_for_a_new_one(tmp_path: Path) -> None:
    first = PartFile(tmp_path / 'a.mcap')
    first.write(b'mine')
    with pytest.raises(FileExistsError):
        PartFile(tmp_path / 'a.mcap', replace=True)
    first.close()
    first.close()
    with pytest.raises(FileExistsError):
        PartFile(tmp_path / 'a.mcap')
    second = PartFile(tmp_path / 'a.mcap', replace=True)
    assert second.part.read_bytes() == b''
    second.discard()
    assert list(tmp_path.iterdir()) == []


def test_a_part_removed_between_making_and_locking_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock, removed = fcntl.flock, [0]

    def raced(descriptor: int, how: int) -> None:
        lock(descriptor, how)
        if removed[0] < wanted:
            removed[0] += 1
            (tmp_path / 'a.mcap.part').unlink()

    monkeypatch.setattr(part_file.fcntl, 'flock', raced)
    wanted = 2
    file = PartFile(tmp_path / 'a.mcap')
    file.write(b'here')
    assert file.part.read_bytes() == b'here'
    with taken(file.part) as free:
        assert not free
    file.discard()
    removed[0], wanted = 0, 1000
    # What earlier tests left to the collector may go at any moment.
    gc.collect()
    descriptors = len(os.listdir('/proc/self/fd'))
    with pytest.raises(FileNotFoundError):
        PartFile(tmp_path / 'a.mcap')
    assert len(os.listdir('/proc/self/fd')) == descriptors


def test_a_part_that_cannot_be_locked_leaves_no_descriptor_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_descriptor: int, _how: int) -> None:
        raise OSError(errno.ENOLCK, 'No locks available')

    monkeypatch.setattr(part_file.fcntl, 'flock', broken)
    # What earlier tests left to the collector may go at any moment.
    gc.collect()
    before = len(os.listdir('/proc/self/fd'))
    with pytest.raises(OSError, match='No locks available'):
        PartFile(tmp_path / 'a.mcap')
    assert len(os.listdir('/proc/self/fd')) == before


def test_numbers_of_a_continued_folder_are_others_than_before(tmp_path: Path) -> None:
    for k in range(3):
        with RecordingWriter(tmp_path, name='log', definitions=STOCK) as writer:
            writer.add_topic('/a', FLOAT64)
            # Equal but for the number: three messages, not a message and two repetitions.
            writer.write('/a', float64(5), START_NS + k, START_NS)
    np.testing.assert_array_equal(numbers_in(tmp_path), [5, 5, 5])
