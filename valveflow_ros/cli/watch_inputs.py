"""How the inputs of a recording are, judged from their readings alone."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np

from valveflow_ros.cli.log_input import limits
from valveflow_ros.errors import ValveflowError
from valveflow_ros.logs.mcap.gather import Rows
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S, SIGNALS, Quality, Signal
from valveflow_ros.report.terminal.frame import OK, STALE, WARN, HealthView
from valveflow_ros.report.words import counted, duration, plain
from valveflow_ros.signals.units import UNITS, convert

_SILENT_S = 5.0
_SILENT_STEPS = 10.0
# A rejected reading is told of for so long.
_TOLD_S = 60.0


@dataclass(slots=True)
class _Track:
    """What is remembered of one signal."""

    topic: str
    last_ns: int = 0
    value: float = float('nan')
    step_s: float = 1.0
    rejected: int = 0
    refused: float = float('nan')
    refused_ns: int = 0


class InputWatch:
    """Follows the readings of each signal."""

    def __init__(self) -> None:
        self._settings = Settings()
        self._units: dict[Signal, str] = {}
        self._tracks: dict[Signal, _Track] = {}

    def parameters(self, attached: bytes) -> None:
        """Take the parameters that the recording was made with."""
        try:
            given = json.loads(attached)
            self._settings = Settings(given)
        except (ValueError, TypeError, ValveflowError):
            # Of another version, perhaps: the defaults judge well enough for a look.
            return
        named = {info.signal: given.get(f'{info.topic}_unit') for info in SIGNALS}
        self._units = {s: str(unit) for s, unit in named.items() if unit in UNITS[s]}

    def take(self, signal: Signal, topic: str, rows: Rows) -> None:
        """Take readings of a signal, in their order."""
        if not len(rows.value):
            return
        track = self._tracks.setdefault(signal, _Track(topic))
        stamped = topic.endswith('plant_sample')
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

    def health(self, newest_ns: int) -> tuple[HealthView, ...]:
        """Return how each signal is; an optional one that never came is left out.

        Parameters
        ----------
        newest_ns : int
            The newest log time of the whole recording.
        """
        if not newest_ns:
            return ()
        return tuple(
            self._judged(info.signal, newest_ns)
            for info in SIGNALS
            if info.required or info.signal in self._tracks
        )

    def _judged(self, signal: Signal, newest_ns: int) -> HealthView:
        info, track = SIGNALS[signal], self._tracks.get(signal)
        if track is None:
            return HealthView(info.topic, STALE, 'nothing of it is in the recording.')
        silent_s = (newest_ns - track.last_ns) / NS_PER_S
        if silent_s > max(_SILENT_S, _SILENT_STEPS * track.step_s):
            return HealthView(info.topic, STALE, f'silent for {duration(round(silent_s))}.')
        if track.rejected and newest_ns - track.refused_ns < _TOLD_S * NS_PER_S:
            value = plain(track.refused)
            why = (
                'without a usable value' if value == 'unknown' else f'{value} {info.unit}, refused'
            )
            told = f'{counted(track.rejected, "reading")} rejected, the last {why}.'
            return HealthView(info.topic, WARN, told)
        return HealthView(info.topic, OK, f'{plain(track.value)} {info.unit}.')
