"""Now and then part of the steam or of the heat goes elsewhere.

An extraction or a feed water heater is in or out of service for hours:

    x = F(u) (1 + g w(t)),  w = 0 or 1

w begins with 0; how long it stays is drawn uniformly between two bounds, from
a generator of its own, so that ``pattern`` names one fixed sequence of times.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from valveflow_ros.config import Parameter
from valveflow_ros.plant.effect import Effect, Values
from valveflow_ros.plant.hooks import DAY_S, Forcing, Hooks
from valveflow_ros.records import FloatArray

_HOUR_S = 3600.0


def _draw(values: Values) -> Iterator[tuple[float, float]]:
    """Yield start and end of one interval after the other, in seconds."""
    rng = np.random.default_rng([int(values['pattern']), 1])
    end = 0.0
    while True:
        start = end + _HOUR_S * rng.uniform(values['off_low_h'], values['off_high_h'])
        end = start + _HOUR_S * rng.uniform(values['on_low_h'], values['on_high_h'])
        yield start, end


def intervals_s(values: Values, length_s: float) -> FloatArray:
    """Return start and end of every interval that begins in a run, (k, 2), in seconds."""
    rows = []
    for start, end in _draw(values):
        if start >= length_s:
            break
        rows.append((start, end))
    return np.array(rows).reshape(-1, 2)


def install(values: Values, hooks: Hooks) -> None:
    """Multiply x inside the intervals."""
    edges = intervals_s(values, hooks.length_s).ravel()

    def change(rows: Forcing) -> None:
        inside = np.searchsorted(edges, rows.time_s, side='right') % 2
        rows.gain[:] *= 1.0 + values['g'] * inside

    hooks.forcing.append(change)


def starts_days(values: Values) -> float:
    """Return when the first interval begins."""
    return next(_draw(values))[0] / DAY_S


def problem(values: Values) -> str:
    """Say which bounds are the wrong way round."""
    for state in ('on', 'off'):
        if values[f'{state}_low_h'] > values[f'{state}_high_h']:
            return f'{state}_low_h must not exceed {state}_high_h'
    return ''


EFFECT = Effect(
    'intervals',
    'For hours at a time the power belonging to a flow is another one.',
    (
        Parameter('g', -0.01, '', 'Relative change inside an interval.', -0.2, 0.2),
        Parameter('on_low_h', 5.0, 'h', 'Shortest interval.', 0.1, 1000.0),
        Parameter('on_high_h', 22.0, 'h', 'Longest interval.', 0.1, 1000.0),
        Parameter('off_low_h', 24.0, 'h', 'Shortest pause.', 0.1, 1000.0),
        Parameter('off_high_h', 60.0, 'h', 'Longest pause.', 0.1, 1000.0),
        Parameter('pattern', 1, '', 'Which sequence of times.', 0, 2**31 - 1),
    ),
    install,
    starts_days=starts_days,
    problem=problem,
)
