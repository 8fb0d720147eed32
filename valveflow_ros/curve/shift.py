# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Test for a shift of the flow characteristic from a reference: piece, size and onset."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import ndtr, ndtri

from valveflow_ros.curve.characteristic import Characteristic, Piece, curve_error, level_error_mw
from valveflow_ros.curve.characteristic_json import number
from valveflow_ros.curve.segment_residual import (
    LEAST_SIDE,
    Scan,
    SegmentResiduals,
    after_known_changes,
    common_change,
    scan,
    segment_residuals,
)
from valveflow_ros.errors import DataError, listed, short
from valveflow_ros.records import NS_PER_S, FloatArray, IntArray, SpecialSegment

_SURE = 0.9999


def shift_sentence(shift: Shift, reference: Characteristic) -> str:
    """Return a sentence on the piece that shifted, the size, onset and confidence; or on no shift.

    A second one names the compared range if it is not the whole reference.
    """
    judgement = _judgement(shift, reference)
    first, last = float(reference.breakpoints[0]), float(reference.breakpoints[-1])
    known = [p for p in shift.pieces if math.isfinite(p.u_from)]
    low, high = min(p.u_from for p in known), max(p.u_to for p in known)
    if low <= first and high >= last:
        return judgement
    return (
        f'{judgement} Only the range {reference.place_words(low, high)} could be compared; the '
        f'reference covers {reference.place_words(first, last)}.'
    )


def _judgement(shift: Shift, curve: Characteristic) -> str:
    known = [p for p in shift.pieces if math.isfinite(p.middle_mw)]
    made = minute(shift.reference_ns) if shift.reference_ns > 0 else 'unknown date'
    reference = f'the reference of {made}'
    worst = shift.largest
    if worst is None:
        smallest = [p.smallest_mw for p in known if math.isfinite(p.smallest_mw)]
        if not smallest:
            return f'No shift against {reference} is seen, but no error of the curves is known.'
        least, most = short(min(smallest), 1), short(max(smallest), 1)
        span = least if least == most else f'{least} to {most}'
        return (
            f'The curve agrees with {reference}; a shift of {span} MW, by piece, '
            'would have been seen.'
        )
    index = shift.pieces.index(worst) + 1
    side = 'more' if worst.shift_mw > 0.0 else 'less'
    others = [k + 1 for k, p in enumerate(shift.pieces) if p.moved and k + 1 != index]
    return (
        f'At {curve.place_words(worst.u_from, worst.u_to)} (piece {index}) the unit gives '
        f'{short(abs(worst.shift_mw), 1)} MW ({abs(worst.percent):.1f} %) {side} than '
        f'{reference}, {_since_words(shift)}. Confidence: {_confidence(worst)}.'
        f'{_others(shift, others, curve)}'
    )


def minute(time_ns: int) -> str:
    """Return a date with hours and minutes as text, UTC."""
    at = np.datetime64(time_ns // NS_PER_S, 's').astype('datetime64[m]')
    return f'{at}'.replace('T', ' ') + ' UTC'


def _since_words(shift: Shift) -> str:
    if shift.since_ns > 0:
        return (
            f'since about {minute(shift.since_ns)} (95 % interval {minute(shift.since_low_ns)} '
            f'to {minute(shift.since_high_ns)})'
        )
    if shift.reference_ns >= shift.first_ns > 0:
        return 'onset unknown (the reference was made from the same days)'
    if shift.first_ns > 0:
        return f'with no change seen since {minute(shift.first_ns)}, so from before that'
    return 'since when is not known'


def _confidence(piece: PieceShift) -> str:
    if piece.confidence > _SURE:
        return f'above {100.0 * _SURE:.2f} %'
    return f'{100.0 * piece.confidence:.2f} %'


def _others(shift: Shift, numbers: list[int], curve: Characteristic) -> str:
    if not numbers:
        return ''
    told = []
    for k in numbers:
        p = shift.pieces[k - 1]
        place = curve.place_words(p.u_from, p.u_to)
        side = 'more' if p.shift_mw > 0.0 else 'less'
        told.append(f'{short(abs(p.shift_mw), 1)} MW {side} at {place} (piece {k})')
    return f' The unit also gives {listed(told)}.'


# The errors of curves assume uniform samples over a piece and noise with a short correlation
# time. With slow noise of 1 MW, differences of clean plants were 1.8 times larger than these
# errors (plants of the paper's kind, seeds 1 to 5); without it not (seeds 1 to 12).
_WIDER = 1.8
_PROFILE = 101  # points along a piece
# Limits of p-value and standard errors for reporting a change within the data of a curve. In one
# piece it must also be larger than this fraction of the power's range: in 30 healthy units with
# weather (8001 to 8010 of three kinds, seven days of means over a minute) the means of a piece
# changed by up to 3.8 MW. With these limits none was told there, nor in 54 records of the units
# 8102 to 8110; their power had a range of 93 to 193 MW.
_MIXED_CHANCE, _MIXED_ERRORS = 1e-4, 3.0
_MIXED_ERRORS_OF_PIECE, _MIXED_LEAST = 4.0, 0.025
_HALF_DAY_NS, _LEAST_HALF_DAYS = 43_200 * NS_PER_S, 4
_TESTS = 2  # each piece is tested by the curves and by its segments


@dataclass(frozen=True, slots=True)
class PieceShift:
    """Comparison of a piece of the current curve with the reference; NaN where unknown."""

    u_from: float  # the part of the piece in the range of both curves
    u_to: float
    middle_mw: float  # current minus reference: in the middle, and the extremes along the piece
    low_mw: float
    high_mw: float
    error_mw: float  # standard error of `middle_mw`
    # Mean difference of the segments after the change with its error, or of all segments of the
    # curve if the time is unknown; NaN if the piece has not shifted, or has no segments.
    now_mw: float
    now_error_mw: float
    flow_mw: float  # power of the reference in the middle
    p_value: float  # of such a difference without a shift, corrected for all pieces and tests
    moved: bool  # the p-value is below the limit, and the shift at least the minimum size
    smallest_mw: float  # the smallest shift that would have been detected

    @property
    def shift_mw(self) -> float:
        """Return the present shift: the window may contain data from before the change."""
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
    """The result of the test."""

    reference_id: str
    model_id: str
    reference_ns: int  # end of the reference's data
    first_ns: int  # time of the oldest segment used; 0 without any
    pieces: tuple[PieceShift, ...]  # one per piece of the current curve
    # Onset of the shift, with a 95 % interval; 0 if the segments do not determine it, for example
    # if it was before the first of them.
    since_ns: int
    since_low_ns: int
    since_high_ns: int
    sentence: str  # the result for the operator

    @property
    def moved(self) -> bool:
        """Return True if any piece shifted."""
        return any(p.moved for p in self.pieces)

    @property
    def largest(self) -> PieceShift | None:
        """Return the piece with the largest shift; None if there is none."""
        moved = [p for p in self.pieces if p.moved]
        return max(moved, key=lambda p: abs(p.shift_mw)) if moved else None


@dataclass(frozen=True, slots=True)
class ShiftLimits:
    """The limits of the test."""

    confidence: float = 0.999  # required, 0.5 to 1, for all pieces together
    least_mw: float = 0.3  # smaller shifts are ignored


def judge_shift(
    reference: Characteristic,
    current: Characteristic,
    segments: Sequence[SpecialSegment] = (),
    limits: ShiftLimits | None = None,
) -> Shift:
    """Test the current curve for a shift from a reference.

    Raises `DataError` if both curves have different axes, or V p^m with different m, or no u in
    common.

    Parameters
    ----------
    reference, current : Characteristic
        Their errors are assumed independent. If their windows overlap, the error of the
        difference is therefore overestimated.
    segments : sequence of SpecialSegment
        Of the current window; they determine the onset, and the levels before and after.
        Segments outside the range of the reference are ignored, and so are changes
        within the reference's own data.
    limits : ShiftLimits, optional

    Returns
    -------
    Shift
        A piece has shifted if the curves differ in its middle and its segments confirm this,
        or if its segments change at some time and differ from the reference after it.
    """
    limits = limits or ShiftLimits()
    _comparable(reference, current)
    found = segment_residuals(reference, segments)
    # Curves are compared at one pressure, at which their power is F(u).
    pressure = reference.shown_at_mpa
    reference, current = reference.at_pressure(pressure), current.at_pressure(pressure)
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
        _judged(reference, current, k, series[k].time_ns, scans[k], tests, limits)
        for k in range(len(current.pieces))
    )
    moved = [s for piece, s in zip(pieces, series, strict=True) if piece.moved and len(s)]
    since = common_change(moved, reference.source.window_end_ns) if moved else (0, 0, 0)
    begun_ns = since[0] or current.source.window_start_ns - 1
    if len(found):
        least = LEAST_SIDE if since[0] else 1
        least_mw = 0.0 if since[0] else limits.least_mw
        pieces = tuple(
            _borne_out(_with_now(reference, p, s, begun_ns, least), s, begun_ns, least_mw)
            for p, s in zip(pieces, series, strict=True)
        )
    shift = Shift(
        reference.model_id, current.model_id, reference.source.window_end_ns,
        int(found.time_ns[0]) if len(found) else 0, pieces, *since, '',
    )  # fmt: skip
    return replace(shift, sentence=shift_sentence(shift, reference))


def mixture_sentence(curve: Characteristic, segments: Sequence[SpecialSegment]) -> str:
    """Return a sentence if the unit changed within the data of a curve, of these segments.

    The mean over all loads is tested, and each piece: a valve that fails changes only the loads
    that need it.
    """
    found = segment_residuals(curve, segments)
    wander_mw, pieces = curve.residuals.wander_mw, curve.pieces
    whole = _change_within(found, wander_mw, _MIXED_CHANCE)
    if whole is not None and not whole[1] > _MIXED_ERRORS:
        whole = None
    shown = curve.at_pressure(curve.shown_at_mpa)
    least_mw = _MIXED_LEAST * float(np.ptp(shown.model.static(shown.breakpoints)))
    told: list[tuple[float, int, float, str]] = []
    tested = 0
    for index, piece in enumerate(pieces, 1):
        there = found.inside(piece.u_from, piece.u_to)
        tested += len(there) >= 2 * LEAST_SIDE
        change = _change_within(there, wander_mw, _MIXED_CHANCE / len(pieces), own=True)
        if change is not None and abs(change[0]) > least_mw and change[1] > _MIXED_ERRORS_OF_PIECE:
            place = f'at {curve.place_words(piece.u_from, piece.u_to)} (piece {index})'
            told.append((change[1], change[2], change[0], _moved(change[0], place)))
    if told and (whole is None or len(told) < tested):
        told.sort(reverse=True)
        # What the unit visited first after the change dates it best.
        onsets = [since for _, since, *_ in told]
        if whole is not None and whole[0] * told[0][2] > 0.0:
            onsets.append(whole[2])
        return _mixture_words(min(onsets), listed([words for *_, words in told]))
    if whole is None:
        return ''
    return _mixture_words(whole[2], _moved(whole[0], '(mean over the loads seen)'))


def _change_within(
    found: SegmentResiduals, wander_mw: float, chance: float, *, own: bool = False
) -> tuple[float, float, int] | None:
    """Return a change of the mean: MW, its size in standard errors, onset; None if it is chance.

    With ``own`` the slow variation is at most that of half days about the two means: the
    ``wander_mw`` of a curve that is a mixture contains the change.
    """
    change = scan(found.residual_mw, found.weights)
    if change is None or change.p_value > chance:
        return None
    time_ns, weights, place = found.time_ns, found.weights, change.place
    if own:
        means = np.where(np.arange(len(found)) < place, change.before, change.after)
        wander_mw = float(
            np.fmin(wander_mw, _slow_sd(time_ns, found.residual_mw - means, weights))
        )
    since_ns = int(time_ns[place])
    share = float(weights[place:].sum() / weights.sum())
    error = math.hypot(
        change.after_error / math.sqrt(1.0 - share),
        level_error_mw(wander_mw, int(time_ns[0]), int(time_ns[place - 1])),
        level_error_mw(wander_mw, since_ns, int(time_ns[-1])),
    )
    size = change.after - change.before
    return size, abs(size) / max(error, 1e-300), since_ns


def _slow_sd(time_ns: IntArray, rest: FloatArray, weights: FloatArray) -> float:
    """Return the sd of half-day means about two fitted levels; of all members if there are few."""
    _, half_day = np.unique(time_ns // _HALF_DAY_NS, return_inverse=True)
    weight = np.bincount(half_day, weights)
    mean = np.bincount(half_day, weights * rest) / weight
    if len(mean) < _LEAST_HALF_DAYS:
        return math.sqrt(float(np.average(rest**2, weights=weights)))
    return math.sqrt(float(np.sum(mean**2)) / (len(mean) - 2))


def _moved(size_mw: float, place: str) -> str:
    return f'{short(abs(size_mw), 1)} MW {"more" if size_mw > 0.0 else "less"} {place}'


def _mixture_words(since_ns: int, moved: str) -> str:
    return (
        f'The unit changed within these data: since about {minute(since_ns)} it gives {moved}, '
        'at the same opening and pressure, so this curve is a mixture of before and after. '
        '"valveflow diagnose" looks for the cause; "valveflow '
        f'identify --from {minute(since_ns).removesuffix(" UTC").replace(" ", "T")}Z" gives the '
        'curve since then.'
    )


def _comparable(reference: Characteristic, current: Characteristic) -> None:
    if reference.axis != current.axis:
        raise DataError(
            f'The reference is a curve of {reference.static_form.words} and the current one of '
            f'{current.static_form.words}: they cannot be compared.'
        )
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
    knots = reference.breakpoints
    low = max(float(knots[0]), piece.u_from)
    high = min(float(knots[-1]), piece.u_to)
    return (low, high) if low < high else None


def _judged(
    reference: Characteristic, current: Characteristic, index: int, time_ns: IntArray,
    found: Scan | None, tests: int, limits: ShiftLimits,
) -> PieceShift:  # fmt: skip
    """Test one piece by the curves and by its segments, whose times are ``time_ns``."""
    common = _common(reference, current.pieces[index])
    if common is None:
        unknown: dict[str, Any] = dict.fromkeys(PieceShift.__match_args__, math.nan)
        return PieceShift(**{**unknown, 'moved': False})
    u = np.linspace(*common, _PROFILE)
    # The end points are left out: after a jump they have the neighbour's value.
    difference = (current.model.static(u) - reference.model.static(u))[1:-1]
    middle = u[_PROFILE // 2 : _PROFILE // 2 + 1]
    middle_mw = float(difference[_PROFILE // 2 - 1])
    reference_error = _reference_error(reference, middle)
    wander_mw, source = reference.residuals.wander_mw, current.source
    level_error = level_error_mw(wander_mw, source.window_start_ns, source.window_end_ns)
    error = math.hypot(
        reference_error, _WIDER * float(curve_error(current, middle)[0]), level_error
    )
    p_curves = _two_sided(middle_mw, error)
    now_mw = now_error = math.nan
    p_segments = 1.0
    if found is not None:
        now_error = math.hypot(
            found.after_error, reference_error,
            level_error_mw(wander_mw, int(time_ns[found.place]), source.window_end_ns),
        )  # fmt: skip
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
    reference: Characteristic, piece: PieceShift, series: SegmentResiduals, since_ns: int,
    least: int,
) -> PieceShift:  # fmt: skip
    """Return a shifted piece with the mean of its segments after the common time of change."""
    after = series.part(series.time_ns > since_ns)
    # A series that begins after that time has its own time of change.
    own = math.isfinite(piece.now_mw) and len(series) - len(after) < LEAST_SIDE
    if not piece.moved or own or len(after) < least:
        return piece
    weights = after.weights
    mean = float(np.average(after.residual_mw, weights=weights))
    scatter = float(np.average((after.residual_mw - mean) ** 2, weights=weights))
    middle = np.array([0.5 * (piece.u_from + piece.u_to)])
    since_ns, until_ns = int(after.time_ns[0]), int(after.time_ns[-1])
    error = math.hypot(
        math.sqrt(scatter / max(1, len(after) - 1)), _reference_error(reference, middle),
        level_error_mw(reference.residuals.wander_mw, since_ns, until_ns),
    )  # fmt: skip
    return replace(piece, now_mw=mean, now_error_mw=error)


def _borne_out(
    piece: PieceShift, series: SegmentResiduals, since_ns: int, least_mw: float
) -> PieceShift:
    """Return a piece as not shifted if its segments agree with the reference, or it has none.

    A curve may be wrong where there are few segments, and differ there by much.
    """
    if math.isfinite(piece.now_mw):
        borne_out = abs(piece.now_mw) >= least_mw
    else:
        borne_out = bool(np.any(series.time_ns > since_ns))
    return piece if borne_out else replace(piece, moved=False)


def _reference_error(reference: Characteristic, u: FloatArray) -> float:
    """Return the error of the reference at one u, including the variation from day to day."""
    source = reference.source
    level_error = level_error_mw(
        reference.residuals.wander_mw, source.window_start_ns, source.window_end_ns
    )
    return math.hypot(_WIDER * float(curve_error(reference, u)[0]), level_error)


def _two_sided(value: float, error: float) -> float:
    """Return the two-sided p-value of ``value`` with a normal ``error``; 1 if unknown."""
    if not (math.isfinite(value) and error > 0.0):
        return 1.0
    return float(2.0 * ndtr(-abs(value) / error))


FORMAT = 'valveflow/shift'
VERSION = 1


# Keys of a piece in ``shift.json`` that differ from the names here.
_KEYS = {
    'shift_percent': 'percent', 'middle_stderr_mw': 'error_mw', 'now_stderr_mw': 'now_error_mw',
    'smallest_seen_mw': 'smallest_mw',
}  # fmt: skip
_PIECE = (
    'u_from', 'u_to', 'moved', 'shift_mw', 'shift_percent', 'confidence', 'p_value', 'middle_mw',
    'middle_stderr_mw', 'low_mw', 'high_mw', 'now_mw', 'now_stderr_mw', 'flow_mw',
    'smallest_seen_mw',
)  # fmt: skip


def _piece_json(piece: PieceShift) -> dict[str, Any]:
    values = {key: getattr(piece, _KEYS.get(key, key)) for key in _PIECE}
    return {key: v if key == 'moved' else number(v) for key, v in values.items()}


def shift_json(shift: Shift) -> dict[str, Any]:
    """Return the content of ``shift.json``; unknown values are null."""
    return {
        'format': FORMAT,
        'version': VERSION,
        'reference_model_id': shift.reference_id,
        'model_id': shift.model_id,
        'reference_end_ns': shift.reference_ns,
        'moved': shift.moved,
        'sentence': shift.sentence,
        'since_ns': shift.since_ns or None,
        'since_low_ns': shift.since_low_ns or None,
        'since_high_ns': shift.since_high_ns or None,
        'judged_from_ns': shift.first_ns or None,
        'pieces': [_piece_json(piece) for piece in shift.pieces],
    }
