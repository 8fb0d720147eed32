"""How a diagnosis is put for people: its variables, its parameters, times as dates."""

from __future__ import annotations

import math
from collections.abc import Sequence

from valveflow_ros.diagnosis.estimate import Estimate, dates, told
from valveflow_ros.report.numbers import UNKNOWN, interval, plain
from valveflow_ros.report.words import input_unit, input_unit_plain

# What the residual is held against: in a sentence, at an axis, at a narrow one, and what a
# line that leaves the band there points to.
_VARIABLES = {
    'u': (
        'the integrated input u', 'integrated input u ({unit})', '',
        'A bend or a step here points to the shape of the curve.',
    ),
    'pressure given u': (
        'the steam pressure given u', 'pressure above its usual at that u (MPa)',
        'pressure above usual (MPa)',
        'A tilt here points to the pressure exponent or to a flow that is choked.',
    ),
    'temperature': (
        'the steam temperature', 'main steam temperature (°C)', 'steam temperature (°C)',
        'A tilt here points to steam temperature or reheating.',
    ),
    'time': (
        'time', 'time (UTC)', '',
        'A step points to something that happened then, a slope to wear or drift.',
    ),
    'time of day': (
        'the time of day', 'time of day (h UTC)', '',
        'A wave here points to cooling water or ambient temperature.',
    ),
    'ramp': (
        'the ramp rate', 'change of u in 3 min ({unit})', '',
        'A tilt here points to lag and delay, or to a valve that is slower than its command.',
    ),
    'direction': (
        'the direction of motion', 'last motion (−1 closing, +1 opening)',
        'last motion (−1 to +1)',
        'A difference between the two ends points to backlash or stiction.',
    ),
}  # fmt: skip
_MOST_SPANS = 20


def variable(name: str) -> str:
    """Return a variable as it stands in a sentence."""
    return _VARIABLES[name][0] if name in _VARIABLES else name


def axis_title(name: str, exponent: float) -> str:
    """Return what stands at the axis of a variable, as HTML; the exponent is that of u."""
    if name not in _VARIABLES:
        return name
    return _VARIABLES[name][1].replace('{unit}', input_unit(exponent))


def axis_titles(name: str, exponent: float) -> dict[str, str]:
    """Return what stands at an axis, and at a narrow one, as HTML."""
    short = _VARIABLES[name][2] if name in _VARIABLES else ''
    return {'text': axis_title(name, exponent), **({'short': short} if short else {})}


def points_to(name: str) -> str:
    """Return what a line that leaves the band points to; '' where nothing is known."""
    return _VARIABLES[name][3] if name in _VARIABLES else ''


def cells(estimate: Estimate, exponent: float) -> tuple[str, str]:
    """Return a parameter with its unit, and its 95 % interval; a time and its own as dates."""
    if estimate.origin_ns is not None:
        at, between = dates(estimate)
        return at, between or UNKNOWN
    unit = estimate.unit.replace(input_unit_plain(math.nan), input_unit_plain(exponent))
    value = f'{plain(estimate.value)} {unit}'.strip()
    return value, interval(estimate.low, estimate.high)


def times_in_effect(switches_s: Sequence[float], start_ns: int, end_ns: int) -> str:
    """Return when a cause was in effect that is switched in and out, as dates.

    Parameters
    ----------
    switches_s : sequence of float
        In, out, in, ...: seconds after the first row.
    start_ns, end_ns : int
        First and last row.
    """
    moments = [told(start_ns, s) for s in switches_s]
    if len(moments) % 2:
        moments.append(told(end_ns, 0.0))
    spans = [f'{a} to {b}' for a, b in zip(moments[::2], moments[1::2], strict=True)]
    shown = '; '.join(spans[:_MOST_SPANS])
    more = len(spans) - _MOST_SPANS
    return f'{shown}; and {more} times more' if more > 0 else shown
