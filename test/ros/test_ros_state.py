# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What is kept between runs: one owner, whole or not at all, used only where it fits."""

from __future__ import annotations

import errno
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
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as limits
from hypothesis import strategies as st
from valveflow_msgs.msg import PlantSample

from valveflow_ros.errors import DataError, RecordingError
from valveflow_ros.logs import LoggedMessage
from valveflow_ros.logs.mcap.definitions import Definitions
from valveflow_ros.monitoring.events import CurveAdopted, JournalKind
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S
from valveflow_ros.ros import encoding
from valveflow_ros.ros.decoding import journal_entry
from valveflow_ros.ros.node import restart, state_store
from valveflow_ros.ros.node.diagnostics import Level
from valveflow_ros.ros.node.engine import LiveEngine, example_curve
from valveflow_ros.ros.node.outputs import OUTPUTS, Output, Outputs
from valveflow_ros.ros.node.restart import Restart
from valveflow_ros.ros.node.state_store import (
    ASIDE,
    LOCK,
    STATE,
    InUseError,
    StateFolder,
    StateStore,
    state_folder,
)
from valveflow_ros.signals.align import Aligner
from valveflow_ros.state import (
    FORMAT,
    VERSION,
    from_bytes,
    put_back,
    to_bytes,
)

CURVE = example_curve(Settings()).with_id()
STATE_A = {'numbers': np.arange(3.0), 'log_ns': 5}


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[StateFolder]:
    made = StateFolder(tmp_path / 'state')
    yield made
    made.close()


def settings(folder: Path, **more: object) -> Settings:
    return Settings({'record_directory': str(folder), **more})


def written(folder: Path, state: dict[str, Any] = STATE_A, **more: object) -> None:
    given = settings(folder, **more)
    store = StateStore(given)
    store.write({'settings': dict(given), **state}, lambda: True)
    store.close()


# States as bytes

arrays = st.builds(
    lambda kind, shape: (np.arange(np.prod(shape, dtype=int)) % 2).reshape(shape).astype(kind),
    st.sampled_from(['f8', 'i8', 'u1', '?', 'f4']),
    st.lists(st.integers(0, 3), max_size=3).map(tuple),
)
INTEGERS = st.integers(-(2**63), 2**63 - 1)  # nothing in a state counts further
plain = st.one_of(
    st.none(), st.booleans(), INTEGERS, st.floats(allow_nan=False), st.text(),
    arrays,
)  # fmt: skip
values = st.recursive(
    plain,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
)
states = st.dictionaries(st.text(), values, max_size=5)


def same(one: Any, other: Any) -> bool:
    """Tell whether two values are equal to the type of each number."""
    if isinstance(one, np.ndarray):
        fits = isinstance(other, np.ndarray) and one.dtype == other.dtype
        return fits and one.shape == other.shape and bool(np.array_equal(one, other))
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[k], other[k]) for k in one)
    if isinstance(one, list):
        return len(one) == len(other) and all(map(same, one, other))
    return type(one) is type(other) and one == other


@given(states)
@limits(max_examples=60)
def test_every_state_comes_back_as_it_was_and_equal_ones_are_equal_bytes(
    state: dict[str, Any],
) -> None:
    data = to_bytes(state)
    found = from_bytes(data)
    assert same(state, found)
    assert to_bytes(found) == data


def test_whole_is_what_its_first_line_says() -> None:
    """The slow truth: format, version and SHA-256 of all that follows the line."""
    line, content = to_bytes({'a': [1, 2]}).split(b'\n', 1)
    # What stands on disks already.
    assert line.startswith(b'valveflow-state 2 ')
    digest = hashlib.sha256(content).hexdigest().encode()
    assert line == FORMAT + b' ' + str(VERSION).encode() + b' ' + digest


def signed(content: bytes, version: int = VERSION, name: bytes = FORMAT) -> bytes:
    digest = hashlib.sha256(content).hexdigest().encode()
    return name + b' %d ' % version + digest + b'\n' + content


def archived(**more: Any) -> bytes:
    archive = io.BytesIO()
    np.savez(archive, **more)
    return archive.getvalue()


def tree(value: Any) -> Any:
    return np.frombuffer(json.dumps(value).encode(), dtype=np.uint8)


class Trap:
    """Would be executed by whoever unpickles it."""

    def __reduce__(self) -> tuple[Callable[[str], None], tuple[str]]:
        return os.mkdir, ('executed',)


def test_nothing_in_a_state_is_executed_however_well_it_is_signed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    trap = np.array([Trap()], dtype=object)
    for content in (
        archived(tree=tree({'x': {'$array': 0}}), a0=trap),
        archived(tree=trap),
    ):
        with pytest.raises(DataError, match='cannot be read'):
            from_bytes(signed(content))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ('data', 'sentence'),
    [
        (b'', 'is none, or its beginning is damaged'),
        (b'\n', 'is none, or its beginning is damaged'),
        (signed(b'', name=b'other-state'), 'is none, or its beginning is damaged'),
        (FORMAT + b' 1 abc\n', 'is none, or its beginning is damaged'),
        (FORMAT + b' 1 ' + b'0' * 64 + b' more\n', 'is none, or its beginning is damaged'),
        (FORMAT + b' 2 ' + b'0' * 64 + b'\nwhatever', 'its checksum is another one'),
        (signed(b'', version=3), 'has version 3, this program reads 2'),
        (signed(b'', version=1), r'cannot be read \('),
        (signed(b'', version=0), 'has version 0, this program reads 2'),
        (FORMAT + b' ' + b'9' * 50 + b' ' + b'0' * 64 + b'\n', f'version {"9" * 20}, this'),
        (FORMAT + b' \xff ' + b'0' * 64 + b'\n', 'version \ufffd, this'),
        (signed(b''), r'cannot be read \('),
        (signed(b'no archive'), r'cannot be read \('),
        (signed(archived(other=tree({}))), r'cannot be read \(KeyError\)'),
        (signed(archived(tree=np.zeros(3, dtype=np.uint8))), r'cannot be read \('),
        *(
            (signed(archived(tree=tree(v))), 'The saved state is none')
            for v in ([1], 'x', 5, None)
        ),
    ],
)
def test_what_is_no_state_is_a_sentence(data: bytes, sentence: str) -> None:
    with pytest.raises(DataError, match=sentence):
        from_bytes(data)


def test_what_only_looks_like_a_place_of_an_array_is_a_table() -> None:
    for state in ({'x': {'$array': 0, 'y': 1}}, {'x': {'a': {'b': {}}}}):
        assert from_bytes(to_bytes(state)) == state


def test_every_single_cut_and_many_flips_are_noticed() -> None:
    data = to_bytes({'a': [1, 2.5, None, 'text'], 'b': np.arange(5), 'c': {'d': np.eye(2)}})
    assert to_bytes(from_bytes(data)) == data
    for end in range(len(data)):
        with pytest.raises(DataError):
            from_bytes(data[:end])
    chance = np.random.default_rng(3)
    for _ in range(200):
        place, bit = int(chance.integers(len(data))), int(chance.integers(8))
        with pytest.raises(DataError):
            from_bytes(data[:place] + bytes([data[place] ^ 1 << bit]) + data[place + 1 :])


def test_numbers_of_numpy_and_tuples_come_back_as_plain_ones() -> None:
    state = {'number': np.float64(1.5), 'whole': np.int64(7), 'true': np.bool_(True),
             'tuple': (1, 2), 'nan': float('nan'), 'empty': [np.zeros(0)]}  # fmt: skip
    found = from_bytes(to_bytes(state))
    assert (found['number'], found['whole'], found['true']) == (1.5, 7, True)
    assert (found['tuple'], found['empty'][0].shape) == ([1, 2], (0,))
    assert np.isnan(found['nan'])
    with pytest.raises(DataError, match=r'cannot be read \(KeyError\)'):
        from_bytes(to_bytes({'$array': 5}))


@pytest.mark.parametrize('given', [5, [1.0, 2.0], np.zeros(3), np.zeros(2, dtype=np.int64)])
def test_what_does_not_fit_an_array_changes_nothing(given: Any) -> None:
    arrays = {'first': np.ones(2), 'second': np.ones(2)}
    with pytest.raises(DataError, match="'second'"):
        put_back(arrays, {'first': np.zeros(2), 'second': given})
    np.testing.assert_array_equal(arrays['first'], [1.0, 1.0])


# The folder


def test_of_two_states_that_do_not_fit_the_larger_one_is_kept_aside(folder: StateFolder) -> None:
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


def test_taking_back_twice_changes_nothing(folder: StateFolder) -> None:
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


@pytest.mark.parametrize('mask', [0o000, 0o022, 0o077])
def test_all_that_is_kept_is_its_owners(tmp_path: Path, mask: int) -> None:
    before = os.umask(mask)
    try:
        folder = StateFolder(tmp_path / 'deep' / 'state')
        folder.write(b'x')
        folder.set_aside(of_use=True)
        folder.aside.chmod(0o600)
        folder.write_curve(CURVE)
        folder.close()
    finally:
        os.umask(before)
    modes = {p.name: stat.S_IMODE(p.stat().st_mode) for p in folder.folder.iterdir()}
    assert set(modes.values()) == {0o600}
    # By the names that an earlier run wrote.
    names = {'lock', 'monitor.state', 'monitor.state.unused', f'curve_{CURVE.model_id}.json'}
    assert set(modes) == names
    assert stat.S_IMODE(folder.folder.stat().st_mode) == 0o700


def test_the_last_curves_stay_and_each_is_found_by_its_name(folder: StateFolder) -> None:
    curves = []
    for k in range(9):
        curve = replace(CURVE, notes=(f'number {k}',)).with_id()
        curves.append(curve)
        folder.write_curve(curve)
        path = folder.folder / f'curve_{curve.model_id}.json'
        # Whatever the clock of a disk can tell apart.
        os.utime(path, ns=(10**9 * (k + 1), 10**9 * (k + 1)))
        kept = list(folder.folder.glob('curve_*.json'))
        assert {p.name for p in kept} == {f'curve_{c.model_id}.json' for c in curves[-5:]}
        assert repr(folder.curve(curve.model_id)) == repr(curve)
    assert not list(folder.folder.glob('.*.tmp'))


@pytest.mark.parametrize('content', ['[' * 100_000, '', '{}', 'null', '\udcff', '{"format": 1'])
def test_a_file_that_is_no_curve_or_another_one_is_one_sentence(
    folder: StateFolder, content: str
) -> None:
    folder.write_curve(CURVE)
    path = folder.folder / 'curve_abc.json'
    shutil.copy(folder.folder / f'curve_{CURVE.model_id}.json', path)
    with pytest.raises(DataError, match='Curve abc was not saved'):
        folder.curve('abc')
    path.write_text(content, encoding='utf-8', errors='surrogateescape')
    with pytest.raises(DataError, match='Curve abc was not saved'):
        folder.curve('abc')


def test_a_lock_names_its_owner_and_nothing_of_the_one_before(tmp_path: Path) -> None:
    (tmp_path / LOCK).write_text('1234567890123456789\nand a lot more of the one before\n')
    folder = StateFolder(tmp_path)
    assert (tmp_path / LOCK).read_text() == f'{os.getpid()}\n'
    with pytest.raises(InUseError, match=rf'another monitor \(process {os.getpid()}\) keeps'):
        StateFolder(tmp_path)
    for unknown in ('', 'nobody\n'):
        (tmp_path / LOCK).write_text(unknown)
        with pytest.raises(InUseError, match='another monitor keeps its state there'):
            StateFolder(tmp_path)
    folder.close()


def test_being_refused_keeps_no_descriptor(tmp_path: Path) -> None:
    folder = StateFolder(tmp_path)
    # What earlier tests left to the collector may go at any moment.
    gc.collect()
    before = len(os.listdir('/proc/self/fd'))
    for _ in range(3):
        with pytest.raises(InUseError):
            StateFolder(tmp_path)
    (tmp_path / 'file').write_text('')
    with pytest.raises(RecordingError, match=r'cannot be used \(not a directory\)'):
        StateFolder(tmp_path / 'file' / 'state')
    with pytest.raises(RecordingError, match=r'cannot be used \(embedded null byte\)'):
        StateFolder(tmp_path / 'nul\0')
    assert folder.read() is None
    folder.write(b'x')
    assert folder.read() == b'x'
    assert len(os.listdir('/proc/self/fd')) == before
    folder.close()


def test_nothing_is_locked_or_written_through_a_link(tmp_path: Path) -> None:
    victim = tmp_path / 'victim'
    victim.write_text('not ours')
    state = tmp_path / 'state'
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
    assert victim.read_text() == 'not ours'
    folder.close()


def test_a_state_that_is_too_large_or_a_link_is_a_sentence(
    folder: StateFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere = tmp_path / 'elsewhere'
    elsewhere.write_bytes(b'not ours')
    folder.path.symlink_to(elsewhere)
    with pytest.raises(RecordingError, match='cannot be read'):
        folder.read()
    # A new one takes the place of the link, not of what it points to.
    folder.write(b'mine')
    assert (folder.read(), elsewhere.read_bytes()) == (b'mine', b'not ours')
    monkeypatch.setattr(state_store, '_MAX_BYTES', 3)
    with pytest.raises(RecordingError, match='too large to be a saved state'):
        folder.read()


def test_closing_twice_lets_nobody_elses_descriptor_go(tmp_path: Path) -> None:
    folder = StateFolder(tmp_path)
    folder.close()
    other = os.open(tmp_path / 'lock', os.O_RDONLY)
    folder.close()
    os.fstat(other)
    os.close(other)
    again = StateFolder(tmp_path)
    with pytest.raises(InUseError):
        StateFolder(tmp_path)
    again.close()


def test_a_folder_that_another_program_removes_is_an_altered_one_and_made_again(
    folder: StateFolder,
) -> None:
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


def test_killed_at_any_moment_it_is_the_old_or_the_new_state(tmp_path: Path) -> None:
    chance = np.random.default_rng(1)
    with subprocess.Popen(
        [sys.executable, '-c', _WRITES], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as nursery:
        assert nursery.stdin is not None
        assert nursery.stdout is not None
        for _ in range(8):
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
            assert not list(tmp_path.glob('.*.tmp'))
        nursery.stdin.close()


# The store


def test_what_is_written_is_found_again_with_the_rights_of_its_owner(tmp_path: Path) -> None:
    written(tmp_path)
    found = StateStore(settings(tmp_path))
    assert found.saved is not None
    assert found.saved['log_ns'] == 5
    np.testing.assert_array_equal(found.saved['numbers'], STATE_A['numbers'])
    folder = state_folder(settings(tmp_path))
    assert folder is not None
    assert folder.stat().st_mode & 0o777 == 0o700
    assert {p.stat().st_mode & 0o777 for p in folder.iterdir()} == {0o600}
    found.close()


def test_only_one_at_a_time_and_the_next_as_soon_as_it_is_gone(tmp_path: Path) -> None:
    first = StateStore(settings(tmp_path))
    with pytest.raises(RecordingError, match=rf'another monitor \(process {os.getpid()}\)'):
        StateStore(settings(tmp_path))
    StateStore(settings(tmp_path, unit_tag='another')).close()
    StateStore(settings(tmp_path, state_directory=str(tmp_path / 'own'))).close()
    for none in ({'keep_state': False}, {'record': False}):
        store = StateStore(settings(tmp_path, **none))
        assert not store.on
        store.close()
    first.close()
    StateStore(settings(tmp_path)).close()


@pytest.mark.parametrize(
    ('more', 'words'),
    [
        ({'generated_power_unit': 'kW'}, 'It was made with another generated_power_unit.'),
        (
            {'main_steam_pressure_unit': 'bar', 'model_file': 'x', 'block': 20.0},
            'It was made with another main_steam_pressure_unit and model_file.',
        ),
        ({'sample_period': 2.0}, ''),
        ({'block': 20.0, 'window_days': 5.0}, ''),
        ({'alarm_limit': 3.0, 'refit_period': 60.0}, ''),
        ({'record_keep': 5, 'refit_timeout': 50.0}, ''),
    ],
)
def test_a_state_of_other_parameters_is_used_unless_it_is_of_another_unit(
    tmp_path: Path, more: dict[str, object], words: str
) -> None:
    written(tmp_path)
    store = StateStore(settings(tmp_path, **more))
    assert (store.saved is None) == bool(words)
    assert words in store.sentence
    # It waits for a run that it fits.
    assert not store.lost
    store.close()


def test_a_mistyped_unit_costs_no_state(tmp_path: Path) -> None:
    written(tmp_path)
    for _ in range(2):
        store = StateStore(settings(tmp_path, valve_opening_unit='fraction'))
        assert store.saved is None
        assert 'a run that it fits takes it up again' in store.sentence
        store.close()
        # A young state takes its place at once.
        written(tmp_path, {'numbers': np.arange(1.0)}, valve_opening_unit='fraction')
        mended = StateStore(settings(tmp_path))
        assert mended.sentence == ''
        assert mended.saved is not None
        np.testing.assert_array_equal(mended.saved['numbers'], STATE_A['numbers'])
        mended.close()
        # The other one is not lost either.
        again = StateStore(settings(tmp_path, valve_opening_unit='fraction'))
        assert again.saved is not None
        assert len(again.saved['numbers']) == 1
        again.close()
        written(tmp_path)
        (tmp_path / 'state_unit' / ASIDE).unlink()


def test_a_mistyped_period_costs_no_window(tmp_path: Path) -> None:
    written(tmp_path)
    other = StateStore(settings(tmp_path, sample_period=2.0))
    # Its curve and reference are of use; its rows are kept for whoever corrects the mistake.
    assert (other.saved is None, other.sentence) == (False, '')
    other.close()
    written(tmp_path, {'numbers': np.arange(1.0)}, sample_period=2.0)
    mended = StateStore(settings(tmp_path))
    assert mended.saved is not None
    np.testing.assert_array_equal(mended.saved['numbers'], STATE_A['numbers'])
    mended.close()


def test_a_state_of_a_version_with_other_parameters_is_used(tmp_path: Path) -> None:
    store = StateStore(settings(tmp_path))
    then = {
        **settings(tmp_path), 'no_longer_there': 3.0, 'alarm_floor': 1e9, 'refit_period': 'daily',
        'alarm_off_delay': 300.0,
    }  # fmt: skip
    del then['reference_after']
    store.write({'settings': then, **STATE_A}, lambda: True)
    store.close()
    found = StateStore(settings(tmp_path))
    assert found.saved is not None
    # What it knew holds; the rest is as by default.
    assert found.saved['settings'] == settings(tmp_path, alarm_off_delay=300.0)
    found.close()


@pytest.mark.parametrize('given', ['/proc/nothing', '~nobody_of_that_name/x'])
def test_where_nothing_can_be_saved_the_monitor_goes_on_and_says_so(given: str) -> None:
    store = StateStore(Settings({'state_directory': given}))
    assert not store.on
    assert store.problem.startswith('The state cannot be saved. ')
    assert not store.due
    store.close()


@pytest.mark.parametrize('how', ['cut', 'flipped', 'empty', 'junk', 'newer', 'folder', 'pipe'])
def test_a_state_that_is_not_whole_is_a_sentence_and_never_an_exception(
    tmp_path: Path, how: str
) -> None:
    written(tmp_path)
    path = tmp_path / 'state_unit' / STATE
    data = path.read_bytes()
    path.unlink()
    if how == 'folder':
        path.mkdir()
    elif how == 'pipe':
        os.mkfifo(path)
    else:
        half = len(data) // 2
        path.write_bytes(
            {
                'cut': data[:-1],
                'flipped': data[:half] + bytes([data[half] ^ 1]) + data[half + 1 :],
                'empty': b'',
                'junk': b'x' * 1000,
                'newer': data.replace(b'state 2 ', b'state 3 ', 1),
            }[how]
        )
    store = StateStore(settings(tmp_path))
    assert store.saved is None
    assert store.sentence.startswith('The state saved by an earlier run is not used. ')
    assert 'alarms and reference of before are gone' in store.sentence
    assert store.sentence.endswith('.')
    assert store.lost
    assert (store.item().level, store.item().sentence) == (Level.WARN, store.sentence)
    store.close()
    # Until the next start.
    again = StateStore(settings(tmp_path))
    assert (again.item().level, 'is saved regularly.' in again.item().sentence) == (Level.OK, True)
    again.close()


def test_where_nothing_is_kept_nothing_is_asked_of_a_disk() -> None:
    store = StateStore(Settings({'record': False}))
    assert (store.on, store.problem, store.saved_s, store.due) == (False, '', None, False)
    assert 'Nothing is kept' in store.item().sentence
    store.write({}, lambda: True)
    with pytest.raises(DataError, match='Curve abc was not saved'):
        store.curve('abc')
    store.close()


def test_an_adopted_curve_is_saved_at_once_and_the_newest_state_last(tmp_path: Path) -> None:
    given = settings(tmp_path)
    store = StateStore(given)
    store.note([CurveAdopted(CURVE)])
    assert repr(store.curve(CURVE.model_id)) == repr(CURVE)
    with pytest.raises(DataError, match='was not saved'):
        store.curve('another')
    for k in range(5):
        store.write({'settings': dict(given), 'numbers': np.full(99_000, float(k))}, lambda: True)
    store.close()
    found = StateStore(given)
    assert found.saved is not None
    assert (found.saved['numbers'] == 4.0).all()
    assert not list((tmp_path / 'state_unit').glob('.*'))
    found.close()


def test_a_state_is_put_in_place_when_the_recording_is_ready_or_after_its_patience(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(state_store, '_PATIENCE_S', 60.0)
    store = StateStore(settings(tmp_path))
    path = tmp_path / 'state_unit' / STATE

    def there() -> bytes:
        return path.read_bytes() if path.exists() else b''

    for answers in ([True], [False] * 3 + [True]):
        left = list(answers)
        asked: list[bytes] = []

        def ready(left: list[bool] = left, asked: list[bytes] = asked) -> bool:
            asked.append(there())
            return left.pop(0)

        before = there()
        store.write({'answers': answers}, ready)
        store.finish()
        # Until it is ready, what was there before is there.
        assert asked == [before] * len(answers)
        assert from_bytes(there()) == {'answers': answers}
    monkeypatch.setattr(state_store, '_PATIENCE_S', 0.3)
    begun = time.monotonic()
    store.write({'never': 'ready'}, lambda: False)
    assert store.busy
    assert not store.due
    store.finish()
    assert 0.3 <= time.monotonic() - begun < 20.0
    assert not store.busy
    assert from_bytes(there()) == {'never': 'ready'}
    assert store.saved_s is not None
    assert begun + 0.3 <= store.saved_s <= time.monotonic()
    store.close()


def test_what_cannot_be_written_is_a_problem_until_it_can(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write, broken = StateFolder.write, [True]

    def failing(self: StateFolder, data: bytes) -> None:
        if broken:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write(self, data)

    monkeypatch.setattr(StateFolder, 'write', failing)
    store = StateStore(settings(tmp_path))
    path = tmp_path / 'state_unit' / STATE
    for state, said in (
        ({}, f'{path}: the state cannot be saved (no space left on device).'),
        ({'cannot be saved': object()}, 'The state cannot be saved (TypeError: '),
    ):
        store.write(state, lambda: True)
        store.finish()
        assert store.problem.startswith(said)
        assert (store.saved_s, store.item().level) == (None, Level.ERROR)
    broken.clear()
    store.write({'fine': 1}, lambda: True)
    store.finish()
    assert store.problem == ''
    assert store.saved_s is not None
    assert from_bytes(path.read_bytes()) == {'fine': 1}
    store.close()


# Continuing an earlier run

NAMES = {'characteristic': '/m/characteristic', 'breakpoints': '/m/breakpoints'}
LOG_NS = 1_700_000_000_000_000_000
# As `Session` records them: before the first row there is no time of the plant, and the message
# bears the time of the log.
BEFORE, AFTER = Output('characteristic', b'curve', 0), Output('breakpoints', b'knots', 5_000)


WORKER: Any = SimpleNamespace(poll=list)


def restarted(
    saved: dict[str, Any], given: Settings, inputs: dict[str, str], make: Any = None
) -> tuple[Restart, LiveEngine, list[tuple[Level, str]]]:
    """Return a restart from a saved state, its engine, and what was logged."""
    whole = {'settings': Settings(), 'log_ns': 1, 'recording': 'folder', 'began': {}, **saved}
    store: Any = SimpleNamespace(saved=whole, problem='', sentence='', curve=None)
    logged: list[tuple[Level, str]] = []
    names = {name: topic for name, topic in whole.get('topics', {}).items() if name not in inputs}
    made = Restart(given, store, inputs, names, lambda *line: logged.append(line))
    engine = made.engine(make or (lambda settings: LiveEngine(settings, WORKER)))
    assert made.continues
    return made, engine, logged


@pytest.fixture
def recorded(monkeypatch: pytest.MonkeyPatch) -> list[LoggedMessage]:
    """What was recorded after the state was saved."""
    tail: list[LoggedMessage] = []
    monkeypatch.setattr(restart, 'recover_leftovers', lambda _: [])
    monkeypatch.setattr(restart, 'messages_since', lambda *_: tail)
    return tail


@pytest.mark.parametrize(
    ('said', 'again'),
    [
        ([], [BEFORE, AFTER]),
        ([BEFORE], [AFTER]),
        ([AFTER], [BEFORE]),
        ([AFTER, BEFORE], []),
    ],
)
def test_each_output_stands_in_the_recording_once(
    said: list[Output], again: list[Output], recorded: list[LoggedMessage]
) -> None:
    given = Settings()
    recorded += [
        LoggedMessage(NAMES[o.name], 'some/msg/Type', LOG_NS, o.time_ns or LOG_NS, o.data)
        for o in said
    ]
    engine: Any = SimpleNamespace(
        monitor=Monitor(given), aligner=Aligner(given), restore=lambda _: None
    )
    of_tail = iter([[BEFORE, AFTER]])
    outputs: Any = SimpleNamespace(of=lambda _: next(of_tail, []))
    saved = {'engine': None, 'topics': {**NAMES, 'journal': '/m/journal'}}
    ours, found, logged = restarted(saved, given, {}, lambda _: engine)
    assert found is engine
    assert (ours.folder, ours.log_ns) == (Path('folder'), LOG_NS if said else 1)
    assert list(ours.begin(given, engine, outputs)) == again
    assert logged == [(Level.OK, 'Going on after 0 rows of an earlier run.')]


@pytest.mark.usefixtures('recorded')
def test_a_run_with_other_parameters_goes_on_in_a_new_recording_and_says_what_it_kept() -> None:
    first = LiveEngine(Settings(), WORKER)
    first.monitor.set_reference(CURVE)
    saved = {'topics': {name: f'/m/{name}' for name in OUTPUTS}, 'engine': first.snapshot()}
    told = (
        Level.OK,
        'Since the state was saved steady_min changed. Segments were found again in 0 rows. '
        'The reference and the alarms stay.',
    )
    for more, folder in (({'steady_min': 180.0}, None), ({}, Path('folder'))):
        wanted = Settings({'alarm_floor': 2.0, **more})
        ours, engine, logged = restarted(saved, wanted, {})
        assert ours.folder == folder
        messages = list(ours.begin(wanted, engine, Outputs('unit')))
        assert engine.monitor.settings == wanted
        assert engine.monitor.reference.curve == CURVE
        kinds = [journal_entry(m.data).kind for m in messages if m.name == 'journal']
        assert kinds == [JournalKind.RESUMED, JournalKind.SETTINGS]
        assert (told in logged) == (folder is None)


@pytest.mark.parametrize('earlier', [False, True])
def test_the_tail_of_an_earlier_run_is_read_by_the_codes_it_was_recorded_with(
    monkeypatch: pytest.MonkeyPatch, earlier: bool
) -> None:
    text = Definitions().text('valveflow_msgs/msg/PlantSample')
    if earlier:  # before there was a code for unknown
        text = text.replace('QUALITY_GOOD=1', 'QUALITY_GOOD=0')
    start_ns, tail = 1_700_000_000 * NS_PER_S, []
    for k in range(60):
        sample = PlantSample(
            valve_opening=77.0, main_steam_pressure=13.0, main_steam_temperature=538.0,
            generated_power=240.0,
        )  # fmt: skip
        sample.header.stamp = encoding.to_time(start_ns + k * NS_PER_S)
        for name in ('valve_opening', 'main_steam_pressure', 'main_steam_temperature',
                     'generated_power'):  # fmt: skip
            setattr(sample, f'{name}_quality', 0 if earlier else PlantSample.QUALITY_GOOD)
        log_ns = start_ns + k * NS_PER_S + 1
        data = encoding.encode(sample)
        tail.append(
            LoggedMessage('/plant', 'valveflow_msgs/msg/PlantSample', log_ns, log_ns, data)
        )

    def messages(_folder: Path, _after: int, definitions: dict[str, str]) -> list[LoggedMessage]:
        definitions['/plant'] = text
        return tail

    monkeypatch.setattr(restart, 'recover_leftovers', lambda _: [])
    monkeypatch.setattr(restart, 'messages_since', messages)
    topics = {**{name: f'/m/{name}' for name in OUTPUTS}, 'plant_sample': '/plant'}
    saved = {'topics': topics, 'engine': LiveEngine(Settings(), WORKER).snapshot()}
    ours, engine, _ = restarted(saved, Settings(), {'plant_sample': '/plant'})
    list(ours.begin(Settings(), engine, Outputs('unit')))
    counts = engine.aligner.counts()
    assert counts['generated_power']['accepted'] == 60
    assert counts['generated_power']['bad_quality'] == 0
    # Its folder would hold two meanings of a code.
    assert ours.folder == (None if earlier else Path('folder'))


@pytest.mark.parametrize('how', ['absent', 'other'])
def test_a_state_of_another_version_is_used_where_it_fits_and_the_rest_is_told(how: str) -> None:
    first = LiveEngine(Settings(), WORKER)
    first.monitor.set_reference(CURVE)
    engine = first.snapshot()
    engine['monitor']['diagnosing'] = {'another': 'version'}
    if how == 'absent':
        del engine['monitor']['diagnosing']
    _, found, logged = restarted({'recording': None, 'engine': engine}, Settings(), {})
    assert found.monitor.reference.curve == CURVE
    assert logged == [(
        Level.WARN, 'The saved state is of another version. Discarded: the last diagnosis. The '
        'reference and the alarms stay.',
    )]  # fmt: skip


@pytest.mark.parametrize('what', ['state', 'lock', 'everything', 'folder', 'folder moved'])
def test_what_another_program_removes_is_made_again_and_stays_taken(
    what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(state_store, '_WATCH_S', 0.0)
    given = settings(tmp_path)
    store = StateStore(given)
    state = {'settings': dict(given), 'number': 1}
    store.write(state, lambda: True)
    store.finish()
    folder = tmp_path / 'state_unit'
    acts: dict[str, Callable[[], object]] = {
        'state': (folder / STATE).unlink,
        'lock': (folder / LOCK).unlink,
        'everything': lambda: [path.unlink() for path in folder.iterdir()],
        'folder': lambda: shutil.rmtree(folder),
        'folder moved': lambda: folder.rename(tmp_path / 'moved'),
    }
    acts[what]()
    store.watch()
    store.finish()
    assert store.altered == bool(what != 'lock')
    if store.altered:
        assert 'was removed or changed by another program' in store.problem
        assert store.item().level == Level.ERROR
    with pytest.raises(RecordingError, match=rf'another monitor \(process {os.getpid()}\)'):
        StateStore(given)
    store.write(state, lambda: True)
    store.close()
    assert store.problem == ''
    found = StateStore(given)
    assert found.saved is not None
    assert found.saved['number'] == 1
    found.close()


def test_who_lost_its_lock_to_another_monitor_says_so_and_writes_nothing(tmp_path: Path) -> None:
    given = settings(tmp_path)
    first = StateStore(given)
    (tmp_path / 'state_unit' / LOCK).unlink()
    second = StateStore(given)
    second.write({'settings': dict(given), 'whose': 'second'}, lambda: True)
    second.finish()
    first.write({'settings': dict(given), 'whose': 'first'}, lambda: True)
    first.close()
    assert 'another monitor' in first.problem
    second.close()
    found = StateStore(given)
    assert found.saved is not None
    assert found.saved['whose'] == 'second'
    found.close()


def test_a_disk_that_does_not_answer_is_told_and_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers = threading.Event()
    write = StateFolder.write

    def hanging(self: StateFolder, data: bytes) -> None:
        answers.wait(60.0)
        write(self, data)

    monkeypatch.setattr(StateFolder, 'write', hanging)
    monkeypatch.setattr(state_store, '_LONGEST_S', 0.05)
    monkeypatch.setattr(state_store, '_STUCK_S', 0.0)
    store = StateStore(settings(tmp_path))
    store.write({'first': 1}, lambda: True)
    assert store.item().level == Level.ERROR
    assert 'does not answer' in store.item().sentence
    store.write({'second': 2}, lambda: True)
    assert sum(t.name == 'state writer' for t in threading.enumerate()) == 1
    assert not store.altered
    store.close()
    assert 'does not answer' in store.problem
    answers.set()
