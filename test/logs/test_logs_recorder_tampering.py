# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Another program removes or changes what a recorder writes: the account is what a reader finds.

The slow truth is the stock reader, after damaged files were recovered.
"""

import os
import shutil
import time
from contextlib import suppress

import pytest
from log_files import (
    FLOAT64,
    PATIENCE_S,
    START_NS,
    STOCK,
    balanced,
    float64,
    numbered,
    put,
    record,
    recorder_of,
    records,
    rotate,
    wait_for,
)
from mcap.opcode import Opcode

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import RecordingWriter, recover, recover_leftovers
from valveflow_ros.logs.mcap import recorder as recorder_module

BEFORE, AFTER = 200, 100


def unlink(path):
    path.unlink()


def move_away(path):
    path.rename(path.with_name('kept.bin'))


def replace_by_link(path):
    # At one moment: a recorder that looked in between would rightly find nothing.
    other, draft = path.parent.parent / 'other.bin', path.with_name('draft')
    os.link(path, other)
    draft.symlink_to(other)
    draft.replace(path)


def replace_by_another(path):
    draft = path.with_name('draft')
    draft.write_bytes(b'something else')
    draft.replace(path)


def empty(path):
    os.truncate(path, 0)


def halve(path):
    os.truncate(path, path.stat().st_size // 2)


def append(path):
    with path.open('ab') as file:
        file.write(b'log line\n')


def overwrite(path):
    chunks = [begin for op, begin, _ in records(path.read_bytes()) if op == Opcode.CHUNK]
    with path.open('r+b') as file:
        file.seek(chunks[3] + 100)
        file.write(bytes(50))


def overwrite_and_put_the_time_back(path):
    before = path.stat()
    overwrite(path)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


def remove_folder(path):
    shutil.rmtree(path.parent)


def move_folder(path):
    path.parent.rename(path.parent.with_name('moved'))


def empty_folder(path):
    shutil.rmtree(path.parent)
    path.parent.mkdir(exist_ok=True)  # the recorder may have been quicker


GONE = (unlink, move_away, replace_by_another)
FOLDER_ACTS = (remove_folder, move_folder, empty_folder)
CHANGED = (halve, overwrite, overwrite_and_put_the_time_back)
ACTS = (*GONE, *FOLDER_ACTS, *CHANGED, replace_by_link, empty, append)


def sequences(path):
    return [number for _, number in numbered(path)]


def found_by_stock_reader(folder):
    recover_leftovers(folder)
    found = []
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


def finish(recorder):
    """Close, and hold the account against the truth."""
    status = recorder.close(PATIENCE_S)
    assert balanced(status)
    assert status.written == len(found_by_stock_reader(recorder.folder))
    return status


@pytest.fixture
def folder(tmp_path):
    return tmp_path / 'log'


@pytest.fixture
def recorder(folder):
    """Return a recorder after messages in many chunks of one split."""
    return in_small_chunks(folder)


def in_small_chunks(folder):
    made = recorder_of(folder)
    for part in range(10):
        put(made, part * BEFORE // 10, BEFORE // 10)
    return made


@pytest.fixture
def rotated(recorder):
    """Return a recorder whose only split is finished."""
    rotate(recorder)
    return recorder


def names_the_first(folder):
    return 'log_0' in (folder / 'metadata.yaml').read_text('utf-8')


@pytest.mark.parametrize('last', [False, True])
@pytest.mark.parametrize('act', ACTS)
def test_the_account_of_a_growing_file_is_what_a_reader_finds(act, last, recorder):
    """Also if it is changed after the last flush, where nothing but the end can notice it."""
    act(recorder.folder / 'log_0.mcap.part')
    after = 0 if last else AFTER
    record(recorder, BEFORE, after)
    status = finish(recorder)
    assert not status.reason
    assert status.written >= after
    if act in (*GONE, *FOLDER_ACTS):
        assert (status.written, status.lost) == (after, BEFORE)
        assert 'log_0.mcap.part' in status.loss
    if act in CHANGED:
        assert 0 < status.lost < BEFORE, 'whole chunks are kept'
    if act is append:
        assert status.lost == 0, 'a tail costs nothing'


@pytest.mark.parametrize('act', ACTS)
def test_the_account_of_finished_files_is_what_a_reader_finds(act, rotated):
    act(rotated.folder / 'log_0.mcap')
    if act is replace_by_link:
        # The link leads to the file, in which a reader finds all.
        assert finish(rotated).lost == 0
        return
    record(rotated, BEFORE, AFTER)
    status = finish(rotated)
    assert status.written >= AFTER
    if act in (unlink, move_away, *FOLDER_ACTS):
        assert (status.removed, status.lost) == (BEFORE, 0), 'it may stand in an archive'
    if act in CHANGED:
        assert status.lost > 0


@pytest.mark.parametrize('act', [unlink, overwrite])
def test_while_it_records_it_says_so(act, recorder):
    act(recorder.folder / 'log_0.mcap.part')
    wait_for(lambda: recorder.status().lost)
    lost = recorder.status().lost
    assert f': {lost} messages in it are lost.' in recorder.status().loss
    finish(recorder)


def test_finished_files_are_looked_at_while_it_records(rotated, monkeypatch):
    monkeypatch.setattr(recorder_module, '_LOOK_S', 0.01)
    (rotated.folder / 'log_0.mcap').unlink()
    wait_for(lambda: rotated.status().removed == BEFORE)
    assert not names_the_first(rotated.folder)
    rotated.close()


def test_a_number_is_not_given_twice(folder, recorder):
    """Who moved a file away may bring it back."""
    part = folder / 'log_0.mcap.part'
    away = part.rename(folder.parent / part.name)
    wait_for(lambda: recorder.status().lost == BEFORE)
    record(recorder, BEFORE, AFTER)
    recorder.close()
    away.rename(part)
    assert len(found_by_stock_reader(folder)) == BEFORE + AFTER


def test_a_folder_that_cannot_be_made_again_is_an_error(folder, recorder):
    shutil.rmtree(folder)
    folder.write_text('a file')
    record(recorder, BEFORE, AFTER)
    wait_for(lambda: recorder.status().reason)
    assert 'log' in recorder.status().reason
    folder.unlink()
    wait_for(lambda: recorder.status().queued == 0)
    assert finish(recorder).written == AFTER


def test_a_file_of_the_same_name_made_meanwhile_stays(folder):
    """What a writer gives up it may only remove while it is its own."""
    with RecordingWriter(folder, definitions=STOCK) as writer:
        writer.add_topic('/valve_opening', FLOAT64)
        writer.write('/valve_opening', float64(1.0), START_NS, START_NS)
        writer.flush()
        part = folder / 'log_0.mcap.part'
        replace_by_another(part)
    assert part.read_bytes() == b'something else'
    assert (writer.written, writer.lost) == (0, 1)


def test_a_file_that_takes_the_name_of_the_next_split_stays(folder, recorder):
    (folder / 'log_0.mcap').write_bytes(b'something else')
    record(recorder, BEFORE, AFTER)
    status = recorder.close(PATIENCE_S)
    assert (folder / 'log_0.mcap').read_bytes() == b'something else'
    assert (status.written, status.reason) == (BEFORE + AFTER, '')
    assert len(sequences(folder / 'log_1.mcap')) == BEFORE + AFTER


def test_a_folder_removed_while_a_file_gets_its_name(tmp_path):
    """Whatever the moment, no claim is left over."""
    for trial in range(20):
        folder = tmp_path / str(trial) / 'log'
        recorder = recorder_of(folder)
        put(recorder, 0, BEFORE)
        recorder.rotate()
        time.sleep(0.0005 * trial)
        shutil.rmtree(folder, ignore_errors=True)
        record(recorder, BEFORE, AFTER)
        finish(recorder)


def test_an_error_at_the_end_does_not_spare_the_last_look(folder, rotated):
    put(rotated, BEFORE, AFTER)
    (folder / 'log_0.mcap').unlink()
    (folder / 'metadata.yaml').unlink()
    (folder / 'metadata.yaml').mkdir()
    status = finish(rotated)
    assert (status.written, status.removed) == (AFTER, BEFORE)
    assert status.reason
    assert not list(folder.glob('.*.tmp'))


def test_what_only_recover_can_read_is_told_and_not_listed(folder, rotated):
    append(folder / 'log_0.mcap')
    status = finish(rotated)
    assert (status.written, status.lost) == (BEFORE, 0)
    assert 'needs `valveflow recover`' in status.loss
    assert not names_the_first(folder)


def test_a_removed_list_is_written_again(folder, rotated):
    (folder / 'metadata.yaml').unlink()
    finish(rotated)
    assert names_the_first(folder)
