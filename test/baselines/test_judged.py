# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Scores of predictions on special segments, who is better than whom, and the tests for it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from streams import examples, needs_jit

from valveflow_ros.baselines.comparison import (
    ErrorOrder,
    Finding,
    Terms,
    everywhere,
    finding_of,
    pairs_on_segments,
)
from valveflow_ros.baselines.judged import judge, over_blocks, over_samples, trial_of, widening_of
from valveflow_ros.errors import DataError
from valveflow_ros.records import SegmentKind
from valveflow_ros.report.comparison_tables import pairs_table

pytestmark = needs_jit


def test_scores_are_those_of_obvious_loops(curve, data):
    other = data()
    trial = trial_of(other, curve())
    predicted = curve(shift_mw=0.3).model.static(trial.u)
    found = judge(trial, {'a': predicted})
    total = count = 0.0
    for segment, (a, b, kind) in zip(found.segments, other.spans.tolist(), strict=True):
        errors = [
            trial.power_mw[t] - predicted[t]
            for t in range(a, b)
            if 1000.0 <= trial.u[t] <= 2200.0 and t >= 20
        ]
        assert segment.kind == kind
        assert len(segment.rows) == len(errors)
        score = segment.scores['a']
        assert score.mse_mw2 == pytest.approx(sum(e * e for e in errors) / len(errors))
        assert score.samples.mean == pytest.approx(sum(errors) / len(errors))
        total += sum(e * e for e in errors)
        count += len(errors)
    assert found.mse('a') == pytest.approx(total / count)
    assert found.samples == count
    kinds = [len(found.kinds(k)) for k in (SegmentKind.STEADY, SegmentKind.SLOPE)]
    assert kinds == [20, 10]
    assert found.bias('a').mean == pytest.approx(-0.3, abs=0.05)


def test_data_beyond_the_curve_are_refused_with_their_range(curve, data):
    trial = trial_of(data(u_shift=5000.0), curve())
    with pytest.raises(DataError, match=r'their u lies from 60\d\d to 71\d\d'):
        judge(trial, {'a': trial.power_mw})
    empty = replace(data(), spans=np.empty((0, 3), dtype=np.int64))
    with pytest.raises(DataError, match='no special segment'):
        judge(trial_of(empty, curve()), {})


def predictions(trial, curve, hammerstein_mw, sparse_mw, rng):
    """Return predictions whose errors beyond the noise are given."""
    static = curve().model.static(trial.u)
    wrong = rng.choice([-1.0, 1.0], len(trial.u) // 400).repeat(400)
    return {
        'paper.static': static, 'proposed.static': static, 'proposed.dynamic': static,
        'hammerstein.static': static, 'sparse.static': static,
        'hammerstein.dynamic': static + hammerstein_mw * wrong,
        'sparse.dynamic': static + sparse_mw * wrong,
    }  # fmt: skip


@pytest.mark.parametrize(
    ('hammerstein', 'sparse', 'finding'),
    [(2.0, 3.0, Finding.CONFIRMED), (0.0, 3.0, Finding.OPEN), (0.0, 0.0, Finding.OPEN)],
)
def test_what_becomes_of_the_finding(curve, data, hammerstein, sparse, finding):
    trial = trial_of(data(), curve())
    made = predictions(trial, curve, hammerstein, sparse, np.random.default_rng(3))
    pairs = pairs_on_segments(judge(trial, made), made)
    assert finding_of(pairs) is finding
    assert [p.terms for p in pairs] == 2 * [Terms.AS_PAPER, Terms.STATIC, Terms.DYNAMIC]
    # One baseline alone confirms nothing, however bad it is.
    assert finding_of([p for p in pairs if p.baseline == 'sparse']) is Finding.OPEN


def test_a_baseline_that_is_better_contradicts_it(curve, data):
    trial = trial_of(data(), curve())
    made = predictions(trial, curve, 0.0, 5.0, np.random.default_rng(3))
    wrong = np.repeat(np.tile([-1.5, 1.5], 15), 400)
    made['paper.static'] = made['paper.static'] + wrong
    pairs = pairs_on_segments(judge(trial, made), made)
    assert finding_of(pairs) is Finding.CONTRADICTED
    worse = next(p for p in pairs if p.terms is Terms.AS_PAPER)
    assert (worse.baseline, worse.outcome) == ('hammerstein', ErrorOrder.WORSE)
    # Who is better does not depend on who is called ours.
    j = judge(trial, made)
    there, back = (
        j.gain('paper.static', 'sparse.dynamic'),
        j.gain('sparse.dynamic', 'paper.static'),
    )
    assert there.t == pytest.approx(-back.t)


def test_a_simulation_that_runs_away_counts_against_it(curve, data):
    trial = trial_of(data(), curve())
    made = predictions(trial, curve, 0.0, 0.0, np.random.default_rng(3))
    away = made['sparse.dynamic'].copy()
    away[4000:] = np.inf
    made['sparse.dynamic'] = away
    j = judge(trial, made)
    assert j.failed('sparse.dynamic') == 20
    assert j.mse('sparse.dynamic') == np.inf
    pairs = pairs_on_segments(j, made)
    pair = next(p for p in pairs if p.theirs == 'sparse.dynamic')
    assert pair.outcome is ErrorOrder.BETTER
    # What makes it better stands beside the verdict.
    assert pair.failed == 20
    assert 'theirs has no finite answer in 20 of 30; the others: p' in pairs_table(pairs)
    assert 'no finite answer' not in pairs_table([p for p in pairs if p.theirs != pair.theirs])
    mse, rows = everywhere(trial, made)
    assert mse['sparse.dynamic'] == np.inf
    assert next(p for p in rows if p.baseline == 'sparse').failed > 0


def test_one_segment_without_an_answer_decides_nothing(curve, data):
    trial = trial_of(data(), curve())
    made = predictions(trial, curve, 3.0, 0.0, np.random.default_rng(3))
    made['sparse.dynamic'][6000:6100] = np.inf
    pairs = pairs_on_segments(judge(trial, made), made)
    pair = next(p for p in pairs if p.theirs == 'sparse.dynamic')
    assert (pair.failed, pair.judged, pair.outcome) == (1, 30, ErrorOrder.OPEN)
    assert finding_of(pairs) is Finding.OPEN
    rows = everywhere(trial, made)[1]
    assert next(p for p in rows if p.baseline == 'sparse').outcome is ErrorOrder.OPEN


# --- tests of a mean difference ------------------------------------------------------------


def ar1(n, phi, rng):
    e = rng.standard_normal(n + 200)
    for t in range(1, len(e)):
        e[t] += phi * e[t - 1]
    return e[200:]


@examples(40)
@given(st.integers(0, 10_000), st.integers(2, 60), st.floats(-2.0, 2.0))
def test_counting_each_sample_is_the_textbooks_paired_test(seed, n, shift):
    rng = np.random.default_rng(seed)
    y, predicted = rng.normal(shift, 1.0, n), rng.normal(0.0, 1.0, n)
    ours, theirs = over_samples(y - predicted), stats.ttest_rel(y, predicted)
    assert ours.t == pytest.approx(theirs.statistic, rel=1e-9)
    assert ours.p_value == pytest.approx(theirs.pvalue, rel=1e-6, abs=1e-12)
    low, high = ours.interval()
    wanted = theirs.confidence_interval(0.95)
    np.testing.assert_allclose([low, high], [wanted.low, wanted.high], rtol=1e-8)


def test_correlated_noise_fools_the_one_and_not_the_other():
    """Under the null, a zero mean is rejected ever so often at 5 %."""
    rng = np.random.default_rng(12)
    naive = counted = 0
    for _ in range(150):
        segments = [ar1(400, 0.97, rng) for _ in range(12)]
        edges = np.arange(13) * 400
        spans = np.column_stack([edges[:-1], edges[1:]])
        widening = widening_of(np.concatenate(segments), spans, 1.0)
        naive += over_samples(segments[0]).zero_is_rejected()
        counted += over_samples(segments[0], widening).zero_is_rejected()
    assert naive > 100
    # A dozen short segments teach the correlation roughly; 5 % becomes 5 to 15 %.
    assert counted < 23


@pytest.mark.parametrize('phi', [0.0, 0.95])
def test_the_widening_of_a_known_noise(phi):
    rng = np.random.default_rng(15)
    edges = np.arange(101) * 600
    spans = np.column_stack([edges[:-1], edges[1:]])
    found = widening_of(ar1(60_000, phi, rng), spans, 1.0)
    assert found == pytest.approx((1.0 + phi) / (1.0 - phi), rel=0.3)


def test_what_cannot_be_tested_says_so():
    for difference, widening in ((np.array([1.0]), 1.0), (np.arange(5.0), 4.0), (np.empty(0), 1)):
        test = over_samples(difference, widening)
        assert np.isnan(test.p_value)
        assert not test.zero_is_rejected()
        assert np.isnan(test.interval()).all()
    assert np.isnan(over_blocks(np.array([3.0])).p_value)
    assert np.isnan(over_blocks(np.empty(0)).mean)
    # No scatter at all.
    same = over_samples(np.full(10, 2.0))
    assert (same.p_value, same.t) == (0.0, np.inf)
    assert over_samples(np.zeros(10)).p_value == 1.0


@examples(30)
@given(st.integers(0, 1000), st.floats(0.1, 50.0))
def test_scaling_changes_no_verdict(seed, scale):
    values = np.random.default_rng(seed).normal(0.3, 1.0, 40)
    for test in (over_samples, over_blocks):
        a, b = test(values), test(scale * values)
        assert b.t == pytest.approx(a.t, rel=1e-6)
        assert b.mean == pytest.approx(scale * a.mean, rel=1e-6)
        assert test(-values).t == pytest.approx(-a.t, rel=1e-9)
