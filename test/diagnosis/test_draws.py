# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A valve that sticks: several draws of the sensor's noise, believed by how they predict."""

from __future__ import annotations

import numpy as np
import pytest
from diagnosis_records import record, rough_model, table, unit
from hypothesis import given
from hypothesis import strategies as st
from streams import needs_jit

from valveflow_ros.diagnosis.cause import FittedCause, Kind
from valveflow_ros.diagnosis.causes import catalogue
from valveflow_ros.diagnosis.extended import Extended, answer
from valveflow_ros.diagnosis.fitting import Task, beliefs, free, held, whitening
from valveflow_ros.diagnosis.grids import ORDER, make_grids, sensor_noise

pytestmark = needs_jit
STICKS = (2.0, 1.4)


@pytest.mark.parametrize('noise', [0.01, 0.02, 0.05])
@pytest.mark.parametrize('seed', [1, 2, 3])
def test_the_noise_of_a_wandering_position_is_told_from_its_moves(noise, seed):
    rng = np.random.default_rng(seed)
    moves = np.cumsum(rng.normal(0.0, 0.03, 200_000))
    v = np.round(moves + rng.normal(0.0, noise, len(moves)), 2)
    v[::997] = np.nan
    assert sensor_noise(v) == pytest.approx(noise, rel=0.2, abs=0.003)
    assert sensor_noise(np.full(10, np.nan)) == 0.0


@given(
    st.integers(2, 5),
    st.lists(st.floats(-5.0, 5.0), min_size=2, max_size=30),
    st.integers(0, 2**32 - 1),
)
def test_beliefs_sum_to_one_and_know_the_past_only(count, values, seed):
    rng = np.random.default_rng(seed)
    white = np.array(values)[None, :] + rng.normal(size=(count, len(values)))
    good = rng.random(len(values)) < 0.8
    out = np.empty_like(white)
    beliefs(white, good, 1.0, 0.01, out)
    np.testing.assert_allclose(out.sum(axis=0), 1.0, atol=1e-12)
    other = white.copy()
    other[:, -1] = rng.normal(size=count)
    again = np.empty_like(white)
    beliefs(other, good, 1.0, 0.01, again)
    np.testing.assert_array_equal(out, again)


def test_what_predicted_well_is_believed_and_can_be_given_up():
    white = np.zeros((2, 400))
    white[0, :200] = 3.0
    white[1, 200:] = 3.0
    out = np.empty_like(white)
    beliefs(white, np.ones(400, dtype=bool), 1.0, 0.005, out)
    assert out[1, 100] > 0.98
    assert out[0, 399] > 0.98


@pytest.fixture(scope='module')
def sticking():
    samples = table(1.0, 4, (f'stiction:s_percent={STICKS[0]},j_percent={STICKS[1]}',), unit())
    grids = make_grids(*record(samples).about, np.zeros(samples.values.shape, dtype=bool))
    plain = Extended(rough_model())
    task = Task(grids, grids.open_rows, np.zeros(ORDER))
    return Task(grids, grids.open_rows, whitening(grids, task.residual(plain))), plain


def test_believed_draws_predict_better_than_their_mean_and_than_a_slack(sticking):
    task, plain = sticking
    drawn = plain.with_cause(FittedCause(catalogue()['stiction'], STICKS))
    slack = plain.with_cause(FittedCause(catalogue()['backlash'], (STICKS[0],)))
    mean = np.mean((task.grids.power - answer(task.grids, drawn))[task.rows] ** 2)
    believed = np.mean(task.residual(drawn)[task.rows] ** 2)
    assert believed < mean
    assert task.cost(drawn) < 0.98 * task.cost(slack)
    assert task.cost(drawn) < 0.9 * task.cost(plain)


def test_held_draws_say_nearly_the_same_and_come_free_again(sticking):
    task, plain = sticking
    drawn = plain.with_cause(FittedCause(catalogue()['stiction'], STICKS))
    fixed = held(task.grids, drawn, task.ar)
    (active,) = fixed.active
    assert active.values == STICKS
    assert {u.kind for u in active.cause.unknowns} == {Kind.HELD}
    rows = task.rows
    apart = (task.residual(fixed) - task.residual(drawn))[rows]
    assert np.std(apart) < 0.5 * np.std(task.residual(plain)[rows] - task.residual(drawn)[rows])
    assert free(fixed, catalogue()) == drawn
    assert held(task.grids, plain, task.ar) is plain
