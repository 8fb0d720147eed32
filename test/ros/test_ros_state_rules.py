"""What holds of every state, folder and curve that is kept, whatever happens in between."""

from __future__ import annotations

import errno
import gc
import hashlib
import io
import json
import os
import stat
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from valveflow_ros.errors import DataError, RecordingError
from valveflow_ros.parameters import Settings
from valveflow_ros.ros.node import state_store
from valveflow_ros.ros.node.state_store import LOCK, STATE, InUseError, StateFolder, StateWriter
from valveflow_ros.ros.node.warmup import made_up_curve
from valveflow_ros.state import (
    FORMAT,
    VERSION,
    from_bytes,
    to_bytes,
)

CURVE = made_up_curve(Settings()).with_id()


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[StateFolder]:
    made = StateFolder(tmp_path / 'state')
    yield made
    made.close()


# --- bytes ----------------------------------------------------------------------------------

arrays = st.builds(
    lambda kind, shape: (np.arange(np.prod(shape, dtype=int)) % 2).reshape(shape).astype(kind),
    st.sampled_from(['f8', 'i8', 'u1', '?', 'f4']),
    st.lists(st.integers(0, 3), max_size=3).map(tuple),
)
plain = st.one_of(
    st.none(), st.booleans(), st.integers(-(2**70), 2**70), st.floats(allow_nan=False), st.text(),
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
@settings(max_examples=60)
def test_every_state_comes_back_as_it_was_and_equal_ones_are_equal_bytes(
    state: dict[str, Any],
) -> None:
    data = to_bytes(state)
    found = from_bytes(data)
    assert same(state, found)
    assert to_bytes(found) == data


@given(st.dictionaries(st.text(), st.integers() | st.lists(st.integers()), max_size=3))
@settings(max_examples=20)
def test_whole_is_what_its_first_line_says(state: dict[str, Any]) -> None:
    """The slow truth: format, version and SHA-256 of all that follows the line."""
    line, content = to_bytes(state).split(b'\n', 1)
    # What stands on disks already.
    assert line.startswith(b'valveflow-state 1 ')
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
        (FORMAT + b' 1 ' + b'0' * 64 + b'\nwhatever', 'its checksum is another one'),
        (signed(b'', version=2), 'has version 2, this program reads 1'),
        (signed(b'', version=0), 'has version 0, this program reads 1'),
        (FORMAT + b' ' + b'9' * 50 + b' ' + b'0' * 64 + b'\n', f'version {"9" * 20}, this'),
        (FORMAT + b' \xff ' + b'0' * 64 + b'\n', 'version \ufffd, this'),
        (signed(b''), r'cannot be read \('),
        (signed(b'no archive'), r'cannot be read \('),
        (signed(archived(other=tree({}))), r'cannot be read \(KeyError\)'),
        (signed(archived(tree=np.zeros(3, dtype=np.uint8))), r'cannot be read \('),
        (signed(archived(tree=tree([1]))), 'The saved state is none'),
    ],
)
def test_what_is_no_state_is_a_sentence(data: bytes, sentence: str) -> None:
    with pytest.raises(DataError, match=sentence):
        from_bytes(data)


def test_what_only_looks_like_a_place_of_an_array_is_a_table() -> None:
    for state in ({'x': {'$array': 0, 'y': 1}}, {'x': {'a': {'b': {}}}}):
        assert from_bytes(to_bytes(state)) == state


# --- folder ---------------------------------------------------------------------------------


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


def test_the_names_on_the_disk_are_those_that_an_earlier_run_wrote(folder: StateFolder) -> None:
    folder.write(b'x')
    folder.set_aside()
    folder.write(b'y')
    folder.keep_curve(CURVE)
    names = {'lock', 'monitor.state', 'monitor.state.unused', f'curve_{CURVE.model_id}.json'}
    assert {p.name for p in folder.folder.iterdir()} == names


def test_taking_back_twice_changes_nothing(folder: StateFolder) -> None:
    folder.write(b'mended')
    folder.aside.write_bytes(b'before')
    for _ in range(2):
        now, aside = folder.read(), folder.read(folder.aside)
        folder.take_back()
        assert (folder.read(), folder.read(folder.aside)) == (aside, now)
    folder.path.unlink()
    folder.take_back()
    assert (folder.read(), folder.read(folder.aside)) == (b'before', None)
    assert {p.name for p in folder.folder.iterdir()} == {LOCK, STATE}


@pytest.mark.parametrize('mask', [0o000, 0o022, 0o077])
def test_all_that_is_kept_is_its_owners(tmp_path: Path, mask: int) -> None:
    before = os.umask(mask)
    try:
        folder = StateFolder(tmp_path / 'deep' / 'state')
        folder.write(b'x')
        folder.keep_curve(CURVE)
        folder.close()
    finally:
        os.umask(before)
    modes = {p.name: stat.S_IMODE(p.stat().st_mode) for p in folder.folder.iterdir()}
    assert set(modes.values()) == {0o600}
    assert set(modes) == {LOCK, STATE, f'curve_{CURVE.model_id}.json'}
    assert stat.S_IMODE(folder.folder.stat().st_mode) == 0o700


def test_the_last_curves_stay_and_each_is_found_by_its_name(folder: StateFolder) -> None:
    curves = []
    for k in range(9):
        curve = replace(CURVE, notes=(f'number {k}',)).with_id()
        curves.append(curve)
        folder.keep_curve(curve)
        path = folder.folder / f'curve_{curve.model_id}.json'
        # Whatever the clock of a disk can tell apart.
        os.utime(path, ns=(10**9 * (k + 1), 10**9 * (k + 1)))
        kept = list(folder.folder.glob('curve_*.json'))
        assert {p.name for p in kept} == {f'curve_{c.model_id}.json' for c in curves[-5:]}
        assert folder.curve(curve.model_id).model_id == curve.model_id
    assert not list(folder.folder.glob('.*.tmp'))


@pytest.mark.parametrize('content', ['[' * 100_000, '', '{}', 'null', '\udcff', '{"format": 1'])
def test_a_file_that_is_no_curve_is_one_sentence(folder: StateFolder, content: str) -> None:
    path = folder.folder / 'curve_abc.json'
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


def test_closing_again_and_again_closes_one_descriptor(tmp_path: Path) -> None:
    # What earlier tests left to the collector may go at any moment.
    gc.collect()
    before = os.listdir('/proc/self/fd')
    folder = StateFolder(tmp_path)
    for _ in range(3):
        folder.close()
        assert os.listdir('/proc/self/fd') == before


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
    folder.keep_curve(CURVE)
    with pytest.raises(DataError, match='was not saved'):
        folder.curve(CURVE.model_id)
    assert victim.read_text() == 'not ours'
    folder.close()


def test_a_pipe_in_the_place_of_a_state_makes_nobody_wait(folder: StateFolder) -> None:
    os.mkfifo(folder.path)
    found: list[object] = []

    def read() -> None:
        try:
            found.append(folder.read())
        except RecordingError as error:
            found.append(error)

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    reader.join(10.0)
    assert not reader.is_alive()
    assert len(found) == 1


# --- writer ---------------------------------------------------------------------------------


def test_a_state_is_put_in_place_when_the_recording_is_ready_or_after_its_patience(
    folder: StateFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(state_store, '_PATIENCE_S', 60.0)
    writer = StateWriter(folder)
    for answers in ([True], [False] * 3 + [True]):
        left = list(answers)
        asked: list[bytes | None] = []

        def ready(left: list[bool] = left, asked: list[bytes | None] = asked) -> bool:
            asked.append(folder.read())
            return left.pop(0)

        before = folder.read()
        writer.write({'answers': answers}, ready)
        writer.finish()
        # Until it is ready, what was there before is there.
        assert asked == [before] * len(answers)
        assert from_bytes(folder.read() or b'') == {'answers': answers}
    monkeypatch.setattr(state_store, '_PATIENCE_S', 0.3)
    begun = time.monotonic()
    writer.write({'never': 'ready'}, lambda: False)
    assert writer.busy
    writer.finish()
    waited = time.monotonic() - begun
    assert 0.3 <= waited < 20.0
    assert not writer.busy
    assert from_bytes(folder.read() or b'') == {'never': 'ready'}
    assert writer.saved_s is not None
    assert begun + 0.3 <= writer.saved_s <= time.monotonic()


def test_what_cannot_be_written_is_said_in_the_systems_words_until_it_can(
    folder: StateFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = StateWriter(folder)
    write, ill = StateFolder.write, [True]

    def failing(self: StateFolder, data: bytes) -> None:
        if ill:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write(self, data)

    monkeypatch.setattr(StateFolder, 'write', failing)
    writer.write({}, lambda: True)
    writer.finish()
    said = f'{folder.path}: the state cannot be saved (no space left on device).'
    assert (writer.problem, writer.saved_s) == (said, None)
    ill.clear()
    writer.write({}, lambda: True)
    writer.finish()
    assert writer.problem == ''
    assert writer.saved_s is not None


def test_an_end_waits_for_the_one_being_written_but_not_for_ever(
    folder: StateFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(state_store, '_LONGEST_S', 0.05)
    monkeypatch.setattr(state_store, '_PATIENCE_S', 60.0)
    go = threading.Event()
    writer = StateWriter(folder)
    writer.write({'late': 1}, go.is_set)
    (thread,) = (t for t in threading.enumerate() if t.name == 'state writer')
    assert thread.daemon
    writer.finish()
    assert writer.busy
    assert folder.read() is None
    go.set()
    monkeypatch.setattr(state_store, '_LONGEST_S', 20.0)
    writer.finish()
    assert not writer.busy
    assert from_bytes(folder.read() or b'') == {'late': 1}
