"""Single wild values in a record: disturbed transmission.

Their times are a Poisson process and their signs random, drawn from a
generator of their own, so that ``pattern`` names one fixed set of them.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from valveflow_ros.config import Parameter
from valveflow_ros.plant.effect import SIGNAL, Effect, Values
from valveflow_ros.plant.hooks import DAY_S, Hooks, Written
from valveflow_ros.records import FloatArray


def _draw(values: Values) -> Iterator[tuple[float, float]]:
    """Yield time in seconds and sign of one spike after the other."""
    rng = np.random.default_rng([int(values['pattern']), 2])
    now = 0.0
    while True:
        now += DAY_S * rng.exponential(1.0 / values['per_day'])
        yield now, 1.0 if rng.random() < 0.5 else -1.0


def spikes(values: Values, length_s: float) -> FloatArray:
    """Return time in seconds and sign of every spike of a run, (k, 2)."""
    rows = []
    for now, sign in _draw(values):
        if now >= length_s:
            break
        rows.append((now, sign))
    return np.array(rows).reshape(-1, 2)


def install(values: Values, hooks: Hooks) -> None:
    """Add the spikes to the recorded signal."""
    signal = values.signal()
    h = hooks.unit.sample_period_s
    drawn = spikes(values, hooks.length_s)
    row_of_spike, sign = np.floor(drawn[:, 0] / h), drawn[:, 1]

    def change(rows: Written) -> None:
        if rows.time_s.size == 0:
            return
        place = row_of_spike - round(rows.time_s[0] / h)
        here = (place >= 0) & (place < rows.time_s.size)
        np.add.at(rows.columns[signal], place[here].astype(int), values['height'] * sign[here])

    hooks.writing.append(change)


def starts_days(values: Values) -> float:
    """Return when the first spike comes."""
    return next(_draw(values))[0] / DAY_S


EFFECT = Effect(
    'spikes',
    'A recorded signal has single wild values.',
    (
        SIGNAL,
        Parameter('height', 20.0, "the signal's", 'Height, up or down.', 0.0, 1e4),
        Parameter('per_day', 10.0, '1/d', 'How many a day on average.', 0.01, 10_000.0),
        Parameter('pattern', 1, '', 'Which set of times and signs.', 0, 2**31 - 1),
    ),
    install,
    starts_days=starts_days,
)
