# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Covariates: further columns, such as the condenser vacuum, in step with the rows of the signals.

An entry is the text ``NAME=COLUMN:UNIT``, with an empty unit if it is unknown. A saved window has
the values of a covariate under its entry.
"""

from __future__ import annotations

import numpy as np

from valveflow_ros.records import NS_PER_S, FloatArray, IntArray

_HOLD_NS = 300 * NS_PER_S
# A slower column holds this many of its usual steps; the usual step is a median of so many.
_STEPS, _LAST = 2.5, 3


def entry(name: str, column: str, unit: str) -> str:
    """Return the entry of a covariate."""
    return f'{name}={column}:{unit}'


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
