"""A record with a coarse step: few bits, or a historian's dead band.

Every value is rounded to the nearest multiple of ``step``.
"""

from __future__ import annotations

import numpy as np

from valveflow_ros.config import Parameter
from valveflow_ros.plant.effect import SIGNAL, Effect, Values
from valveflow_ros.plant.hooks import Hooks, Written


def install(values: Values, hooks: Hooks) -> None:
    """Round the recorded values coarsely."""
    signal, step = values.signal(), values['step']
    if step == 0.0:
        return

    def change(rows: Written) -> None:
        rows.columns[signal] = step * np.round(rows.columns[signal] / step)

    hooks.writing.append(change)


EFFECT = Effect(
    'quantisation',
    'A recorded signal has a coarse step.',
    (
        SIGNAL,
        Parameter('step', 5.0, "the signal's", 'Step of the record; 0: none.', 0.0, 100.0),
    ),
    install,
)
