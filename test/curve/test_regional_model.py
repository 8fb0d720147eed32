from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive_stream import naive_curve, naive_respond
from streams import examples, steps_and_ramps

from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.fit.problem import Problem, Samples


@st.composite
def models(draw, most_pieces=4, most_regions=3, kinks=True):
    pieces = draw(st.integers(1, most_pieces))
    widths = draw(st.lists(st.floats(50.0, 400.0), min_size=pieces, max_size=pieces))
    knots = 1000.0 + np.cumsum([0.0, *widths])
    slopes = np.array(draw(st.lists(st.floats(0.02, 0.3), min_size=pieces, max_size=pieces)))
    right = 100.0 + np.cumsum(slopes * np.diff(knots))
    left = np.concatenate([[100.0], right[:-1]])
    left[1:] += draw(st.lists(st.floats(-5.0, 5.0), min_size=pieces - 1, max_size=pieces - 1))
    # The answer has a kink in the delay at each whole step.
    whole = st.integers(0, 11)
    delay = (
        st.floats(0.0, 12.0) if kinks else st.builds(sum, st.tuples(whole, st.floats(0.1, 0.9)))
    )
    regions = draw(st.integers(1, most_regions))
    span = right[-1] - 100.0
    levels = 100.0 + span * np.arange(1, regions) / regions
    return RegionalModel(
        knots=knots, left=left, right=right, levels=levels,
        time_constants=np.array(
            draw(st.lists(st.floats(1.0, 90.0), min_size=regions, max_size=regions))
        ),
        delays=np.array(
            draw(st.lists(delay, min_size=regions, max_size=regions)), dtype=np.float64
        ),
    )  # fmt: skip


def inputs(model, seed, n=300, noise=3.0):
    rng = np.random.default_rng(seed)
    low, high = model.knots[0] - 50.0, model.knots[-1] + 50.0
    return steps_and_ramps(rng, n, low, high, hold=(20, 60)) + noise * rng.normal(0.0, 1.0, n)


def gaps(seed, n):
    """Return which rows are usable: long stretches and a few gaps."""
    rng = np.random.default_rng(seed)
    usable = np.ones(n, dtype=np.uint8)
    for _ in range(rng.integers(0, 4)):
        at = int(rng.integers(0, n))
        usable[at : at + int(rng.integers(1, 20))] = 0
    return usable


def samples_of(u, power, usable, settle_s=20.0, group=5, step_s=1.0):
    return Samples(
        u=np.where(usable > 0, u, 0.0), power_mw=np.where(usable > 0, power, 0.0), usable=usable,
        step_s=step_s, settle_s=settle_s, group=group,
    )  # fmt: skip


def naive_means(model, u, usable, step_s, settle, group):
    """Return the mean answers and which of them count, by loops."""
    x = [naive_curve(v, model.knots, model.left, model.right) for v in u]
    answer = naive_respond(x, usable, model.levels, model.time_constants, model.delays, step_s)
    age, settled = 0, []
    for good in usable:
        age = age + 1 if good else 0
        settled.append(age > settle)
    means, counts = [], []
    for start in range(0, len(u) - group + 1, group):
        rows = range(start, start + group)
        counts.append(all(settled[k] for k in rows))
        means.append(sum(answer[k] for k in rows) / group if counts[-1] else None)
    return means, counts


# --- the curve ------------------------------------------------------------------------------


@examples(60)
@given(models(), st.lists(st.floats(900.0, 3000.0), min_size=1, max_size=20))
def test_the_curve_is_the_slow_one_and_goes_on_beyond_its_ends(model, u):
    u = np.array([*u, *model.knots])
    expected = [naive_curve(v, model.knots, model.left, model.right) for v in u]
    assert model.static(u) == pytest.approx(expected, rel=1e-12)
    lines = model.slopes() * u[:, None] + model.intercepts()
    assert all(np.abs(line - v).min() < 1e-7 for line, v in zip(lines, expected, strict=True))


@examples(60)
@given(models())
def test_packing_and_unpacking_gives_the_same_model(model):
    back = model.unpack(model.pack())
    for name in ('knots', 'left', 'right', 'levels', 'time_constants', 'delays'):
        assert getattr(back, name) == pytest.approx(getattr(model, name), rel=1e-12, abs=1e-12)
    assert len(model.pack()) == 3 * model.pieces - 1 + 2 * model.regions
    assert (back.pieces, back.regions) == (model.pieces, model.regions)


def test_without_data_there_is_no_flow():
    model = RegionalModel(*(np.array(a) for a in ([0.0, 1.0], [0.0], [1.0], [], [], [])))
    assert np.isnan(model.static(np.array([np.nan]))).all()
    assert model.regions == 0


# --- the response ---------------------------------------------------------------------------


@examples(40)
@given(models(), st.integers(0, 2**32 - 1), st.sampled_from([0.5, 1.0, 2.0]))
def test_the_response_is_the_slow_one(model, seed, step):
    u, usable = inputs(model, seed), gaps(seed, 300)
    x = [naive_curve(v, model.knots, model.left, model.right) for v in u]
    expected = naive_respond(x, usable, model.levels, model.time_constants, model.delays, step)
    got, settled = model.respond(u, usable, step, settle_s=20.0 * step)
    for k in range(300):
        if usable[k]:
            assert got[k] == pytest.approx(expected[k], rel=1e-10)
        else:
            assert np.isnan(got[k])
        recent = usable[max(0, k - 20) : k + 1]
        assert settled[k] == (k >= 20 and recent.all())


@examples(40)
@given(models(), st.integers(0, 2**32 - 1), st.sampled_from([1, 3, 10]))
def test_means_of_the_response_are_the_slow_ones(model, seed, group):
    u, usable = inputs(model, seed), gaps(seed, 300)
    power = np.random.default_rng(seed).normal(200.0, 5.0, 300)
    problem = Problem(samples_of(u, power, usable, group=group))
    residual, weight = problem.answer(model)
    means, counts = naive_means(model, u, usable, 1.0, 20, group)
    assert weight.tolist() == [int(c) for c in counts]
    for k, counted in enumerate(counts):
        measured = power[k * group : (k + 1) * group].mean()
        assert residual[k] == pytest.approx(measured - means[k] if counted else 0.0, abs=1e-8)


@examples(20)
@given(models(), st.integers(0, 2**32 - 1))
def test_in_equilibrium_the_answer_is_the_curve(model, seed):
    level = float(np.random.default_rng(seed).uniform(model.knots[0], model.knots[-1]))
    u = np.full(200, level)
    got, _ = model.respond(u, np.ones(200, dtype=np.uint8), 1.0, 20.0)
    assert got == pytest.approx(np.full(200, model.static(np.array([level]))[0]), rel=1e-12)


def one_region(time_constant, delay):
    return RegionalModel(
        np.array([0.0, 100.0]), np.array([0.0]), np.array([100.0]), np.empty(0),
        np.array([time_constant]), np.array([delay]),
    )  # fmt: skip


@pytest.mark.parametrize('step', [0.1, 1.0, 2.5, 60.0])
@pytest.mark.parametrize('delay', [0.0, 3.0, 7.7])
def test_a_ramp_is_answered_late_by_time_constant_and_delay_at_any_period(step, delay):
    """Eqs. (13) and (14): y(t) = K_f u(t - T - tau) + C once the transient is over."""
    n = 3000
    time_constant = max(4.0, step)
    time_s = step * np.arange(n)
    u = 10.0 + 80.0 * time_s / time_s[-1]
    got, _ = one_region(time_constant, delay).respond(u, np.ones(n, dtype=np.uint8), step, 0.0)
    late = 10.0 + 80.0 * (time_s - time_constant - delay) / time_s[-1]
    settled = time_s > 40.0 * time_constant + delay
    assert settled.any()
    assert got[settled] == pytest.approx(late[settled], rel=1e-9)


def test_a_step_is_answered_after_the_delay_with_the_time_constant():
    """Between two rows the flow runs straight, so a step takes one row to be there."""
    u = np.where(np.arange(200) < 50, 20.0, 60.0)
    got, _ = one_region(10.0, 3.0).respond(u, np.ones(200, dtype=np.uint8), 1.0, 0.0)
    after = np.arange(147)
    first = 1.0 - 10.0 * (1.0 - np.exp(-0.1))
    expected = 1.0 - (1.0 - first) * np.exp(-after / 10.0)
    assert got[:53] == pytest.approx(20.0)
    assert got[53:] == pytest.approx(20.0 + 40.0 * expected, rel=1e-12)


@examples(20)
@given(models(most_regions=1), st.integers(0, 2**32 - 1), st.floats(-100.0, 100.0))
def test_power_shifted_with_the_curve_shifts_the_answer(model, seed, more):
    u, usable = inputs(model, seed), gaps(seed, 300)
    here, _ = model.respond(u, usable, 1.0, 20.0)
    moved = RegionalModel(
        model.knots, model.left + more, model.right + more, model.levels,
        model.time_constants, model.delays,
    )  # fmt: skip
    there, _ = moved.respond(u, usable, 1.0, 20.0)
    assert there == pytest.approx(here + more, abs=1e-9, nan_ok=True)


# --- derivatives ----------------------------------------------------------------------------


def by_differences(problem, model, column):
    """Return the derivative of the mean answers by one packed parameter.

    The answers are piecewise smooth: where a sample changes its piece, its region or its
    whole step of delay the two sides differ, and only where they agree is there a derivative.
    """
    h = 1e-5 * max(1.0, abs(model.pack()[column]))
    sides = []
    for sign in (-1.0, 1.0):
        packed = model.pack()
        packed[column] += sign * h
        moved, _ = problem.answer(model.unpack(packed))
        here, weight = problem.answer(model)
        sides.append(np.where(weight > 0, sign * (here - moved) / h, np.nan))
    smooth = np.abs(sides[0] - sides[1]) < 2e-4 * (1.0 + np.abs(sides[0]))
    return 0.5 * (sides[0] + sides[1]), smooth


@examples(30)
@given(models(most_regions=1, kinks=False), st.integers(0, 2**32 - 1), st.sampled_from([1, 5]))
def test_the_tangents_of_one_region_are_the_differences(model, seed, group):
    """With one region nothing flips but pieces, and those differ by a kink only."""
    u, usable = inputs(model, seed), gaps(seed, 300)
    problem = Problem(samples_of(u, np.zeros(300), usable, group=group))
    residual, jacobian, weight = problem.tangents(model)
    assert np.array_equal(weight, problem.answer(model)[1])
    assert residual == pytest.approx(problem.answer(model)[0], abs=1e-9)
    share = []
    for column in range(jacobian.shape[1]):
        expected, smooth = by_differences(problem, model, column)
        rows = (weight > 0) & smooth
        share.append(rows.sum() / max(1, (weight > 0).sum()))
        # Rows count as smooth while their two sides differ by less than 1e-3.
        assert jacobian[rows, column] == pytest.approx(expected[rows], rel=2e-3, abs=1e-3)
    assert np.median(share) > 0.8


@examples(20)
@given(models(kinks=False), st.integers(0, 2**32 - 1))
def test_the_tangents_of_several_regions_are_the_differences_where_no_sample_flips(model, seed):
    """Freeze the regime: time constants and delays move no sample across a level."""
    u, usable = inputs(model, seed), gaps(seed, 300)
    problem = Problem(samples_of(u, np.zeros(300), usable))
    _, jacobian, weight = problem.tangents(model)
    dynamic = range(3 * model.pieces - 1, jacobian.shape[1])
    for column in dynamic:
        expected, smooth = by_differences(problem, model, column)
        rows = (weight > 0) & smooth
        assert jacobian[rows, column] == pytest.approx(expected[rows], rel=2e-3, abs=2e-4)


def test_the_curves_tangents_add_up_with_the_regions_frozen():
    """F lifted by one everywhere lifts every answer by one, whatever the dynamics."""
    model = RegionalModel(
        np.array([1000.0, 1300.0, 1600.0]), np.array([100.0, 165.0]), np.array([160.0, 200.0]),
        np.array([150.0]), np.array([10.0, 40.0]), np.array([2.5, 7.25]),
    )  # fmt: skip
    u = inputs(model, 3)
    problem = Problem(samples_of(u, np.zeros(300), np.ones(300, dtype=np.uint8)))
    _, jacobian, weight = problem.tangents(model)
    values = jacobian[:, : model.pieces + 1].sum(axis=1)
    assert values[weight > 0] == pytest.approx(1.0)


# --- hostile --------------------------------------------------------------------------------


def test_rows_that_do_not_fill_a_group_are_left_out():
    samples = samples_of(np.arange(23.0), np.zeros(23), np.ones(23, dtype=np.uint8), 0.0, 5)
    assert samples.means == 4
    assert len(Problem(samples).power) == 4


@pytest.mark.parametrize('n', [0, 1, 4])
def test_less_than_one_group_gives_no_means(n):
    model = RegionalModel(*(np.array(a) for a in (
        [0.0, 10.0], [0.0], [10.0], [], [5.0], [1.0])))  # fmt: skip
    problem = Problem(samples_of(np.zeros(n), np.zeros(n), np.ones(n, dtype=np.uint8)))
    residual, jacobian, weight = problem.tangents(model)
    assert len(residual) == len(weight) == 0
    assert jacobian.shape == (0, 4)
    assert problem.cost(model, np.zeros(4)) == 0.0


def test_no_usable_row_scores_nothing():
    model = RegionalModel(*(np.array(a) for a in (
        [0.0, 10.0], [0.0], [10.0], [], [5.0], [1.0])))  # fmt: skip
    problem = Problem(samples_of(np.full(50, 5.0), np.full(50, np.nan),
                                 np.zeros(50, dtype=np.uint8)))  # fmt: skip
    residual, weight = problem.answer(model)
    assert not weight.any()
    assert not residual.any()


def test_what_stands_in_rows_that_are_not_usable_does_not_matter():
    rng = np.random.default_rng(0)
    model = RegionalModel(*(np.array(a) for a in (
        [1000.0, 2000.0], [100.0], [200.0], [], [5.0], [1.0])))  # fmt: skip
    u, usable = inputs(model, 1), gaps(5, 300)
    usable[100:110] = 0
    power = rng.normal(150.0, 1.0, 300)
    clean = Problem(samples_of(u, power, usable)).answer(model)
    dirty = Samples(
        u=np.where(usable > 0, u, np.nan), power_mw=np.where(usable > 0, power, np.inf),
        usable=usable, step_s=1.0, settle_s=20.0, group=5,
    )  # fmt: skip
    got = Problem(dirty).answer(model)
    assert np.array_equal(got[0], clean[0])
    assert np.array_equal(got[1], clean[1])
