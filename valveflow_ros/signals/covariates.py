# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Covariates: further columns, such as the condenser vacuum, in step with the rows of the signals.

An entry is the text ``NAME=COLUMN:UNIT``, with an empty unit if it is unknown. A saved window has
the values of a covariate under its entry.
"""

from __future__ import annotations

import math

import numpy as np

from valveflow_ros.parameters import Settings, covariate_columns
from valveflow_ros.records import NS_PER_S, FloatArray, IntArray
from valveflow_ros.state import State

_HOLD_NS = 300 * NS_PER_S
# A slower column holds this many of its usual steps; the usual step is a median of so many.
_STEPS, _LAST = 2.5, 3
# Most values that wait for rows, if the signals are silent.
_MOST_WAITING = 1000


def entry(name: str, column: str, unit: str) -> str:
    """Return the entry of a covariate."""
    return f'{name}={column}:{unit}'


def entries_of(settings: Settings) -> tuple[str, ...]:
    """Return the entries of the parameter ``covariates``, with the topic as the column."""
    said = covariate_columns(settings.text('covariates').split())
    return tuple(entry(name, *theirs.partition(':')[::2]) for name, theirs in said.items())


def parts(text: str) -> tuple[str, str, str]:
    """Return name, column and unit of an entry."""
    name, _, rest = text.partition('=')
    column, _, unit = rest.rpartition(':')
    return name, column, unit


def held(time_ns: IntArray, values: FloatArray, rows_ns: IntArray) -> FloatArray:
    """Return the newest value at each row, NaN if it is too old.

    Parameters
    ----------
    time_ns : int64 (k,)
        Times of the values, not decreasing.
    values : float64 (k,)
    rows_ns : int64 (n,)

    Returns
    -------
    float64 (n,)
        A value holds until the next one, for at most 300 s, or 2.5 of its usual steps if that is
        longer. The usual step is the median of the last three before it.
    """
    if not len(time_ns):
        return np.full(len(rows_ns), np.nan)
    longest = np.full(len(time_ns), _HOLD_NS)
    if len(time_ns) > _LAST:
        steps = np.lib.stride_tricks.sliding_window_view(np.diff(time_ns), _LAST)
        usual = (_STEPS * np.median(steps, axis=1)).astype(np.int64)
        longest[_LAST:] = np.maximum(usual, _HOLD_NS)
    last = np.searchsorted(time_ns, rows_ns, side='right') - 1
    there = (last >= 0) & (rows_ns - time_ns[last] <= longest[last])
    return np.where(there, values[last], np.nan)


class Arriving:
    """Values of covariates as they arrive, and their values at the rows that are closed.

    A value belongs to the rows closed after its arrival. It replaces the values with later times,
    so that a wrong time, or a clock that is set back, does no lasting harm.

    Parameters
    ----------
    entries : tuple of str
    """

    def __init__(self, entries: tuple[str, ...]) -> None:
        self._entries = entries
        self._time_ns: list[list[int]] = [[] for _ in entries]
        self._values: list[list[float]] = [[] for _ in entries]

    def take(self, number: int, time_ns: int, value: float) -> None:
        """Take a value of the covariate of this number; one that is not finite is ignored."""
        times, values = self._time_ns[number], self._values[number]
        if not math.isfinite(value):
            return
        while times and times[-1] >= time_ns:
            times.pop()
            values.pop()
        times.append(time_ns)
        values.append(value)
        del times[:-_MOST_WAITING], values[:-_MOST_WAITING]

    def at(self, rows_ns: IntArray) -> FloatArray:
        """Return the values at rows in order of time, (rows, covariates); forget older ones."""
        found = np.empty((len(rows_ns), len(self._entries)))
        for k, (times, values) in enumerate(zip(self._time_ns, self._values, strict=True)):
            known_ns = np.array(times, dtype=np.int64)
            found[:, k] = held(known_ns, np.array(values), rows_ns)
            if len(rows_ns):
                last = int(np.searchsorted(known_ns, rows_ns[-1], side='right')) - 1
                del times[: max(0, last - _LAST)], values[: max(0, last - _LAST)]
        return found

    def snapshot(self) -> State:
        """Return the state to be saved."""
        columns = zip(self._entries, self._time_ns, self._values, strict=True)
        return {entry: [list(times), list(values)] for entry, times, values in columns}

    def restore(self, saved: State) -> None:
        """Continue from a saved state; covariates that it does not have begin anew."""
        for k, entry in enumerate(self._entries):
            self._time_ns[k], self._values[k] = map(list, saved.get(entry, ([], [])))
