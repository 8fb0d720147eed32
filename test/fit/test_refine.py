# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
import functools
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from streams import lagged, needs_jit, steps_and_ramps

from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.fit.problem import Problem, Samples
from valveflow_ros.fit.refine import refine, relative_noise
from valveflow_ros.fit.whitening import whitened

pytestmark = needs_jit

TRUE = RegionalModel(
    knots=np.array([1000.0, 1300.0, 1600.0, 2000.0]),
    left=np.array([100.0, 172.0, 220.0]),
    right=np.array([172.0, 220.0, 240.0]),
    levels=np.array([190.0]),
    time_constants=np.array([5.0, 20.0]),
    delays=np.array([2.3, 6.6]),
)


def straight(knots, values):
    """Return a curve without jumps and without dynamics, to start from."""
    values = np.asarray(values, dtype=np.float64)
    empty = np.empty(0)
    return RegionalModel(
        np.asarray(knots, dtype=np.float64), values[:-1].copy(), values[1:].copy(),
        empty, empty, empty,
    )  # fmt: skip


START = straight([1000.0, 1320.0, 1580.0, 2000.0], [101.0, 175.0, 219.0, 239.0])


def measured(model, seed, n=8000, noise=1.0, gaps=0):
    """Return rows of a plant that is ``model``, with white and slow noise of the power."""
    rng = np.random.default_rng(seed)
    u = steps_and_ramps(rng, n, 1000.0, 2000.0, hold=(60, 200), rate=3.0)
    usable = np.ones(n, dtype=np.uint8)
    for at in rng.integers(0, n, gaps):
        usable[at : at + 30] = 0
    power, _ = model.respond(u, np.ones(n, dtype=np.uint8), 1.0, 0.0)
    slow = lagged(rng.normal(0.0, 1.0, n), 20.0, 0.0)
    power = power + noise * (0.5 * rng.normal(0.0, 1.0, n) + slow)
    return Samples(u=u, power_mw=power, usable=usable, step_s=1.0, settle_s=110.0, group=5)


@functools.cache
def refined(seed):
    return refine(measured(TRUE, seed), START)


def deviations(result, true=TRUE):
    """Return how many standard errors each free parameter is off."""
    error = np.sqrt(np.diag(result.covariance))
    off = result.model.pack() - true.pack()
    return (off / np.where(error > 0.0, error, 1.0))[result.free]


SEEDS = range(4)


@pytest.mark.parametrize('seed', SEEDS)
def test_curve_dynamics_and_level_are_recovered_within_their_errors(seed):
    result = refined(seed)
    assert (result.model.pieces, result.model.regions) == (3, 2)
    assert result.long_s == 0.0  # fast movements fit as well as slow ones
    assert np.abs(deviations(result)).max() < 4.5
    assert result.model.levels == pytest.approx([190.0], abs=1.5)
    assert result.model.time_constants == pytest.approx([5.0, 20.0], rel=0.15)
    assert result.model.delays == pytest.approx([2.3, 6.6], abs=1.0)
    assert result.model.slopes() == pytest.approx(TRUE.slopes(), abs=0.01)


def test_the_standard_errors_are_neither_boast_nor_excuse():
    every = np.concatenate([deviations(refined(seed)) for seed in SEEDS])
    assert 0.5 < np.sqrt(np.mean(every**2)) < 1.7


def test_what_is_left_is_white_and_as_large_as_the_noise():
    result = refined(0)
    residual, weight = Problem(measured(TRUE, 0).finer()).answer(result.model)
    e = whitened(residual, weight, result.ar)[:, 0]
    assert result.innovation_mw == pytest.approx(e.std(), rel=0.02)
    assert e.std() < residual[weight > 0].std()
    assert abs(np.corrcoef(e[1:], e[:-1])[0, 1]) < 0.05
    assert np.isfinite(result.covariance).all()
    eigenvalues = np.linalg.eigvalsh(result.covariance)
    assert eigenvalues.min() > -1e-9 * eigenvalues.max()


@pytest.mark.parametrize(
    'start',
    [
        START,
        straight(
            [1000.0, 1100.0, 1290.0, 1450.0, 1610.0, 1800.0, 2000.0],
            [100.0, 125.0, 170.0, 195.0, 220.0, 230.0, 240.0],
        ),
    ],
    ids=['three', 'six'],
)
def test_the_number_of_pieces_is_found_from_enough_and_too_many(start):
    result = refine(measured(TRUE, 2), start, most_pieces=8)
    assert result.model.pieces == 3
    assert result.model.knots[1:-1] == pytest.approx([1300.0, 1600.0], abs=25.0)


@pytest.mark.parametrize('most', [1, 2])
def test_no_more_pieces_than_allowed(most):
    result = refine(measured(TRUE, 2), straight([1000.0, 2000.0], [100.0, 240.0]), most)
    assert result.model.pieces <= most


def test_a_straight_valve_stays_one_piece_and_one_region():
    true = RegionalModel(
        np.array([1000.0, 2000.0]), np.array([100.0]), np.array([240.0]), np.empty(0),
        np.array([12.0]), np.array([4.0]),
    )  # fmt: skip
    for seed in range(2):
        result = refine(measured(true, seed), straight([1000.0, 2000.0], [100.0, 240.0]), 8)
        assert (result.model.pieces, result.model.regions) == (1, 1)
        assert np.abs(deviations(result, true)).max() < 4.5


def test_a_start_with_a_narrow_piece_moves_all_the_same():
    """The exact partition may find a piece that is narrow in u where the samples are dense."""
    start = straight([1000.0, 1299.0, 1301.0, 1600.0, 2000.0], [100.0, 172.0, 172.0, 220.0, 240.0])
    result = refine(measured(TRUE, 1), start, most_pieces=8)
    assert result.model.pieces == 3
    assert result.model.regions == 2
    assert np.abs(deviations(result)).max() < 4.5


def test_a_plant_faster_than_its_rows_show_has_the_right_curve_all_the_same():
    fast = replace(TRUE, levels=np.empty(0), time_constants=np.array([2.0]), delays=np.zeros(1))
    rng = np.random.default_rng(4)
    u = steps_and_ramps(rng, 4000, 1000.0, 2000.0, hold=(60, 200), rate=3.0)
    usable = np.ones(len(u), dtype=np.uint8)
    power, _ = fast.respond(u, usable, 60.0, 0.0)
    power += rng.normal(0.0, 0.3, len(u))
    result = refine(Samples(u, power, usable, step_s=60.0, settle_s=110.0, group=1), START)
    at = np.linspace(1000.0, 2000.0, 101)
    assert np.abs(result.model.static(at) - fast.static(at)).max() < 0.3
    assert result.model.time_constants <= 6.0  # what rows a minute apart cannot tell from 2 s


def test_no_jump_is_found_where_there_is_none():
    assert not refined(0).free[2 * 3 : 2 * 3 + 2].any()


@pytest.mark.parametrize(('seed', 'jump'), [(1, 8.0), (2, -6.0)])
def test_a_jump_is_found_where_there_is_one(seed, jump):
    left, right = TRUE.left.copy(), TRUE.right.copy()
    left[1:] += jump
    right[1:] += jump
    jumping = RegionalModel(TRUE.knots, left, right, np.empty(0), np.array([8.0]), np.array([2.0]))
    start = straight(
        [1000.0, 1150.0, 1290.0, 1310.0, 1600.0, 1800.0, 2000.0],
        [100.0, 136.0, 170.0, 172.0 + jump, 220.0 + jump, 230.0 + jump, 240.0 + jump],
    )
    result = refine(measured(jumping, seed), start, most_pieces=8)
    assert result.model.pieces == 3
    assert result.model.left[1:] - result.model.right[:-1] == pytest.approx([jump, 0.0], abs=1.0)
    assert result.free[2 * 3 : 2 * 3 + 2].tolist() == [True, False]
    assert result.model.knots[1] == pytest.approx(1300.0, abs=2.0)


def test_a_constant_error_of_the_power_lifts_the_curve_and_nothing_else():
    samples = measured(TRUE, 1)
    lifted = Samples(samples.u, samples.power_mw + 50.0, samples.usable, 1.0, 110.0, 5)
    start = straight(START.knots, np.append(START.left, START.right[-1]) + 50.0)
    here, there = refined(1), refine(lifted, start)
    assert there.model.knots == pytest.approx(here.model.knots, abs=0.5)
    assert there.model.left - 50.0 == pytest.approx(here.model.left, abs=0.1)
    assert there.model.time_constants == pytest.approx(here.model.time_constants, rel=1e-2)
    assert there.model.levels - 50.0 == pytest.approx(here.model.levels, abs=0.5)


def test_gaps_cost_rows_and_no_accuracy_and_what_stands_in_them_does_not_matter():
    samples = measured(TRUE, 4, gaps=12)
    result = refine(samples, START)
    assert result.model.regions == 2
    assert np.abs(deviations(result)).max() < 4.5
    wild = Samples(
        np.where(samples.usable > 0, samples.u, 1e9),
        np.where(samples.usable > 0, samples.power_mw, np.nan),
        samples.usable, 1.0, 110.0, 5,
    )  # fmt: skip
    again = refine(wild, START)
    assert again.model.pack().tolist() == result.model.pack().tolist()
    assert again.model.levels.tolist() == result.model.levels.tolist()


def test_the_same_rows_give_the_same_bits_and_are_not_written():
    samples = measured(TRUE, 1)
    before = [array.tobytes() for array in (samples.u, samples.power_mw, samples.usable)]
    again = refine(samples, START)
    assert [a.tobytes() for a in (samples.u, samples.power_mw, samples.usable)] == before
    assert again.model.pack().tolist() == refined(1).model.pack().tolist()
    assert again.covariance.tolist() == refined(1).covariance.tolist()


# --- noise of the input -----------------------------------------------------------------------


def wandering(rng, n):
    """Return a valve that wanders slowly and now and then leaps."""
    u = 1500.0 + lagged(rng.normal(0.0, 100.0, n), 30.0, 0.0)
    u[n // 2 :] += 300.0
    return u


@pytest.mark.parametrize(('seed', 'share'), [(0, 0.0005), (1, 0.002)])
def test_the_noise_is_told_from_the_movement(seed, share):
    rng = np.random.default_rng(seed)
    u = wandering(rng, 100_000)
    found = relative_noise(u * (1.0 + share * rng.normal(0.0, 1.0, len(u))), np.ones(len(u)))
    assert found == pytest.approx(share, rel=0.5)


@pytest.mark.parametrize('scale', [0.01, 100.0])
def test_it_is_a_share(scale):
    rng = np.random.default_rng(3)
    u = wandering(rng, 20_000) * (1.0 + 0.002 * rng.normal(0.0, 1.0, 20_000))
    usable = np.ones(len(u))
    assert relative_noise(scale * u, usable) == pytest.approx(relative_noise(u, usable), rel=1e-9)


@pytest.mark.parametrize(
    'u',
    [np.empty(0), np.full(5000, 7.0), np.linspace(1.0, 2.0, 5000), np.full(5000, np.nan),
     np.full(5000, -1.0)],
    ids=['empty', 'still', 'ramp', 'nan', 'negative'],
)  # fmt: skip
def test_nothing_to_learn_is_no_noise(u):
    assert relative_noise(u, np.ones(len(u))) == 0.0
    noisy = 100.0 + np.random.default_rng(1).normal(0.0, 1.0, 5000)
    assert relative_noise(noisy, np.zeros(5000)) == 0.0


@pytest.mark.parametrize('rows_s', [10, 60])
def test_slow_rows_do_not_pass_movement_off_as_noise(rows_s):
    rng = np.random.default_rng(11)
    u = 1500.0 + lagged(rng.normal(0.0, 100.0, 40_000 * rows_s), 30.0, 0.0)[::rows_s]
    assert relative_noise(u, np.ones(len(u))) == 0.0


def test_sensor_noise_makes_the_plant_slower_and_most_of_it_is_taken_back(monkeypatch):
    one = replace(TRUE, levels=np.empty(0), time_constants=np.array([8.0]), delays=np.array([2.0]))
    errors = {}
    for name in ('corrected', 'as it is'):
        if name == 'as it is':
            monkeypatch.setattr('valveflow_ros.fit.refine.corrected', lambda *args: args[2])
        errors[name] = []
        for seed in range(3):
            samples = measured(one, seed, n=16_000, noise=0.2)
            rng = np.random.default_rng(seed + 100)
            noisy = samples.u * (1.0 + 0.0015 * rng.normal(0.0, 1.0, len(samples.u)))
            result = refine(replace(samples, u=noisy), START)
            errors[name].append(result.model.time_constants[0] - 8.0)
    assert np.mean(errors['as it is']) > 0.1
    assert abs(np.mean(errors['corrected'])) < 0.5 * np.mean(errors['as it is'])


def stored(x, band, most=300):
    """Return the rows that a historian holds: a new value after a change by the dead band."""
    out, age = x.copy(), 0
    for k in range(1, len(x)):
        age += 1
        if abs(x[k] - out[k - 1]) < band and age < most:
            out[k] = out[k - 1]
        else:
            age = 0
    return out


def held(seed, n=20000):
    """Return rows of P = p F(V) held by a historian, and the model."""
    rng = np.random.default_rng(seed)

    def wander(sd, rows):
        phi = np.exp(-1.0 / rows)
        return lfilter([sd * np.sqrt(1.0 - phi**2)], [1.0, -phi], rng.normal(size=n))

    v = np.clip(65.0 + wander(8.0, 2000.0) + wander(1.0, 60.0), 42.0, 88.0)
    p = 15.0 + wander(1.5, 3000.0) + wander(0.05, 100.0) - 0.02 * (v - 65.0)
    true = replace(
        straight([40.0, 60.0, 90.0], [6.0, 12.0, 15.0]), offset_mw=0.0,
        time_constants=np.array([10.0]), delays=np.array([2.0]),
    )  # fmt: skip
    usable = np.ones(n, dtype=np.uint8)
    y = true.respond(v, usable, 2.0, 0.0, p)[0] + wander(0.5, 200.0)
    v, p = v + 0.05 * rng.normal(size=n), p + 0.01 * rng.normal(size=n)
    v, p, y = stored(v, 0.5), stored(p, 0.12), stored(y, 2.0)
    return Samples(v, y, usable, 2.0, 110.0, 5, scale=p, pressure_mpa=p), true


def test_what_a_historian_held_hardly_makes_the_plant_slower():
    rows, true = held(1)
    assert rows.held
    assert not measured(TRUE, 0).held
    start = replace(true, time_constants=np.empty(0), delays=np.empty(0))
    model = refine(rows, start).model
    assert model.time_constants == pytest.approx(10.0, rel=0.5)  # without the correction 16 to 23


def test_simulated_rows_are_those_of_a_historian():
    rows, true = held(1, 4000)
    again = rows.simulated(true)
    new = np.append(True, np.diff(rows.power_mw) != 0.0)
    assert np.all(np.diff(again.power_mw)[~new[1:]] == 0.0)  # stored at the same times
    assert np.abs(again.power_mw - rows.power_mw).mean() < 1.5
    assert again.power_mw.std() == pytest.approx(rows.power_mw.std(), rel=0.02)
