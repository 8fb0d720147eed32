"""A number with its 95 % interval, and how a time is told: as dates in UTC."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from valveflow_ros.records import NS_PER_S

DAY_S = 86_400.0
_DAY, _HOUR, _MINUTE = 86_400, 3_600, 60
_STEPS = (_DAY, _HOUR, 10 * _MINUTE)
_OF_INTERVAL = 5  # an interval is told in steps of at most a fifth of its length


@dataclass(frozen=True, slots=True)
class Estimate:
    """A value with its 95 % interval; ``low`` and ``high`` are NaN where not known.

    Attributes
    ----------
    value, low, high : float
    unit : str
    origin_ns : int or None
        Of a time in days: what it counts from, ns since 1970 UTC. None: it is no time.
    """

    value: float
    low: float
    high: float
    unit: str
    origin_ns: int | None = None

    @property
    def full_unit(self) -> str:
        """Return the unit; of a time with what it counts from: 'days since 2025-03-04 ...'."""
        if self.origin_ns is None:
            return self.unit
        return f'days since {_written(self.origin_ns // NS_PER_S, "s")} UTC'

    @property
    def known(self) -> bool:
        """Tell whether there is an interval."""
        return math.isfinite(self.low) and math.isfinite(self.high)


def dates(e: Estimate) -> tuple[str, str]:
    """Return a time and its interval as dates, '' where there is no interval.

    They are told to the minute, of long intervals to ten minutes, an hour or a day. The ends of
    the interval are rounded outwards, so that it goes on covering what it covers.

    Raises
    ------
    ValueError
        The estimate is no time.
    """
    if e.origin_ns is None:
        raise ValueError('This estimate is no time.')
    step_s = _step_s(DAY_S * (e.high - e.low)) if e.known else _MINUTE
    at = told(e.origin_ns, DAY_S * e.value, step_s)
    if not e.known:
        return at, ''
    ends = DAY_S * e.low - 0.5 * step_s, DAY_S * e.high + 0.5 * step_s
    return at, ' to '.join(told(e.origin_ns, end, step_s) for end in ends)


def told(origin_ns: int, after_s: float, step_s: int = _MINUTE) -> str:
    """Write a time rounded to a step: '2025-03-04 05:06 UTC', of whole days '2025-03-04'.

    Parameters
    ----------
    origin_ns : int
        Ns since 1970 UTC.
    after_s : float
        How long after it.
    """
    second = origin_ns // NS_PER_S + math.floor(after_s + 0.5 * step_s)
    rounded = second - second % step_s
    return _written(rounded, 'D') if step_s >= _DAY else f'{_written(rounded, "m")} UTC'


def _written(second: int, unit: str) -> str:
    return str(np.datetime64(second, 's').astype(f'datetime64[{unit}]')).replace('T', ' ')


def _step_s(width_s: float) -> int:
    return next((s for s in _STEPS if s * _OF_INTERVAL <= width_s), _MINUTE)
