# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The saved state as bytes, and its folder: one owner, whole or not at all."""

import gc
import hashlib
import io
import json
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
from hypothesis import given
from hypothesis import settings as limits
from hypothesis import strategies as st

from valveflow_ros.errors import DataError, RecordingError
from valveflow_ros.parameters import Settings
from valveflow_ros.ros.node import state_store
from valveflow_ros.ros.node.engine import example_curve
from valveflow_ros.ros.node.state_store import LOCK, STATE, InUseError, StateFolder
from valveflow_ros.state import FORMAT, VERSION, from_bytes, put_back, to_bytes

CURVE = example_curve(Settings()).with_id()

# States as bytes

arrays = st.builds(
    lambda kind, shape: (np.arange(np.prod(shape, dtype=int)) % 2).reshape(shape).astype(kind),
    st.sampled_from(['f8', 'i8', 'u1', '?', 'f4']),
    st.lists(st.integers(0, 3), max_size=3).map(tuple),
)
INTEGERS = st.integers(-(2**63), 2**63 - 1)  # nothing in a state counts further
plain = st.one_of(
    st.none(), st.booleans(), INTEGERS, st.floats(allow_nan=False), st.text(), arrays
)
values = st.recursive(
    plain,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
)


def same(one, other):
    """Tell whether two values are equal to the type of each number."""
    if isinstance(one, np.ndarray):
        fits = isinstance(other, np.ndarray) and one.dtype == other.dtype
        return fits and one.shape == other.shape and bool(np.array_equal(one, other))
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[k], other[k]) for k in one)
    if isinstance(one, list):
        return len(one) == len(other) and all(map(same, one, other))
    return type(one) is type(other) and one == other


@given(st.dictionaries(st.text(), values, max_size=5))
@limits(max_examples=30)
def test_every_state_comes_back_and_its_first_line_tells_its_checksum(state):
    data = to_bytes(state)
    found = from_bytes(data)
    assert same(state, found)
    assert to_bytes(found) == data
    line, content = data.split(b'\n', 1)
    # What stands on disks already.
    assert line == b'valveflow-state 2 ' + hashlib.sha256(content).hexdigest().encode()


def signed(content, version=VERSION, name=FORMAT):
    digest = hashlib.sha256(content).hexdigest().encode()
    return name + b' %d ' % version + digest + b'\n' + content


def archived(**more):
    archive = io.BytesIO()
    np.savez(archive, **more)
    return archive.getvalue()


def tree(value):
    return np.frombuffer(json.dumps(value).encode(), dtype=np.uint8)


class Trap:
    """Would be executed by whoever unpickles it."""

    def __reduce__(self):
        return os.mkdir, ('executed',)


TRAP = np.array([Trap()], dtype=object)


@pytest.mark.parametrize(
    ('data', 'sentence'),
    [
        (b'', 'is none, or its beginning is damaged'),
        (signed(b'', name=b'other-state'), 'is none, or its beginning is damaged'),
        (FORMAT + b' 1 abc\n', 'is none, or its beginning is damaged'),
        (FORMAT + b' 2 ' + b'0' * 64 + b'\nwhatever', 'its checksum is another one'),
        (signed(b'', version=3), 'has version 3, this program reads 2'),
        (signed(b'', version=1), r'cannot be read \('),
        (FORMAT + b' ' + b'9' * 50 + b' ' + b'0' * 64 + b'\n', f'version {"9" * 20}, this'),
        (FORMAT + b' \xff ' + b'0' * 64 + b'\n', 'version \ufffd, this'),
        (signed(b'no archive'), r'cannot be read \('),
        (signed(archived(other=tree({}))), r'cannot be read \(KeyError\)'),
        (signed(archived(tree=np.zeros(3, dtype=np.uint8))), r'cannot be read \('),
        # Nothing in a state is executed, however well it is signed.
        (signed(archived(tree=tree({'x': {'$array': 0}}), a0=TRAP)), 'cannot be read'),
        (signed(archived(tree=TRAP)), 'cannot be read'),
        (signed(archived(tree=tree([1]))), 'The saved state is none'),
        (signed(archived(tree=tree(None))), 'The saved state is none'),
        (to_bytes({'$array': 5}), r'cannot be read \(KeyError\)'),
    ],
)
def test_what_is_no_state_is_a_sentence(data, sentence, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DataError, match=sentence):
        from_bytes(data)
    assert list(tmp_path.iterdir()) == []


def test_every_single_cut_and_many_flips_are_noticed():
    data = to_bytes({'a': [1, 2.5, None, 'text'], 'b': np.arange(5), 'c': {'d': np.eye(2)}})
    for end in range(len(data)):
        with pytest.raises(DataError):
            from_bytes(data[:end])
    chance = np.random.default_rng(3)
    for _ in range(200):
        place, bit = int(chance.integers(len(data))), int(chance.integers(8))
        with pytest.raises(DataError):
            from_bytes(data[:place] + bytes([data[place] ^ 1 << bit]) + data[place + 1 :])


def test_numbers_of_numpy_and_tuples_come_back_as_plain_ones():
    state = {'number': np.float64(1.5), 'true': np.bool_(True), 'tuple': (1, 2), 'nan': np.nan,
             'table': {'$array': 0, 'y': 1}}  # fmt: skip
    found = from_bytes(to_bytes(state))
    assert np.isnan(found.pop('nan'))
    assert found == {'number': 1.5, 'true': True, 'tuple': [1, 2], 'table': state['table']}


@pytest.mark.parametrize('given', [5, [1.0, 2.0], np.zeros(3), np.zeros(2, dtype=np.int64)])
def test_what_does_not_fit_an_array_changes_nothing(given):
    arrays = {'first': np.ones(2), 'second': np.ones(2)}
    with pytest.raises(DataError, match="'second'"):
        put_back(arrays, {'first': np.zeros(2), 'second': given})
    np.testing.assert_array_equal(arrays['first'], [1.0, 1.0])


# The folder


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


def test_a_folder_that_another_program_removes_is_an_altered_one_and_made_again(folder):
    place = folder.folder
    folder.write(b'x')
    assert not folder.altered
    shutil.rmtree(place)
    folder.write_curve(CURVE)
    assert repr(folder.curve(CURVE.model_id)) == repr(CURVE)
    shutil.rmtree(place)
    # In that of another one nothing is kept.
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
