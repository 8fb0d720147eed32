"""Keeps the monitor's state, and finds it again at the next start."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.characteristic_json import from_json, to_json
from valveflow_ros.errors import DataError, RecordingError, ValveflowError
from valveflow_ros.logs.part_file import FILE_MODE, make_folder, write_whole
from valveflow_ros.monitoring.alarms import AlarmChange
from valveflow_ros.monitoring.events import (
    CurveAdopted,
    Diagnosed,
    Event,
    JournalEntry,
    JournalKind,
    ReferenceSet,
)
from valveflow_ros.parameters import Settings, parameter
from valveflow_ros.ros.node.recording import DEFAULT_FOLDER, Recording, at_home, tag_of
from valveflow_ros.state import State, from_bytes, to_bytes

# Where a monitor keeps its state: one file, one owner.


STATE = 'monitor.state'
ASIDE = 'monitor.state.unused'
LOCK = 'lock'
_CURVE, _CURVES = 'curve_', 5
_MOST_BYTES = 4 << 30
# The file is put in place when the recording has everything that went into it, or after this.
_PATIENCE_S = 1.0
_LOOK_S = 0.02
_LONGEST_S = 30.0


class InUseError(RecordingError):
    """Another monitor keeps its state there."""


class StateFolder:
    """A folder that only one monitor works in, as long as it lives.

    Parameters
    ----------
    folder : Path
        Made if absent.

    Raises
    ------
    InUseError
        Another monitor is at work there.
    RecordingError
        It cannot be made or used.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.path, self.aside = folder / STATE, folder / ASIDE
        try:
            make_folder(folder)
            self._lock = _locked(folder / LOCK)
        except BlockingIOError:
            raise InUseError(folder, _in_use(folder / LOCK)) from None
        except (OSError, ValueError) as error:
            raise RecordingError(folder, f'cannot be used ({_reason(error)})') from None
        # What a killed process left half written; if it cannot be removed, it does no harm.
        with contextlib.suppress(OSError):
            for stale in folder.glob('.*.tmp'):
                stale.unlink()

    def read(self, path: Path | None = None) -> bytes | None:
        """Return what was saved last, or what was set aside; None if nothing was.

        Parameters
        ----------
        path : Path, optional
            `path` by default, or `aside`.

        Raises
        ------
        RecordingError
            It is there and cannot be read.
        """
        path = self.path if path is None else path
        flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        try:
            with os.fdopen(os.open(path, flags), 'rb') as file:
                if os.fstat(file.fileno()).st_size > _MOST_BYTES:
                    raise RecordingError(path, 'is too large to be a saved state')
                return file.read()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise RecordingError(path, f'cannot be read ({_reason(error)})') from None

    def set_aside(self) -> None:
        """Keep a state that cannot be used from being written over by the next one.

        Of two such the larger one stays: it knows more of the unit.
        """
        with contextlib.suppress(OSError):
            if not self.aside.exists() or self.aside.lstat().st_size < self.path.lstat().st_size:
                self.path.replace(self.aside)

    def take_back(self) -> None:
        """Let the state that was set aside and the last one change places."""
        between = self.folder / f'.{STATE}.tmp'
        with contextlib.suppress(OSError):
            if self.path.exists():
                self.path.replace(between)
            self.aside.replace(self.path)
            if between.exists():
                between.replace(self.aside)

    def write(self, data: bytes) -> None:
        """Put a state in place of the last one: it is the old or the new one, never half."""
        write_whole(self.path, data)

    def keep_curve(self, curve: Characteristic) -> None:
        """Put a curve beside the state, which is written a moment later; the older ones go.

        It is small and must only outlive the process: nothing waits for the disk. If it cannot be
        written, the state that follows has it.
        """
        with contextlib.suppress(OSError):
            place = self.folder / f'{_CURVE}{curve.model_id}.json'
            draft = self.folder / f'.{place.name}.tmp'
            with open(draft, 'w', encoding='utf-8', opener=_private) as file:
                json.dump(to_json(curve), file)
            draft.replace(place)
            kept = sorted(self.folder.glob(f'{_CURVE}*.json'), key=lambda p: p.stat().st_mtime_ns)
            for old in kept[:-_CURVES]:
                old.unlink()

    def curve(self, model_id: str) -> Characteristic:
        """Return a curve that was kept; raises `DataError` if it is not there whole."""
        place = self.folder / f'{_CURVE}{model_id}.json'
        try:
            found = from_json(json.loads(place.read_text(encoding='utf-8')))
        except (OSError, ValueError, RecursionError, DataError):
            raise DataError(f'Curve {model_id} was not saved.') from None
        if found.model_id != model_id:
            raise DataError(f'Curve {model_id} was not saved.')
        return found

    def close(self) -> None:
        """Let another monitor in."""
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1


class StateWriter:
    """Writes states from a thread, one at a time; the monitor never waits for it.

    Parameters
    ----------
    folder : StateFolder

    Attributes
    ----------
    problem : str
        Why the last one could not be written; empty if it was.
    saved_s : float or None
        When the last one was put in place, by a clock that never goes back.
    """

    def __init__(self, folder: StateFolder) -> None:
        self._folder = folder
        self._thread: threading.Thread | None = None
        self.problem = ''
        self.saved_s: float | None = None

    @property
    def busy(self) -> bool:
        """Tell whether one is being written."""
        return self._thread is not None and self._thread.is_alive()

    def write(self, state: State, ready: Callable[[], bool]) -> None:
        """Write a state once ``ready`` says so, or after a while; call it only when not busy."""
        self._thread = threading.Thread(
            target=self._write, args=(state, ready), name='state writer', daemon=True
        )
        self._thread.start()

    def finish(self) -> None:
        """Wait for the one being written; that is bounded, unless a disk hangs."""
        if self._thread is not None:
            self._thread.join(_LONGEST_S)

    def _write(self, state: State, ready: Callable[[], bool]) -> None:
        try:
            data = to_bytes(state)
            until_s = time.monotonic() + _PATIENCE_S
            while not ready() and time.monotonic() < until_s:
                time.sleep(_LOOK_S)
            self._folder.write(data)
        except OSError as error:
            self.problem = f'{self._folder.path}: the state cannot be saved ({_reason(error)}).'
        except Exception as error:  # noqa: BLE001 - a dead thread must not go unnoticed
            self.problem = f'The state cannot be saved ({type(error).__name__}: {error}).'
        else:
            self.problem = ''
            self.saved_s = time.monotonic()


def _private(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW | os.O_CLOEXEC, FILE_MODE)


def _locked(path: Path) -> int:
    """Return a descriptor that holds the lock; the kernel lets go when the process ends."""
    flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
    descriptor = os.open(path, flags, FILE_MODE)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.fchmod(descriptor, FILE_MODE)
        os.ftruncate(descriptor, 0)
        os.write(descriptor, f'{os.getpid()}\n'.encode())
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def _in_use(lock: Path) -> str:
    """Say who holds it."""
    owner = ''
    with contextlib.suppress(OSError, ValueError):
        owner = f' (process {int(lock.read_text()[:20])})'
    return (
        f'another monitor{owner} keeps its state there; stop it, or give this one a '
        'state_directory or unit_tag of its own'
    )


def _reason(error: OSError | ValueError) -> str:
    return (getattr(error, 'strerror', None) or str(error)).lower()


# A window of ten days takes 40 MB.
_LEAST_S = 1.0
_RETRY_S = 10.0
_WORTH = (AlarmChange, CurveAdopted, Diagnosed, ReferenceSet)
_ENTRIES = (JournalKind.SETTINGS, JournalKind.RESET, JournalKind.RESUMED)


def folder_of(settings: Settings) -> Path | None:
    """Return the folder that the parameters name; None if they want no state kept."""
    given = settings.text('state_directory')
    if not settings.flag('keep_state') or not (given or settings.flag('record')):
        return None
    if given:
        return at_home(given)
    home = at_home(settings.text('record_directory') or DEFAULT_FOLDER)
    return home / f'state_{tag_of(settings)}'


class Keeper:
    """Owns the state's folder from configure to clean-up.

    Parameters
    ----------
    settings : Settings

    Attributes
    ----------
    saved : State or None
        What an earlier run left, if it can be used by this one.
    sentence : str
        Why there is none although there was something; empty otherwise.

    Raises
    ------
    InUseError
        Another monitor keeps its state in the same folder.
    """

    def __init__(self, settings: Settings) -> None:
        self.saved: State | None = None
        self.sentence = ''
        self.lost = False
        self._period_s = settings.real('state_period')
        self._written_s = time.monotonic()
        # At the start too: with any state, however empty, the recording after it is fed again.
        self._due = True
        self._folder: StateFolder | None = None
        self._refused = ''
        self._open(settings)

    @property
    def on(self) -> bool:
        """Tell whether a state is kept."""
        return self._folder is not None

    @property
    def problem(self) -> str:
        """Return why the state cannot be saved; empty if it can."""
        return self._writer.problem if self.on else self._refused

    @property
    def age_s(self) -> float | None:
        """Return how long ago the last state was put in place, None before the first."""
        saved_s = self._writer.saved_s if self.on else None
        return None if saved_s is None else time.monotonic() - saved_s

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
        then = (
            'It stays beside the new one, and a run that it fits takes it up again.' if whole else
            'It stays beside the new one. Window, standing alarms and reference of before are '
            'gone; curves of before stand there as curve_*.json, for reference_file.'
        )  # fmt: skip
        self.sentence = f'The state saved by an earlier run is not used. {reason} {then}'
        if self._folder is not None:
            self._folder.set_aside()

    def curve(self, model_id: str) -> Characteristic:
        """Return a curve that was adopted lately; raises `DataError` if it is not there."""
        if self._folder is None:
            raise DataError(f'Curve {model_id} was not saved.')
        return self._folder.curve(model_id)

    def note(self, events: Sequence[Event]) -> None:
        """Look for what must survive the end of the process; a curve is saved at once."""
        for event in events:
            if isinstance(event, CurveAdopted) and self._folder is not None:
                self._folder.keep_curve(event.characteristic)
        self._due = self._due or any(
            isinstance(e, _WORTH) or (isinstance(e, JournalEntry) and e.kind in _ENTRIES)
            for e in events
        )

    @property
    def due(self) -> bool:
        """Tell whether a state is to be written now."""
        if not self.on or self._writer.busy:
            return False
        waited_s = time.monotonic() - self._written_s
        if self._writer.problem:
            return waited_s >= min(_RETRY_S, self._period_s)
        return waited_s >= (min(_LEAST_S, self._period_s) if self._due else self._period_s)

    def write(
        self,
        settings: Settings,
        engine: State,
        log_ns: int,
        recording: Recording,
        topics: Mapping[str, str],
    ) -> None:
        """Write a state.

        Parameters
        ----------
        settings : Settings
            Those in force.
        engine : State
            The engine's snapshot.
        log_ns : int
            Log time of the newest message that went into it.
        recording : Recording
            Where the messages up to then lie.
        topics : mapping of str to str
            Full names of inputs and outputs.
        """
        self._writer.finish()
        self._due, self._written_s = False, time.monotonic()
        folder = recording.folder if recording.on else None
        state = {
            'settings': dict(settings),
            'engine': engine,
            'log_ns': log_ns,
            'topics': dict(topics),
            'began': recording.began,
            'recording': None if folder is None else str(folder.resolve()),
        }
        self._writer.write(state, recording.settled())

    def close(self) -> None:
        """End; what is being written is finished first."""
        if self._folder is not None:
            self._writer.finish()
            self._folder.close()
            self._folder = None

    def _open(self, settings: Settings) -> None:
        """Take the folder; where that cannot be, the monitor goes on without, and says so."""
        try:
            place = folder_of(settings)
            if place is None:
                return
            folder = StateFolder(place)
        except InUseError:
            raise
        except ValveflowError as error:
            self._refused = f'The state cannot be saved. {error}'
            return
        self._folder, self._writer = folder, StateWriter(folder)
        try:
            self._look(folder, settings)
        except BaseException:
            folder.close()
            raise

    def _look(self, folder: StateFolder, settings: Settings) -> None:
        """Find a state that fits: the last one, or one that was set aside because it did not."""
        try:
            self.saved = _fitting(folder.read(), settings)
        except _OtherError as error:
            # Whoever mends a mistyped parameter gets back what was there before.
            with contextlib.suppress(ValveflowError, KeyError, TypeError):
                self.saved = _fitting(folder.read(folder.aside), settings)
            if self.saved is None:
                self.drop(str(error), whole=True)
            else:
                folder.take_back()
        except (ValveflowError, KeyError, TypeError) as error:
            self.drop(str(error) if isinstance(error, ValveflowError) else 'It is not whole.')


class _OtherError(DataError):
    """A state was made with other parameters."""


def _fitting(data: bytes | None, settings: Settings) -> State | None:
    """Return the state in those bytes, None if there are none.

    Raises
    ------
    _OtherError
        It was made with other parameters.
    DataError
        It is damaged.
    """
    if data is None:
        return None
    saved = from_bytes(data)
    other = _other(Settings(saved['settings']), settings)
    if other:
        raise _OtherError(f'It was made with another {other}.')
    return saved


def _other(then: Mapping[str, object], now: Mapping[str, object]) -> str:
    """Return which parameters differ that make a state another one; empty if none does."""
    names = [n for n, v in now.items() if v != then[n] and parameter(n).of_state]
    return ' and '.join(names) if len(names) < 3 else f'{", ".join(names[:-1])} and {names[-1]}'
