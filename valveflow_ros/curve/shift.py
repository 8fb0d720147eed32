"""Has the flow characteristic moved away from a reference: which piece, how far, since when."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr, ndtri

from valveflow_ros.curve.change_point import LEAST_SIDE, Scan, moment_of, scan
from valveflow_ros.curve.characteristic import Characteristic, Piece
from valveflow_ros.curve.line_error import curve_error
from valveflow_ros.curve.segment_residual import (
    SegmentResiduals,
    after_known_changes,
    segment_residuals,
)
from valveflow_ros.curve.shift_words import shift_sentence
from valveflow_ros.errors import DataError
from valveflow_ros.records import IntArray, SpecialSegment

# The errors of curves assume that samples spread evenly over a piece and that all noise is
# soon forgotten. With a slow wander of 1 MW differences of clean plants were 1.8 times larger
# (benchmarks/shift_study.py --wander 1, seeds 1 to 5), without one not at all (seeds 1 to 12).
_WIDER = 1.8
_PROFILE = 101  # points along a piece
_TESTS = 2  # each piece is judged by the curves and by its segments


@dataclass(frozen=True, slots=True)
class PieceShift:
    """A piece of the current curve against the reference.

    Attributes
    ----------
    u_from, u_to : float
        The part of the piece on which both curves are known; NaN if there is none.
    middle_mw, low_mw, high_mw : float
        Current less reference: in the middle, and the extremes along the piece.
    error_mw : float
        Standard error of ``middle_mw``.
    now_mw, now_error_mw : float
        Mean difference of the segments after the change, with its error; NaN if the piece has
        not moved, or the window does not show when.
    flow_mw : float
        The reference in the middle.
    p_value : float
        Chance of such a difference without a shift, for all pieces and both tests together.
    moved : bool
        The chance is below the limit, and the shift is large enough to matter.
    smallest_mw : float
        The smallest shift that would have been judged one.
    """

    u_from: float
    u_to: float
    middle_mw: float
    low_mw: float
    high_mw: float
    error_mw: float
    now_mw: float
    now_error_mw: float
    flow_mw: float
    p_value: float
    moved: bool
    smallest_mw: float

    @property
    def shift_mw(self) -> float:
        """Return the shift as it is now: the window may hold data from before the change."""
        return self.now_mw if math.isfinite(self.now_mw) else self.middle_mw

    @property
    def percent(self) -> float:
        """Return the shift in % of the flow in the middle of the piece."""
        return 100.0 * self.shift_mw / self.flow_mw if self.flow_mw else math.nan

    @property
    def confidence(self) -> float:
        """Return the confidence that there is a shift, 0 to 1."""
        return 1.0 - self.p_value


@dataclass(frozen=True, slots=True)
class Shift:
    """The judgement.

    Attributes
    ----------
    reference_id, model_id : str
    reference_ns : int
        End of the reference's data.
    first_ns : int
        The oldest segment judged; 0 without any.
    pieces : tuple of PieceShift
        One a piece of the current curve.
    since_ns, since_low_ns, since_high_ns : int
        When the pieces that moved did so, with a 95 % interval; 0 where the segments do
        not show it, as when it was before the first of them.
    sentence : str
        For the operator.
    """

    reference_id: str
    model_id: str
    reference_ns: int
    first_ns: int
    pieces: tuple[PieceShift, ...]
    since_ns: int
    since_low_ns: int
    since_high_ns: int
    sentence: str

    @property
    def moved(self) -> bool:
        """Tell whether any piece moved."""
        return any(p.moved for p in self.pieces)

    @property
    def largest(self) -> PieceShift | None:
        """Return the piece that moved most; None if none did."""
        moved = [p for p in self.pieces if p.moved]
        return max(moved, key=lambda p: abs(p.shift_mw)) if moved else None


@dataclass(frozen=True, slots=True)
class ShiftLimits:
    """What counts as a shift.

    Attributes
    ----------
    confidence : float
        At least this sure, 0.5 to 1, over all pieces together.
    least_mw : float
        Smaller shifts do not matter, however sure.
    """

    confidence: float = 0.999
    least_mw: float = 0.3


def judge_shift(
    reference: Characteristic,
    current: Characteristic,
    segments: Sequence[SpecialSegment] = (),
    limits: ShiftLimits | None = None,
) -> Shift:
    """Judge the current curve against a reference.

    Parameters
    ----------
    reference, current : Characteristic
        Errors that windows in common would make alike are taken as independent, which
        makes the difference look less sure than it is.
    segments : sequence of SpecialSegment
        Of the current window; they tell since when, and what was before and after.
        Segments that the reference does not reach count for nothing, nor do changes
        within the reference's own data.
    limits : ShiftLimits, optional

    Returns
    -------
    Shift
        A piece counts as moved if the curves differ in its middle, or if its segments change
        at some moment and differ from the reference after it.

    Raises
    ------
    DataError
        Both curves have different exponents of the pressure, or no u in common.
    """
    limits = limits or ShiftLimits()
    _comparable(reference, current)
    found = segment_residuals(reference, segments)
    series = [
        after_known_changes(found.inside(p.u_from, p.u_to), reference.source.window_end_ns)
        for p in current.pieces
    ]
    scans = [
        scan(s.residual_mw, s.weights, s.count_until(reference.source.window_end_ns))
        for s in series
    ]
    tests = _TESTS * sum(1 for piece in current.pieces if _common(reference, piece))
    pieces = tuple(
        _judged(reference, current, k, scans[k], tests, limits) for k in range(len(current.pieces))
    )
    since = _since(pieces, series, scans)
    if since[0]:
        pieces = tuple(
            _with_now(reference, p, s, since[0]) for p, s in zip(pieces, series, strict=True)
        )
    shift = Shift(
        reference.model_id, current.model_id, reference.source.window_end_ns,
        int(found.time_ns[0]) if len(found) else 0, pieces, *since, '',
    )  # fmt: skip
    return replace(shift, sentence=shift_sentence(shift, reference.breakpoints))


def _comparable(reference: Characteristic, current: Characteristic) -> None:
    if reference.pressure_exponent != current.pressure_exponent:
        raise DataError(
            f'The reference has the pressure exponent {reference.pressure_exponent:g} and the '
            f'curve {current.pressure_exponent:g}: their inputs u are not the same thing.'
        )
    a, b = reference.breakpoints, current.breakpoints
    if max(a[0], b[0]) >= min(a[-1], b[-1]):
        raise DataError(
            f'The reference is known for u from {a[0]:.0f} to {a[-1]:.0f} and the curve from '
            f'{b[0]:.0f} to {b[-1]:.0f}: nothing can be compared.'
        )


def _common(reference: Characteristic, piece: Piece) -> tuple[float, float] | None:
    """Return the part of a piece of the current curve that the reference knows."""
    knots = reference.breakpoints
    low = max(float(knots[0]), piece.u_from)
    high = min(float(knots[-1]), piece.u_to)
    return (low, high) if low < high else None


def _judged(
    reference: Characteristic,
    current: Characteristic,
    index: int,
    found: Scan | None,
    tests: int,
    limits: ShiftLimits,
) -> PieceShift:
    """Judge one piece by the curves and by its segments."""
    common = _common(reference, current.pieces[index])
    if common is None:
        nan = math.nan
        return PieceShift(nan, nan, nan, nan, nan, nan, nan, nan, nan, nan, False, nan)
    u = np.linspace(*common, _PROFILE)
    # At the ends of a piece the neighbour's value would count after a jump.
    difference = (current.model.static(u) - reference.model.static(u))[1:-1]
    middle = u[_PROFILE // 2 : _PROFILE // 2 + 1]
    middle_mw = float(difference[_PROFILE // 2 - 1])
    reference_error = _WIDER * float(curve_error(reference, middle)[0])
    error = math.hypot(reference_error, _WIDER * float(curve_error(current, middle)[0]))
    p_curves = _two_sided(middle_mw, error)
    now_mw = now_error = math.nan
    p_segments = 1.0
    if found is not None:
        now_error = math.hypot(found.after_error, reference_error)
        p_segments = max(found.p_value, _two_sided(found.after, now_error))
        now_mw = found.after
    p = min(1.0, tests * min(p_curves, p_segments))
    chance = 1.0 - limits.confidence
    if not tests * p_segments < chance:
        now_mw = now_error = math.nan
    size = now_mw if math.isfinite(now_mw) else middle_mw
    smallest = float(-ndtri(0.5 * chance / tests)) * error
    return PieceShift(
        *common, middle_mw, float(difference.min()), float(difference.max()), error,
        now_mw, now_error, float(reference.model.static(middle)[0]), p,
        bool(p < chance and abs(size) >= limits.least_mw), max(smallest, limits.least_mw),
    )  # fmt: skip


def _with_now(
    reference: Characteristic, piece: PieceShift, series: SegmentResiduals, since_ns: int
) -> PieceShift:
    """Return a piece that moved with what its segments say after the common moment."""
    after = series.part(series.time_ns > since_ns)
    # A series that begins after that moment changed at one of its own.
    own = math.isfinite(piece.now_mw) and len(series) - len(after) < LEAST_SIDE
    if not piece.moved or own or len(after) < LEAST_SIDE:
        return piece
    weights = after.weights
    mean = float(np.average(after.residual_mw, weights=weights))
    scatter = float(np.average((after.residual_mw - mean) ** 2, weights=weights))
    middle = np.array([0.5 * (piece.u_from + piece.u_to)])
    error = math.hypot(
        math.sqrt(scatter / (len(after) - 1)), _WIDER * float(curve_error(reference, middle)[0])
    )
    return replace(piece, now_mw=mean, now_error_mw=error)


def _two_sided(value: float, error: float) -> float:
    """Return the chance of a normal deviate as large as ``value``; 1 where it is not known."""
    if not (math.isfinite(value) and error > 0.0):
        return 1.0
    return float(2.0 * ndtr(-abs(value) / error))


def _since(
    pieces: Sequence[PieceShift], series: Sequence[SegmentResiduals], scans: Sequence[Scan | None]
) -> tuple[int, int, int]:
    """Return when the pieces that moved changed, by their segments together."""
    times: list[IntArray] = []
    used: list[Scan] = []
    for piece, residuals, found in zip(pieces, series, scans, strict=True):
        if piece.moved and math.isfinite(piece.now_mw) and found is not None:
            times.append(residuals.time_ns)
            used.append(found)
    return moment_of(times, used) if used else (0, 0, 0)
