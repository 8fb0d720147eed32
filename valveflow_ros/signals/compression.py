# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Signals that a historian stores by exception: each value is valid until the next one.

Such a historian stores a value if it differs by more than a dead band from the last stored one,
or if that one is too old. The time steps are therefore irregular and changes are never small.
A log is taken as compressed if both are found in at least two of opening, pressure and power;
any other log is not changed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from valveflow_ros.records import (
    NS_PER_S,
    SIGNALS,
    BoolArray,
    FloatArray,
    IntArray,
    Quality,
    Readings,
    Signal,
)

_DECISIVE = (Signal.VALVE_OPENING, Signal.MAIN_STEAM_PRESSURE, Signal.GENERATED_POWER)
_LEAST_VALUES = 60
_LEAST_SIGNALS = 2
_NEAR_MEDIAN = 0.25  # relative difference from the median of regular time steps
_REGULAR_SHARE = 0.6
_LOW = 0.02  # quantile of the changes that is used as dead band
_BAND_OF_MEDIAN = 0.4  # minimum ratio of dead band and median change; ordinary noise has 0.02
_RESOLUTIONS = 5.0  # minimum dead band in resolution steps of the record, if rows are regular
# The historian stores a value because of its age if this fraction of the gaps is within this
# factor, and if this many times fewer gaps are within the same factor below them.
_EDGE_LEAST, _EDGE_SHARE, _EDGE_WIDTH, _EDGE_RISE = 8, 0.001, 1.08, 3.0
_NEARLY_ALL = 0.998
_YOUNG = 0.75  # of the longest interval: an earlier value is stored because of its change
_LATE = 1.1  # validity of a value, in longest regular intervals
_SCAN = 0.05  # quantile of the gaps that is used as scan interval
_OF_SCAN = 0.6  # maximum step of rows, in scans of the fastest signal
_ROUND_S = (1, 2, 5, 10, 15, 20, 30, 60)


@dataclass(frozen=True, slots=True)
class Updates:
    """How one signal of a compressed log is stored."""

    interval_s: float  # median time between values
    dead_band: float  # smallest change that is stored, in the engine's unit


@dataclass(frozen=True, slots=True)
class Compression:
    """A log that was compressed by exception."""

    updates: dict[Signal, Updates]  # the signals in which compression was found
    # Longest regular time between values; after a longer time the value is missing.
    longest_s: float
    # Time between rows: that of the log if it repeats its values, else a suitable one.
    step_s: float
    # True if values have their own times; otherwise the rows of the log repeat them.
    own_times: bool

    @property
    def interval_s(self) -> float:
        """Return the median of the typical update intervals of the signals."""
        return float(np.median([u.interval_s for u in self.updates.values()]))

    @property
    def sentence(self) -> str:
        """Return a sentence on how the log was stored."""
        told = ', '.join(
            f'{SIGNALS[s].topic} typically every {u.interval_s:.0f} s, from changes of '
            f'{u.dead_band:.2g} {SIGNALS[s].unit} on'
            for s, u in sorted(self.updates.items())
        )
        longest_min = _LATE * self.longest_s / 60.0
        how = (
            f'Each value is held until the next one, for up to {longest_min:.0f} min, in rows '
            f'{self.step_s:g} s apart.'
            if self.own_times
            else 'Its rows repeat each value until the next one.'
        )
        return f'The log is compressed by exception: {told}. {how}'


def find_compression(readings: Readings) -> Compression | None:
    """Return how a log was compressed, None if it seems not compressed.

    Notes
    -----
    A log with a step back of the clock is not compressed. The longest regular interval is a
    length that many gaps of all signals have.
    """
    series = {}
    for s, part in readings.by_signal().items():
        if np.diff(part.time_ns).min(initial=0) < 0:
            return None
        there = np.isfinite(part.value) & (part.quality < Quality.BAD)
        if there.sum() >= _LEAST_VALUES:
            series[Signal(s)] = part.time_ns[there] / NS_PER_S, part.value[there]
    decisive = [s for s in _DECISIVE if s in series]
    if len(decisive) < _LEAST_SIGNALS:
        return None
    regular = [s for s in decisive if _is_regular(np.diff(series[s][0]))]
    held = len(regular) == len(decisive)
    if held:
        # A log that repeats values: only the rows with a change are relevant.
        step_s = float(np.median(np.diff(series[decisive[0]][0])))
        series = {s: _changes(*one) for s, one in series.items()}
    elif regular and len(decisive) - len(regular) < _LEAST_SIGNALS:
        return None
    gaps = {s: np.diff(t) for s, (t, _) in series.items()}
    if not all(len(gap) for gap in gaps.values()):
        return None
    longest_s = _longest(np.concatenate(list(gaps.values())))
    updates = {}
    for s in (*decisive, *(s for s in series if s not in decisive)):
        if (found := _updates(gaps[s], series[s][1], longest_s, held)) is not None:
            updates[s] = found
    if sum(s in updates for s in decisive) < _LEAST_SIGNALS:
        return None
    if not held:
        scans = [float(np.quantile(gaps[s], _SCAN)) for s in updates]
        step_s = float(max(r for r in _ROUND_S if r <= max(_OF_SCAN * min(scans), 1.0)))
    return Compression(updates, longest_s, step_s, not held)


def _is_regular(gap_s: FloatArray) -> bool:
    near = np.abs(gap_s - np.median(gap_s)) <= _NEAR_MEDIAN * np.median(gap_s)
    return bool(near.mean() >= _REGULAR_SHARE)


def _changes(time_s: FloatArray, value: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the values that differ from the previous one."""
    new = np.append(True, value[1:] != value[:-1])
    return time_s[new], value[new]


def _longest(gap_s: FloatArray) -> float:
    """Return the longest regular gap: a length of many gaps, else a limit of nearly all."""
    gap = np.sort(gap_s)
    below, far_below = (np.searchsorted(gap, gap / _EDGE_WIDTH**k, side='left') for k in (1, 2))
    here, before = np.arange(len(gap)) + 1 - below, below - far_below
    many = here >= max(_EDGE_LEAST, _EDGE_SHARE * len(gap))
    edges = np.flatnonzero(many & (here >= _EDGE_RISE * before) & (gap > 3.0 * np.median(gap)))
    if not len(edges):
        return float(np.quantile(gap, _NEARLY_ALL))
    # Choose the length that covers most time.
    return float(gap[edges[np.argmax((here * gap)[edges])]])


def _updates(gap_s: FloatArray, value: FloatArray, longest_s: float, held: bool) -> Updates | None:
    """Return how a signal is stored, None if it is not stored by exception."""
    if len(gap_s) < _LEAST_VALUES or _is_regular(gap_s):
        return None
    change = np.abs(np.diff(value))[gap_s < _YOUNG * longest_s]
    if len(change) < _LEAST_VALUES // 2:
        return None
    band, median = (float(np.quantile(change, q)) for q in (_LOW, 0.5))
    if not band > 0.0 or band < _BAND_OF_MEDIAN * median:
        return None
    resolution = float(np.median(np.diff(np.unique(value))))
    if held and band < _RESOLUTIONS * resolution:
        return None
    return Updates(float(np.median(gap_s)), band)


def held_readings(readings: Readings, compression: Compression) -> Readings:
    """Return a compressed log as rows in which each value is repeated until the next one.

    A value is valid for 1.1 times the longest regular interval; rows without a value are left
    out. A value marked as bad by the sender ends the previous one; NaN means no new value.
    """
    step_ns = round(compression.step_s * NS_PER_S)
    longest_ns = round(_LATE * compression.longest_s * NS_PER_S)
    first, last = int(readings.time_ns.min()), int(readings.time_ns.max())
    grid = np.arange(-(-first // step_ns), last // step_ns + 1, dtype=np.int64) * step_ns
    parts = [
        _held(part, grid, longest_ns)
        for s, part in sorted(
            readings.by_signal().items(), key=lambda item: SIGNALS[item[0]].required
        )
    ]
    joined = Readings(
        np.concatenate([p.time_ns for p in parts]), np.concatenate([p.signal for p in parts]),
        np.concatenate([p.value for p in parts]), np.concatenate([p.quality for p in parts]),
    )  # fmt: skip
    order = np.argsort(joined.time_ns, kind='stable')
    return Readings(
        joined.time_ns[order], joined.signal[order], joined.value[order], joined.quality[order]
    )


def _held(part: Readings, grid: IntArray, longest_ns: int) -> Readings:
    new = np.flatnonzero(np.isfinite(part.value))
    time_ns, value, quality = part.time_ns[new], part.value[new], part.quality[new]
    at = np.searchsorted(time_ns, grid, side='right') - 1
    at, known = np.maximum(at, 0), at >= 0
    if not len(new):
        return part.part(0, 0)
    good: BoolArray = known & (grid - time_ns[at] <= longest_ns) & (quality[at] < Quality.BAD)
    return Readings(
        grid[good], np.full(int(good.sum()), part.signal[0]), value[at[good]], quality[at[good]]
    )
