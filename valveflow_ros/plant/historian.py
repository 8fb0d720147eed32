# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The values of a plant's signals that a historian stores: all, means, or exceptions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from valveflow_ros.errors import InputError
from valveflow_ros.numerics import kernel
from valveflow_ros.plant.thermal_unit import assignments
from valveflow_ros.plant.unit import refuse_unless
from valveflow_ros.records import NS_PER_S, BoolArray, FloatArray, IntArray

RECORDINGS = ('1s', 'minute', 'compressed')
# Spans of the transmitters, to which a dead band in % refers; that of a position is 100 %.
SPANS = {
    'main_steam_pressure_mpa': 25.0, 'main_steam_temperature_degc': 600.0,
    'generated_power_mw': 400.0, 'condenser_pressure_kpa': 20.0, 'grid_frequency_hz': 2.0,
}  # fmt: skip
_MINUTE = 60
_OPTIONS = (
    'band_percent', 'scan_low_s', 'scan_high_s', 'longest_s', 'resample_s',
    'dropouts_per_day', 'dropout_minutes',
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Historian:
    """How signals are recorded.

    ``recording`` '1s': every sample. 'minute': the mean of each full minute of the record, stamped
    at its end. 'compressed': a value is stored if a scan finds that it differs by more than the
    dead band from the last stored one, or that the last one is too old.
    """

    recording: str = '1s'
    band_percent: float = 0.5  # dead band, % of the span in `SPANS`
    # Each signal has its own scan interval in whole seconds, random between these limits.
    scan_low_s: float = 5.0
    scan_high_s: float = 30.0
    longest_s: float = 600.0  # between stored values; it is rounded down to a scan
    # Of a compressed record: 0 gives each value at its own time; otherwise the step in whole
    # seconds of rows with the last stored values, from the time when all signals have one.
    resample_s: float = 0.0
    dropouts_per_day: float = 0.0  # of each signal
    dropout_minutes: float = 30.0  # their mean duration

    def __post_init__(self) -> None:
        if self.recording not in RECORDINGS:
            raise InputError(
                f"There is no recording '{self.recording}': use one of {', '.join(RECORDINGS)}."
            )
        checks = (
            (0.0 <= self.band_percent <= 50.0, 'band_percent must be 0 to 50 %'),
            (1.0 <= self.scan_low_s <= self.scan_high_s <= 600.0,
             'scans must be 1 to 600 s and the shortest not above the longest'),
            (self.longest_s >= self.scan_high_s, 'longest_s must not be below scan_high_s'),
            (0.0 <= self.resample_s <= 3600.0 and self.resample_s == self.resample_s // 1,
             'resample_s must be whole seconds, 0 to 3600'),
            (self.resample_s == 0.0 or self.recording == 'compressed',
             "resample_s belongs to the recording 'compressed'"),
            (0.0 <= self.dropouts_per_day <= 100.0, 'dropouts_per_day must be 0 to 100'),
            (0.0 < self.dropout_minutes <= 10_000.0, 'dropout_minutes: above 0, at most 10000'),
        )  # fmt: skip
        refuse_unless('recording cannot be made', *checks)

    @classmethod
    def parse(cls, text: str) -> Historian:
        """Read ``NAME`` or ``NAME:key=value,...``; the keys are the attributes."""
        name, _, rest = text.strip().partition(':')
        given: dict[str, Any] = assignments(rest, f"Recording '{name}'", _OPTIONS)
        return cls(name, **given)

    @property
    def own_times(self) -> bool:
        """Return True if each value has its own time, so that an empty cell means no new value."""
        return self.recording == 'compressed' and self.resample_s == 0.0

    def record(
        self, start_ns: int, signals: Mapping[str, FloatArray], rng: np.random.Generator
    ) -> tuple[IntArray, dict[str, FloatArray]]:
        """Return times, int64 (m,), and columns of signals (n,) that were sampled every second.

        NaN means that a value is missing or, with own times, that there is no new value. The
        number of random draws, for scans and dropouts, is the same for all recordings.
        """
        there = self._there(signals, rng)
        scans = self._scans(signals, rng)
        if self.recording == '1s':
            seconds = np.arange(_length(signals), dtype=np.int64)
            columns = there
        elif self.recording == 'minute':
            seconds, columns = _minutes(there)
        else:
            kept = {}
            for name, column in there.items():
                band = self.band_percent / 100.0 * SPANS.get(name, 100.0)
                kept[name] = exceptions(column, *scans[name], band, round(self.longest_s))
            seconds, columns = self._rows(there, kept)
        return start_ns + seconds * NS_PER_S, columns

    def _there(
        self, signals: Mapping[str, FloatArray], rng: np.random.Generator
    ) -> dict[str, FloatArray]:
        n, out, pause_s = _length(signals), {}, 86_400.0 / max(self.dropouts_per_day, 1e-9)
        for name, column in signals.items():
            # Each signal has its own generator: dropouts of one do not change those of another.
            mine = np.random.default_rng(rng.integers(2**63))
            out[name] = column
            if self.dropouts_per_day == 0.0:
                continue
            out[name] = column.copy()
            now = mine.exponential(pause_s)
            while now < n:
                end = now + mine.exponential(60.0 * self.dropout_minutes)
                out[name][int(now) : int(end) + 1] = np.nan
                now = end + mine.exponential(pause_s)
        return out

    def _scans(
        self, signals: Mapping[str, FloatArray], rng: np.random.Generator
    ) -> dict[str, tuple[int, int]]:
        """Draw scan interval and first scan of each signal, in s."""
        found = {}
        for name in signals:
            place, phase = rng.random(2)
            low, high = round(self.scan_low_s), round(self.scan_high_s)
            scan = low + int(place * (high - low + 1))
            found[name] = scan, int(phase * scan)
        return found

    def _rows(
        self, signals: dict[str, FloatArray], kept: dict[str, BoolArray]
    ) -> tuple[IntArray, dict[str, FloatArray]]:
        """Return a row for each second with any stored value, or equally spaced rows."""
        if self.own_times:
            anything = np.any(list(kept.values()), axis=0)
            seconds = np.flatnonzero(anything).astype(np.int64)
            columns = {
                name: np.where(kept[name][seconds], column[seconds], np.nan)
                for name, column in signals.items()
            }
            return seconds, columns
        step = round(self.resample_s)
        # Do not wait for a signal that is always missing.
        begin = max((int(np.argmax(k)) for k in kept.values() if k.any()), default=0)
        seconds = np.arange(-(-begin // step) * step, _length(signals), step, dtype=np.int64)
        columns = {}
        for name, column in signals.items():
            stored = np.where(kept[name], np.arange(column.size), -1)
            last = np.maximum.accumulate(stored)[seconds]
            columns[name] = np.where(last >= 0, column[last], np.nan)
        return seconds, columns


def _length(signals: Mapping[str, FloatArray]) -> int:
    return next(iter(signals.values())).size


def _minutes(signals: dict[str, FloatArray]) -> tuple[IntArray, dict[str, FloatArray]]:
    count = _length(signals) // _MINUTE
    columns = {}
    for name, column in signals.items():
        block = column[: count * _MINUTE].reshape(count, _MINUTE)
        number = np.isfinite(block).sum(axis=1)
        total = np.where(np.isfinite(block), block, 0.0).sum(axis=1)
        columns[name] = np.where(number > 0, total / np.maximum(number, 1), np.nan)
    return (1 + np.arange(count, dtype=np.int64)) * _MINUTE, columns


@kernel
def exceptions(column: FloatArray, scan: int, phase: int, band: float, longest: int) -> BoolArray:
    """Return a mask of the samples that exception compression stores, bool (n,).

    Only every ``scan``-th sample from ``phase`` on is tested. If a scan finds no value,
    the next value found is stored.
    """
    kept = np.zeros(column.size, dtype=np.bool_)
    last, since = np.nan, 0
    for t in range(phase, column.size, scan):
        value = column[t]
        if np.isnan(value):
            last = np.nan
        elif np.isnan(last) or abs(value - last) > band or t + scan - since > longest:
            kept[t] = True
            last, since = value, t
    return kept
