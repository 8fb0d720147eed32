# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The loop of governor, valve, turbine and boiler of a thermal unit, in steps of one second.

Lags are discretised exactly for an input that is constant (controllers) or linear (steam) between
two samples. The pressure of one second acts on the flow of the next; this delay is short compared
with the boiler's storage.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from valveflow_ros.numerics import jit, kernel
from valveflow_ros.plant.loop import lag_coefficients, settings
from valveflow_ros.plant.thermal_effects import ThermalHooks
from valveflow_ros.plant.thermal_unit import TABLE_STEP_PERCENT, ThermalUnit
from valveflow_ros.records import FloatArray

_LOWEST_OPENING, _SERVO_PERCENT_PER_S = 3.0, 10.0
# The condenser: temperature rise of the cooling water at full flow, and terminal difference.
_WATER_RISE_K, _TERMINAL_K, _CONDENSER_S = 9.5, 4.0, 60.0


class Series(NamedTuple):
    """The inputs of the loop; float64 (n,) each.

    MW, MW, MPa, fraction of full firing, factor on the power, MW, factor on and error of the
    position, factor on the area, degC, MW, MW, MPa.
    """

    demand: FloatArray
    primary: FloatArray
    pressure_set: FloatArray
    fire: FloatArray
    gain: FloatArray
    offset: FloatArray
    position_factor: FloatArray
    position_zero: FloatArray
    area_factor: FloatArray
    water: FloatArray
    swing: FloatArray
    power_noise: FloatArray
    pressure_noise: FloatArray


class TrueRows(NamedTuple):
    """The true values, every second; float64 (n,) each.

    %, % (of the servo, before the effects after the position sensor), %, MPa, MPa in the drum,
    fraction of full flow, heat that the boiler absorbed in the last second as a fraction of that
    of full flow, MW without the meter's noise, kPa.
    """

    command: FloatArray
    stem: FloatArray
    plug: FloatArray
    pressure: FloatArray
    drum: FloatArray
    flow: FloatArray
    heat: FloatArray
    power: FloatArray
    condenser: FloatArray


class Law(NamedTuple):
    """The constants of a run; lags are (a, b, c) of `lag_coefficients`, banks `settings`."""

    area: FloatArray
    opening_of: FloatArray  # the governor's inverse of the area, on a grid of `inverse_step`
    inverse_step: float
    on_opening: bool
    exponent: float
    rated_pressure: float
    pressure_factor: float
    full_mw: float  # rated_mw + no_load_mw
    no_load_mw: float
    share: float
    servo: float
    high_pressure: tuple[float, float, float]
    reheater: tuple[float, float, float]
    mill: float
    fuel: tuple[float, float, float]
    storage_s: float
    drop: float
    integral_s: float
    vacuum_per_kpa: float
    water_reference: float
    bank_before: FloatArray  # from the command to the position sensor
    bank_behind: FloatArray


def law_of(unit: ThermalUnit, hooks: ThermalHooks) -> Law:
    """Return the constants of a run."""
    area = unit.area_table()
    known = np.arange(area.size) * TABLE_STEP_PERCENT
    # The table of a governor has few points.
    points = np.linspace(0.0, 104.0, 14)
    at_points = np.interp(points, known, area)
    rising = np.append(True, np.diff(at_points) > 1e-6)
    grid = np.linspace(0.0, float(at_points[-1]), 1024)
    before = settings(hooks.before_sensor, 1.0)
    before[0] = min(before[0], _SERVO_PERCENT_PER_S)
    return Law(
        area, np.interp(grid, at_points[rising], points[rising]), float(grid[1]),
        unit.on_opening, unit.exponent, unit.pressure_rated_mpa, hooks.pressure_factor,
        unit.rated_mw + unit.no_load_mw, unit.no_load_mw, unit.high_pressure_share,
        math.exp(-1.0 / unit.actuator_s), lag_coefficients(unit.high_pressure_s, 1.0),
        lag_coefficients(unit.reheater_s, 1.0), math.exp(-1.0 / unit.mill_s),
        lag_coefficients(unit.fuel_s, 1.0), unit.storage_s, unit.drop, unit.integral_s,
        unit.vacuum_per_kpa, unit.water_degc, before, settings(hooks.after_sensor, 1.0),
    )  # fmt: skip


@jit
def _at(table: FloatArray, step: float, x: float) -> float:
    """Interpolate a table over multiples of ``step``; constant beyond its ends."""
    place = min(max(x / step, 0.0), table.size - 1.000001)
    k = int(place)
    return float(table[k] + (table[k + 1] - table[k]) * (place - k))


@jit
def _saturation_kpa(degc: float) -> float:  # of water, by Magnus
    return float(0.61094 * np.exp(17.625 * degc / (degc + 243.04)))


@jit
def _through(wanted: float, memory: FloatArray, bank: FloatArray) -> float:
    """Return the position after servo speed, friction, stop and slack; ``memory`` is (6,).

    Friction has two states: the stem is at rest until the force exceeds (S + J) / 2 and slips by
    J. Then it follows with a lag of (S - J) / 2 until the force stops or reverses.
    """
    servo, before, position, direction = memory[0], memory[1], memory[2], memory[3]
    servo += min(max(wanted - servo, -bank[0]), bank[0])
    if (servo - before) * direction <= 0.0:
        direction = 0.0
    pull = servo - position
    if direction == 0.0 and abs(pull) > bank[1]:
        direction = 1.0 if pull > 0.0 else -1.0
    if direction != 0.0:
        position = servo - direction * bank[2]
    stopped = min(position, bank[3])
    loose = min(max(memory[4], stopped - bank[4]), stopped + bank[4])
    memory[0], memory[1], memory[2], memory[3], memory[4] = (
        servo, servo, position, direction, loose,
    )  # fmt: skip
    return float(loose)


@jit
def _governor_opening(flow: float, density: float, law: Law) -> float:
    if law.on_opening:
        opening = _at(law.opening_of, law.inverse_step, flow / density)
    else:
        opening = _at(law.opening_of, law.inverse_step, flow) / density
    return min(max(opening, _LOWEST_OPENING), 100.0)


@jit
def _flow(plug: float, pressure: float, law: Law) -> float:
    density = (pressure / law.rated_pressure) ** law.exponent
    if law.on_opening:
        return float(density * _at(law.area, TABLE_STEP_PERCENT, plug))
    return float(_at(law.area, TABLE_STEP_PERCENT, plug * density))


@kernel
def run(series: Series, law: Law, out: FloatArray) -> None:
    """Fill ``out`` (9, n) as `TrueRows`, starting in steady state."""
    rated, full = law.rated_pressure, law.full_mw
    demand = series.demand[0]
    flow = heat = mill = firing = direct = reheated = warmed = (demand + law.no_load_mw) / full
    reference, trim, boiler_trim = demand, 0.0, 0.0
    lost = law.drop * rated * flow * flow
    drum = series.pressure_set[0] + lost
    seen = series.pressure_set[0] * law.pressure_factor
    command = _governor_opening(flow, (seen / rated) ** law.exponent, law)
    servo = command
    before = np.full(5, command)
    behind = np.full(5, (command - series.position_zero[0]) * series.position_factor[0])
    before[3] = behind[3] = 0.0
    ka, kb, kc = law.high_pressure
    ra, rb, rc = law.reheater
    fa, fb, fc = law.fuel
    loss_decay, seen_decay = np.exp(-1.0 / 4.0), np.exp(-1.0 / 3.0)
    warm_decay = np.exp(-1.0 / _CONDENSER_S)
    for t in range(series.demand.size):
        # Boiler: mills, furnace, storage, and the pressure drop up to the valve.
        mill_old, heat_old = mill, heat
        mill = law.mill * mill + (1.0 - law.mill) * firing
        heat = fa * heat + fb * mill_old + fc * mill
        taken = 0.5 * (heat_old + heat) + series.fire[t]
        drum += rated / law.storage_s * (taken - flow)
        lost = loss_decay * lost + (1.0 - loss_decay) * law.drop * rated * flow * flow
        pressure = max(drum - lost, 0.05 * rated)
        # Valve. The servo controls the measured position.
        servo = law.servo * servo + (1.0 - law.servo) * command
        stem = _through(servo, before, law.bank_before)
        position = (stem - series.position_zero[t]) * series.position_factor[t]
        plug = min(max(_through(position, behind, law.bank_behind), 0.0), 105.0)
        # Turbine.
        flow_old, direct_old = flow, direct
        flow = _flow(plug, pressure, law) * series.area_factor[t]
        direct = ka * direct + kb * flow_old + kc * flow
        reheated = ra * reheated + rb * direct_old + rc * direct
        steam = law.share * direct + (1.0 - law.share) * reheated
        warmed = warm_decay * warmed + (1.0 - warm_decay) * flow
        above = _WATER_RISE_K * warmed + _TERMINAL_K
        condenser = _saturation_kpa(series.water[t] + above)
        worse = condenser - _saturation_kpa(law.water_reference + above)
        gain = series.gain[t] * (1.0 + law.vacuum_per_kpa * worse)
        power = (full * steam - law.no_load_mw) * gain + series.offset[t] + series.swing[t]
        # Governor: feedforward of the set point, and an integral of the deviation from a
        # response of the usual shape.
        demand_old, demand = demand, series.demand[t] + series.primary[t]
        reference = ra * reference + rb * demand_old + rc * demand
        expected = law.share * demand + (1.0 - law.share) * reference
        missing = expected - power - series.power_noise[t]
        wide = (command >= 100.0 and missing > 0.0) or (
            command <= _LOWEST_OPENING and missing < 0.0
        )
        if not wide:
            trim = min(max(trim + missing / law.integral_s, -0.2 * full), 0.2 * full)
        read = pressure * law.pressure_factor + series.pressure_noise[t]
        seen = seen_decay * seen + (1.0 - seen_decay) * read
        wanted = (demand + trim + 0.1 * missing + law.no_load_mw) / full
        density = (max(seen, 0.05 * rated) / rated) ** law.exponent
        command = _governor_opening(max(wanted, 0.0), density, law)
        # Fire: feedforward of load and of the storage for a new set point, and pressure control.
        short = (series.pressure_set[t] - seen) / rated
        rise = (series.pressure_set[t] - series.pressure_set[max(t - 1, 0)]) / rated
        asked = (series.demand[t] + law.no_load_mw) / full + law.storage_s * rise
        wish = asked + 1.6 * short + boiler_trim
        firing = min(max(wish, 0.2), 1.15)
        if firing == wish:
            boiler_trim = min(max(boiler_trim + 1.6 * short / 700.0, -0.3), 0.3)
        out[0, t] = command
        out[1, t] = stem
        out[2, t] = plug
        out[3, t] = pressure
        out[4, t] = drum
        out[5, t] = flow
        out[6, t] = taken
        out[7, t] = power
        out[8, t] = condenser
