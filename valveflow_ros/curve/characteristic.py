# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The result: the flow characteristic, its uncertainty, and its data."""

from __future__ import annotations

import hashlib
import itertools
import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.errors import DataError
from valveflow_ros.records import NS_PER_S, FloatArray, IntArray
from valveflow_ros.signals.static_form import INTEGRATED_INPUT, OPENING, StaticForm
from valveflow_ros.signals.units import in_unit

_COMMON_MPA = 10.0


@dataclass(frozen=True, slots=True)
class ChartDesign:
    """The design of a control chart for the residual."""

    block_s: float  # length of a block
    correlation: float  # lag-one correlation of block means, 0 <= correlation < 1
    innovation_mw: float  # sd of a block mean given the previous one
    slack: tuple[float, float]  # per block, in innovations: of the sum for small and large shifts
    limit: tuple[float, float]  # of each sum, in innovations
    run_length_days: float  # mean time between false alarms for which the limits were chosen


@dataclass(frozen=True, slots=True)
class Piece:
    """One line segment of eq. (2); u in % MPa^m, slope in MW per unit of u, intercept in MW."""

    u_from: float
    u_to: float
    slope: float
    intercept: float
    slope_stderr: float
    intercept_stderr: float
    samples: int


@dataclass(frozen=True, slots=True)
class RegionDynamics:
    """First-order dynamics with delay, eq. (3), between two power levels.

    ``power_to_stderr_mw`` is the standard error of the upper level; the last region has none.
    """

    power_from: float
    power_to: float
    time_constant_s: float
    delay_s: float
    time_constant_stderr_s: float
    delay_stderr_s: float
    power_to_stderr_mw: float = math.nan


@dataclass(frozen=True, slots=True)
class Choice:
    """The choice of J: the rule, Omega(J) of eq. (19) and Lambda(J) of eq. (24).

    ``confidence`` is the probability of each J; empty if the rule gives none.
    """

    rule: str
    cost: dict[int, float]
    turning_angle: dict[int, float]
    note: str = ''
    confidence: dict[int, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Support:
    """The data of a piece: numbers of special segments and samples inside it.

    ``levels`` are the distinct steady levels in u. ``identifiable`` is True if the
    condition after Proposition 2 of the paper holds.
    """

    steady: int
    slope_response: int
    samples: int
    levels: tuple[float, ...]
    identifiable: bool


@dataclass(frozen=True, slots=True)
class FittedData:
    """The data to which the curve was fitted."""

    window_start_ns: int
    window_end_ns: int
    steady: int
    slope_response: int
    samples: int
    temperature_mean_degc: float
    temperature_spread_k: float
    temperature_flag: bool

    @classmethod
    def of(
        cls, time_ns: IntArray, steady: int, slope_response: int, temperature_degc: FloatArray,
        spread_limit_k: float,
    ) -> FittedData:  # fmt: skip
        """Describe a window by its times, its segments, and the temperature in the rows used.

        The paper requires a constant temperature; its spread is the range of 95 % of the rows.
        """
        known = temperature_degc[np.isfinite(temperature_degc)]
        mean = spread = math.nan
        if len(known):
            low, high = np.quantile(known, (0.025, 0.975))
            mean, spread = float(known.mean()), float(high - low)
        return cls(
            int(time_ns[0]), int(time_ns[-1]), steady, slope_response, len(temperature_degc),
            mean, spread, bool(spread > spread_limit_k),
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class FormEvidence:
    """Comparison of the form of the curve with the other form, on held-out stretches of time."""

    chosen: str  # 'integrated_input' or 'opening'
    told: bool  # the data decide for the chosen form
    log_likelihood_gain: float  # of the chosen form
    rmse_mw: float  # of means over a minute
    rmse_other_mw: float
    other: str = ''  # the other form with its best exponent
    # Root mean square difference of the two forms over the visited range; opening in %, pressure
    # in MPa and difference where 1 % of the means differ more.
    apart_mw: float = math.nan
    worst: tuple[float, float, float] = (math.nan, math.nan, math.nan)
    contradicted: bool = False  # the form was given, and the data show that it is wrong


@dataclass(frozen=True, slots=True)
class HeldCause:
    """A cause of the diagnosis that was removed from the rows before the curve was fitted.

    ``values`` are its parameters by name; ``sentence`` is the text for the user.
    """

    name: str
    values: tuple[tuple[str, float], ...]
    sentence: str


@dataclass(frozen=True, slots=True)
class ResidualStatistics:
    """Statistics of the residuals of this curve on the data to which it was fitted (MW).

    95 % of single measurements lie within +- ``width_mw`` of the prediction. ``chart`` detects
    a lasting shift; without it there is no alarm. ``wander_mw`` is the sd of the level from
    day to day of a healthy unit (weather), NaN if unknown.
    """

    rmse_mw: float
    average_sd_mw: float
    average_s: float
    input_noise: float
    power_noise_mw: float
    width_mw: float = math.nan
    chart: ChartDesign | None = None
    wander_mw: float = math.nan


# Correlation time of the weather.
_WANDER_NS = 2 * 86_400 * NS_PER_S


def level_error_mw(wander_mw: float, start_ns: int, end_ns: int) -> float:
    """Return the standard error of a mean over a period, due to the variation over days.

    ``wander_mw`` is the sd from day to day; the error is 0 if it is NaN (unknown).
    """
    share = _WANDER_NS / (_WANDER_NS + max(end_ns - start_ns, 0))
    return 0.0 if math.isnan(wander_mw) else wander_mw * math.sqrt(share)


@dataclass(frozen=True, slots=True)
class OpeningsSeen:
    """The openings at which the unit ran in a band of the pressure; 99 % of its rows."""

    pressure_from_mpa: float
    pressure_to_mpa: float
    opening_from_percent: float
    opening_to_percent: float
    samples: int


@dataclass(frozen=True, slots=True)
class Characteristic:
    """A fitted flow characteristic: static power is p^e F(u) + c.

    If causes are ``held``, the curve is that of the plant without them.

    Attributes
    ----------
    pressure_exponent : float
        q of u = V p^q: m of the paper's form, 0 if the breakpoints are at fixed openings.
    axis : str
        'integrated_input' (the paper's: e = 0, c = 0) or 'opening' (q = 0).
    pressure_scale_exponent, offset_mw : float
        e and c.
    reference_pressure_mpa : float
        Median pressure of the data, NaN if unknown; see `shown_at_mpa`.
    form : FormEvidence or None
        Comparison of this form with the other one; None if they were not compared.
    openings_seen : tuple of OpeningsSeen
        By rising pressure, without bands in which the unit did not run; empty if unknown.
    output_unit : str
        MW, or the unit of a flow: all values named ``_mw`` or described as MW have this unit.
    """

    pressure_exponent: float
    pieces: tuple[Piece, ...]
    breakpoint_intervals: tuple[tuple[float, float], ...]
    choice: Choice
    source: FittedData
    residuals: ResidualStatistics
    dynamics: tuple[RegionDynamics, ...] = ()
    partition_pieces: tuple[Piece, ...] = ()
    notes: tuple[str, ...] = ()
    support: tuple[Support, ...] = ()
    model_id: str = field(default='')
    held: tuple[HeldCause, ...] = field(default=(), repr=False)
    axis: str = field(default=INTEGRATED_INPUT, repr=False)
    pressure_scale_exponent: float = field(default=0.0, repr=False)
    offset_mw: float = field(default=0.0, repr=False)
    reference_pressure_mpa: float = field(default=math.nan, repr=False)
    form: FormEvidence | None = field(default=None, repr=False)
    output_unit: str = field(default='MW', repr=False)
    openings_seen: tuple[OpeningsSeen, ...] = field(default=(), repr=False)

    @property
    def static_form(self) -> StaticForm:
        """Return the form with its exponent."""
        scaled = self.axis == OPENING
        return StaticForm(
            self.axis, self.pressure_scale_exponent if scaled else self.pressure_exponent
        )

    @property
    def shown_at_mpa(self) -> float:
        """Return the pressure at which a curve with e > 0 is shown.

        It is the reference pressure, or a usual one if a file of another program has none.
        """
        p = self.reference_pressure_mpa
        return _COMMON_MPA if self.axis == OPENING and math.isnan(p) else p

    @property
    def reference_scale(self) -> float:
        """Return p^e at the pressure at which the curve is shown; 1 for the paper's form."""
        return float(self.static_form.scale(self.shown_at_mpa))

    def place_words(self, u_from: float, u_to: float | None = None) -> str:
        """Return a place or a range on the curve in words of an operator.

        This is the opening if u is the opening, else the power: the opening of a u depends on
        the pressure.
        """
        ends = np.array([u_from] if u_to is None else [u_from, u_to])
        if self.pressure_exponent == 0.0:
            return ' to '.join(f'{v:.1f}' for v in ends.tolist()) + ' % opening'
        knots = self.breakpoints
        power = self(np.clip(ends, knots[0], knots[-1]))
        return ' to '.join(f'{y:.0f}' for y in power.tolist()) + f' {self.output_unit}'

    @property
    def breakpoints(self) -> FloatArray:
        """Return the boundary point vector U of the paper, shape (J + 1,)."""
        return np.array([self.pieces[0].u_from, *(p.u_to for p in self.pieces)])

    @property
    def model(self) -> RegionalModel:
        """Return the curve and the dynamics as a model for prediction."""
        slopes = np.array([p.slope for p in self.pieces])
        intercepts = np.array([p.intercept for p in self.pieces])
        knots = self.breakpoints
        return RegionalModel(
            knots=knots,
            left=slopes * knots[:-1] + intercepts,
            right=slopes * knots[1:] + intercepts,
            levels=np.array([d.power_to for d in self.dynamics[:-1]]),
            time_constants=np.array([d.time_constant_s for d in self.dynamics]),
            delays=np.array([d.delay_s for d in self.dynamics]),
            offset_mw=self.offset_mw if self.axis == OPENING else None,
        )

    def values(self) -> FloatArray:
        """Return the power at the breakpoints in MW, (J + 1,); at a jump the mean of both ends.

        The pressure is the reference pressure if the form has p^e.
        """
        m = self.at_pressure().model
        inner = 0.5 * (m.right[:-1] + m.left[1:])
        return np.concatenate([m.left[:1], inner, m.right[-1:]])

    def at_pressure(self, pressure_mpa: float | None = None) -> Characteristic:
        """Return the curve at one pressure, by default the reference pressure: power is F(u).

        All its values in MW are then in MW. The paper's form is returned unchanged.
        """
        if self.axis != OPENING:
            return self
        p = self.shown_at_mpa if pressure_mpa is None else pressure_mpa
        scale = float(self.static_form.scale(p))

        def there(piece: Piece) -> Piece:
            return replace(
                piece, slope=scale * piece.slope,
                intercept=scale * piece.intercept + self.offset_mw,
                slope_stderr=scale * piece.slope_stderr,
                intercept_stderr=scale * piece.intercept_stderr,
            )  # fmt: skip

        return replace(
            self, pieces=tuple(map(there, self.pieces)),
            partition_pieces=tuple(map(there, self.partition_pieces)), axis=INTEGRATED_INPUT,
            pressure_scale_exponent=0.0, offset_mw=0.0, reference_pressure_mpa=p,
        )  # fmt: skip

    def over_opening(self, pressure_mpa: float) -> Characteristic:
        """Return the curve at one pressure over the opening in %: its exponent is 0."""
        c = self.at_pressure(pressure_mpa)
        per_percent = pressure_mpa**c.pressure_exponent

        def there(piece: Piece) -> Piece:
            return replace(
                piece, u_from=piece.u_from / per_percent, u_to=piece.u_to / per_percent,
                slope=piece.slope * per_percent, slope_stderr=piece.slope_stderr * per_percent,
            )  # fmt: skip

        return replace(
            c, pieces=tuple(map(there, c.pieces)),
            partition_pieces=tuple(map(there, c.partition_pieces)), pressure_exponent=0.0,
            breakpoint_intervals=tuple(
                (low / per_percent, high / per_percent) for low, high in c.breakpoint_intervals
            ),
            residuals=replace(c.residuals, input_noise=c.residuals.input_noise / per_percent),
        )  # fmt: skip

    def __call__(
        self, u: FloatArray, pressure_mpa: FloatArray | float | None = None
    ) -> FloatArray:
        """Return the static power in MW, eq. (26); NaN outside the identified range.

        The curve is unknown beyond the outer breakpoints. The default pressure is the
        reference pressure; in the paper's form u contains the pressure.
        """
        u = np.asarray(u, dtype=np.float64)
        knots = self.breakpoints
        inside = (u >= knots[0]) & (u <= knots[-1])
        p = self.shown_at_mpa if pressure_mpa is None else pressure_mpa
        return np.where(inside, self.model.static(u, self.static_form.scale(p)), np.nan)

    def inverse(self, power_mw: FloatArray) -> FloatArray:
        """Return u at which the power is x, at the reference pressure; NaN if there is none.

        Raises
        ------
        DataError
            The curve does not rise throughout, so it has no inverse.
        """
        m = self.at_pressure().model
        if np.any(m.slopes() <= 0.0):
            falling = int(np.argmin(m.slopes())) + 1
            raise DataError(
                f'The curve has no inverse: piece {falling} does not rise (slope '
                f'{m.slopes()[falling - 1]:.4g} {self.output_unit} per unit of u).'
            )
        x, u = _rising_points(m)
        power = np.asarray(power_mw, dtype=np.float64)
        # If x repeats, use the first one: the smallest u that reaches the power.
        i = np.clip(np.searchsorted(x, power, side='left'), 1, len(x) - 1)
        with np.errstate(invalid='ignore'):
            share = (power - x[i - 1]) / (x[i] - x[i - 1])
        found = u[i - 1] + share * (u[i] - u[i - 1])
        return np.where((power >= x[0]) & (power <= x[-1]), found, np.nan)

    def power(self, opening_percent: ArrayLike, pressure_mpa: ArrayLike) -> FloatArray:
        """Return the static power at an opening and a main steam pressure in MW.

        Parameters
        ----------
        opening_percent : array_like of float
            Valve opening V, % of full opening.
        pressure_mpa : array_like of float
            Main steam pressure p, MPa absolute; broadcast against the opening.

        Returns
        -------
        float64
            p^e F(V p^q) + c. NaN outside the identified range of u = V p^q, if the pressure
            is not positive, and if an argument is NaN.
        """
        opening, positive = _with_pressure(opening_percent, pressure_mpa)
        return self(opening * positive**self.pressure_exponent, positive)

    def opening(self, power_mw: ArrayLike, pressure_mpa: ArrayLike) -> FloatArray:
        """Return the opening that gives a power at a main steam pressure in %.

        Parameters
        ----------
        power_mw : array_like of float
            Static power, MW.
        pressure_mpa : array_like of float
            Main steam pressure, MPa absolute; broadcast against the power.

        Returns
        -------
        float64
            The unique opening from 0 to 100 % at which `power` is ``power_mw``, up to rounding.
            NaN if there is none: beyond the ends of the curve, within a jump, above full
            opening. NaN if there are several: on a flat piece, and if the curve falls.

        See Also
        --------
        inverse : the same in u, for curves that always rise; also defined within a jump.
        """
        power, positive = _with_pressure(power_mw, pressure_mpa)
        m = self.model
        flow = (power - m.offset) / self.static_form.scale(positive)
        found = np.full(power.shape, np.nan)
        for k, slope in enumerate(m.slopes()):
            low, high = float(m.knots[k]), float(m.knots[k + 1])
            rounding = 1e-9 * max(abs(low), abs(high))
            if slope == 0.0:
                found[flow == m.left[k]] = np.inf
                continue
            at = low + (flow - m.left[k]) / slope
            here = (at >= low - rounding) & (at <= high + rounding)
            at = np.clip(at, low, high)
            # At a knot the pieces on both sides give the same opening, unless there is a jump.
            other = here & ~np.isnan(found) & ~(np.abs(found - at) <= 2.0 * rounding)
            found = np.where(here & np.isnan(found), at, found)
            found[other] = np.inf
        # At a jump only one end belongs to F: check the opening with F.
        with np.errstate(invalid='ignore', divide='ignore'):
            back = self(found, positive)
            reached = np.abs(back - power) <= 1e-9 * np.maximum(1.0, np.abs(power))
            opening = found / positive**self.pressure_exponent
        known = reached & (opening >= 0.0) & (opening <= 100.0 * (1.0 + 1e-12))
        return np.where(known, np.minimum(opening, 100.0), np.nan)

    def measured_in(self, unit: str) -> Characteristic:
        """Return the same values for an output in ``unit``, with sentences in that unit."""
        return replace(
            self, output_unit=unit, notes=tuple(in_unit(note, unit) for note in self.notes),
            choice=replace(self.choice, note=in_unit(self.choice.note, unit)),
        ).with_id()  # fmt: skip

    def with_id(self) -> Characteristic:
        """Return a copy whose `model_id` is a hash of its numbers."""
        # Held causes change the hash only if there are any, so that other curves keep their names.
        told = repr(replace(self, model_id='')) + (repr(self.held) if self.held else '')
        if self.axis == OPENING:
            told += repr((self.axis, self.pressure_scale_exponent, self.offset_mw))
        told += '' if self.output_unit == 'MW' else self.output_unit
        digest = hashlib.sha256(told.encode()).hexdigest()
        return replace(self, model_id=digest[:12])


def _with_pressure(values: ArrayLike, pressure_mpa: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return both in one shape; a pressure that is not positive becomes NaN."""
    given, pressure = np.broadcast_arrays(
        np.asarray(values, dtype=np.float64), np.asarray(pressure_mpa, dtype=np.float64)
    )
    return given, np.where(pressure > 0.0, pressure, np.nan)


def _rising_points(m: RegionalModel) -> tuple[FloatArray, FloatArray]:
    """Return the points (x, u) of the line of the smallest u that reaches each power.

    For all powers inside a jump up it is the knot; after a jump down a piece is
    used only above the powers that were reached before.
    """
    points = [(float(m.left[0]), float(m.knots[0]))]
    for k, slope in enumerate(m.slopes()):
        reached = points[-1][0]
        low = max(float(m.left[k]), reached)
        if m.right[k] > low:
            begin = float(m.knots[k] + (low - m.left[k]) / slope)
            # Powers inside a jump, or not reached by lower pieces, are mapped to ``begin``.
            points += [(reached, begin), (low, begin), (float(m.right[k]), float(m.knots[k + 1]))]
    points = [points[0], *(b for a, b in itertools.pairwise(points) if a != b)]
    return np.array([x for x, _ in points]), np.array([u for _, u in points])


def piece_error(piece: Piece, u: FloatArray) -> FloatArray:
    """Return the standard error of a piece's line at ``u`` in MW (MW / MPa^e where e > 0).

    It is NaN if the slope's error is unknown.

    Notes
    -----
    A line through samples with mean m and variance v of u has the error
    ``slope_stderr * sqrt((u - m)^2 + v)``. m cannot be computed accurately from the errors of
    slope and intercept (a difference of large numbers), so the samples are assumed to be
    uniform over the piece: m is its middle and v a twelfth of its width squared.
    """
    u = np.asarray(u, dtype=np.float64)
    width, middle = piece.u_to - piece.u_from, 0.5 * (piece.u_from + piece.u_to)
    return np.asarray(piece.slope_stderr * np.sqrt((u - middle) ** 2 + width**2 / 12.0))


def piece_of(curve: Characteristic, u: FloatArray) -> IntArray:
    """Return the index of the piece at each ``u``; beyond the ends that of the outer piece."""
    return np.asarray(np.searchsorted(curve.breakpoints[1:-1], u, side='right'))


def curve_error(curve: Characteristic, u: FloatArray) -> FloatArray:
    """Return the standard error of the curve in MW, shape of ``u``; see `piece_error`.

    The pressure is the reference pressure if the form has p^e.
    """
    u = np.asarray(u, dtype=np.float64)
    index = piece_of(curve, u)
    error = np.full(u.shape, math.nan)
    for k, piece in enumerate(curve.pieces):
        error[index == k] = piece_error(piece, u[index == k])
    return curve.reference_scale * error
