# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Definition of a cause: a parametric change of the model and a method to search for it."""

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

# A number with its 95 % interval, and the output of times as UTC dates.

DAY_S = 86_400.0
_DAY, _HOUR, _MINUTE = 86_400, 3_600, 60
_STEPS = (_DAY, _HOUR, 10 * _MINUTE)
_OF_INTERVAL = 5  # interval ends are rounded to at most a fifth of the interval length


@dataclass(frozen=True, slots=True)
class Estimate:
    """A value with its 95 % interval; ``low`` and ``high`` are NaN if unknown.

    Attributes
    ----------
    value, low, high : float
    unit : str
    origin_ns : int or None
        For a time in days: its origin, ns since 1970 UTC. None: the value is not a time.
    """

    value: float
    low: float
    high: float
    unit: str
    origin_ns: int | None = None

    @property
    def full_unit(self) -> str:
        """Return the unit; a time includes its origin: 'days since 2025-03-04 ...'."""
        if self.origin_ns is None:
            return self.unit
        return f'days since {_written(self.origin_ns // NS_PER_S, "s")} UTC'

    @property
    def known(self) -> bool:
        """Return True if there is an interval."""
        return math.isfinite(self.low) and math.isfinite(self.high)


def dates(e: Estimate) -> tuple[str, str]:
    """Return a time and its interval as dates; the second is '' if there is no interval.

    Times are given to the minute; with a long interval to ten minutes, an hour or a day. The ends
    of the interval are rounded outwards, so that it keeps its coverage.

    Raises
    ------
    ValueError
        The estimate is not a time.
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
    """Return a time rounded to a step: '2025-03-04 05:06 UTC'; '2025-03-04' for whole days.

    Parameters
    ----------
    origin_ns : int
        Ns since 1970 UTC.
    after_s : float
        Time after the origin.
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
_OPENING_UNIT = 0.04  # this many % of opening correspond to one unit of V p^m


def axis_unit(form: StaticForm) -> float:
    """Return the length on the axis of a form that corresponds to one unit of V p^m."""
    return _OPENING_UNIT if form.scaled else 1.0


# A value above this fraction of its upper bound suggests that the cause is another one.
_END = 0.95
_Z95 = 1.959963984540054


class Stage(enum.IntEnum):
    """Place in the plant where a cause acts, from the position sensor to the power meter.

    Arguments and result of ``act`` of a cause:

    - ``OPENING``: (v in % (nn,), values, grids) -> the opening downstream of the fault
    - ``INPUT``: (u (n,), values, grids, model) -> a factor on u
    - ``FLOW``: (u (n,), values, grids) -> MW added to x = F(u)
    - ``GAIN``: (values, grids, extra) -> a factor on x
    - ``DYNAMICS``: (model, values) -> a model with other dynamics
    - ``OUTPUT``: (y (n,) in MW, values, grids) -> the measured power
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
        Step for finite differences; about a tenth of a relevant change.
    low, high : float
        Bounds of plausible values.
    kind : Kind
        ``LINE`` parameters are found by a line search with first step ``step`` (the cost is
        not smooth in them). ``HELD`` ones stay fixed. The others are found by Gauss-Newton.
    concealed : float
        Part of it that has no effect on any record; added to the upper end of the interval.
    dated : bool
        True for a time in days after the first row; users see it as a date.
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
        """Return the parameter for a form; positions on the curve are in the unit of its axis."""
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


_BY_U = 'u = {:.4g}'.format


class SentenceValues(dict[str, float]):
    """Parameter values by name, for a sentence.

    Attributes
    ----------
    onset : str
        Date of the onset with its interval; empty for a cause without an onset.
    unsure : frozenset of str
        Names of values that are smaller than their standard error.
    place : callable
        Returns a value of u in words of an operator.
    """

    def __init__(
        self, values: Mapping[str, float], onset: str = '', unsure: Iterable[str] = (),
        place: Callable[[float], str] = _BY_U,
    ) -> None:  # fmt: skip
        super().__init__(values)
        self.onset, self.place = onset, place
        self.unsure = frozenset(unsure)


@dataclass(frozen=True, slots=True)
class Start:
    """Initial values for a full fit and their expected gain.

    ``gain`` is the gain in log-likelihood on the open blocks. ``extra`` holds values that are not
    fitted as numbers (the switching times). ``base`` gives the initial curve and dynamics if those
    of the plain model already explain much of the cause.
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
        Name in the catalogue.
    family : str
        Causes of one family are always compared with each other.
    stage : Stage
    unknowns : tuple of Unknown
    act : callable
        See `Stage`.
    starts : callable
        Takes the `Screening` and returns promising initial values; empty if there are none.
    sentence : callable
        Takes `SentenceValues` and returns a sentence about the fault for an operator.
    hindered : callable
        Returns why the record cannot show this cause; empty if it can.
    confusers : tuple of str
        Names of causes with similar effects.
    experiment : str
        Experiment that would distinguish them.
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
    slow: bool = False  # can be confused with a slow disturbance of the power
    # Estimates the hidden state (``extra``) from the allowed sub-blocks, for a given size.
    infer: Callable[[Any, FittedCause, BoolArray], Values] | None = None
    of_model: bool = False  # a free identification may include it in the model
    order: int = 0  # order among causes of one stage: from the actuator to the plug
    # Number of simulated noise paths, and the ``act`` of a single one; see `fitting.beliefs`.
    draws: int = 0
    draw: Callable[[int], Callable[..., Any]] | None = None
    # A simpler cause that is a special case, and such special values near given ones.
    contains: str = ''
    simpler: Callable[[Values], list[Values]] | None = None
    # Families that cannot be judged together with it: its remaining error looks like them.
    conceals: tuple[str, ...] = ()
    # The column that the power follows, if any.
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
class FittedCause:
    """A cause with parameter values, as part of an extended model."""

    cause: Cause
    values: Values
    extra: Values = ()

    @property
    def name(self) -> str:
        """Return the name in the catalogue."""
        return self.cause.name

    @property
    def size(self) -> int:
        """Return the number of values determined from the data; each switching time counts."""
        return len(self.values) + len(self.extra)

    def named(self) -> dict[str, float]:
        """Return the values by name."""
        return {u.name: v for u, v in zip(self.cause.unknowns, self.values, strict=True)}

    @property
    def changes_h(self) -> tuple[float, ...]:
        """Return when it begins or changes, in hours since the first row."""
        pairs = zip(self.cause.unknowns, self.values, strict=True)
        onsets = tuple(24.0 * v for u, v in pairs if u.dated)
        return (*onsets, *(s / 3600.0 for s in self.extra))

    @property
    def beyond(self) -> str:
        """Return a sentence about a value near its upper bound; empty if there is none."""
        for unknown, value in zip(self.cause.unknowns, self.values, strict=True):
            if value >= _END * unknown.high > 0.0:
                return (
                    f'its {unknown.name} would have to be {unknown.high:g} {unknown.unit} or more'
                ).replace('  ', ' ')
        return ''

    def sentence(
        self, start_ns: int, estimates: Mapping[str, Estimate] | None = None,
        place: Callable[[float], str] = _BY_U,
    ) -> str:  # fmt: skip
        """Return a sentence about the fault for an operator.

        Parameters
        ----------
        start_ns : int
            Time of the first row, ns since 1970 UTC.
        estimates : mapping, optional
            The values with their intervals, by name; without them no intervals are reported.
        place : callable, optional
            Returns a value of u in words of an operator.
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
        return self.cause.sentence(SentenceValues(values, onset, unsure, place))
