# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The manual test at constant pressure."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from step_plan import StepPlan, step_test

from valveflow_ros.plant.spec import EffectSpec
from valveflow_ros.plant.unit import UnitDescription, random_unit
from valveflow_ros.records import Signal


def test_the_pressure_stays_and_the_opening_climbs() -> None:
    log, plan = step_test(1), StepPlan()
    pressure = log.table.column(Signal.MAIN_STEAM_PRESSURE)
    assert pressure.mean() == pytest.approx(16.7, abs=0.02)
    assert pressure.std() < 0.04
    command = log.table.column(Signal.VALVE_COMMAND)
    assert np.all(np.diff(command) >= 0.0)
    assert (command[0], command[-1]) == (plan.opening_from_percent, plan.opening_to_percent)
    levels, counts = np.unique(command, return_counts=True)
    assert np.sum(counts >= 900) == plan.steps + 1
    assert levels.size > plan.steps + 1
    # It covers the curve that the load programme would visit.
    assert log.true_u.min() < 1100.0
    assert log.true_u.max() > 2250.0


def test_at_rest_the_power_is_the_curve(quiet: UnitDescription) -> None:
    plan = StepPlan(pressure_wander_mpa=0.0, hold_s=1800.0, steps=10)
    log = step_test(1, plan, quiet)
    times, openings = plan.corners()
    at = np.round(times[1::2]).astype(int) - 1
    u = openings[1::2] * plan.pressure_mpa**1.125
    np.testing.assert_allclose(log.true_power_mw[at], quiet.curve(u), atol=1e-6)
    np.testing.assert_allclose(log.true_u[at], u, rtol=1e-12)
    np.testing.assert_allclose(log.load_mw[at], quiet.curve(u), rtol=1e-12)


def test_it_begins_at_rest(quiet: UnitDescription) -> None:
    log = step_test(1, StepPlan(pressure_wander_mpa=0.0), quiet)
    assert np.ptp(log.true_power_mw[:900]) < 1e-9


@pytest.mark.parametrize('slack_percent', [0.0, 2.0])
def test_up_and_down_are_the_same_way_unless_the_linkage_is_loose(
    quiet: UnitDescription, slack_percent: float
) -> None:
    plan = StepPlan(pressure_wander_mpa=0.0, hold_s=1800.0, steps=6)
    back = dataclasses.replace(plan, opening_from_percent=98.0, opening_to_percent=45.0)
    at = np.round(plan.corners()[0][1::2]).astype(int) - 1
    slack = [EffectSpec.parse(f'backlash:w_percent={slack_percent}')]
    up, down = (step_test(1, p, quiet, effects=slack).true_power_mw[at] for p in (plan, back))
    if slack_percent:
        assert np.all(up[1:-1] < down[::-1][1:-1])
    else:
        np.testing.assert_allclose(up, down[::-1], atol=1e-6)


def test_the_seed_decides_the_noise() -> None:
    one, two, again = (step_test(seed) for seed in (1, 2, 1))
    np.testing.assert_array_equal(one.table.values, again.table.values)
    assert not np.array_equal(one.table.values, two.table.values)


@pytest.mark.parametrize('number', range(4))
def test_other_units_can_be_tested(number: int) -> None:
    unit = random_unit(np.random.default_rng(number))
    log = step_test(number, unit=unit)
    assert np.isfinite(log.table.values).all()
    steps_s = np.diff(log.table.time_ns) / 1e9
    np.testing.assert_allclose(steps_s, unit.sample_period_s)
