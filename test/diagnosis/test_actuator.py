# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Faults between command and position sensor: found where they are, and only there."""

from __future__ import annotations

import numpy as np
import pytest
from diagnosis_records import masked, record, table, unit
from streams import needs_jit

from valveflow_ros.diagnosis.diagnose import notes
from valveflow_ros.diagnosis.grids import make_grids
from valveflow_ros.diagnosis.loop import actuator
from valveflow_ros.diagnosis.loop.actuator import sized
from valveflow_ros.records import Signal

pytestmark = needs_jit
DAYS = 0.5
FAULTS = {
    'stiction': ('stiction:before_sensor=1,s_percent=1.2,j_percent=0.8', (1.2, 0.8)),
    'backlash': ('stiction:before_sensor=1,s_percent=0.8,j_percent=0', (0.8,)),
    'rate_limit': ('rate_limit:before_sensor=1,r_percent_per_s=0.1', (0.1,)),
    'saturation': ('saturation:before_sensor=1,max_percent=84', (84.0,)),
}


def scene_of(samples):
    bad = np.zeros(samples.values.shape, dtype=bool)
    return make_grids(*record(samples).about, bad)


def judged(*effects, seed):
    return actuator.judge(scene_of(table(DAYS, seed, effects, unit())))


@pytest.mark.parametrize('seed', [41, 42])
def test_a_sound_actuator_is_not_named(seed):
    assert judged(seed=seed) is None


@pytest.mark.parametrize('behind', ['stiction:s_percent=2,j_percent=1.4', 'backlash:w_percent=2'])
def test_what_lies_behind_the_sensor_is_not_seen_before_it(behind):
    assert judged(behind, seed=44) is None


@pytest.mark.parametrize('name', FAULTS)
def test_every_fault_is_named_with_its_sizes(name):
    effect, truth = FAULTS[name]
    found = judged(effect, seed=45)
    assert found.name == name
    assert found.p_value < 1e-3
    assert found.rms_after < found.rms_before
    for (value, low, high), true in zip(found.parameters.values(), truth, strict=True):
        assert low <= value <= high
        assert value == pytest.approx(true, rel=0.03)


@pytest.mark.parametrize('change', ['sensor offset', 'missing rows', 'mirrored'])
def test_what_does_not_matter(change):
    effect, truth = FAULTS['stiction']
    samples = table(DAYS, 45, (effect,), unit())
    grids = scene_of(masked(samples, 0.01, 3) if change == 'missing rows' else samples)
    if change == 'sensor offset':
        grids.v[:] += 1.5
    if change == 'mirrored':
        grids.v[:], grids.command[:] = 100.0 - grids.v, 100.0 - grids.command
    found = actuator.judge(grids)
    assert found.name == 'stiction'
    sizes = [value for value, _, _ in found.parameters.values()]
    assert sizes == pytest.approx(truth, rel=0.05)


def test_a_stop_that_holds_most_of_the_time_is_found():
    samples = table(DAYS, 45, (), unit())
    stop = float(np.quantile(samples.values[:, Signal.VALVE_OPENING], 0.5))
    found = judged(f'saturation:before_sensor=1,max_percent={stop:.2f}', seed=45)
    assert found.name == 'saturation'
    assert found.parameters['max_percent'][0] == pytest.approx(stop, abs=0.2)


def test_a_command_of_another_day_is_no_fault():
    grids = scene_of(table(DAYS, 45, (FAULTS['stiction'][0],), unit()))
    grids.command[:] = np.roll(grids.command, len(grids.command) // 2)
    found = actuator.judge(grids)
    assert found is None or found.name != 'stiction'


@pytest.mark.parametrize(
    ('rows', 'words'),
    [
        (slice(None), 'the commanded opening was not logged'),
        (slice(500, None), 'hardly changes, or was rarely logged'),
    ],
)
def test_a_missing_command_is_said(rows, words):
    samples = table(DAYS, 41, (), unit())
    samples.values[rows, Signal.VALVE_COMMAND], kept = (
        np.nan,
        samples.values[rows, Signal.VALVE_COMMAND].copy(),
    )
    try:
        grids = scene_of(samples)
    finally:
        samples.values[rows, Signal.VALVE_COMMAND] = kept
    assert words in actuator.hindered(grids)
    assert actuator.judge(grids) is None
    (note,) = notes(grids)
    assert note.startswith('Faults between command and position sensor cannot be judged')


def obvious(rows, band, jump, rate, seed):
    """Return a command and the reading of a valve that sticks and has a fastest motion."""
    rng = np.random.default_rng(seed)
    t = np.arange(rows)
    c = (
        60
        + 4 * np.sin(t / 150)
        + 2 * np.sin(t / 31)
        + 4 * np.sign(np.sin(t / 97))
        + 0.15 * rng.normal(size=rows)
    )
    place, out = c[0], []
    for wanted in c:
        pull = wanted - place
        if abs(pull) > (band + jump) / 2:
            aim = wanted - np.sign(pull) * (band - jump) / 2
            place += min(max(aim - place, -rate), rate)
        out.append(place)
    return np.round(c, 2), np.round(np.array(out) + 0.02 * rng.normal(size=rows), 2)


@pytest.mark.parametrize(
    ('name', 'truth', 'start'),
    [
        ('stiction', (2.0, 1.2), (2.3, 1.0)),
        ('backlash', (1.5,), (1.6,)),
        ('rate_limit', (0.2,), (0.21,)),
    ],
)
def test_sizes_are_freed_of_the_pull_of_noise(name, truth, start):
    """From a start that is off, intervals of several records hold the truth mostly."""
    band, jump = {'stiction': truth, 'backlash': (truth[0], 0.0)}.get(name, (0.0, 0.0))
    rate = truth[0] if name == 'rate_limit' else np.inf
    held = []
    for seed in range(5):
        found = sized(name, *obvious(9_000, band, jump, rate, seed), 1.0, start)
        held += [low <= t <= high for (_, low, high), t in zip(found, truth, strict=True)]
        assert [v for v, _, _ in found] == pytest.approx(truth, rel=0.02)
    assert np.mean(held) >= 0.7


def test_sizes_need_rows():
    c, v = obvious(40, 2.0, 1.2, np.inf, 1)
    assert sized('stiction', c, v, 1.0, (2.0, 1.2)) is None
    assert sized('saturation', c, v, 1.0, (84.0,)) is None
