# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Faults of the record itself: they are named and masked, but not modelled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

from valveflow_ros.errors import counted
from valveflow_ros.records import SIGNALS, BoolArray, FloatArray, SampleTable, Signal, SignalInfo

FLAT_LEAST_S = 30.0
_FLAT_FACTOR = 3.0
_LARGEST_SHARE = 0.5
_LARGEST = 0.999  # quantile of an opening; larger values may be spikes
_SPIKE_WINDOW, _SPIKE_SD, _LONGEST_SPIKE = 11, 6.0, 1
_SPIKE_SHARE, _LEAST_SPIKES, _LEAST_HEIGHT = 0.01, 4, 0.01
_NOISE_ROWS = 3600
_BACK_SHARE = 0.6
_FLAT_CHANCE = 1e-6
_LEAP_ROWS, _LEAP_SD = 200, 4.2
_COARSE_SHARE = 0.3


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of one signal.

    Attributes
    ----------
    name : str
        'flatline', 'spikes' or 'quantisation'.
    signal : SignalInfo
    rows : int
        Number of masked rows; for quantisation, rows without a change.
    size : float
        Longest constant stretch in seconds, typical height of spikes, or the step.
    """

    name: str
    signal: SignalInfo
    rows: int
    size: float

    @property
    def sentence(self) -> str:
        """Return a sentence for an operator."""
        what = self.signal.topic.replace('_', ' ')
        if self.name == 'flatline':
            return (
                f'The recorded {what} did not change for up to {self.size:.0f} s; '
                f'{counted(self.rows, "row was", "rows were")} left out.'
            )
        if self.name == 'spikes':
            return (
                f'The recorded {what} has {counted(self.rows, "single outlier")} of '
                f'about {self.size:.2g} {self.signal.unit}; '
                f'{"it was" if self.rows == 1 else "they were"} left out.'
            )
        return (
            f'The {what} is recorded in steps of {self.size:.2g} {self.signal.unit}, coarser '
            'than it moves from row to row.'
        )


def _runs(x: FloatArray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first row and the length of runs of equal values; NaN never equals NaN."""
    first = np.flatnonzero(np.concatenate([[True], x[1:] != x[:-1]]))
    return first, np.diff(np.append(first, len(x)))


def _at_stop(x: FloatArray) -> BoolArray:
    """Return where a valve is at a stop: shut, fully open, or at its largest opening."""
    return np.asarray((x <= 0.0) | (x >= 100.0) | (x >= np.nanquantile(x, _LARGEST)))


def _flat(x: FloatArray, step_s: float, rests: BoolArray | None = None) -> tuple[BoolArray, float]:
    """Return rows in runs that are much longer than usual for this signal.

    ``rests`` are rows in which the signal may be constant.
    """
    first, length = _runs(x)
    bad = np.zeros(len(x), dtype=bool)
    usual = float(np.quantile(length, 0.99))
    least = max(FLAT_LEAST_S / step_s, _FLAT_FACTOR * usual, 4.0)
    # A coarse reading repeats itself: n rows have a run of L by chance with about n q^L.
    repeated = 1.0 - len(length) / len(x)
    if 0.0 < repeated < 1.0:
        least = max(least, np.log(_FLAT_CHANCE / len(x)) / np.log(repeated))
    long = length >= least
    if rests is not None:
        long &= ~rests[first]
    if length[long].sum() > _LARGEST_SHARE * len(x):
        return bad, 0.0
    for a, n in zip(first[long], length[long], strict=True):
        bad[a + 1 : a + n] = True  # the first value was correct when it was written
    return bad, float(length[long].max(initial=0)) * step_s


def _returns(x: FloatArray, a: int, b: int) -> bool:
    """Return True if a signal jumps at row ``a`` and jumps back at row ``b``.

    A fast move does not return, and the peak of a varying signal is not reached in one row.
    """
    if a == 0 or b >= len(x):
        return False
    near = x[max(0, a - _LEAP_ROWS) : b + _LEAP_ROWS]
    # A high quantile, not the median: a valve at its stop is constant in half of the rows.
    usual = float(np.nanquantile(np.abs(np.diff(near)), 0.98)) / 2.326
    there, back = x[a] - x[a - 1], x[b] - x[b - 1]
    abrupt = there * back < 0.0 and min(abs(there), abs(back)) > _LEAP_SD * usual
    leap = float(np.min(np.abs(x[a:b] - x[a - 1])))
    return bool(abrupt and abs(x[b] - x[a - 1]) < _BACK_SHARE * leap)


def _spikes(x: FloatArray) -> tuple[BoolArray, float]:
    """Return single values far from the median of their neighbours."""
    good = np.isfinite(x)
    filled = np.where(good, x, 0.0)
    away = np.where(good, x - median_filter(filled, _SPIKE_WINDOW), 0.0)
    size = np.abs(away)
    bad = np.zeros(len(x), dtype=bool)
    for a in range(0, len(x), _NOISE_ROWS):
        part = size[a : a + _NOISE_ROWS]
        noise = float(np.median(part)) / 0.6745
        spread = float(np.sqrt(np.mean(np.minimum(part, 4.0 * noise) ** 2)))
        bad[a : a + _NOISE_ROWS] = part > _SPIKE_SD * max(noise, spread, 1e-12)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], bad.view(np.int8), [0]])))
    for a, b in zip(edges[::2], edges[1::2], strict=True):
        bad[a:b] = b - a <= _LONGEST_SPIKE and _returns(x, a, b)
    bad &= good
    if not _LEAST_SPIKES <= bad.sum() <= _SPIKE_SHARE * len(x):
        return np.zeros(len(x), dtype=bool), 0.0
    height = float(np.median(size[bad]))
    # With an active governor many moves return within a row; spikes of a faulty converter are
    # much larger than the range of such moves.
    low, high = np.quantile(x[good], (0.01, 0.99))
    if not height > _LEAST_HEIGHT * (high - low):
        return np.zeros(len(x), dtype=bool), 0.0
    return bad, height


def _coarse(x: FloatArray) -> tuple[int, float]:
    """Return the number of constant rows and the step of a coarse record; 0 if it is fine."""
    x = x[np.isfinite(x)]
    if len(x) < 100:
        return 0, 0.0
    change = np.abs(np.diff(x))
    still = int((change == 0.0).sum())
    if still <= _COARSE_SHARE * len(change) or still == len(change):
        return 0, 0.0
    values = np.unique(x)
    step = float(np.median(np.diff(values)))
    moved = float(np.median(change[change > 0.0]))
    # Steps of one unit mean a coarse record; larger steps mean a valve at rest.
    return (still, step) if moved < 2.0 * step else (0, 0.0)


def faults(
    table: SampleTable, step_s: float, held: bool = False
) -> tuple[BoolArray, tuple[Fault, ...]]:
    """Search for faults in every signal.

    Parameters
    ----------
    table : SampleTable
    step_s : float
        Step of its rows.
    held : bool
        The log was compressed: constant values and steps of the dead band are not faults.

    Returns
    -------
    bad : bool (rows, 5)
        Invalid values.
    found : tuple of Fault
    """
    bad = np.zeros(table.values.shape, dtype=bool)
    found = []
    for info in SIGNALS:
        x = table.column(info.signal)
        if not info.required or not np.isfinite(x).any() or np.nanmax(x) == np.nanmin(x):
            continue
        still, step = (0, 0.0) if held else _coarse(x)
        wild, height = _spikes(x)
        # A coarse signal is often constant; that is already reported.
        flat, longest = np.zeros(len(x), dtype=bool), 0.0
        if not still and not held:
            rests = _at_stop(x) if info.signal == Signal.VALVE_OPENING else None
            flat, longest = _flat(x, step_s, rests)
        if flat.any():
            found.append(Fault('flatline', info, int(flat.sum()), longest))
        if wild.any():
            found.append(Fault('spikes', info, int(wild.sum()), height))
        if still:
            found.append(Fault('quantisation', info, still, step))
        bad[:, info.signal] = flat | wild
    return bad, tuple(found)
