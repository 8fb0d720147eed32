# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The saved state of the monitor, in a folder that only one process uses."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.characteristic_json import from_json, to_json
from valveflow_ros.errors import DataError, RecordingError, ValveflowError, listed
from valveflow_ros.logs.part_file import FILE_MODE, make_folder, mark_of, write_whole
from valveflow_ros.monitoring.alarms import AlarmChange
from valveflow_ros.monitoring.events import (
    CurveAdopted,
    Diagnosed,
    Event,
    JournalEntry,
    JournalKind,
    ReferenceSet,
)
from valveflow_ros.parameters import Depends, Settings, parameter
from valveflow_ros.ros.node.diagnostics import Item, Level
from valveflow_ros.ros.node.recording import expand_home, parent_of, tag_of
from valveflow_ros.state import State, from_bytes, perhaps, to_bytes

STATE = 'monitor.state'
ASIDE = 'monitor.state.unused'
LOCK = 'lock'
_CURVE, _CURVES = 'curve_', 5
_MAX_BYTES = 4 << 30
# Maximum wait until the recording holds everything that is in the state.
_PATIENCE_S = 1.0
_LOOK_S = 0.02
# This wait occurs twice at the end, and a service manager kills the process after 10 s.
_LONGEST_S = 3.0
# The state with a window of ten days has 40 MB.
_LEAST_S = 1.0
_RETRY_S = 10.0
_WATCH_S = 1.0
# Longer than writing 40 MB to a slow disk takes.
_STUCK_S = 20.0
# Events that must survive the end of the process.
_SAVED_EVENTS = (AlarmChange, CurveAdopted, Diagnosed, ReferenceSet)
_KINDS = {
    'settings': dict, 'engine': dict, 'log_ns': int, 'topics': dict, 'began': dict,
    'recording': str,
}  # fmt: skip
_SAVED_ENTRIES = (JournalKind.SETTINGS, JournalKind.RESET, JournalKind.RESUMED)


class InUseError(RecordingError):
    """Another monitor keeps its state in the same folder."""


class StateFolder:
    """A folder that is locked by one monitor as long as it runs; created if absent.

    Raises `InUseError` if another monitor keeps its state there. Raises `RecordingError` if it
    cannot be created or used.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.path, self.aside = folder / STATE, folder / ASIDE
        self._lock = -1
        self._mark: tuple[int, ...] | None = None
        self._written = False
        self.keep()
        # Incomplete files of a killed process; they do no harm if they cannot be removed.
        with contextlib.suppress(OSError):
            for stale in folder.glob('.*.tmp'):
                stale.unlink()

    def keep(self) -> None:
        """Create folder and lock, also if another program removed them; raises as the class."""
        lock = self.folder / LOCK
        try:
            if self._lock >= 0 and _is_named(lock, self._lock):
                return
            make_folder(self.folder)
            taken = _locked(lock)
        except BlockingIOError:
            owner = ''
            with contextlib.suppress(OSError, ValueError):
                owner = f' (process {int(lock.read_text()[:20])})'
            problem = (
                f'another monitor{owner} keeps its state there; stop it, or give this one a '
                'state_directory or unit_tag of its own'
            )
            raise InUseError(self.folder, problem) from None
        except (OSError, ValueError) as error:
            raise RecordingError(self.folder, f'cannot be used ({_reason(error)})') from None
        self.close()
        self._lock = taken

    @property
    def altered(self) -> bool:
        """Return True if another program removed or changed the state after it was written."""
        mark = mark_of(self.path)
        return self._written and (mark is None or mark != self._mark)

    def read(self, path: Path | None = None) -> bytes | None:
        """Return the content of a file, by default of the state; None if it does not exist.

        Raises `RecordingError` if it exists but cannot be read.
        """
        path = self.path if path is None else path
        try:
            with os.fdopen(_private(path, os.O_RDONLY | os.O_NONBLOCK), 'rb') as file:
                if os.fstat(file.fileno()).st_size > _MAX_BYTES:
                    raise RecordingError(path, 'is too large to be a saved state')
                return file.read()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise RecordingError(path, f'cannot be read ({_reason(error)})') from None

    def set_aside(self, of_use: bool = False) -> bool:
        """Keep the current state under the name `aside`, unless a larger one is already there.

        A state ``of_use`` is copied and stays in use; otherwise it is moved. Returns True if it
        was kept.
        """
        with contextlib.suppress(OSError):
            if not self.aside.exists() or self.aside.lstat().st_size < self.path.lstat().st_size:
                if of_use:
                    between = self.folder / f'.{STATE}.tmp'
                    shutil.copyfile(self.path, between)
                    between.replace(self.aside)
                else:
                    self.path.replace(self.aside)
                return True
        return False

    def swap_aside(self) -> None:
        """Exchange the current state and the one that was set aside."""
        between = self.folder / f'.{STATE}.tmp'
        with contextlib.suppress(OSError):
            if self.path.exists():
                self.path.replace(between)
            self.aside.replace(self.path)
            if between.exists():
                between.replace(self.aside)

    def write(self, data: bytes) -> None:
        """Replace the state atomically; raises `OSError`, and `RecordingError` as `keep`."""
        self.keep()
        write_whole(self.path, data)
        self._mark, self._written = mark_of(self.path), True

    def write_curve(self, curve: Characteristic) -> None:
        """Write a curve to the folder of the state; the oldest curves are removed.

        It must only survive the end of the process, so it is not flushed to disk. If it cannot be
        written, the next state contains it.
        """
        with contextlib.suppress(OSError, RecordingError):
            # Raises if another monitor uses the folder, so that its curves are kept.
            self.keep()
            place = self.folder / f'{_CURVE}{curve.model_id}.json'
            draft = self.folder / f'.{place.name}.tmp'
            with open(draft, 'w', encoding='utf-8', opener=_private) as file:
                json.dump(to_json(curve), file)
            draft.replace(place)
            kept = sorted(self.folder.glob(f'{_CURVE}*.json'), key=lambda p: p.stat().st_mtime_ns)
            for old in kept[:-_CURVES]:
                old.unlink()

    def curve(self, model_id: str) -> Characteristic:
        """Return a curve that was written; raises `DataError` if it is missing or damaged."""
        place = self.folder / f'{_CURVE}{model_id}.json'
        try:
            found = from_json(json.loads(place.read_text(encoding='utf-8')))
        except (OSError, ValueError, RecursionError, DataError):
            raise DataError(f'Curve {model_id} was not saved.') from None
        if found.model_id != model_id:
            raise DataError(f'Curve {model_id} was not saved.')
        return found

    def close(self) -> None:
        """Release the lock."""
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1


def state_folder(settings: Settings) -> Path | None:
    """Return the folder of the state from the parameters; None if no state is kept."""
    given = settings.text('state_directory')
    if not settings.flag('keep_state') or not (given or settings.flag('record')):
        return None
    if given:
        return expand_home(given)
    return parent_of(settings) / f'state_{tag_of(settings)}'


class StateStore:
    """Saves the state in a thread, and finds the state that an earlier run saved.

    Raises `InUseError` if another monitor keeps its state in the same folder.
    """

    def __init__(self, settings: Settings) -> None:
        self.saved: State | None = None  # state of an earlier run, if this run can use it
        self.sentence = ''  # why an existing state is not used; empty otherwise
        self.lost = False  # True if no other run can use it either
        self.problem = ''  # why the state cannot be saved; empty if it can
        self.saved_s: float | None = None  # monotonic time at which the last state was written
        self._period_s = settings.real('state_period')
        self._begun_s = self._watched_s = self._started_s = time.monotonic()
        # Save soon after the start: a restart uses the recording only with a saved state.
        self._urgent = True
        self._thread: threading.Thread | None = None
        self._folder: StateFolder | None = None
        try:
            place = state_folder(settings)
            if place is not None:
                self._folder = StateFolder(place)
        except InUseError:
            raise
        except ValveflowError as error:
            self.problem = f'The state cannot be saved. {error}'
        if self._folder is not None:
            try:
                self._find(self._folder, settings)
            except BaseException:
                self._folder.close()
                raise

    @property
    def on(self) -> bool:
        """Return True if a state is kept."""
        return self._folder is not None

    @property
    def busy(self) -> bool:
        """Return True while a state is being written."""
        return self._thread is not None and self._thread.is_alive()

    @property
    def due(self) -> bool:
        """Return True if a state must be written now."""
        if not self.on or self.busy:
            return False
        period_s = self._period_s
        if self.problem:
            period_s = min(_RETRY_S, period_s)
        elif self._urgent:
            period_s = min(_LEAST_S, period_s)
        return time.monotonic() - self._begun_s >= period_s

    def drop(self, reason: str, whole: bool = False) -> None:
        """Discard the saved state for a reason; a ``whole`` one can be used by another run."""
        self.saved = None
        self.lost = not whole
        stays = self._folder is not None and self._folder.set_aside()
        kept = f'It is kept as {ASIDE}' if stays else f'It is not kept as {ASIDE}'
        then = (
            f'{kept}, and a run with the same settings will use it.' if whole and stays else
            f'{kept}. Its window, active alarms and reference are not used; its curves are in the '
            'same folder as curve_*.json, for reference_file.'
        )  # fmt: skip
        self.sentence = f'The state saved by an earlier run is not used. {reason} {then}'

    def curve(self, model_id: str) -> Characteristic:
        """Return a recently adopted curve; raises `DataError` if it is missing."""
        if self._folder is None:
            raise DataError(f'Curve {model_id} was not saved.')
        return self._folder.curve(model_id)

    def note(self, events: Sequence[Event]) -> None:
        """Save a curve at once, and the state soon if an event must survive the process."""
        for event in events:
            if isinstance(event, CurveAdopted) and self._folder is not None:
                self._folder.write_curve(event.characteristic)
            if isinstance(event, _SAVED_EVENTS) or (
                isinstance(event, JournalEntry) and event.kind in _SAVED_ENTRIES
            ):
                self._urgent = True

    @property
    def altered(self) -> bool:
        """Return True if another program removed or changed the state since it was saved."""
        self.finish()
        # A disk that does not respond is not accessed again.
        return self._folder is not None and not self.busy and self._folder.altered

    def watch(self) -> None:
        """Check once a second, in a thread, that folder, lock and state are unchanged."""
        folder, now_s = self._folder, time.monotonic()
        if folder is not None and not self.busy and now_s - self._watched_s >= _WATCH_S:
            self._watched_s = now_s
            self._start(self._watch, folder)

    def write(self, state: State, ready: Callable[[], bool]) -> None:
        """Write a state in a thread, after the previous one.

        ``ready`` returns True when the recording holds everything that is in the state. The state
        is written then, or after at most `_PATIENCE_S`.
        """
        if self._folder is None:
            return
        self.finish()
        if self.busy:
            # The disk does not respond; `item` reports it.
            return
        self._urgent, self._begun_s = False, time.monotonic()
        self._start(self._write, self._folder, state, ready)

    def finish(self) -> None:
        """Wait for the state being written, for a limited time, since a disk may hang."""
        if self._thread is not None:
            self._thread.join(_LONGEST_S)

    def item(self) -> Item:
        """Return the health item of the saved state."""
        level, sentence = Level.OK, 'The state is saved regularly.'
        if self.busy and time.monotonic() - self._started_s > _STUCK_S:
            level, sentence = Level.ERROR, 'The state cannot be saved. Its disk does not answer.'
        elif self.problem:
            level, sentence = Level.ERROR, self.problem
        elif not self.on:
            nothing = 'Nothing is kept (parameters keep_state, state_directory).'
            return Item('state', Level.OK, nothing)
        elif self.lost:
            # Shown until the next start, which continues this run; otherwise the loss would not
            # be noticed.
            level, sentence = Level.WARN, self.sentence
        age = '' if self.saved_s is None else f'{time.monotonic() - self.saved_s:.0f}'
        return Item('state', level, sentence, {'Seconds since it was saved': age})

    def close(self) -> None:
        """Release the folder after the pending save has finished."""
        if self._folder is not None:
            self.finish()
            if self.busy:
                self.problem = f'{self._folder.path}: the disk does not answer; nothing was saved.'
            self._folder.close()
            self._folder = None

    def _start(self, work: Callable[..., None], *given: object) -> None:
        self._started_s = time.monotonic()
        self._thread = threading.Thread(target=work, args=given, name='state writer', daemon=True)
        self._thread.start()

    def _watch(self, folder: StateFolder) -> None:
        try:
            folder.keep()
            if folder.altered:
                self.problem = f"'{folder.path}' was removed or changed by another program."
                self._urgent = True
        except (ValveflowError, OSError) as error:
            # Saving is retried, and reports the problem as long as it fails.
            self.problem = f'The state cannot be saved. {error}'
            self._urgent = True

    def _write(self, folder: StateFolder, state: State, ready: Callable[[], bool]) -> None:
        try:
            data = to_bytes(state)
            until_s = time.monotonic() + _PATIENCE_S
            while not ready() and time.monotonic() < until_s:
                time.sleep(_LOOK_S)
            folder.write(data)
        except OSError as error:
            self.problem = f'{folder.path}: the state cannot be saved ({_reason(error)}).'
        except ValveflowError as error:
            self.problem = f'The state cannot be saved. {error}'
        except Exception as error:  # noqa: BLE001 - every failure must be reported
            self.problem = f'The state cannot be saved ({type(error).__name__}: {error}).'
        else:
            self.problem = ''
            self.saved_s = time.monotonic()

    def _find(self, folder: StateFolder, settings: Settings) -> None:
        """Find the most useful state: the last one, or one that was set aside."""
        try:
            self.saved = _whole(folder.read())
        except (ValveflowError, KeyError, TypeError) as error:
            self.drop(str(error) if isinstance(error, ValveflowError) else 'It is not whole.')
        if self.saved is None:
            return
        names = _changed(self.saved, settings, Depends.ROWS)
        if not names:
            if _changed(self.saved, settings, Depends.NOTHING):
                # Such a change may lose rows, for example a shorter window.
                folder.set_aside(of_use=True)
            return
        # After the correction of a mistyped parameter, the state from before it is used again.
        with contextlib.suppress(ValveflowError, KeyError, TypeError):
            aside = _whole(folder.read(folder.aside))
            if aside is not None and not _changed(aside, settings, Depends.ROWS):
                self.saved = aside
                folder.swap_aside()
                return
        if others := _changed(self.saved, settings, Depends.ALL):
            then: Settings = self.saved['settings']
            told = [f'{n} ({then[n]!r} instead of {settings[n]!r})' for n in others]
            self.drop(f'It was made with another {listed(told)}.', whole=True)
        else:
            folder.set_aside(of_use=True)


def _whole(data: bytes | None) -> State | None:
    """Return the state in ``data``, None if there is none; raises `DataError`."""
    if data is None:
        return None
    saved = from_bytes(data)
    for name in saved.keys() & _KINDS.keys():
        perhaps(saved, name, _KINDS[name])
    # A state of an earlier version may have other parameters.
    saved['settings'] = Settings.earlier(saved['settings'])
    return saved


def _changed(saved: State, settings: Settings, depends: Depends) -> list[str]:
    """Return the changed parameters on which at least this much of a state depends."""
    then: Settings = saved['settings']
    return [n for n in settings.retuned(then) if parameter(n).depends >= depends]


def _is_named(path: Path, descriptor: int) -> bool:
    """Return True if ``path`` is the name of the open file; raises `OSError`."""
    try:
        return os.path.samestat(path.lstat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _locked(path: Path) -> int:
    """Return a descriptor that holds the lock; the kernel releases it when the process ends."""
    descriptor = _private(path, os.O_RDWR | os.O_CREAT)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.fchmod(descriptor, FILE_MODE)
        os.ftruncate(descriptor, 0)
        os.write(descriptor, f'{os.getpid()}\n'.encode())
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def _private(path: str | Path, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW | os.O_CLOEXEC, FILE_MODE)


def _reason(error: OSError | ValueError) -> str:
    return (getattr(error, 'strerror', None) or str(error)).lower()
