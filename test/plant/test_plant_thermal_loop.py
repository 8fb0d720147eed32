# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The slow truth of the thermal unit's loop: plain Python, one second after the other."""

import dataclasses
import math

import numpy as np
import pytest
from plants import naive_lag

from valveflow_ros.plant.thermal_effects import ThermalHooks, thermal_effect
from valveflow_ros.plant.thermal_loop import Series, TrueRows, law_of, run
from valveflow_ros.plant.thermal_unit import TABLE_STEP_PERCENT, random_unit

SECONDS = 3000
FAULTS = ('backlash', 'stiction:before_sensor=1', 'rate_limit:r_percent_per_s=0.3',
          'saturation:max_percent=70', 'pressure_scale')  # fmt: skip


def drives(unit, seed, faulty):
    """Return steps of the load and noise, with what effects do to the rows if asked for."""
    rng = np.random.default_rng(seed)
    n, one = SECONDS, np.ones(SECONDS)
    demand = np.repeat(rng.uniform(unit.load_low_mw, unit.load_high_mw, 10), n // 10)
    pressure = unit.pressure_set_mpa(demand) + 0.1 * np.sin(np.arange(n) / 200.0)
    late = (np.arange(n) > 1500) * (1.0 if faulty else 0.0)
    return Series(
        demand, 2.0 * np.sign(rng.standard_normal(n)), pressure,
        0.01 * rng.standard_normal(n), one + 0.01 * late, 2.0 * late, one + 0.02 * late,
        0.5 * late, one + 0.03 * late, 18.0 + rng.standard_normal(n),
        0.2 * rng.standard_normal(n), 0.2 * rng.standard_normal(n), 0.01 * rng.standard_normal(n),
    )  # fmt: skip


def naive_hold(y, x, time_s):
    """Solve T y' + y = x exactly over one second in which x is held."""
    return x + (y - x) * math.exp(-1.0 / time_s)


def naive_kpa(degc):
    return 0.61094 * math.exp(17.625 * degc / (degc + 243.04))


class NaiveMotion:
    """Servo speed, friction with rest and motion, stop, slack."""

    def __init__(self, at, bank, fastest=math.inf):
        self.servo = self.stem = self.plug = at
        self.moving = 0
        self.bank = bank
        self.fastest = min(fastest, bank.rate_percent_per_s)

    def __call__(self, wanted):
        bank, before = self.bank, self.servo
        self.servo += min(max(wanted - self.servo, -self.fastest), self.fastest)
        if np.sign(self.servo - before) != self.moving:
            self.moving = 0
        if (
            self.moving == 0
            and abs(self.servo - self.stem) > (bank.band_percent + bank.jump_percent) / 2.0
        ):
            self.moving = 1 if self.servo > self.stem else -1
        if self.moving:
            self.stem = self.servo - self.moving * (bank.band_percent - bank.jump_percent) / 2.0
        stopped, half = min(self.stem, bank.top_percent), bank.slack_percent / 2.0
        self.plug = min(max(self.plug, stopped - half), stopped + half)
        return self.plug


def naive(unit, hooks, s):
    """Run the unit row by row; columns as `TrueRows`."""
    table = unit.area_table()
    known = np.arange(table.size) * TABLE_STEP_PERCENT
    inverse = law_of(unit, hooks)
    grid = np.arange(inverse.opening_of.size) * inverse.inverse_step
    rated, c, m = unit.pressure_rated_mpa, unit.no_load_mw, unit.exponent
    full = unit.rated_mw + c

    def governor(flow, seen):
        density = (seen / rated) ** m
        if unit.form == 'integrated_input':
            opening = float(np.interp(flow, grid, inverse.opening_of)) / density
        else:
            opening = float(np.interp(flow / density, grid, inverse.opening_of))
        return min(max(opening, 3.0), 100.0)

    def steam(plug, p):
        density = (p / rated) ** m
        if unit.form == 'integrated_input':
            return float(np.interp(plug * density, known, table))
        return density * float(np.interp(plug, known, table))

    load = float(s.demand[0])
    flow = heat = mill = firing = direct = behind = warm = (load + c) / full
    expected_rest, demand, trim, fire_trim = load, load, 0.0, 0.0
    lost = unit.drop * rated * flow**2
    drum = float(s.pressure_set[0]) + lost
    seen = float(s.pressure_set[0]) * hooks.pressure_factor
    command = servo = governor(flow, seen)
    to_sensor = NaiveMotion(command, hooks.before_sensor, 10.0)
    to_plug = NaiveMotion(
        (command - s.position_zero[0]) * s.position_factor[0], hooks.after_sensor
    )
    out = []
    for t in range(s.demand.size):
        old_mill, old_heat = mill, heat
        mill = naive_hold(mill, firing, unit.mill_s)
        heat = naive_lag(heat, old_mill, mill, unit.fuel_s)
        taken = (old_heat + heat) / 2.0 + s.fire[t]
        drum += (taken - flow) * rated / unit.storage_s
        lost = naive_hold(lost, unit.drop * rated * flow**2, 4.0)
        p = max(drum - lost, 0.05 * rated)
        servo = naive_hold(servo, command, unit.actuator_s)
        stem = to_sensor(servo)
        plug = to_plug((stem - s.position_zero[t]) * s.position_factor[t])
        plug = min(max(plug, 0.0), 105.0)
        old_flow, flow = flow, steam(plug, p) * s.area_factor[t]
        old_direct, direct = direct, naive_lag(direct, old_flow, flow, unit.high_pressure_s)
        behind = naive_lag(behind, old_direct, direct, unit.reheater_s)
        made = unit.high_pressure_share * direct + (1.0 - unit.high_pressure_share) * behind
        warm = naive_hold(warm, flow, 60.0)
        kpa = naive_kpa(s.water[t] + 9.5 * warm + 4.0)
        worse = kpa - naive_kpa(unit.water_degc + 9.5 * warm + 4.0)
        power = (full * made - c) * s.gain[t] * (1.0 + unit.vacuum_per_kpa * worse)
        power += s.offset[t] + s.swing[t]
        old_demand, demand = demand, s.demand[t] + s.primary[t]
        expected_rest = naive_lag(expected_rest, old_demand, demand, unit.reheater_s)
        expected = demand * unit.high_pressure_share + expected_rest * (
            1.0 - unit.high_pressure_share
        )
        missing = expected - (power + s.power_noise[t])
        stuck = (command == 100.0 and missing > 0.0) or (command == 3.0 and missing < 0.0)
        if not stuck:
            trim = min(max(trim + missing / unit.integral_s, -0.2 * full), 0.2 * full)
        seen = naive_hold(seen, p * hooks.pressure_factor + s.pressure_noise[t], 3.0)
        command = governor(max(0.0, (demand + trim + 0.1 * missing + c) / full), seen)
        short = (s.pressure_set[t] - seen) / rated
        rise = (s.pressure_set[t] - s.pressure_set[max(0, t - 1)]) / rated
        wish = (s.demand[t] + c) / full + unit.storage_s * rise + 1.6 * short + fire_trim
        firing = min(max(wish, 0.2), 1.15)
        if firing == wish:
            fire_trim = min(max(fire_trim + 1.6 * short / 700.0, -0.3), 0.3)
        out.append((command, stem, plug, p, drum, flow, taken, power, kpa))
    return np.array(out)


@pytest.mark.parametrize('kind', ['choked', 'sequence_fixed', 'integrated_input'])
@pytest.mark.parametrize('faulty', [False, True])
def test_the_fast_loop_is_the_slow_one(kind, faulty):
    unit = random_unit(kind, 5)
    hooks = ThermalHooks.for_run(float(SECONDS))
    for text in FAULTS if faulty else ():
        spec = thermal_effect(text, kind)
        spec.effect.install(spec.values, hooks)
    series = drives(unit, 2, faulty)
    out = np.empty((len(TrueRows._fields), SECONDS))
    run(series, law_of(unit, hooks), out)
    slow = naive(unit, hooks, series)
    for name, fast, truth in zip(TrueRows._fields, out, slow.T, strict=True):
        np.testing.assert_allclose(fast, truth, rtol=1e-7, atol=1e-7, err_msg=name)
    assert np.ptp(out[2]) > 5.0, 'the valve has to move for this to say something'


@pytest.mark.parametrize('kind', ['choked_fixed', 'sequence', 'integrated_input'])
@pytest.mark.parametrize('load', [160.0, 300.0])
def test_a_unit_left_alone_comes_to_rest_on_its_static_power(kind, load):
    unit = dataclasses.replace(random_unit(kind, 3), vacuum_per_kpa=0.0)
    n = 4 * 3600
    rest, one = np.zeros(n), np.ones(n)
    pressure = unit.pressure_set_mpa(np.full(n, load))
    series = Series(
        np.full(n, load), rest, pressure, rest, one, rest, one, rest, one,
        np.full(n, unit.water_degc), rest, rest, rest,
    )  # fmt: skip
    out = np.empty((len(TrueRows._fields), n))
    run(series, law_of(unit, ThermalHooks.for_run(float(n))), out)
    last = TrueRows(*out[:, -1])
    static = float(unit.static_power(last.plug, last.pressure))
    assert (load, static) == pytest.approx((last.power, last.power), abs=1e-3)
    assert last.pressure == pytest.approx(pressure[-1], abs=1e-3)
    assert last.heat == pytest.approx(last.flow, abs=1e-4)
    assert last.stem == last.plug
