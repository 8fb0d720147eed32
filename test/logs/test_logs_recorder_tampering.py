# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Another program removes or changes what a recorder writes: the account is what a reader finds.

The slow truth is the stock reader, after damaged files were recovered.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
from log_files import FLOAT64, START_NS, STOCK, float64
from mcap.reader import make_reader
from test_logs_recorder import QUICK, is_balanced, record, recorder_of, wait_for

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import (
    Recorder,
    RecorderStatus,
    RecordingWriter,
    recover,
    recover_leftovers,
)
from valveflow_ros.logs.mcap import recorder as recorder_module

BEFORE, AFTER = 200, 100


def unlink(path: Path) -> None:
    path.unlink()


def move_away(path: Path) -> None:
    path.rename(path.with_name('kept.bin'))


def replace_by_link(path: Path) -> None:
    other = path.parent.parent / 'other.bin'
    other.write_bytes(path.read_bytes())
    path.unlink()
    path.symlink_to(other)


def replace_by_another(path: Path) -> None:
    draft = path.with_name('draft')
    draft.write_bytes(b'something else')
    draft.replace(path)


def empty(path: Path) -> None:
    os.truncate(path, 0)


def halve(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def append(path: Path) -> None:
    with path.open('ab') as file:
        file.write(b'log line\n')


def overwrite(path: Path) -> None:
    with path.open('r+b') as file:
        file.seek(path.stat().st_size // 2)
        file.write(bytes(50))


def remove_folder(path: Path) -> None:
    shutil.rmtree(path.parent)


def move_folder(path: Path) -> None:
    path.parent.rename(path.parent.with_name('moved'))


def empty_folder(path: Path) -> None:
    shutil.rmtree(path.parent)
    path.parent.mkdir(exist_ok=True)  # the recorder may have been quicker


GONE = (unlink, move_away, replace_by_another)
FILE_ACTS = (*GONE, replace_by_link, empty, halve, append, overwrite)
FOLDER_ACTS = (remove_folder, move_folder, empty_folder)
Act = Callable[[Path], None]


def found_by_stock_reader(folder: Path) -> set[int]:
    """Return what the stock reader finds in all files, those recovered that it cannot open."""
    recover_leftovers(folder)
    found: list[int] = []
    for path in sorted(folder.glob('*.mcap*')):
        try:
            found += sequences(path)
        except Exception:  # noqa: BLE001 - readers raise what they like
            whole = folder.parent / f'recovered_{path.name}'
            with suppress(RecordingError):
                recover(path, whole)
                found += sequences(whole)
    assert len(found) == len(set(found))
    return set(found)


def sequences(path: Path) -> list[int]:
    """Return the numbers of all messages, by the stock reader, which checks every sum."""
    with path.open('rb') as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_summary() is not None
        return [message.sequence for _, _, message in reader.iter_messages()]


def finish(recorder: Recorder) -> RecorderStatus:
    """Close, and hold the account against the truth."""
    status = recorder.close(20.0)
    assert is_balanced(status)
    assert status.written == len(found_by_stock_reader(recorder.folder))
    return status


def in_small_chunks(folder: Path) -> Recorder:
    """Return a recorder after messages in many chunks of one split."""
    recorder = recorder_of(folder)
    for part in range(10):
        record(recorder, part * BEFORE // 10, BEFORE // 10)
        wait_for(lambda part=part: recorder.status().written == (part + 1) * BEFORE // 10)
    return recorder


@pytest.mark.parametrize('act', [*FILE_ACTS, *FOLDER_ACTS])
def test_the_account_of_a_growing_file_is_what_a_reader_finds(act: Act, tmp_path: Path) -> None:
    folder = tmp_path / 'log'
    recorder = in_small_chunks(folder)
    act(folder / 'log_0.mcap.part')
    record(recorder, BEFORE, AFTER)
    status = finish(recorder)
    assert not status.reason
    assert status.written >= AFTER
    if act in (*GONE, *FOLDER_ACTS):
        assert (status.written, status.lost) == (AFTER, BEFORE)
        assert 'log_0.mcap.part' in status.loss
    if act in (halve, overwrite):
        assert 0 < status.lost < BEFORE, 'whole chunks are kept'
    if act is append:
        assert status.lost == 0, 'a tail costs nothing'


@pytest.mark.parametrize('act', [*FILE_ACTS, *FOLDER_ACTS])
def test_the_account_of_finished_files_is_what_a_reader_finds(act: Act, tmp_path: Path) -> None:
    folder = tmp_path / 'log'
    recorder = in_small_chunks(folder)
    recorder.rotate()
    wait_for(lambda: recorder.status().files_finished == 1)
    act(folder / 'log_0.mcap')
    if act is replace_by_link:
        # The link leads to a copy, in which a reader finds all.
        assert finish(recorder).lost == 0
        return
    record(recorder, BEFORE, AFTER)
    status = finish(recorder)
    assert status.written >= AFTER
    if act in (unlink, move_away, *FOLDER_ACTS):
        assert (status.removed, status.lost) == (BEFORE, 0), 'it may stand in an archive'


def test_the_last_file_too(tmp_path: Path) -> None:
    """It is taken away after the last flush: nothing but the end can notice it."""
    for act in (unlink, overwrite, remove_folder):
        folder = tmp_path / act.__name__ / 'log'
        recorder = in_small_chunks(folder)
        act(folder / 'log_0.mcap.part')
        assert finish(recorder).lost > 0


def test_while_it_records_it_says_so(tmp_path: Path) -> None:
    recorder = in_small_chunks(tmp_path / 'log')
    (tmp_path / 'log' / 'log_0.mcap.part').unlink()
    wait_for(lambda: recorder.status().lost == BEFORE)
    assert recorder.status().loss.endswith('200 messages in it are lost.')
    recorder.close()


def test_finished_files_are_looked_at_while_it_records(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_module, '_LOOK_S', 0.01)
    recorder = in_small_chunks(tmp_path / 'log')
    recorder.rotate()
    wait_for(lambda: recorder.status().files_finished == 1)
    (tmp_path / 'log' / 'log_0.mcap').unlink()
    wait_for(lambda: recorder.status().removed == BEFORE)
    assert 'log_0' not in (tmp_path / 'log' / 'metadata.yaml').read_text('utf-8')
    recorder.close()


def test_a_number_is_not_given_twice(tmp_path: Path) -> None:
    """Who moved a file away may bring it back."""
    folder = tmp_path / 'log'
    recorder = in_small_chunks(folder)
    (folder / 'log_0.mcap.part').rename(tmp_path / 'log_0.mcap.part')
    wait_for(lambda: recorder.status().lost == BEFORE)
    record(recorder, BEFORE, AFTER)
    recorder.close()
    (tmp_path / 'log_0.mcap.part').rename(folder / 'log_0.mcap.part')
    assert len(found_by_stock_reader(folder)) == BEFORE + AFTER


def test_a_folder_that_cannot_be_made_again_is_an_error(tmp_path: Path) -> None:
    recorder = in_small_chunks(tmp_path / 'log')
    shutil.rmtree(tmp_path / 'log')
    (tmp_path / 'log').write_text('a file')
    record(recorder, BEFORE, AFTER)
    wait_for(lambda: recorder.status().reason)
    assert 'log' in recorder.status().reason
    (tmp_path / 'log').unlink()
    wait_for(lambda: recorder.status().queued == 0)
    assert finish(recorder).written == AFTER


def test_a_file_of_the_same_name_made_meanwhile_stays(tmp_path: Path) -> None:
    """What a writer gives up it may only remove while it is its own."""
    with RecordingWriter(tmp_path / 'log', definitions=STOCK) as writer:
        writer.add_topic('/valve_opening', FLOAT64)
        writer.write('/valve_opening', float64(1.0), START_NS, START_NS)
        writer.flush()
        part = tmp_path / 'log' / 'log_0.mcap.part'
        replace_by_another(part)
    assert part.read_bytes() == b'something else'
    assert (writer.written, writer.lost) == (0, 1)


def test_a_file_that_takes_the_name_of_the_next_split_stays(tmp_path: Path) -> None:
    folder = tmp_path / 'log'
    recorder = in_small_chunks(folder)
    (folder / 'log_0.mcap').write_bytes(b'something else')
    record(recorder, BEFORE, AFTER)
    status = recorder.close(20.0)
    assert (folder / 'log_0.mcap').read_bytes() == b'something else'
    assert (status.written, status.reason) == (BEFORE + AFTER, '')
    assert len(sequences(folder / 'log_1.mcap')) == BEFORE + AFTER


def test_a_folder_removed_while_a_file_gets_its_name(tmp_path: Path) -> None:
    """Whatever the moment, no claim is left over."""
    for trial in range(40):
        folder = tmp_path / str(trial) / 'log'
        recorder = recorder_of(folder)
        record(recorder, 0, BEFORE)
        wait_for(lambda r=recorder: r.status().written == BEFORE)
        recorder.rotate()
        time.sleep(0.0005 * (trial % 20))
        shutil.rmtree(folder, ignore_errors=True)
        record(recorder, BEFORE, AFTER)
        finish(recorder)


def test_a_change_that_keeps_name_and_size_shows_before_the_end(tmp_path: Path) -> None:
    recorder = in_small_chunks(tmp_path / 'log')
    overwrite(tmp_path / 'log' / 'log_0.mcap.part')
    wait_for(lambda: recorder.status().lost > 0)
    finish(recorder)


def test_a_change_with_its_time_put_back_is_seen(tmp_path: Path) -> None:
    recorder = in_small_chunks(tmp_path / 'log')
    recorder.rotate()
    wait_for(lambda: recorder.status().files_finished == 1)
    path = tmp_path / 'log' / 'log_0.mcap'
    before = path.stat()
    with path.open('r+b') as file:
        file.seek(path.stat().st_size // 8)
        file.write(bytes(50))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert finish(recorder).lost > 0


def test_an_error_at_the_end_does_not_spare_the_last_look(tmp_path: Path) -> None:
    recorder = in_small_chunks(tmp_path / 'log')
    recorder.rotate()
    wait_for(lambda: recorder.status().files_finished == 1)
    record(recorder, BEFORE, AFTER)
    wait_for(lambda: recorder.status().written == BEFORE + AFTER)
    (tmp_path / 'log' / 'log_0.mcap').unlink()
    (tmp_path / 'log' / 'metadata.yaml').unlink()
    (tmp_path / 'log' / 'metadata.yaml').mkdir()
    status = finish(recorder)
    assert (status.written, status.removed) == (AFTER, BEFORE)
    assert status.reason
    assert not list((tmp_path / 'log').glob('.*.tmp'))


def test_what_only_recover_can_read_is_told_and_not_listed(tmp_path: Path) -> None:
    recorder = in_small_chunks(tmp_path / 'log')
    recorder.rotate()
    wait_for(lambda: recorder.status().files_finished == 1)
    append(tmp_path / 'log' / 'log_0.mcap')
    status = finish(recorder)
    assert (status.written, status.lost) == (BEFORE, 0)
    assert 'needs `valveflow recover`' in status.loss
    assert 'log_0' not in (tmp_path / 'log' / 'metadata.yaml').read_text('utf-8')


def test_a_removed_list_is_written_again(tmp_path: Path) -> None:
    recorder = in_small_chunks(tmp_path / 'log')
    recorder.rotate()
    wait_for(lambda: recorder.status().files_finished == 1)
    (tmp_path / 'log' / 'metadata.yaml').unlink()
    finish(recorder)
    assert 'log_0' in (tmp_path / 'log' / 'metadata.yaml').read_text('utf-8')


def test_retention_leaves_a_copy_of_another_name(tmp_path: Path) -> None:
    folder = tmp_path / 'log'
    recorder = recorder_of(folder, replace(QUICK, keep_files=1))
    for part in range(3):
        record(recorder, part * 10, 10)
        wait_for(lambda part=part: recorder.status().queued == 0)
        recorder.rotate()
        wait_for(lambda part=part: recorder.status().files_finished == part + 1)
        if part == 0:
            shutil.copy(folder / 'log_0.mcap', folder / 'log_000.mcap')
    status = recorder.close()
    assert (folder / 'log_000.mcap').exists()
    assert not (folder / 'log_0.mcap').exists()
    assert (status.written, status.removed, is_balanced(status)) == (10, 20, True)
