# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Frames of the terminal view from a recording, which may still be growing."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from valveflow_ros.errors import RecordingError, ValveflowError
from valveflow_ros.interface.files import reason
from valveflow_ros.interface.plausibility import limits
from valveflow_ros.logs.mcap.follow import Batch, Follower, Picker, Raw
from valveflow_ros.logs.mcap.gather import Rows
from valveflow_ros.logs.names import PLANT_SAMPLE, told_inputs
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S, SIGNALS, Quality, Signal
from valveflow_ros.report.terminal.board import (
    ALARM,
    CURVE,
    DIAGNOSIS,
    KEPT,
    PREDICTION,
    MonitorState,
)
from valveflow_ros.report.terminal.frame import OK, STALE, WARN, Frame, HealthView
from valveflow_ros.report.words import counted, duration, plain
from valveflow_ros.signals.units import convert, known_units

_SILENT_S = 5.0
_SILENT_STEPS = 10.0
# How long a rejected reading is shown.
_TOLD_S = 60.0


@dataclass(slots=True)
class _Track:
    """State of one signal."""

    last_ns: int = 0
    value: float = float('nan')
    step_s: float = 1.0
    rejected: int = 0
    refused: float = float('nan')
    refused_ns: int = 0


class InputWatch:
    """Follow the readings of each signal."""

    def __init__(self) -> None:
        self._settings = Settings()
        self._units: dict[Signal, str] = {}
        self._tracks: dict[Signal, _Track] = {}

    def parameters(self, attached: bytes) -> None:
        """Set the parameters with which the recording was made."""
        try:
            given = json.loads(attached)
            self._settings = Settings(given)
        except (ValueError, TypeError, ValveflowError):
            # Perhaps from another version: the defaults are good enough for a view.
            return
        named = {info.signal: given.get(f'{info.topic}_unit') for info in SIGNALS}
        self._units = {s: str(unit) for s, unit in named.items() if unit in known_units(s)}

    def take(self, signal: Signal, type_name: str, rows: Rows) -> None:
        """Add readings of a signal from messages of this type, in their order."""
        if not len(rows.value):
            return
        track = self._tracks.setdefault(signal, _Track())
        stamped = type_name == PLANT_SAMPLE
        unit = SIGNALS[signal].unit if stamped else self._units.get(signal, SIGNALS[signal].unit)
        values = convert(signal, unit, rows.value)
        low, high = limits(signal, self._settings)
        good = (values >= low) & (values <= high) & (rows.quality != int(Quality.BAD))
        if len(rows.log_time) > 1:
            steps = np.diff(rows.log_time)
            track.step_s = max(float(np.median(steps)) / NS_PER_S, 0.0)
        track.last_ns = int(rows.log_time[-1])
        if good.any():
            track.value = float(values[np.flatnonzero(good)[-1]])
        wrong = np.flatnonzero(~good)
        if len(wrong):
            track.rejected += len(wrong)
            track.refused = float(values[wrong[-1]])
            track.refused_ns = int(rows.log_time[wrong[-1]])

    def health(self, newest_ns: int, finished: bool = False) -> tuple[HealthView, ...]:
        """Return the health of each signal; an optional signal without readings is left out.

        ``newest_ns`` is the newest log time of the whole recording, ``finished``: no more will
        come.
        """
        if not newest_ns:
            return ()
        return tuple(
            self._judged(info.signal, newest_ns, finished)
            for info in SIGNALS
            if info.required or info.signal in self._tracks
        )

    def _judged(self, signal: Signal, newest_ns: int, finished: bool) -> HealthView:
        info, track = SIGNALS[signal], self._tracks.get(signal)
        if track is None:
            return HealthView(info.topic, STALE, 'nothing of it is in the recording.')
        silent_s = (newest_ns - track.last_ns) / NS_PER_S
        if silent_s > max(_SILENT_S, _SILENT_STEPS * track.step_s):
            silent = duration(round(silent_s))
            told = f'silent for {silent}.'
            if finished:
                told = f'the recording has ended; no value in its last {silent}.'
            return HealthView(info.topic, STALE, told)
        if track.rejected and newest_ns - track.refused_ns < _TOLD_S * NS_PER_S:
            value = plain(track.refused)
            why = (
                'without a usable value' if value == 'unknown' else f'{value} {info.unit}, refused'
            )
            told = f'{counted(track.rejected, "reading")} rejected, the last {why}.'
            return HealthView(info.topic, WARN, told)
        return HealthView(info.topic, OK, f'{plain(track.value)} {info.unit}.')


_PARAMETERS = 'parameters.json'
_MANY = 1 << 30
_WANTED = {CURVE: 1, DIAGNOSIS: 1, ALARM: _MANY}
_STILL_S = 10.0


class LogWatch:
    """Follow a recording and return its state.

    Parameters
    ----------
    path : Path
        An ``.mcap`` file, an ``.mcap.part``, a recording's folder, or a folder of those; raises
        `RecordingError` if it is none.
    board : MonitorState, optional
        Object that keeps the state; a new one by default.
    kept : int
        Number of newest predictions that are passed to the board, at the start and later.

    Attributes
    ----------
    share : float
        Fraction of the present file that has been read, 0 to 1.
    """

    def __init__(self, path: Path, board: MonitorState | None = None, kept: int = KEPT) -> None:
        place = recording_in(path)
        self._follower = Follower(place)
        self._name = place.name or str(place)
        self._picker = Picker()
        self._board = MonitorState() if board is None else board
        self._wanted = {**_WANTED, PREDICTION: kept}
        self._inputs = InputWatch()
        self._parameters = b''
        # Decoded on demand: most predictions of a long recording are never shown.
        self._predictions: deque[Raw] = deque(maxlen=kept)
        self._newest_ns = 0
        self._grown_s = time.monotonic()
        self._heard = False
        self.share = 0.0

    @property
    def finished(self) -> bool:
        """Return True if the recording is complete and will not grow."""
        return self._follower.finished

    def read(self) -> Iterator[None]:
        """Read new data; yield from time to time so that the caller can draw."""
        for batch in self._follower.read():
            self._take(batch)
            self.share = batch.share
            yield
        self.share = 1.0

    def frame(self) -> Frame:
        """Return the present state."""
        while self._predictions:
            self._tell(self._predictions.popleft())
        self._board.inputs = self._inputs.health(self._newest_ns, self.finished)
        self._board.recorder = self._recorder()
        return self._board.frame(self._name, self._note())

    def _take(self, batch: Batch) -> None:
        attached = self._follower.attachments.get(_PARAMETERS, b'')
        if attached != self._parameters:
            self._parameters = attached
            self._inputs.parameters(attached)
        for raw in self._picker.last(batch, self._wanted):
            self._heard = True
            if raw.type == PREDICTION:
                self._predictions.append(raw)
            else:
                self._tell(raw)
        told = told_inputs(self._follower.attachments)
        for signal, type_name, rows in self._picker.readings(batch, told):
            self._inputs.take(signal, type_name, rows)
            if not self._heard and len(rows.time_ns):
                self._board.at(int(rows.time_ns[-1]))
        if len(batch.messages):
            self._newest_ns = max(self._newest_ns, int(batch.messages.log_time.max()))
            self._grown_s = time.monotonic()

    def _tell(self, raw: Raw) -> None:
        fields = self._picker.fields(raw)
        if fields is not None:
            self._board.take(raw.type, fields)

    def _note(self) -> str:
        if self.share < 1.0 and self._newest_ns:
            return f'Reading what was recorded so far: {100.0 * self.share:.0f} %.'
        if not self._newest_ns:
            return 'Nothing is recorded yet.'
        if not self._heard:
            return (
                'The recording contains no monitor output; "valveflow identify" finds its curve.'
            )
        return ''

    def _recorder(self) -> HealthView:
        follower, name = self._follower, self._follower.name
        lost = f' {counted(follower.damaged, "place")} in it damaged.' if follower.damaged else ''
        still_s = time.monotonic() - self._grown_s
        if follower.written and still_s > _STILL_S:
            level, told = WARN, f'{name} has not grown for {duration(round(still_s))}.'
        elif follower.written or follower.finished:
            doing = 'recording' if follower.written else 'finished'
            level, told = OK, f'{doing}, {name}, {follower.size / 1e6:.1f} MB.'
        elif not name:
            return HealthView('recorder', OK, 'no file yet.')
        else:
            level, told = WARN, f'{name} is incomplete, and no process writes to it.'
        return HealthView('recorder', WARN if lost else level, told + lost)


def recording_in(path: Path) -> Path:
    """Return the recording at a path: itself, or the newest in a folder of recordings."""
    if not path.exists() and not path.with_name(path.name + '.part').exists():
        raise RecordingError(path, 'is not there')
    if not path.is_dir():
        return path
    try:
        if any('.mcap' in entry.name for entry in path.iterdir()):
            return path
        folders = [f for f in path.iterdir() if f.is_dir() and any(f.glob('*.mcap*'))]
        newest = max(folders, key=lambda folder: folder.stat().st_mtime, default=None)
    except OSError as error:
        raise RecordingError(path, f'cannot be read ({reason(error)})') from None
    if newest is None:
        raise RecordingError(path, 'has no recording in it; name the folder of a running monitor')
    return newest
