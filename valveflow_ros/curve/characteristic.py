# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The result: the flow characteristic, how sure it is, and what it was made from."""

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

# What a chart was designed for; apart from its kernels, for whoever only reads models.


@dataclass(frozen=True, slots=True)
class ChartDesign:
    """What a chart needs to know of the residual it watches.

    Attributes
    ----------
    block_s : float
        Length of a block.
    correlation : float
        From block to block, 0 <= correlation < 1.
    innovation_mw : float
        sd of a block mean given the one before.
    slack : tuple of float
        What each sum lets pass per block, in innovations: for small and for large shifts.
    limit : tuple of float
        Where each sum raises the alarm, in innovations.
    run_length_days : float
        Mean time between false alarms that the limits were set for.
    """

    block_s: float
    correlation: float
    innovation_mw: float
    slack: tuple[float, float]
    limit: tuple[float, float]
    run_length_days: float


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
    """How J was chosen: the rule, Omega(J) of eq. (19) and Lambda(J) of eq. (24).

    ``confidence`` is the probability of each J; empty where the rule has none.
    """

    rule: str
    cost: dict[int, float]
    turning_angle: dict[int, float]
    note: str = ''
    confidence: dict[int, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Support:
    """What a piece rests on: special segments and samples inside it.

    ``levels`` are the distinct steady levels in u. ``identifiable`` says whether the
    condition after Proposition 2 of the paper holds.
    """

    steady: int
    slope_response: int
    samples: int
    levels: tuple[float, ...]
    identifiable: bool


@dataclass(frozen=True, slots=True)
class FittedData:
    """The data the curve was fitted to."""

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

        The paper's condition is an unchanged temperature; its spread is that of 95 % of the rows.
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
    """How the form of the curve compares with the other one, on stretches of time held out.

    Attributes
    ----------
    chosen : str
        'integrated_input' or 'opening'.
    told : bool
        The data tell the two apart in favour of the one chosen.
    log_likelihood_gain : float
        Of the one chosen.
    rmse_mw, rmse_other_mw : float
        Errors of means over a minute.
    other : str
        The other form with the exponent that suits it best.
    apart_mw : float
        Root mean square of the difference between the two over what was visited.
    worst : tuple of float
        Opening in %, pressure in MPa and difference in MW where 1 % of the means differ more.
    contradicted : bool
        The form was given, and the data tell that it is the wrong one.
    """

    chosen: str
    told: bool
    log_likelihood_gain: float
    rmse_mw: float
    rmse_other_mw: float
    other: str = ''
    apart_mw: float = math.nan
    worst: tuple[float, float, float] = (math.nan, math.nan, math.nan)
    contradicted: bool = False


@dataclass(frozen=True, slots=True)
class HeldCause:
    """A cause of the diagnosis that was taken out of the rows before the curve was fitted.

    ``values`` are its parameters by name; ``sentence`` says it to a person.
    """

    name: str
    values: tuple[tuple[str, float], ...]
    sentence: str


@dataclass(frozen=True, slots=True)
class ResidualStatistics:
    """What residuals of this curve look like on the data it was fitted to (MW).

    95 % of single measurements lie within +- ``width_mw`` of the prediction. ``chart`` watches
    for a lasting shift; without one there is no alarm. ``wander_mw`` is the sd with which the
    level moves from day to day while nothing is wrong (weather), NaN where that is not known.
    """

    rmse_mw: float
    average_sd_mw: float
    average_s: float
    input_noise: float
    power_noise_mw: float
    width_mw: float = math.nan
    chart: ChartDesign | None = None
    wander_mw: float = math.nan


# Days of weather are alike for about so long.
_WANDER_NS = 2 * 86_400 * NS_PER_S


def level_error_mw(wander_mw: float, start_ns: int, end_ns: int) -> float:
    """Return the standard error of a mean over some days, as one of many days.

    Parameters
    ----------
    wander_mw : float
        sd from day to day; the error is 0 where it is NaN, not known.
    start_ns, end_ns : int
        Of those days.
    """
    share = _WANDER_NS / (_WANDER_NS + max(end_ns - start_ns, 0))
    return 0.0 if math.isnan(wander_mw) else wander_mw * math.sqrt(share)


@dataclass(frozen=True, slots=True)
class Characteristic:
    """A fitted flow characteristic: static power is p^e F(u) + c.

    Where causes were ``held`` the curve is that of the plant without them.

    Attributes
    ----------
    pressure_exponent : float
        q of u = V p^q: m of the paper's form, 0 where the knees stand at fixed openings.
    axis : str
        'integrated_input' (the paper's: e = 0, c = 0) or 'opening' (q = 0).
    pressure_scale_exponent, offset_mw : float
        e and c.
    reference_pressure_mpa : float
        Median pressure of the data, NaN where it is not known; see `shown_at_mpa`.
    form : FormEvidence or None
        How this form compares with the other; None where they were not compared.
    output_unit : str
        MW, or the unit of a flow: everything that is named ``_mw`` or told in MW is in it.
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

    @property
    def static_form(self) -> StaticForm:
        """Return the form with its exponent."""
        scaled = self.axis == OPENING
        return StaticForm(
            self.axis, self.pressure_scale_exponent if scaled else self.pressure_exponent
        )

    @property
    def shown_at_mpa(self) -> float:
        """Return the pressure that a curve with e > 0 is shown at.

        That of reference; a common one where a file of another program does not state it.
        """
        p = self.reference_pressure_mpa
        return _COMMON_MPA if self.axis == OPENING and math.isnan(p) else p

    @property
    def reference_scale(self) -> float:
        """Return p^e at the pressure the curve is shown at; 1 for the paper's form."""
        return float(self.static_form.scale(self.shown_at_mpa))

    @property
    def breakpoints(self) -> FloatArray:
        """Return the boundary point vector U of the paper, shape (J + 1,)."""
        return np.array([self.pieces[0].u_from, *(p.u_to for p in self.pieces)])

    @property
    def model(self) -> RegionalModel:
        """Return the numbers as the model that predicts."""
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

        At the reference pressure where the form has p^e.
        """
        m = self.at_pressure().model
        inner = 0.5 * (m.right[:-1] + m.left[1:])
        return np.concatenate([m.left[:1], inner, m.right[-1:]])

    def at_pressure(self, pressure_mpa: float | None = None) -> Characteristic:
        """Return the curve at one pressure, that of reference unless given: power is F(u) alone.

        What is told in MW is in MW then. The paper's form is such a curve at every pressure.
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

    def __call__(
        self, u: FloatArray, pressure_mpa: FloatArray | float | None = None
    ) -> FloatArray:
        """Return the static power in MW, eq. (26); NaN outside the identified range.

        Nothing is known beyond the outer breakpoints, so nothing is said there. The pressure
        is that of reference unless given; in the paper's form u contains it.
        """
        u = np.asarray(u, dtype=np.float64)
        knots = self.breakpoints
        inside = (u >= knots[0]) & (u <= knots[-1])
        p = self.shown_at_mpa if pressure_mpa is None else pressure_mpa
        return np.where(inside, self.model.static(u, self.static_form.scale(p)), np.nan)

    def inverse(self, power_mw: FloatArray) -> FloatArray:
        """Return u at which the power is x, at the reference pressure; NaN where it is none.

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
        # Of equal x the first counts: the smallest u that reaches the power.
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
            p^e F(V p^q) + c. NaN outside the identified range of u = V p^q, where the pressure
            is not positive, and where an argument is NaN.
        """
        opening, pressure = np.broadcast_arrays(
            np.asarray(opening_percent, dtype=np.float64),
            np.asarray(pressure_mpa, dtype=np.float64),
        )
        positive = np.where(pressure > 0.0, pressure, np.nan)
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
            The only opening from 0 to 100 % at which `power` is ``power_mw``, but for rounding.
            NaN where there is none: beyond the ends of the curve, within a jump, above full
            opening. NaN where there are several: on a flat piece, and where the curve falls.

        See Also
        --------
        inverse : the same in u, for curves that rise throughout; it answers within a jump.
        """
        power, pressure = np.broadcast_arrays(
            np.asarray(power_mw, dtype=np.float64), np.asarray(pressure_mpa, dtype=np.float64)
        )
        m = self.model
        positive = np.where(pressure > 0.0, pressure, np.nan)
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
            # At a knot the pieces on both sides give the same answer, unless there is a jump.
            other = here & ~np.isnan(found) & ~(np.abs(found - at) <= 2.0 * rounding)
            found = np.where(here & np.isnan(found), at, found)
            found[other] = np.inf
        # What is at the lower end of a jump belongs to the other side of it: F counts.
        with np.errstate(invalid='ignore', divide='ignore'):
            back = self(found, positive)
            reached = np.abs(back - power) <= 1e-9 * np.maximum(1.0, np.abs(power))
            opening = found / positive**self.pressure_exponent
        known = reached & (opening >= 0.0) & (opening <= 100.0 * (1.0 + 1e-12))
        return np.where(known, np.minimum(opening, 100.0), np.nan)

    def measured_in(self, unit: str) -> Characteristic:
        """Return the same numbers as those of an output in ``unit``, and sentences that say so."""
        return replace(
            self, output_unit=unit, notes=tuple(in_unit(note, unit) for note in self.notes),
            choice=replace(self.choice, note=in_unit(self.choice.note, unit)),
        ).with_id()  # fmt: skip

    def with_id(self) -> Characteristic:
        """Return a copy whose `model_id` is a hash of its numbers."""
        # Held causes count where there are some; the names of other curves stay what they were.
        told = repr(replace(self, model_id='')) + (repr(self.held) if self.held else '')
        if self.axis == OPENING:
            told += repr((self.axis, self.pressure_scale_exponent, self.offset_mw))
        told += '' if self.output_unit == 'MW' else self.output_unit
        digest = hashlib.sha256(told.encode()).hexdigest()
        return replace(self, model_id=digest[:12])


def _rising_points(m: RegionalModel) -> tuple[FloatArray, FloatArray]:
    """Return (x, u) along which the smallest u that reaches a power lies.

    At a jump up the knot answers for all powers inside it; after a jump down a
    piece counts only from where it goes beyond what was reached before.
    """
    points = [(float(m.left[0]), float(m.knots[0]))]
    for k, slope in enumerate(m.slopes()):
        reached = points[-1][0]
        low = max(float(m.left[k]), reached)
        if m.right[k] > low:
            begin = float(m.knots[k] + (low - m.left[k]) / slope)
            # Powers inside a jump, or skipped by lower pieces, are answered by where this begins.
            points += [(reached, begin), (low, begin), (float(m.right[k]), float(m.knots[k + 1]))]
    points = [points[0], *(b for a, b in itertools.pairwise(points) if a != b)]
    return np.array([x for x, _ in points]), np.array([u for _, u in points])


# How far off a curve may be at one u, told from the two standard errors of its pieces.


def piece_error(piece: Piece, u: FloatArray) -> FloatArray:
    """Return the standard error of a piece's line at ``u`` in MW (MW / MPa^e where e > 0).

    Parameters
    ----------
    piece : Piece
    u : float64 (n,)
        Integrated input, % MPa^m.

    Returns
    -------
    float64 (n,)
        NaN where the slope's error is not known.

    Notes
    -----
    A line through samples with mean m and variance v of u has the error
    ``slope_stderr * sqrt((u - m)^2 + v)``. Slope and intercept errors alone do not say
    where m is (their difference is one of large numbers), so the samples are taken to be
    spread evenly over the piece: m is its middle and v a twelfth of its width squared.
    """
    u = np.asarray(u, dtype=np.float64)
    width, middle = piece.u_to - piece.u_from, 0.5 * (piece.u_from + piece.u_to)
    return np.asarray(piece.slope_stderr * np.sqrt((u - middle) ** 2 + width**2 / 12.0))


def piece_of(curve: Characteristic, u: FloatArray) -> IntArray:
    """Return the index of the piece at each ``u``; beyond the ends the outer pieces."""
    return np.asarray(np.searchsorted(curve.breakpoints[1:-1], u, side='right'))


def curve_error(curve: Characteristic, u: FloatArray) -> FloatArray:
    """Return the standard error of the curve in MW, shape of ``u``; see `piece_error`.

    At the reference pressure where the form has p^e.
    """
    u = np.asarray(u, dtype=np.float64)
    index = piece_of(curve, u)
    error = np.full(u.shape, math.nan)
    for k, piece in enumerate(curve.pieces):
        error[index == k] = piece_error(piece, u[index == k])
    return curve.reference_scale * error
