"""A record that stands still: a stuck transmitter or a gateway that repeats itself.

From the onset the last value is written again and again; the plant goes on.
"""

from __future__ import annotations

import numpy as np

from valveflow_ros.config import Parameter
from valveflow_ros.plant.effect import ONSET, SIGNAL, Effect, Values, at_onset
from valveflow_ros.plant.hooks import DAY_S, Hooks, Written


def install(values: Values, hooks: Hooks) -> None:
    """Hold the recorded value for a while."""
    signal, start = values.signal(), values['t0_days'] * DAY_S
    end = start + values['minutes'] * 60.0
    held = np.nan

    def change(rows: Written) -> None:
        nonlocal held
        first, last = np.searchsorted(rows.time_s, (start, end))
        if first < last:
            column = rows.columns[signal]
            held = column[first] if np.isnan(held) else held
            column[first:last] = held

    hooks.writing.append(change)


EFFECT = Effect(
    'flatline',
    'A recorded signal stands still for a while.',
    (
        SIGNAL,
        Parameter('minutes', 120.0, 'min', 'How long.', 0.0, 1e6),
        ONSET,
    ),
    install,
    starts_days=at_onset,
)
