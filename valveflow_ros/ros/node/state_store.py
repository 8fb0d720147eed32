# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The monitor's saved state: one folder, one owner, written whole, found at the next start."""

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
from valveflow_ros.ros.node.recording import DEFAULT_FOLDER, expand_home, tag_of
from valveflow_ros.state import State, from_bytes, perhaps, to_bytes

STATE = 'monitor.state'
ASIDE = 'monitor.state.unused'
LOCK = 'lock'
_CURVE, _CURVES = 'curve_', 5
_MAX_BYTES = 4 << 30
# The file is put in place when the recording has everything that went into it, or after this.
_PATIENCE_S = 1.0
_LOOK_S = 0.02
# At the end this is waited for twice, and a service manager ends what takes longer than 10 s.
_LONGEST_S = 3.0
# A window of ten days takes 40 MB.
_LEAST_S = 1.0
_RETRY_S = 10.0
_WATCH_S = 1.0
# Longer than a state of 40 MB takes on a slow disk.
_STUCK_S = 20.0
# What must survive the end of the process.
_SAVED_EVENTS = (AlarmChange, CurveAdopted, Diagnosed, ReferenceSet)
_KINDS = {
    'settings': dict, 'engine': dict, 'log_ns': int, 'topics': dict, 'began': dict,
    'recording': str,
}  # fmt: skip
_SAVED_ENTRIES = (JournalKind.SETTINGS, JournalKind.RESET, JournalKind.RESUMED)


class InUseError(RecordingError):
    """Another monitor keeps its state in the same folder."""


class StateFolder:
    """A folder that only one monitor works in, as long as it lives.

    Parameters
    ----------
    folder : Path
        Made if absent.

    Raises
    ------
    InUseError
        Another monitor keeps its state there.
    RecordingError
        It cannot be made or used.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.path, self.aside = folder / STATE, folder / ASIDE
        self._lock = -1
        self._mark: tuple[int, ...] | None = None
        self._written = False
        self.keep()
        # What a killed process left half written; if it cannot be removed, it does no harm.
        with contextlib.suppress(OSError):
            for stale in folder.glob('.*.tmp'):
                stale.unlink()

    def keep(self) -> None:
        """Make folder and lock, and make them again if another program removed them.

        Raises
        ------
        InUseError
            Another monitor keeps its state there.
        RecordingError
            They cannot be made or used.
        """
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
        """Return True if another program removed or changed the state since it was written."""
        mark = mark_of(self.path)
        return self._written and (mark is None or mark != self._mark)

    def read(self, path: Path | None = None) -> bytes | None:
        """Return the bytes at ``path`` (by default) or ``aside``; None if nothing is there.

        Raises
        ------
        RecordingError
            It is there and cannot be read.
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
        """Keep a state from being overwritten; of two the larger one stays.

        Parameters
        ----------
        of_use : bool
            Whether it is also to stay where it is, until there is another.

        Returns
        -------
        bool
            Whether this one stays.
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
        """Exchange the last state and the one that was set aside."""
        between = self.folder / f'.{STATE}.tmp'
        with contextlib.suppress(OSError):
            if self.path.exists():
                self.path.replace(between)
            self.aside.replace(self.path)
            if between.exists():
                between.replace(self.aside)

    def write(self, data: bytes) -> None:
        """Replace the state; a reader finds the old or the new one, never half.

        Raises
        ------
        OSError
            It cannot be written.
        RecordingError
            As `keep`.
        """
        self.keep()
        write_whole(self.path, data)
        self._mark, self._written = mark_of(self.path), True

    def write_curve(self, curve: Characteristic) -> None:
        """Write a curve beside the state, which follows a moment later; older curves are removed.

        It must only outlive the process, so nothing waits for the disk. If it cannot be written,
        the state that follows has it.
        """
        with contextlib.suppress(OSError, RecordingError):
            # If another monitor has taken the folder, its curves stay.
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
        """Return a curve that was written; raises `DataError` if it is not there whole."""
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
    """Return the folder that the parameters name; None if no state is to be kept."""
    given = settings.text('state_directory')
    if not settings.flag('keep_state') or not (given or settings.flag('record')):
        return None
    if given:
        return expand_home(given)
    parent = expand_home(settings.text('record_directory') or DEFAULT_FOLDER)
    return parent / f'state_{tag_of(settings)}'


class StateStore:
    """Saves the state from a thread, and finds the one that an earlier run saved.

    Parameters
    ----------
    settings : Settings

    Attributes
    ----------
    saved : State or None
        What an earlier run left, if this one can use it.
    sentence : str
        Why there is none although there was something; empty otherwise.
    lost : bool
        Whether no other run can use it either.
    problem : str
        Why the state cannot be saved; empty if it can.
    saved_s : float or None
        When the last state was put in place, by a clock that never goes back.

    Raises
    ------
    InUseError
        Another monitor keeps its state in the same folder.
    """

    def __init__(self, settings: Settings) -> None:
        self.saved: State | None = None
        self.sentence = ''
        self.lost = False
        self.problem = ''
        self.saved_s: float | None = None
        self._period_s = settings.real('state_period')
        self._begun_s = self._watched_s = self._started_s = time.monotonic()
        # At the start too: with any state, however empty, the recording after it is fed again.
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
        """Return True if a state is to be written now."""
        if not self.on or self.busy:
            return False
        period_s = self._period_s
        if self.problem:
            period_s = min(_RETRY_S, period_s)
        elif self._urgent:
            period_s = min(_LEAST_S, period_s)
        return time.monotonic() - self._begun_s >= period_s

    def drop(self, reason: str, whole: bool = False) -> None:
        """Use nothing of what was saved.

        Parameters
        ----------
        reason : str
        whole : bool
            Whether another run can use it.
        """
        self.saved = None
        self.lost = not whole
        stays = self._folder is not None and self._folder.set_aside()
        kept = 'It stays beside the new one' if stays else f'It is not kept beside {ASIDE}'
        then = (
            f'{kept}, and a run that it fits takes it up again.' if whole and stays else
            f'{kept}. Window, standing alarms and reference of before are '
            'gone; curves of before stand there as curve_*.json, for reference_file.'
        )  # fmt: skip
        self.sentence = f'The state saved by an earlier run is not used. {reason} {then}'

    def curve(self, model_id: str) -> Characteristic:
        """Return a curve that was adopted lately; raises `DataError` if it is not there."""
        if self._folder is None:
            raise DataError(f'Curve {model_id} was not saved.')
        return self._folder.curve(model_id)

    def note(self, events: Sequence[Event]) -> None:
        """Look for what must survive the end of the process; a curve is saved at once."""
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
        # A disk that does not answer is not asked again.
        return self._folder is not None and not self.busy and self._folder.altered

    def watch(self) -> None:
        """See once a second, from a thread, that folder, lock and state are as they were left."""
        folder, now_s = self._folder, time.monotonic()
        if folder is not None and not self.busy and now_s - self._watched_s >= _WATCH_S:
            self._watched_s = now_s
            self._start(self._watch, folder)

    def write(self, state: State, ready: Callable[[], bool]) -> None:
        """Write a state from a thread, after the one before.

        Parameters
        ----------
        state : State
        ready : callable
            Returns True when the recording has everything that went into the state. It is put in
            place then, or after a while.
        """
        if self._folder is None:
            return
        self.finish()
        if self.busy:
            # The disk does not answer; `item` says so.
            return
        self._urgent, self._begun_s = False, time.monotonic()
        self._start(self._write, self._folder, state, ready)

    def finish(self) -> None:
        """Wait for the state being written; not long, as a disk may hang."""
        if self._thread is not None:
            self._thread.join(_LONGEST_S)

    def item(self) -> Item:
        """Return how saving goes, for the health."""
        age = '' if self.saved_s is None else f'{time.monotonic() - self.saved_s:.0f}'
        values: dict[str, object] = {'Seconds since it was saved': age}
        if self.busy and time.monotonic() - self._started_s > _STUCK_S:
            stuck = 'The state cannot be saved. Its disk does not answer.'
            return Item('state', Level.ERROR, stuck, values)
        if self.problem:
            return Item('state', Level.ERROR, self.problem, values)
        if not self.on:
            nothing = 'Nothing is kept (parameters keep_state, state_directory).'
            return Item('state', Level.OK, nothing)
        if self.lost:
            # Nobody would notice otherwise, as what was lost is not shown. Until the next start,
            # which continues this run.
            return Item('state', Level.WARN, self.sentence, values)
        return Item('state', Level.OK, 'The state is saved regularly.', values)

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
            # Saving is tried again, and tells of it as long as it fails.
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
        except Exception as error:  # noqa: BLE001 - a dead thread must not go unnoticed
            self.problem = f'The state cannot be saved ({type(error).__name__}: {error}).'
        else:
            self.problem = ''
            self.saved_s = time.monotonic()

    def _find(self, folder: StateFolder, settings: Settings) -> None:
        """Find the state of most use: the last one, or one that was set aside."""
        try:
            self.saved = _whole(folder.read())
        except (ValveflowError, KeyError, TypeError) as error:
            self.drop(str(error) if isinstance(error, ValveflowError) else 'It is not whole.')
        if self.saved is None:
            return
        names = _changed(self.saved, settings, Depends.ROWS)
        if not names:
            if _changed(self.saved, settings, Depends.NOTHING):
                # A shorter window, say, lets rows go.
                folder.set_aside(of_use=True)
            return
        # Whoever corrects a mistyped parameter gets back what was there before.
        with contextlib.suppress(ValveflowError, KeyError, TypeError):
            aside = _whole(folder.read(folder.aside))
            if aside is not None and not _changed(aside, settings, Depends.ROWS):
                self.saved = aside
                folder.swap_aside()
                return
        if others := _changed(self.saved, settings, Depends.ALL):
            self.drop(f'It was made with another {listed(others)}.', whole=True)
        else:
            folder.set_aside(of_use=True)


def _whole(data: bytes | None) -> State | None:
    """Return the state in those bytes, None if there are none; raises `DataError`."""
    if data is None:
        return None
    saved = from_bytes(data)
    for name in saved.keys() & _KINDS.keys():
        perhaps(saved, name, _KINDS[name])
    # Of an earlier version too; it may have had other parameters.
    saved['settings'] = Settings.earlier(saved['settings'])
    return saved


def _changed(saved: State, settings: Settings, depends: Depends) -> list[str]:
    """Return the parameters that changed and on which so much of a state, or more, depends."""
    then: Settings = saved['settings']
    return [n for n in settings.retuned(then) if parameter(n).depends >= depends]


def _is_named(path: Path, descriptor: int) -> bool:
    """Return True if ``path`` names the file that is open; raises `OSError`."""
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
