# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a cause is: a change of the model with parameters, and a way to look for it."""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.diagnosis.grids import Covariate, Grids
from valveflow_ros.records import NS_PER_S, BoolArray
from valveflow_ros.signals.static_form import StaticForm

# A number with its 95 % interval, and how a time is told: as dates in UTC.

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


Values = tuple[float, ...]
U_UNIT = '% MPa^m'
_OPENING_UNIT = 0.04  # % of opening move as much as one unit of V p^m does


def axis_unit(form: StaticForm) -> float:
    """Return how much of the axis of a form is as much as one unit of V p^m."""
    return _OPENING_UNIT if form.scaled else 1.0


# So near to the end of what a plant can have the data ask for something else.
_END = 0.95
_Z95 = 1.959963984540054


class Stage(enum.IntEnum):
    """Where in the plant a cause acts, from the position sensor to the power meter.

    What ``act`` of a cause takes and returns:

    - ``OPENING``: (v in % (nn,), values, grids) to the opening behind the fault
    - ``INPUT``: (u (n,), values, grids, model) to a factor on u
    - ``FLOW``: (u (n,), values, grids) to MW added to x = F(u)
    - ``GAIN``: (values, grids, extra) to a factor on x
    - ``DYNAMICS``: (model, values) to a model with other dynamics
    - ``OUTPUT``: (y (n,) in MW, values, grids) to the power shown
    """

    OPENING = 0
    INPUT = 1
    FLOW = 2
    GAIN = 3
    DYNAMICS = 4
    OUTPUT = 5


class Kind(enum.Enum):
    """How a parameter is estimated and how its interval is found."""

    SMOOTH = 'smooth'
    ROUGH = 'rough'
    LINE = 'line'
    HELD = 'held'


@dataclass(frozen=True, slots=True)
class Unknown:
    """A parameter of a cause.

    Attributes
    ----------
    name, unit : str
    step : float
        For differences; about a tenth of what matters.
    low, high : float
        Bounds of what a plant can have.
    kind : Kind
        ``LINE`` parameters are moved by a line search that begins with ``step`` (the cost
        is not smooth in them), ``HELD`` ones not at all, the others by Gauss-Newton.
    concealed : float
        How much larger it may be without showing in any record; belongs to its interval.
    dated : bool
        It is a time in days after the first row, and people are told its date.
    """

    name: str
    unit: str
    step: float
    low: float
    high: float
    kind: Kind = Kind.SMOOTH
    concealed: float = 0.0
    dated: bool = False

    def on(self, form: StaticForm) -> Unknown:
        """Return it for curves of a form; a place on the curve is in the unit of their axis."""
        if self.unit != U_UNIT or not form.scaled:
            return self
        one = axis_unit(form)
        return replace(
            self, unit='%', step=one * self.step, low=one * self.low, high=one * self.high
        )

    def step_on(self, grids: Grids) -> float:
        """Return the step for differences, in proportion to the output."""
        if self.unit.endswith('/MW'):
            return self.step / grids.size
        return self.step * (grids.size if self.unit.startswith('MW') else 1.0)


class SentenceValues(dict[str, float]):
    """Values by name, for a sentence.

    Attributes
    ----------
    onset : str
        When it set in, as a date with its interval; empty for a cause without an onset.
    unsure : frozenset of str
        Names of values that their standard error exceeds.
    """

    def __init__(
        self, values: Mapping[str, float], onset: str = '', unsure: Iterable[str] = ()
    ) -> None:
        super().__init__(values)
        self.onset = onset
        self.unsure = frozenset(unsure)


@dataclass(frozen=True, slots=True)
class Start:
    """Values to begin a full fit from, and what screening expects of them.

    ``gain`` is a log-likelihood on the open blocks; ``extra`` holds what is not a number
    to be fitted (the times of switches); ``base`` is the curve and the dynamics to begin with
    where those of the plain model have swallowed much of the cause.
    """

    values: Values
    gain: float
    extra: Values = ()
    base: RegionalModel | None = None


@dataclass(frozen=True, slots=True)
class Cause:
    """One entry of the catalogue.

    Attributes
    ----------
    name : str
        The catalogue's word.
    family : str
        Causes of one family are always tried against each other.
    stage : Stage
    unknowns : tuple of Unknown
    act : callable
        See `Stage`.
    starts : callable
        Takes the `Screening` and returns promising values, none if there are none.
    sentence : callable
        Takes what is to be told (see `SentenceValues`) and says what is wrong, for an operator.
    hindered : callable
        Why the record cannot judge this cause; empty if it can.
    confusers : tuple of str
        Names of causes that look alike.
    experiment : str
        What would tell them apart.
    """

    name: str
    family: str
    stage: Stage
    unknowns: tuple[Unknown, ...]
    act: Callable[..., Any]
    starts: Callable[[Any], Sequence[Start]]
    sentence: Callable[[SentenceValues], str]
    confusers: tuple[str, ...]
    experiment: str
    hindered: Callable[[Grids], str] = field(default=lambda grids: '')
    slow: bool = False  # a slow wander of the power could be mistaken for it
    # Infers what is hidden (``extra``) from the sub-blocks allowed, for a given size.
    infer: Callable[[Any, Active, BoolArray], Values] | None = None
    of_model: bool = False  # an identification that is free to choose may find it too
    order: int = 0  # among causes of one stage: from the oil to the plug
    # How many paths the noise may make of it, and what acts in one of them; see `draws`.
    draws: int = 0
    draw: Callable[[int], Callable[..., Any]] | None = None
    # A simpler cause it becomes at some values, and those values near given ones.
    contains: str = ''
    simpler: Callable[[Values], list[Values]] | None = None
    # Families that cannot be judged beside it, since what it leaves open looks like them.
    conceals: tuple[str, ...] = ()
    # What it follows, if that is a column beside the signals.
    covariate: Covariate | None = None

    def on(self, form: StaticForm) -> Cause:
        """Return the cause for curves of a form; see `Unknown.on`."""
        return replace(self, unknowns=tuple(u.on(form) for u in self.unknowns))

    def clipped(self, values: Values) -> Values:
        """Return values within the bounds."""
        return tuple(
            min(max(v, u.low), u.high) for v, u in zip(values, self.unknowns, strict=True)
        )


@dataclass(frozen=True, slots=True)
class Active:
    """A cause with values: a part of an extended model."""

    cause: Cause
    values: Values
    extra: Values = ()

    @property
    def name(self) -> str:
        """Return the catalogue's word."""
        return self.cause.name

    @property
    def size(self) -> int:
        """Return how many numbers were chosen from the data; every switch is one."""
        return len(self.values) + len(self.extra)

    def named(self) -> dict[str, float]:
        """Return the values by name."""
        return {u.name: v for u, v in zip(self.cause.unknowns, self.values, strict=True)}

    @property
    def beyond(self) -> str:
        """Return which value had to go to the end of what a plant can have; empty if none."""
        for unknown, value in zip(self.cause.unknowns, self.values, strict=True):
            if value >= _END * unknown.high > 0.0:
                return (
                    f'its {unknown.name} would have to be {unknown.high:g} {unknown.unit} or more'
                ).replace('  ', ' ')
        return ''

    def sentence(self, start_ns: int, estimates: Mapping[str, Estimate] | None = None) -> str:
        """Return what is wrong, for an operator.

        Parameters
        ----------
        start_ns : int
            Time of the first row, ns since 1970 UTC.
        estimates : mapping, optional
            The values with their intervals, by name; without them none are told.
        """
        values, onset = self.named(), ''
        for u in self.cause.unknowns:
            if u.dated:
                bare = Estimate(values[u.name], math.nan, math.nan, u.unit, start_ns)
                at, between = dates(estimates[u.name] if estimates else bare)
                onset = f'{at} on (95 % interval {between})' if between else f'{at} on'
        unsure = [
            name for name, e in (estimates or {}).items()
            if e.high - e.low > 2.0 * _Z95 * abs(e.value)
        ]  # fmt: skip
        return self.cause.sentence(SentenceValues(values, onset, unsure))
