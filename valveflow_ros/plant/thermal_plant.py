# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Simulate a unit of `valveflow_ros.plant.thermal_unit` and the record of its historian.

The set point comes from schedule, AGC and primary response. The governor converts it into an
opening, turbine and boiler respond, and instruments and a historian record the values.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from valveflow_ros.errors import InputError
from valveflow_ros.numerics import kernel
from valveflow_ros.plant.effect import DAY_S, HistorianRows, LoopInputs, clock_at_ns
from valveflow_ros.plant.historian import Historian
from valveflow_ros.plant.loop import lag_coefficients
from valveflow_ros.plant.plant import Wander
from valveflow_ros.plant.simulator import DEFAULT_START_NS
from valveflow_ros.plant.spec import EffectSpec, install
from valveflow_ros.plant.thermal_effects import ThermalHooks, thermal_effect
from valveflow_ros.plant.thermal_loop import Series, TrueRows, law_of, run
from valveflow_ros.plant.thermal_unit import SequencedValves, ThermalUnit
from valveflow_ros.records import (
    NS_PER_S,
    SIGNALS,
    FloatArray,
    IntArray,
    Readings,
    SampleTable,
    Signal,
    table_to_readings,
)

LONGEST_DAYS = 60.0
_WARM_UP_S = 7200
# Rows after the end, for a clock that stamps the power early. They are always simulated, so
# that this effect does not change the random numbers.
_MARGIN_S = 600
# Fraction of the range of load by hour of day: a morning and an evening peak.
_HOURS = (0.0, 4.0, 7.0, 10.0, 13.0, 17.0, 20.0, 23.0, 24.0)
_SHARES = (0.35, 0.15, 0.45, 0.9, 0.6, 0.75, 1.0, 0.55, 0.35)
_PRIMARY_LIMIT = 0.06
_NOMINAL_HZ = 50.0


@dataclass(frozen=True, slots=True)
class ThermalLog:
    """The record of a thermal unit, and the true values of every second; float64 (n,) each.

    ``extra`` are further columns of the rows of the table: ``condenser_pressure_kpa``,
    ``grid_frequency_hz``, and ``valve_1_position_percent`` and so on of valves in sequence.
    """

    table: SampleTable  # if values have their own times, NaN means no new value
    extra: dict[str, FloatArray]
    unit: ThermalUnit  # without its effects
    historian: Historian
    truth: TrueRows
    demand_mw: FloatArray  # the set point after the rate limit
    temperature_degc: FloatArray
    water_degc: FloatArray
    active: tuple[EffectSpec, ...] = ()

    def __len__(self) -> int:
        return len(self.table)

    @property
    def readings(self) -> Readings:
        """Return the values one by one, without the empty cells of values with their own times."""
        readings = table_to_readings(self.table)
        if not self.historian.own_times:
            return readings
        there = np.isfinite(readings.value)
        return Readings(
            readings.time_ns[there], readings.signal[there],
            readings.value[there], readings.quality[there],
        )  # fmt: skip

    def to_json(self) -> dict[str, Any]:
        """Return the true values of the plant.

        ``form``, ``pressure_exponent``, ``pressure_scale_exponent`` and ``offset_mw`` describe
        the static power as in a characteristic. ``curve`` is the static power at rated
        pressure; its ``knees`` are in % for the form 'opening', in % MPa^m for
        'integrated_input'; for 'sequence' a valve begins to open there.
        """
        unit, area, opening = self.unit, self.unit.area, np.arange(0.0, 100.1, 2.5)
        at_opening, density = unit.on_opening, unit.pressure_rated_mpa**unit.exponent
        if isinstance(area, SequencedValves):
            knees = [valve.from_percent for valve in area.valves]
        else:
            knees = [k if at_opening else k * density for k in area.knees_percent]
        return {
            'sample_period_s': 1.0,
            'form': unit.form,
            'pressure_exponent': unit.exponent,
            'pressure_scale_exponent': unit.exponent if at_opening else 0.0,
            # The paper's F contains the no-load power.
            'offset_mw': -unit.no_load_mw if at_opening else 0.0,
            'no_load_mw': unit.no_load_mw,
            'curve': {
                'pressure_mpa': unit.pressure_rated_mpa,
                'opening_percent': opening.tolist(),
                'power_mw': unit.static_power(
                    opening, np.full(opening.size, unit.pressure_rated_mpa)
                ).tolist(),
                'knees': knees,
            },
            'dynamics': {
                name: getattr(unit, name)
                for name in ('actuator_s', 'high_pressure_s', 'reheater_s', 'high_pressure_share')
            },
            'unit': unit.to_json(),
            'recording': dataclasses.asdict(self.historian),
            'effects': [{'name': e.name, 'parameters': e.parameters} for e in self.active],
        }


def simulate_thermal(
    days: float, seed: int, unit: ThermalUnit | None = None, historian: Historian | None = None,
    start_ns: int = DEFAULT_START_NS, effects: Sequence[str | EffectSpec] = (),
) -> ThermalLog:  # fmt: skip
    """Simulate ``days`` of operation, at most 60, of a thermal unit; a day needs about 50 MB.

    The seed determines every random number, for all effects of `thermal_catalogue`, whose order
    has no influence, and all recordings. ``start_ns`` determines the time of day in UTC. By
    default the unit is of the kind 'choked' and every sample is stored. Raises `InputError` if an
    argument is out of range, or effects cannot act in this run or not together.
    """
    unit, historian = unit or ThermalUnit(), historian or Historian()
    if not 0.0 < days <= LONGEST_DAYS:
        raise InputError(
            f'A simulation of this unit must last more than 0 and at most {LONGEST_DAYS:g} days, '
            f'not {days}.'
        )
    if seed < 0:
        raise InputError(f'The seed must be 0 or more, not {seed}.')
    rows = max(1, round(days * DAY_S))
    if start_ns < _WARM_UP_S * NS_PER_S or start_ns + rows * NS_PER_S >= 2**63:
        raise InputError('A simulation must lie between the years 1970 and 2262.')
    hooks = ThermalHooks.for_run(float(rows))
    active = tuple(thermal_effect(effect, unit.kind) for effect in effects)
    install(active, hooks)
    rng = np.random.default_rng([seed, 330])
    outside = _Outside.draw(unit, hooks, rng, rows, clock_at_ns(start_ns))
    out = np.empty((len(TrueRows._fields), outside.series.demand.size))
    run(outside.series, law_of(unit, hooks), out)
    truth = TrueRows(*out)
    signals = _instruments(unit, hooks, outside, truth, rng, rows)
    time_ns, columns = historian.record(start_ns, signals, rng)
    mine = {info.column: info.signal for info in SIGNALS}
    table = SampleTable.from_columns(
        time_ns, {mine[name]: column for name, column in columns.items() if name in mine}
    )
    extra = {name: column for name, column in columns.items() if name not in mine}
    kept = slice(_WARM_UP_S, _WARM_UP_S + rows)
    return ThermalLog(
        table, extra, unit, historian, TrueRows(*out[:, kept]),
        outside.series.demand[kept], outside.temperature[kept], outside.water[kept], active,
    )  # fmt: skip


# Inputs of the unit from outside.


@dataclass(frozen=True, slots=True)
class _Outside:
    series: Series
    temperature: FloatArray
    water: FloatArray
    frequency: FloatArray

    @classmethod
    def draw(
        cls, unit: ThermalUnit, hooks: ThermalHooks, rng: np.random.Generator, rows: int,
        clock_s: float,
    ) -> _Outside:  # fmt: skip
        """Draw all inputs, from the start of the warm-up to the margin after the end."""
        n = _WARM_UP_S + rows + _MARGIN_S
        time_s = np.arange(n, dtype=np.float64) - _WARM_UP_S
        clock = np.mod(clock_s + time_s, DAY_S)
        demand = _set_point(unit, rng, time_s, clock_s)
        frequency = _frequency(rng, n)
        excess = frequency - _NOMINAL_HZ
        excess -= np.clip(excess, -unit.dead_band_hz, unit.dead_band_hz)
        limit = _PRIMARY_LIMIT * unit.rated_mw
        primary = np.clip(-excess / _NOMINAL_HZ / unit.droop * unit.rated_mw, -limit, limit)
        sliding = _lagged(unit.pressure_set_mpa(demand), 150.0)
        wander = unit.pressure_wander_mpa * Wander(rng, 10_800.0, 1.0).advance(n)
        sliding += _reserve(unit, rng, n) * (unit.pressure_rated_mpa - sliding)
        pressure_set = np.minimum(sliding + wander, 1.02 * unit.pressure_rated_mpa)
        temperature = _temperature(unit, rng, demand)
        water = unit.water_degc + unit.water_weather_k * Wander(rng, 1.5 * DAY_S, 1.0).advance(n)
        water += unit.water_daily_k * np.cos(2.0 * np.pi * (clock / 3600.0 - 16.0) / 24.0)
        forcing = LoopInputs.forced(hooks, time_s, clock, pressure_set, temperature)
        gain = forcing.gain * (
            1.0 + unit.temperature_per_k * (temperature - unit.temperature_degc)
        )
        area = np.ones(n)
        for factor in hooks.area:
            area *= factor(time_s)
        zero = np.zeros(n)
        for error in hooks.position_zero:
            zero += error(time_s)
        noise = unit.noise
        series = Series(
            demand, primary, pressure_set, unit.fire * Wander(rng, 900.0, 1.0).advance(n), gain,
            forcing.offset_mw, forcing.input_gain, zero, area, water,
            unit.swing_mw * Wander(rng, 15.0, 1.0).advance(n),
            noise['generated_power_mw'] * rng.standard_normal(n),
            noise['main_steam_pressure_mpa'] * rng.standard_normal(n),
        )  # fmt: skip
        return cls(series, temperature, water, frequency)


def _set_point(
    unit: ThermalUnit, rng: np.random.Generator, time_s: FloatArray, clock_s: float
) -> FloatArray:
    low, span = unit.load_low_mw, unit.load_high_mw - unit.load_low_mw
    per_s = unit.ramp_mw_per_min / 60.0
    hour = np.mod(clock_s + time_s[0], DAY_S) / 3600.0
    level = low + span * float(np.interp(hour, _HOURS, _SHARES))
    knots_s, knots_mw, agc_on = [float(time_s[0])], [level], [1.0]
    while knots_s[-1] < time_s[-1]:
        begin = knots_s[-1] + rng.uniform(900.0, 1800.0) + rng.exponential(2700.0)
        hour = np.mod(clock_s + begin, DAY_S) / 3600.0
        share = float(np.interp(hour, _HOURS, _SHARES)) + 0.15 * rng.standard_normal()
        target = low + span * min(max(share, 0.0), 1.0)
        rate = per_s * rng.uniform(0.5, 1.0)
        knots_s += [begin, begin + max(1.0, abs(target - level) / rate)]
        knots_mw += [level, target]
        agc_on += [agc_on[-1], float(rng.random() < 0.7)]
        level = target
    schedule = np.interp(time_s, knots_s, knots_mw)
    # AGC changes its demand every 20 to 120 s; some holds of the load have no AGC.
    count = int(np.ptp(time_s) / 20.0) + 2
    moments = time_s[0] + np.cumsum(rng.uniform(20.0, 120.0, count))
    amounts = unit.agc_mw * Wander(rng, 6.0, 1.0).advance(count)
    asked = np.append(0.0, amounts)[np.searchsorted(moments, time_s, side='right')]
    on = np.array(agc_on)[np.searchsorted(knots_s, time_s, side='right') - 1]
    target_mw = np.clip(schedule + on * asked, low, unit.load_high_mw)
    return np.asarray(_rate_limited(target_mw, per_s))


def _reserve(unit: ThermalUnit, rng: np.random.Generator, n: int) -> FloatArray:
    """Return the pressure reserve, from 0 at the sliding pressure to 1 at the rated pressure."""
    wanted = np.zeros(n)
    begin = 0
    while begin < n:
        end = begin + int(3600.0 * (2.0 + rng.exponential(5.0)))
        asked, way = rng.random(), rng.uniform(0.3, 1.0)
        wanted[begin:end] = way if asked < unit.reserve_hours else 0.0
        begin = end
    # An operator needs three quarters of an hour for the full change.
    return np.asarray(_rate_limited(wanted, 1.0 / 2700.0))


def _frequency(rng: np.random.Generator, n: int) -> FloatArray:
    """Return the grid's frequency in Hz: noise, and sometimes the loss of a generator or load."""
    deviation = 0.012 * Wander(rng, 300.0, 1.0).advance(n)
    deviation += 0.006 * Wander(rng, 15.0, 1.0).advance(n)
    now = rng.exponential(DAY_S / 4.0)
    while now < n:
        size = rng.uniform(0.04, 0.1) * (1.0 if rng.random() < 0.25 else -1.0)
        after = np.arange(min(3600, n - int(now)), dtype=np.float64)
        deviation[int(now) : int(now) + after.size] += (
            size * (1.0 - np.exp(-after / 5.0)) * np.exp(-after / 240.0)
        )
        now += rng.exponential(DAY_S / 4.0)
    return np.asarray(_NOMINAL_HZ + deviation)


def _temperature(unit: ThermalUnit, rng: np.random.Generator, demand: FloatArray) -> FloatArray:
    """Return the steam temperature in degC: lower at low load and after an increase of load."""
    short = (unit.load_high_mw - demand) / (unit.load_high_mw - unit.load_low_mw)
    per_min = 60.0 * np.diff(demand, prepend=demand[0])
    return np.asarray(
        unit.temperature_degc
        + unit.temperature_wander_k * Wander(rng, 1800.0, 1.0).advance(demand.size)
        - unit.temperature_load_k * _lagged(short, 900.0)
        - 0.3 * _lagged(per_min, 200.0)
    )


@kernel
def _rate_limited(target: FloatArray, per_row: float) -> FloatArray:
    out = np.empty_like(target)
    now = target[0]
    for t in range(target.size):
        now += min(max(target[t] - now, -per_row), per_row)
        out[t] = now
    return out


def _lagged(signal: FloatArray, time_s: float) -> FloatArray:
    """Return the output of a first-order lag, in steady state at the first value."""
    return np.asarray(_lag_rows(signal, *lag_coefficients(time_s, 1.0)))


@kernel
def _lag_rows(signal: FloatArray, a: float, b: float, c: float) -> FloatArray:
    out = np.empty_like(signal)
    out[0] = signal[0]
    for t in range(1, signal.size):
        out[t] = a * out[t - 1] + b * signal[t - 1] + c * signal[t]
    return out


# Instruments.


def _instruments(
    unit: ThermalUnit, hooks: ThermalHooks, outside: _Outside, truth: TrueRows,
    rng: np.random.Generator, rows: int,
) -> dict[str, FloatArray]:  # fmt: skip
    kept = slice(_WARM_UP_S, _WARM_UP_S + rows)
    n, noise = truth.power.size, unit.noise
    series = outside.series
    power = truth.power + series.power_noise
    opening = truth.stem + noise['valve_opening_percent'] * rng.standard_normal(n)
    temperature_noise = noise['main_steam_temperature_degc'] * rng.standard_normal(n)
    shown = {
        'valve_opening_percent': opening,
        'main_steam_pressure_mpa': truth.pressure * hooks.pressure_factor + series.pressure_noise,
        'main_steam_temperature_degc': outside.temperature + temperature_noise,
        'generated_power_mw': _shifted(power, hooks.lead_s),
        'valve_command_percent': truth.command,
        'condenser_pressure_kpa': truth.condenser
        + noise['condenser_pressure_kpa'] * rng.standard_normal(n),
        'grid_frequency_hz': outside.frequency,
    }
    if isinstance(unit.area, SequencedValves):
        for number, valve in enumerate(unit.area.valves, 1):
            shown[f'valve_{number}_position_percent'] = valve.lift_percent(opening)
    columns = {}
    for name, column in shown.items():
        step = unit.resolution.get(name, 0.1)
        columns[name] = np.round(np.round(column[kept] / step) * step, 6)
    time_s = np.arange(rows, dtype=np.float64)
    changed: dict[Signal, FloatArray] = {info.signal: columns[info.column] for info in SIGNALS}
    for change in hooks.writing:
        change(HistorianRows(time_s, changed))
    columns.update({info.column: changed[info.signal] for info in SIGNALS})
    return columns


def _shifted(column: FloatArray, lead_s: float) -> FloatArray:
    """Return the values at times ``lead_s`` later, by linear interpolation."""
    place: IntArray = np.arange(column.size)
    return np.interp(place + lead_s, place, column) if lead_s else column
