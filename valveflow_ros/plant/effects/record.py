# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Faults of the record only: another clock, constant values, coarse steps, spikes."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from valveflow_ros.parameters import Parameter
from valveflow_ros.plant.effect import (  # fmt: skip
    DAY_S,
    ONSET,
    SIGNAL,
    HistorianRows,
    Hooks,
    Values,
    effect,
)
from valveflow_ros.records import FloatArray


@effect(
    'The power is stamped earlier (or later) than it was measured.',
    Parameter('d_s', 12.0, 's', 'How much too early; negative: too late.', -600.0, 600.0),
)
def clock(values: Values, hooks: Hooks) -> None:
    """The stamps of the power come from another clock.

        y in the row of time t was measured at t + d

    With d > 0 the response seems to come before its cause. Power and its noise are
    shifted together; the control of the unit uses no stamps and is not affected.
    """
    hooks.claim('clock')
    hooks.lead_s = values['d_s']


@effect(
    'A recorded signal stands still for a while.',
    SIGNAL,
    Parameter('minutes', 120.0, 'min', 'How long.', 0.0, 1e6),
    ONSET,
)
def flatline(values: Values, hooks: Hooks) -> None:
    """A recorded value is constant: a stuck transmitter or a gateway that repeats a value.

    After the onset the last value is repeated in the record; the plant is not affected.
    """
    signal, start = values.signal(), values['t0_days'] * DAY_S
    end = start + values['minutes'] * 60.0
    held = np.nan

    def change(rows: HistorianRows) -> None:
        nonlocal held
        first, last = np.searchsorted(rows.time_s, (start, end))
        if first < last:
            column = rows.columns[signal]
            held = column[first] if np.isnan(held) else held
            column[first:last] = held

    hooks.writing.append(change)


@effect(
    'A recorded signal has a coarse step.',
    SIGNAL,
    Parameter('step', 5.0, "the signal's", 'Step of the record; 0: none.', 0.0, 100.0),
)
def quantisation(values: Values, hooks: Hooks) -> None:
    """The record has a coarse resolution: few bits, or a historian's dead band.

    Every value is rounded to the nearest multiple of ``step``.
    """
    signal, step = values.signal(), values['step']
    if step == 0.0:
        return

    def change(rows: HistorianRows) -> None:
        rows.columns[signal] = step * np.round(rows.columns[signal] / step)

    hooks.writing.append(change)


def _draw(values: Values) -> Iterator[tuple[float, float]]:
    """Yield time in seconds and sign of successive spikes."""
    rng = np.random.default_rng([int(values['pattern']), 2])
    now = 0.0
    while True:
        now += DAY_S * rng.exponential(1.0 / values['per_day'])
        yield now, 1.0 if rng.random() < 0.5 else -1.0


def spikes_s(values: Values, length_s: float) -> FloatArray:
    """Return time in seconds and sign of every spike of a run, (k, 2)."""
    rows = itertools.takewhile(lambda row: row[0] < length_s, _draw(values))
    return np.array(list(rows)).reshape(-1, 2)


@effect(
    'A recorded signal has single outliers.',
    SIGNAL,
    Parameter('height', 20.0, "the signal's", 'Height, up or down.', 0.0, 1e4),
    Parameter('per_day', 10.0, '1/d', 'How many a day on average.', 0.01, 10_000.0),
    Parameter('pattern', 1, '', 'Which set of times and signs.', 0, 2**31 - 1),
    starts_days=lambda values: next(_draw(values))[0] / DAY_S,
)
def spikes(values: Values, hooks: Hooks) -> None:
    """The record has single outliers: disturbed transmission.

    Their times are a Poisson process and their signs are random. They come from a
    separate random generator, so that ``pattern`` defines a fixed set of them.
    """
    signal = values.signal()
    h = hooks.unit.sample_period_s
    drawn = spikes_s(values, hooks.length_s)
    row_of_spike, sign = np.floor(drawn[:, 0] / h), drawn[:, 1]

    def change(rows: HistorianRows) -> None:
        if rows.time_s.size == 0:
            return
        place = row_of_spike - round(rows.time_s[0] / h)
        here = (place >= 0) & (place < rows.time_s.size)
        np.add.at(rows.columns[signal], place[here].astype(int), values['height'] * sign[here])

    hooks.writing.append(change)
