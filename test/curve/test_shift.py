# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The judgement of a shift, and the change of a mean that it rests on: slow truths, relations."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from curves import curve
from hypothesis import given
from hypothesis import strategies as st
from streams import START_NS, examples

from valveflow_ros.curve.characteristic import (
    FittedData,
    Piece,
    RegionDynamics,
    curve_error,
    piece_error,
)
from valveflow_ros.curve.segment_residual import (
    LEAST_SIDE,
    SegmentResiduals,
    common_change,
    scan,
    segment_residuals,
)
from valveflow_ros.curve.shift import judge_shift, shift_json
from valveflow_ros.errors import DataError
from valveflow_ros.records import NS_PER_S, SegmentKind, SpecialSegment

KNOTS = np.array([1060.0, 1250.0, 1600.0, 1900.0, 2280.0])
SLOPES = np.array([0.24, 0.18, 0.09, 0.01])
VALUES = 155.0 + np.concatenate([[0.0], np.cumsum(SLOPES * np.diff(KNOTS))])
DAY_NS = 86400 * NS_PER_S
STDERR = 5e-4


def curve_of(values=VALUES, knots=KNOTS, end_ns=START_NS, name='now', stderr=STDERR):
    slopes = np.diff(values) / np.diff(knots)
    return curve(
        knots, slopes, start=values[0], stderr=stderr, samples=1000, model_id=name,
        source=FittedData(end_ns - 10 * DAY_NS, end_ns, 1, 1, 1000, 540.0, 1.0, False),
        dynamics=(RegionDynamics(100.0, 300.0, 60.0, 5.0, 1.0, 1.0),),
    )  # fmt: skip


REFERENCE = curve_of(name='then')


def segment(number, start_ns, u, power, kind=SegmentKind.STEADY, rate=0.0, samples=400):
    reach = 0.5 * rate * samples
    slope = SLOPES[np.clip(np.searchsorted(KNOTS, u) - 1, 0, 3)]
    return SpecialSegment(
        number, kind, start_ns, start_ns + samples * NS_PER_S, samples, u - reach, u + reach,
        rate, 1.0, power - slope * reach, power + slope * reach, 1.0, 540.0,
    )  # fmt: skip


def history(seed, days=10.0, change=lambda day, u: 0.0, count=400, noise=1.0, start_ns=START_NS):
    """Return the segments of a plant on the reference curve, plus a change by day and u."""
    rng = np.random.default_rng(seed)
    at = np.sort(rng.uniform(0.0, days, count))
    u = rng.uniform(KNOTS[0] + 20.0, KNOTS[-1] - 20.0, count)
    power = np.interp(u, KNOTS, VALUES) + noise * rng.normal(0.0, 1.0, count)
    return [
        segment(k + 1, start_ns + round(at[k] * DAY_NS), u[k], power[k] + change(at[k], u[k]))
        for k in range(count)
    ]


seeds = st.integers(0, 2**32 - 1)
shifts = st.lists(st.floats(-3.0, 3.0), min_size=5, max_size=5).map(np.array)


@examples(60)
@given(shifts)
def test_changing_places_turns_the_sign_and_nothing_else(by):
    one = judge_shift(REFERENCE, curve_of(VALUES + by))
    other = judge_shift(curve_of(VALUES + by), REFERENCE)
    for a, b in zip(one.pieces, other.pieces, strict=True):
        assert b.middle_mw == pytest.approx(-a.middle_mw, abs=1e-9)
        assert (b.low_mw, b.high_mw) == pytest.approx((-a.high_mw, -a.low_mw), abs=1e-9)
        assert b.p_value == pytest.approx(a.p_value, rel=1e-6, abs=1e-300)
        assert b.moved == a.moved


@examples(40)
@given(shifts, st.floats(1.0, 10.0))
def test_doubt_never_makes_a_shift(by, wider):
    sure = judge_shift(REFERENCE, curve_of(VALUES + by))
    unsure = judge_shift(REFERENCE, curve_of(VALUES + by, stderr=wider * STDERR))
    for a, b in zip(sure.pieces, unsure.pieces, strict=True):
        assert b.p_value >= a.p_value - 1e-15
        assert a.moved or not b.moved


@pytest.mark.parametrize('share', [0.9, 1.1])
def test_the_smallest_shift_that_is_said_to_be_seen_is(share):
    smallest = judge_shift(REFERENCE, curve_of()).pieces[1].smallest_mw
    by = np.array([0.0, 1.0, 1.0, 0.0, 0.0]) * share * smallest
    assert judge_shift(REFERENCE, curve_of(VALUES + by)).pieces[1].moved == (share > 1.0)


def test_a_piece_that_moved_is_named_dated_and_measured():
    change = lambda day, u: -2.1 * (day > 6.0) * (1250.0 <= u < 1600.0)  # noqa: E731
    by = 0.4 * np.array([0.0, -2.1, -2.1, 0.0, 0.0])
    shift = judge_shift(REFERENCE, curve_of(VALUES + by), history(1, change=change))
    assert shift.pieces[1].moved
    assert shift.largest is shift.pieces[1]
    assert not shift.pieces[3].moved
    assert shift.pieces[1].shift_mw == pytest.approx(-2.1, abs=0.4)
    assert shift.pieces[1].percent == pytest.approx(-2.1 / 2.32, abs=0.2)
    day = (shift.since_ns - START_NS) / DAY_NS
    assert day == pytest.approx(6.0, abs=0.4)
    assert shift.since_low_ns <= shift.since_ns <= shift.since_high_ns
    assert re.match(r'At \d+ to \d+ MW \(piece 2\) the unit gives', shift.sentence)
    assert 'less than the reference of 2023-11-15' in shift.sentence
    assert 'since about 2023-11-2' in shift.sentence


def test_what_was_compared_is_said_when_it_is_less_than_the_reference():
    assert 'could be compared' not in judge_shift(REFERENCE, curve_of()).sentence
    half = judge_shift(REFERENCE, curve_of(VALUES[2:], KNOTS[2:]))
    assert re.search(
        r'Only the range \d+ to \d+ MW could be compared; the reference covers \d+ to \d+ MW.$',
        half.sentence,
    )
    assert half.sentence.startswith('The curve agrees with the reference')


def test_a_shift_from_before_the_data_has_no_date():
    shift = judge_shift(REFERENCE, curve_of(VALUES + 2.0), history(3, change=lambda day, u: 2.0))
    assert all(p.moved for p in shift.pieces)
    assert shift.since_ns == 0
    assert 'so from before that' in shift.sentence
    without = judge_shift(REFERENCE, curve_of(VALUES + 2.0))
    assert 'since when is not known' in without.sentence


def test_a_change_the_reference_was_made_of_is_no_shift():
    """Its data end on day 6; the change was on day 3."""
    reference = curve_of(end_ns=START_NS + 6 * DAY_NS, name='then')
    before = history(4, change=lambda day, u: 2.0 * (day < 3.0))
    assert not judge_shift(reference, curve_of(), before).moved
    later = history(4, change=lambda day, u: 2.0 * (day < 3.0) - 3.0 * (day > 8.0))
    shift = judge_shift(reference, curve_of(), later)
    assert shift.moved
    assert (shift.since_ns - START_NS) / DAY_NS == pytest.approx(8.0, abs=0.3)


def test_calm_plants_are_hardly_ever_blamed():
    """The curves agree; the segments scatter, and neighbours are correlated."""
    blamed = 0
    for seed in range(40):
        segments = history(seed, count=200)
        wander = np.random.default_rng(seed).normal(0.0, 0.5, 50).repeat(4)
        segments = [
            replace(s, power_start_mw=s.power_start_mw + w, power_end_mw=s.power_end_mw + w)
            for s, w in zip(segments, wander, strict=True)
        ]
        blamed += judge_shift(REFERENCE, curve_of(), segments).moved
    assert blamed <= 1


def test_ramps_are_taken_with_their_lag():
    rate, u = 0.3, 1425.0
    flow = np.interp(u, KNOTS, VALUES)
    late = segment(1, START_NS, u, flow - 0.18 * rate * 65.0, SegmentKind.SLOPE, rate)
    found = segment_residuals(REFERENCE, [late])
    assert found.residual_mw == pytest.approx([0.0], abs=1e-9)
    unknown = replace(REFERENCE, dynamics=())
    assert len(segment_residuals(unknown, [late])) == 0
    still, outside = segment(2, START_NS, u, flow + 1.0), segment(1, START_NS, 2400.0, 300.0)
    assert segment_residuals(unknown, [late, still, outside]).residual_mw == pytest.approx([1.0])


def test_a_piece_the_reference_does_not_know_is_not_judged():
    knots = np.append(KNOTS, 2600.0)
    current = curve_of(np.append(VALUES, VALUES[-1] + 3.2), knots)
    shift = judge_shift(REFERENCE, current)
    assert math.isnan(shift.pieces[4].middle_mw)
    assert not shift.pieces[4].moved
    assert math.isnan(shift.pieces[4].confidence)
    content = json.loads(json.dumps(shift_json(shift), allow_nan=False))
    assert content['pieces'][4]['shift_mw'] is None
    assert content['pieces'][0]['shift_mw'] == pytest.approx(0.0)


def test_curves_of_different_inputs_are_not_compared():
    with pytest.raises(DataError, match='not the same thing'):
        judge_shift(replace(REFERENCE, pressure_exponent=1.0), curve_of())
    with pytest.raises(DataError, match='nothing can be compared'):
        judge_shift(REFERENCE, curve_of(knots=KNOTS + 2000.0))


def test_errors_that_are_not_known_judge_by_segments_only():
    unknown = curve_of(VALUES + 2.0, stderr=math.nan)
    shift = judge_shift(curve_of(stderr=math.nan), unknown)
    assert not shift.moved
    assert 'no error of the curves is known' in shift.sentence


def test_the_error_of_a_line_is_the_one_of_least_squares():
    """Even samples on a piece: the textbook's error of the fitted value."""
    u, sigma = np.linspace(1250.0, 1600.0, 400), 1.3
    design = np.column_stack([np.ones(400), u])
    covariance = sigma**2 * np.linalg.inv(design.T @ design)
    at = np.array([1250.0, 1300.0, 1425.0, 1600.0])
    rows = np.column_stack([np.ones(4), at])
    truth = np.sqrt(np.einsum('ij,jk,ik->i', rows, covariance, rows))
    piece = Piece(1250.0, 1600.0, 0.18, 0.0, float(np.sqrt(covariance[1, 1])),
                  float(np.sqrt(covariance[0, 0])), 400)  # fmt: skip
    assert piece_error(piece, at) == pytest.approx(truth, rel=0.01)
    both = curve_error(REFERENCE, np.array([1300.0, 2000.0]))
    assert both[0] == piece_error(REFERENCE.pieces[1], np.array([1300.0]))[0]
    assert both[1] == piece_error(REFERENCE.pieces[3], np.array([2000.0]))[0]


@pytest.mark.parametrize(('step_mw', 'moved'), [(-8.0, True), (-8.5, True), (0.0, False)])
def test_a_bent_curve_of_few_segments_is_judged_by_them(step_mw, moved):
    """One piece over all openings lies far from the reference where it has no segments."""
    segments = [
        s for s in history(3, days=0.2, count=60, change=lambda day, u: step_mw)
        if s.u_end < 1200.0 or s.u_start > 2150.0
    ]  # fmt: skip
    chord = curve_of(VALUES[[0, -1]] + step_mw, KNOTS[[0, -1]], end_ns=START_NS + DAY_NS)
    shift = judge_shift(REFERENCE, chord, segments)
    (piece,) = shift.pieces
    assert abs(piece.middle_mw - step_mw) > 15.0
    assert shift.moved == moved
    assert piece.shift_mw == pytest.approx(step_mw, abs=1.5)
    if moved:
        assert f'gives {abs(piece.shift_mw):.1f} MW' in shift.sentence


# --- one change of a mean ----------------------------------------------------------------------


def series(seed, n, at=None, size=0.0):
    rng = np.random.default_rng(seed)
    values = rng.normal(0.0, 1.0, n)
    if at is not None:
        values[at:] += size
    return values, rng.uniform(0.3, 1.0, n)


def best_split(values, weights):
    """Return the split with the least weighted squares about two means, by trying each."""
    best = (np.inf, 0)
    for k in range(LEAST_SIDE, len(values) - LEAST_SIDE + 1):
        cost = 0.0
        for part in (slice(0, k), slice(k, len(values))):
            mean = np.sum(weights[part] * values[part]) / np.sum(weights[part])
            cost += float(np.sum(weights[part] * (values[part] - mean) ** 2))
        best = min(best, (cost, k))
    return best[1]


def piece(values, weights, times=None):
    times = 1000 * np.arange(len(values), dtype=np.int64) if times is None else times
    samples = np.round(900.0 * weights).astype(np.int64)
    return SegmentResiduals(times, np.full(len(values), 1400.0), values, samples)


@examples(60)
@given(seeds, st.integers(2 * LEAST_SIDE, 60))
def test_the_place_is_the_one_of_least_squares(seed, n):
    values, weights = series(seed, n)
    found = scan(values, weights)
    assert found.place == best_split(values, weights)


def test_without_a_change_one_is_seen_no_more_often_than_said():
    limit = 0.01
    chances = [scan(*series(seed, 60)).p_value for seed in range(500)]
    # The correction for correlated neighbours makes it see rather less.
    assert np.mean(np.array(chances) < limit) <= 2.0 * limit


@examples(40)
@given(seeds, st.integers(5, 40), st.integers(5, 40), st.floats(0.1, 0.9))
def test_several_pieces_change_where_their_least_squares_say(seed, n, m, share):
    """The truth is a loop over all times; a piece may have all its members on one side."""
    rng = np.random.default_rng(seed)
    times = [np.sort(rng.choice(10**6, k, replace=False)).astype(np.int64) for k in (n, m)]
    at = int(share * 10**6)
    pieces = [
        piece(rng.normal(0.0, 0.1, len(t)) + jump * (t > at), np.ones(len(t)), t)
        for t, jump in zip(times, (5.0, -7.0), strict=True)
    ]
    edges = np.unique(np.concatenate(times))
    costs = []
    for split in edges[:-1]:
        parts = [p.residual_mw[side] for p in pieces
                 for side in (p.time_ns <= split, p.time_ns > split)]  # fmt: skip
        costs.append(sum(float(np.sum((part - part.mean()) ** 2)) for part in parts if len(part)))
    best = int(np.argmin(costs))
    middle, low, high = common_change(pieces, -1)
    if any(0 < np.sum(p.time_ns > at) < len(p) for p in pieces):
        assert edges[best] <= low <= middle <= high <= edges[best + 1]


def test_changes_before_the_known_time_are_left_out():
    pieces = [piece(*series(1, 80, 30, 5.0))]
    assert common_change(pieces, 60_000) == (0, 0, 0)
    assert common_change(pieces, 10**9) == (0, 0, 0)
    assert common_change(pieces, 20_000)[0] == pytest.approx(29_500, abs=600)
    times = 1000 * np.arange(80, dtype=np.int64)
    times[30:] += 10**6  # no member for a long time, and the known time is in between
    middle, low, high = common_change([piece(*series(1, 80, 30, 5.0), times)], 900_000)
    assert 900_000 <= low <= middle <= high <= times[30]


def test_short_and_still_series():
    assert scan(*series(1, 2 * LEAST_SIDE - 1)) is None
    assert scan(*series(1, 30), first=27) is None
    assert scan(np.zeros(20), np.ones(20)).p_value == 1.0
    only_late = scan(*series(3, 60, 20, 5.0), first=40)
    assert only_late.place >= 40
