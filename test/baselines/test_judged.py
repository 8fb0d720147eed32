# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Scores of predictions on special segments, and who is better than whom."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from streams import needs_jit

from valveflow_ros.baselines.comparison import (
    ErrorOrder,
    Finding,
    Terms,
    everywhere,
    finding_of,
    pairs_on_segments,
)
from valveflow_ros.baselines.judged import judge, trial_of
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


def test_white_noise_is_worth_each_sample(curve, data):
    trial = trial_of(data(), curve())
    found = judge(trial, {'a': curve().model.static(trial.u)})
    assert 1.0 <= found.widening < 1.6
    stands, tested = found.passed('a', as_paper=True)
    assert tested == 30
    assert stands >= 25


def test_rows_nobody_can_judge_are_left_out_and_counted(curve, data):
    other = data()
    samples = other.samples
    usable = samples.usable.copy()
    usable[600] = 0  # in the second segment
    trial = trial_of(replace(other, samples=replace(samples, usable=usable)), curve())
    assert not trial.good[600]
    assert not trial.good[601:621].any()
    assert trial.good[621]
    assert not trial.good[:20].any()
    low = replace(curve(), pieces=curve().pieces[:2], breakpoint_intervals=((0.0, 1.0),))
    narrow = judge(trial_of(other, low), {'a': curve().model.static(samples.u)})
    assert narrow.outside > 0
    assert all(samples.u[s.rows].max() <= 1800.0 for s in narrow.segments)


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
    [
        (2.0, 3.0, Finding.CONFIRMED),
        (0.0, 3.0, Finding.OPEN),
        (0.0, 0.0, Finding.OPEN),
    ],
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


def test_without_dynamics_there_is_nothing_to_simulate(curve, data):
    trial = trial_of(data(), curve())
    made = predictions(trial, curve, 1.0, 1.0, np.random.default_rng(3))
    del made['proposed.dynamic']
    mse, rows = everywhere(trial, made)
    assert rows == ()
    assert set(mse) == {'hammerstein.dynamic', 'sparse.dynamic'}
    pairs = pairs_on_segments(judge(trial, made), made)
    assert Terms.DYNAMIC not in {p.terms for p in pairs}
