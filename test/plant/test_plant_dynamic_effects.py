# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Effects of actuator, storage and clock do what their physics says, and nothing else."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from plants_at_rest import DAYS, at_rest, spec
from step_plan import StepPlan, step_test

from valveflow_ros.plant.simulator import simulate
from valveflow_ros.plant.unit import Programme, Region, UnitDescription
from valveflow_ros.records import Signal


@pytest.mark.parametrize('name', ['reheater', 'region_lag', 'rate_limit', 'clock'])
def test_dynamics_are_nothing_at_rest(quiet: UnitDescription, name: str) -> None:
    none, without = at_rest(quiet)
    power, log = at_rest(quiet, spec(name, ''))
    np.testing.assert_allclose(power, none, atol=1e-6)
    assert np.abs(log.true_power_mw - without.true_power_mw).max() > 0.5


def test_a_reheater_makes_the_unit_late(quiet: UnitDescription) -> None:
    _, none = at_rest(quiet)
    _, log = at_rest(quiet, spec('reheater', ''))
    # The test only opens the valve: late is less, never more.
    assert np.all(log.true_power_mw <= none.true_power_mw + 1e-9)


def test_region_lag_begins_at_its_level() -> None:
    unit = UnitDescription(
        regions=(Region(np.inf, 10.0, 3.0),),
        programme=Programme(
            feedback=False,
            load_mean_mw=195.0,
            load_high_mw=225.0,
            full_load_from_mw=220.0,
            full_load_share=0.0,
        ),
    )
    none = simulate(1.0, 3, unit)
    above = simulate(1.0, 3, unit, effects=[spec('region_lag', 'level_mw=290')])
    np.testing.assert_array_equal(above.true_power_mw, none.true_power_mw)
    inside = simulate(1.0, 3, unit, effects=[spec('region_lag', 'level_mw=200')])
    d = np.abs(inside.true_power_mw - none.true_power_mw)
    high, low = none.load_mw > 205.0, none.load_mw < 185.0
    assert min(high.mean(), low.mean()) > 0.1
    assert d[high].mean() > 10.0 * d[low].mean()


@pytest.mark.parametrize('level', [200.0, 240.0, 270.0])
def test_region_lag_takes_the_place_of_all_regions_above(level: float) -> None:
    first, second = UnitDescription().regions
    below = (first,) if level <= first.power_to_mw else (first, second)
    below = (*below[:-1], dataclasses.replace(below[-1], power_to_mw=level))
    built = UnitDescription(regions=(*below, Region(np.inf, 30.0, 3.0)))
    log = simulate(DAYS, 3, effects=[spec('region_lag', f'level_mw={level}')])
    np.testing.assert_array_equal(log.table.values, simulate(DAYS, 3, built).table.values)


@pytest.mark.parametrize('seconds', [12.0, 3.0, -12.0, 2.5])
def test_the_clock_moves_the_power_only(seconds: float) -> None:
    none = simulate(DAYS, 5)
    log = simulate(DAYS, 5, effects=[spec('clock', f'd_s={seconds}')])
    np.testing.assert_array_equal(log.true_u, none.true_u)
    row = np.arange(20, len(log) - 20)
    for truth in ('true_power_mw', 'noise_mw'):
        at = np.interp(row + seconds, np.arange(len(none)), getattr(none, truth))
        np.testing.assert_allclose(getattr(log, truth)[row], at, atol=1e-9)
    if seconds == int(seconds):
        power = none.table.column(Signal.GENERATED_POWER)
        np.testing.assert_array_equal(
            log.table.column(Signal.GENERATED_POWER)[row], power[row + int(seconds)]
        )


ACTUATOR = {'stiction': '', 'rate_limit': '', 'saturation': ''}


@pytest.mark.parametrize('name', ACTUATOR)
def test_where_the_sensor_stands(name: str) -> None:
    behind, before = (
        simulate(DAYS, 6, effects=[spec(name, f'before_sensor={side}')]) for side in (0, 1)
    )
    # The plant is the same; only what the sensor sees differs.
    np.testing.assert_array_equal(behind.plug_percent, before.plug_percent)
    for log, hidden in ((behind, True), (before, False)):
        opening = log.table.column(Signal.VALVE_OPENING)
        command = log.table.column(Signal.VALVE_COMMAND)
        at_command, at_plug = np.std(opening - command), np.std(opening - log.plug_percent)
        assert (at_command < 0.025 < at_plug) == hidden
        assert (at_plug < 0.025 < at_command) != hidden


def test_the_sensor_does_not_see_the_slack() -> None:
    log = simulate(DAYS, 6, effects=[spec('backlash', '')])
    gap = log.plug_percent - log.table.column(Signal.VALVE_COMMAND)
    assert np.std(
        log.table.column(Signal.VALVE_OPENING) - log.table.column(Signal.VALVE_COMMAND)
    ) < (0.025)
    assert np.abs(gap).max() == pytest.approx(0.3, abs=0.006)
    # It hangs on one of its flanks most of the time.
    assert np.mean(np.abs(gap) > 0.29) > 0.1


def test_slack_loops_are_as_wide_at_any_speed(quiet: UnitDescription) -> None:
    for speed in (0.05, 0.5, 5.0):
        plan = StepPlan(pressure_wander_mpa=0.0, steps=3, hold_s=60.0, speed_percent_per_s=speed)
        up = step_test(1, plan, quiet, effects=[spec('backlash', '')])
        command = up.table.column(Signal.VALVE_COMMAND)
        moved = command > plan.opening_from_percent + 1.0
        np.testing.assert_allclose(command[moved] - up.plug_percent[moved], 0.3, atol=0.006)


def test_a_stop_is_a_stop() -> None:
    log = simulate(DAYS, 6, effects=[spec('saturation', 'max_percent=80')])
    assert log.plug_percent.max() == 80.0
    assert log.table.column(Signal.VALVE_OPENING).max() > 82.0
