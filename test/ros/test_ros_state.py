# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The folder of the saved state: one owner, whole or not at all."""

import gc
import os
import shutil
import signal
import stat
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from valveflow_ros.errors import DataError, RecordingError
from valveflow_ros.parameters import Settings
from valveflow_ros.ros.node import state_store
from valveflow_ros.ros.node.engine import example_curve
from valveflow_ros.ros.node.state_store import LOCK, STATE, InUseError, StateFolder
from valveflow_ros.state import from_bytes

CURVE = example_curve(Settings()).with_id()


@pytest.fixture
def folder(tmp_path):
    made = StateFolder(tmp_path / 'state')
    yield made
    made.close()


def test_of_two_states_that_do_not_fit_the_larger_one_is_kept_aside(folder):
    """In whatever order they came; a tie keeps the one that is there."""
    folder.set_aside()
    assert not folder.aside.exists()
    largest = b''
    for data in (b'22', b'4444', b'333', b'aaaa', b'55555', b''):
        folder.write(data)
        folder.set_aside()
        largest = data if len(data) > len(largest) else largest
        assert folder.read(folder.aside) == largest
    assert folder.read() == b''


def test_taking_back_twice_changes_nothing(folder):
    folder.write(b'mended')
    folder.aside.write_bytes(b'before')
    for _ in range(2):
        now, aside = folder.read(), folder.read(folder.aside)
        folder.swap_aside()
        assert (folder.read(), folder.read(folder.aside)) == (aside, now)
    folder.path.unlink()
    folder.swap_aside()
    assert (folder.read(), folder.read(folder.aside)) == (b'before', None)
    assert {p.name for p in folder.folder.iterdir()} == {LOCK, STATE}


@pytest.mark.parametrize('mask', [0o000, 0o077])
def test_all_that_is_kept_is_its_owners_by_names_of_earlier_runs(tmp_path, mask):
    before = os.umask(mask)
    try:
        folder = StateFolder(tmp_path / 'deep' / 'state')
        folder.write(b'x')
        folder.set_aside()
        folder.write(b'y')
        folder.write_curve(CURVE)
        folder.close()
    finally:
        os.umask(before)
    modes = {p.name: stat.S_IMODE(p.stat().st_mode) for p in folder.folder.iterdir()}
    assert set(modes.values()) == {0o600}
    names = {'lock', 'monitor.state', 'monitor.state.unused', f'curve_{CURVE.model_id}.json'}
    assert set(modes) == names
    assert stat.S_IMODE(folder.folder.stat().st_mode) == 0o700


def test_the_last_curves_stay_and_each_is_found_by_its_name(folder):
    curves = [replace(CURVE, notes=(f'number {k}',)).with_id() for k in range(9)]
    for k, curve in enumerate(curves, 1):
        folder.write_curve(curve)
        # Whatever the clock of a disk can tell apart.
        os.utime(folder.folder / f'curve_{curve.model_id}.json', ns=(10**9 * k, 10**9 * k))
        assert repr(folder.curve(curve.model_id)) == repr(curve)
    kept = {p.name for p in folder.folder.iterdir()} - {LOCK}
    assert kept == {f'curve_{c.model_id}.json' for c in curves[-5:]}


@pytest.mark.parametrize('content', ['[' * 100_000, '', '{}', 'null', '\udcff', 'another'])
def test_a_file_that_is_no_curve_or_another_one_is_one_sentence(folder, content):
    folder.write_curve(CURVE)
    path = folder.folder / 'curve_abc.json'
    if content == 'another':
        shutil.copy(folder.folder / f'curve_{CURVE.model_id}.json', path)
    else:
        path.write_text(content, encoding='utf-8', errors='surrogateescape')
    with pytest.raises(DataError, match='Curve abc was not saved'):
        folder.curve('abc')


def test_a_lock_names_its_owner_and_being_refused_keeps_no_descriptor(tmp_path):
    lock = tmp_path / LOCK
    lock.write_text('1234567890123456789\nand a lot more of the one before\n')
    folder = StateFolder(tmp_path)
    assert lock.read_text() == f'{os.getpid()}\n'
    # What earlier tests left to the collector may go at any moment.
    gc.collect()
    before = len(os.listdir('/proc/self/fd'))
    for owner, told in ((f'{os.getpid()}', rf' \(process {os.getpid()}\)'), ('', ''), ('x', '')):
        lock.write_text(owner)
        with pytest.raises(InUseError, match=f'another monitor{told} keeps its state there'):
            StateFolder(tmp_path)
    (tmp_path / 'file').write_text('')
    for place, why in (('file/state', 'not a directory'), ('nul\0', 'embedded null byte')):
        with pytest.raises(RecordingError, match=rf'cannot be used \({why}\)'):
            StateFolder(tmp_path / place)
    assert folder.read() is None
    folder.write(b'x')
    assert folder.read() == b'x'
    assert len(os.listdir('/proc/self/fd')) == before
    # Closing twice lets nobody else's descriptor go.
    folder.close()
    other = os.open(lock, os.O_RDONLY)
    folder.close()
    os.fstat(other)
    os.close(other)


def test_nothing_is_locked_read_or_written_through_a_link(tmp_path):
    victim, state = tmp_path / 'victim', tmp_path / 'state'
    victim.write_text('not ours')
    state.mkdir()
    (state / LOCK).symlink_to(victim)
    with pytest.raises(RecordingError, match=r'cannot be used \(too many levels of symbolic'):
        StateFolder(state)
    (state / LOCK).unlink()
    folder = StateFolder(state)
    (state / f'.curve_{CURVE.model_id}.json.tmp').symlink_to(victim)
    folder.write_curve(CURVE)
    with pytest.raises(DataError, match='was not saved'):
        folder.curve(CURVE.model_id)
    folder.path.symlink_to(victim)
    with pytest.raises(RecordingError, match='cannot be read'):
        folder.read()
    # A new one takes the place of the link, not of what it points to.
    folder.write(b'mine')
    assert (folder.read(), victim.read_text()) == (b'mine', 'not ours')
    folder.close()


def test_a_file_that_is_too_large_is_not_even_read(folder, monkeypatch):
    monkeypatch.setattr(state_store, '_MAX_BYTES', 3)
    folder.write(b'1234')
    with pytest.raises(RecordingError, match='too large to be a saved state'):
        folder.read()


def test_what_is_made_again_in_the_folder_of_another_one_is_nothing(folder):
    place = folder.folder
    folder.write(b'x')
    assert not folder.altered
    shutil.rmtree(place)
    folder.write_curve(CURVE)
    assert repr(folder.curve(CURVE.model_id)) == repr(CURVE)
    shutil.rmtree(place)
    other = StateFolder(place)
    folder.write_curve(CURVE)
    assert not list(place.glob('curve_*'))
    other.close()
    shutil.rmtree(place)
    place.symlink_to('state')
    assert folder.altered
    with pytest.raises(RecordingError):
        folder.keep()


# Loaded once; each line it reads begins a writer of its own and tells its number.
_WRITES = """
import itertools, os, sys
import numpy as np
from pathlib import Path
from valveflow_ros.state import to_bytes
from valveflow_ros.ros.node.state_store import StateFolder
for line in iter(sys.stdin.readline, ''):
    child = os.fork()
    if child:
        os.waitpid(child, 0)
        os.write(1, b'ended\\n')
        continue
    folder = StateFolder(Path(line[:-1]))
    os.write(1, b'%d\\n' % os.getpid())
    for k in itertools.count(1):
        folder.write(to_bytes({'number': k, 'rows': np.full(200_000, k)}))
        os.write(1, b'%d\\n' % k)
"""


def test_killed_at_any_moment_it_is_the_old_or_the_new_state(tmp_path):
    chance = np.random.default_rng(1)
    with subprocess.Popen(
        [sys.executable, '-c', _WRITES], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as nursery:
        assert nursery.stdin is not None
        assert nursery.stdout is not None
        for _ in range(6):
            nursery.stdin.write(f'{tmp_path}\n')
            nursery.stdin.flush()
            writer, first = int(nursery.stdout.readline()), int(nursery.stdout.readline())
            time.sleep(float(chance.uniform(0.0, 0.15)))
            os.kill(writer, signal.SIGKILL)
            told = [first, *map(int, iter(nursery.stdout.readline, 'ended\n'))]
            folder = StateFolder(tmp_path)
            state = from_bytes(folder.read() or b'')
            folder.close()
            assert state['number'] in (told[-1], told[-1] + 1)
            assert (state['rows'] == state['number']).all()
            # What a killed writer left goes at the next start.
            assert not list(tmp_path.glob('.*.tmp'))
        nursery.stdin.close()
