from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from streams import lagged, needs_jit
from test_refine import START, TRUE, measured

from valveflow_ros.fit.refine import refine, relative_noise


def wandering(rng, n):
    """Return a valve that wanders slowly and now and then leaps."""
    u = 1500.0 + lagged(rng.normal(0.0, 100.0, n), 30.0, 0.0)
    u[n // 2 :] += 300.0
    return u


@pytest.mark.parametrize('seed', range(4))
@pytest.mark.parametrize('share', [0.0005, 0.002])
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


def test_nothing_to_learn_is_no_noise():
    assert relative_noise(np.empty(0), np.empty(0)) == 0.0
    assert relative_noise(np.full(5000, 7.0), np.ones(5000)) == 0.0
    assert relative_noise(np.linspace(1.0, 2.0, 5000), np.ones(5000)) == 0.0
    assert relative_noise(np.full(5000, np.nan), np.ones(5000)) == 0.0
    assert relative_noise(np.full(5000, -1.0), np.ones(5000)) == 0.0
    rng = np.random.default_rng(1)
    noisy = 100.0 + rng.normal(0.0, 1.0, 5000)
    assert relative_noise(noisy, np.zeros(5000)) == 0.0
    assert relative_noise(noisy, np.ones(5000)) == pytest.approx(0.01, rel=0.2)


@pytest.mark.parametrize('rows_s', [10, 60])
def test_slow_rows_do_not_pass_movement_off_as_noise(rows_s):
    rng = np.random.default_rng(11)
    u = 1500.0 + lagged(rng.normal(0.0, 100.0, 40_000 * rows_s), 30.0, 0.0)[::rows_s]
    assert relative_noise(u, np.ones(len(u))) == 0.0


@needs_jit
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
