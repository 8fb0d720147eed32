# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The manual step test: levels found, means, refusals, and the curve through them."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from step_plan import StepPlan, step_test
from streams import INTERPRETED, START_NS, examples, grid_ns, table_of

from valveflow_ros.errors import DataError
from valveflow_ros.fit.step_levels import holds, looks_like_step_test
from valveflow_ros.fit.step_test import (
    ENOUGH,
    Points,
    broken_line,
    identify_step_test,
    pooled,
)
from valveflow_ros.parameters import Settings
from valveflow_ros.plant.simulator import simulate
from valveflow_ros.plant.unit import paper_curve
from valveflow_ros.records import NS_PER_S, SampleTable, Signal

SETTINGS = Settings()
# A plant that settles in seconds, so that tests by hand are short.
QUICK = Settings(
    {'block': 1.0, 'time_constant': 2.0, 'delay': 1.0, 'steady_min': 20.0, 'max_pieces': 4}
)
PRESSURE = 16.0


def by_hand(openings, hold=60, seed=0, noise=0.3, curve=None, pressure=PRESSURE):
    """Return the log of a test: each opening held for so many rows, then two rows of move."""
    rng = np.random.default_rng(seed)
    holds_of = [hold] * len(openings) if isinstance(hold, int) else hold
    opening = np.concatenate([np.full(n, v) for n, v in zip(holds_of, openings, strict=True)])
    u = opening * PRESSURE**1.125
    power = (curve or (lambda v: 20.0 + 0.1 * v))(u) + noise * rng.normal(0.0, 1.0, len(u))
    table = table_of(grid_ns(len(u)), u, power, pressure=PRESSURE)
    table.values[:, Signal.MAIN_STEAM_PRESSURE] = pressure
    return table


# --- levels -----------------------------------------------------------------------------------


@examples(40)
@given(
    st.lists(st.integers(20, 90), min_size=1, max_size=12, unique=True),
    st.lists(st.integers(5, 40), min_size=12, max_size=12),
    st.floats(0.0, 0.05),
)
def test_held_openings_are_found_where_they_are(openings, lengths, noise):
    rng = np.random.default_rng(len(openings))
    lengths = lengths[: len(openings)]
    signal = np.repeat(np.array(openings, float), lengths)
    signal = signal + noise * rng.normal(0.0, 1.0, len(signal))
    ends = np.cumsum(lengths).tolist()
    assert holds(signal, 1, 3) == list(zip([0, *ends[:-1]], ends, strict=True))


@pytest.mark.skipif(INTERPRETED, reason='days of data need the compiled engine')
def test_a_test_is_told_from_ordinary_operation():
    for seed in (1, 2):
        assert looks_like_step_test(step_test(seed).table, SETTINGS)
        day = simulate(1.0, seed).table
        for start in range(0, len(day), 7200):
            assert not looks_like_step_test(day.part(start, start + 7200), SETTINGS)
    still = by_hand([50.0], 2000)
    assert not looks_like_step_test(still, SETTINGS)
    # In rows a minute apart the moves of a controller are taken for noise.
    rows = {'sample_period': 60.0, 'block': 60.0, 'hold_limit': 150.0, 'lateness': 60.0}
    openings, rng = [44.0], np.random.default_rng(5)
    for _ in range(2000):
        openings.append(0.9 * openings[-1] + 4.4 + rng.normal(0.0, 0.7))
    wandering = by_hand(openings, 1)
    assert not looks_like_step_test(wandering, Settings({**rows, 'alarm_block': 120.0}))


# --- the curve through levels -----------------------------------------------------------------


@examples(60)
@given(st.integers(0, 2**32 - 1), st.integers(3, ENOUGH - 1))
def test_few_levels_are_joined_with_those_that_do_not_rise(seed, n):
    rng = np.random.default_rng(seed)
    raw = Points(np.arange(n) * 10.0, rng.normal(0.0, 1.0, n), rng.uniform(0.5, 2.0, n))
    points, members = pooled(raw, 1.0)
    assert sum(members) == n
    assert np.all(np.diff(points.power_mw) > 0.0)
    assert np.all(np.diff(points.u) > 0.0)
    weight = 1.0 / raw.error_mw**2
    # Joining keeps the weighted means: nothing is lost.
    kept = 1.0 / points.error_mw**2
    assert np.sum(kept) == pytest.approx(np.sum(weight))
    assert np.sum(kept * points.power_mw) == pytest.approx(np.sum(weight * raw.power_mw))
    rising = replace(raw, power_mw=np.sort(raw.power_mw) + 0.1 * np.arange(n))
    assert pooled(rising, 1.0)[1] == [1] * n


@pytest.mark.parametrize('knees', [[], [1300.0], [1300.0, 1700.0]])
def test_exact_levels_release_memory_the_broken_line(knees):
    knots = np.array([1000.0, *knees, 2000.0])
    slopes = np.array([0.25, 0.1, 0.02])[: len(knots) - 1]
    values = np.concatenate([[150.0], 150.0 + np.cumsum(slopes * np.diff(knots))])
    u = np.linspace(1000.0, 2000.0, 21) + 7.0 * np.sin(np.arange(21))
    u[[0, -1]] = 1000.0, 2000.0
    line = broken_line(Points(u, np.interp(u, knots, values), np.full(21, 0.5)), 6)
    assert line.knots == pytest.approx(knots, abs=1e-6)
    assert line.values == pytest.approx(values, abs=1e-6)


def test_noise_alone_hardly_ever_gives_a_knee():
    u = np.linspace(1000.0, 2000.0, 20)
    pieces = []
    for seed in range(1000, 1040):
        power = 0.1 * u + np.random.default_rng(seed).normal(0.0, 0.5, 20)
        pieces.append(len(broken_line(Points(u, power, np.full(20, 0.5)), 8).knots) - 1)
    assert pieces.count(1) >= 36


def test_the_errors_of_the_line_are_those_of_many_tests():
    knots, values = np.array([1000.0, 1400.0, 2000.0]), np.array([150.0, 250.0, 280.0])
    u = np.linspace(1000.0, 2000.0, 20)
    found = [
        broken_line(
            Points(u, np.interp(u, knots, values)
                   + np.random.default_rng(seed).normal(0.0, 0.5, 20), np.full(20, 0.5)), 4
        )
        for seed in range(2000, 2080)
    ]  # fmt: skip
    two = [line for line in found if len(line.knots) == 3]
    assert len(two) >= 74
    # The ends do not hang on where the knot falls; the knot's own error is given beside it.
    for k in (0, 2):
        scatter = np.std([line.values[k] for line in two])
        said = np.median([math.sqrt(line.covariance[k, k]) for line in two])
        assert scatter == pytest.approx(said, rel=0.25)
    scatter = np.std([line.knots[1] for line in two])
    assert scatter == pytest.approx(np.median([line.knot_error[0] for line in two]), rel=0.35)


# --- whole tests ------------------------------------------------------------------------------


@pytest.mark.skipif(INTERPRETED, reason='hours of data need the compiled engine')
@pytest.mark.parametrize(('seed', 'down'), [(51, False), (52, True)])
def test_a_simulated_test_gives_the_plants_curve(seed, down):
    plan = StepPlan()
    if down:
        plan = StepPlan(opening_from_percent=98.0, opening_to_percent=45.0)
    found = identify_step_test(step_test(seed, plan).table, SETTINGS)
    curve = found.characteristic
    assert len(found.levels) == len(found.segments) == curve.source.steady == 19
    u = np.linspace(curve.breakpoints[0], curve.breakpoints[-1], 300)
    # Each level's mean is wrong by 1 MW, and a weak knee may be lost in that.
    assert np.sqrt(np.mean((curve(u) - paper_curve()(u)) ** 2)) < 2.0
    assert np.all(np.diff(curve.values()) > 0.0)
    assert found.pressure_spread_percent < 1.0
    assert 'Manual step test: 19 of 19 levels count' in curve.notes[0]


@pytest.mark.skipif(INTERPRETED, reason='hours of data need the compiled engine')
def test_the_error_of_a_level_is_the_one_it_has():
    """Against the true curve, over levels of several tests."""
    off = []
    for seed in range(53, 56):
        found = identify_step_test(step_test(seed).table, SETTINGS)
        for level in found.levels:
            assert level.samples >= 480
            off.append((level.power_mw - paper_curve()(np.array([level.u]))[0])
                       / level.power_error_mw)  # fmt: skip
    assert 0.7 < np.std(off) < 1.4


@pytest.mark.parametrize(
    'openings',
    [[40.0, 50.0, 60.0, 50.0, 70.0], np.linspace(40.0, 80.0, 10).tolist()],
    ids=['one visited again', 'many'],
)
def test_a_power_without_noise_is_not_known_without_error(openings):
    curve = identify_step_test(by_hand(openings, noise=0.0), QUICK).characteristic
    u = np.unique(openings) * PRESSURE**1.125
    assert curve(u) == pytest.approx(20.0 + 0.1 * u, abs=1e-6)
    assert all(0.0 < p.slope_stderr < 0.01 for p in curve.pieces)


def test_missing_time_between_two_holds_at_one_opening_parts_them():
    table = by_hand([40.0, 50.0, 50.0, 60.0, 70.0])
    time_ns = table.time_ns.copy()
    time_ns[120:] += 900 * NS_PER_S
    parted = identify_step_test(replace(table, time_ns=time_ns), QUICK)
    assert len(identify_step_test(table, QUICK).levels) == 4
    assert len(parted.levels) == 5
    # The transient after the gap does not count either.
    settle = math.ceil(QUICK.settle_s)
    assert [v.first for v in parted.levels] == [60 * k + settle for k in range(5)]


def test_a_level_that_was_held_too_short_is_left_out_and_named():
    table = by_hand([40.0, 50.0, 60.0, 70.0, 80.0], [60, 60, 25, 60, 60])
    found = identify_step_test(table, QUICK)
    assert len(found.levels) == 5
    assert len(found.segments) == 4
    (told,) = [n for n in found.characteristic.notes if 'left out' in n]
    assert told.startswith('Level 3 (opening 60.0 %) is left out: it was held for 25 s only')


def test_a_level_that_still_moves_is_left_out_and_named():
    table = by_hand([40.0, 50.0, 60.0, 70.0], 80)
    at = np.arange(80)
    table.values[80:160, Signal.GENERATED_POWER] += 10.0 * (1.0 - np.exp(-at / 40.0))
    found = identify_step_test(table, QUICK)
    (told,) = [n for n in found.characteristic.notes if 'left out' in n]
    assert 'Level 2' in told
    assert 'had not settled: its power still went by +' in told


def test_a_pressure_that_was_not_constant_is_refused():
    table = by_hand([40.0, 50.0, 60.0, 70.0])
    wander = 1.0 + 0.05 * np.sin(np.arange(len(table)) / 40.0)
    table.values[:, Signal.MAIN_STEAM_PRESSURE] = PRESSURE * wander
    with pytest.raises(DataError, match='The pressure was not constant') as caught:
        identify_step_test(table, QUICK)
    assert 'MPa' in str(caught.value)
    slight = by_hand([40.0, 50.0, 60.0, 70.0], pressure=PRESSURE * 1.001)
    assert identify_step_test(slight, QUICK).pressure_spread_percent < 0.01


@pytest.mark.parametrize(
    ('table', 'words'),
    [
        (by_hand([40.0, 50.0]), 'at least 3 needed'),
        (by_hand([40.0, 50.0, 60.0], 25), 'was held for 25 s only'),
        (by_hand([40.0, 50.0, 60.0, 70.0], curve=lambda u: 300.0 - 0.1 * u), 'rise in power'),
        (by_hand([40.0, 40.5, 41.0] * 3, [60, 2, 3] * 3), 'only 1 differ in opening'),
        (by_hand(np.linspace(40.0, 80.0, 200).tolist(), 5), 'This is no step test'),
    ],
    ids=['two levels', 'short', 'falling', 'one opening', 'a slow ramp'],
)
def test_what_is_no_test_is_refused_with_a_sentence(table, words):
    with pytest.raises(DataError) as caught:
        identify_step_test(table, QUICK)
    assert words in str(caught.value)
    assert str(caught.value).endswith('.')


def test_hostile_tables():
    empty = SampleTable.from_columns(np.empty(0, dtype=np.int64), {})
    bad = by_hand([40.0, 50.0, 60.0])
    bad.values[:, Signal.GENERATED_POWER] = math.nan
    for table in (empty, bad):
        with pytest.raises(DataError):
            identify_step_test(table, QUICK)
        assert not looks_like_step_test(empty, QUICK)
    holes = by_hand([40.0, 50.0, 60.0, 70.0])
    holes.values[70:75, Signal.VALVE_OPENING] = math.nan
    found = identify_step_test(holes, QUICK)
    assert found.characteristic.source.window_start_ns == START_NS
