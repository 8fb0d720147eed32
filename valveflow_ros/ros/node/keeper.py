"""Keeps the monitor's state, and finds it again at the next start."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from valveflow_ros.config import Settings, parameter
from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.errors import DataError, ValveflowError
from valveflow_ros.monitoring.alarms import AlarmChange
from valveflow_ros.monitoring.events import (
    CurveAdopted,
    Diagnosed,
    Event,
    JournalEntry,
    JournalKind,
    ReferenceSet,
)
from valveflow_ros.ros.node.recording import DEFAULT_FOLDER, Recording, at_home, tag_of
from valveflow_ros.ros.node.state_folder import InUseError, StateFolder, StateWriter
from valveflow_ros.state import State
from valveflow_ros.state_bytes import from_bytes

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
