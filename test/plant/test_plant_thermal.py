# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The thermal unit as a whole: its truth, its ranges, and what effects do to it alone."""

import dataclasses
import functools

import numpy as np
import pytest
from streams import needs_jit

from valveflow_ros.plant.historian import Historian
from valveflow_ros.plant.thermal_effects import thermal_catalogue
from valveflow_ros.plant.thermal_plant import simulate_thermal
from valveflow_ros.plant.thermal_unit import (
    KINDS,
    GovernorValve,
    SequencedValves,
    SmoothArea,
    ThermalUnit,
    random_unit,
    unit_of,
)
from valveflow_ros.records import Signal

# Instruments that show what they see.
FINE = dict.fromkeys((*ThermalUnit().resolution, 'grid_frequency_hz'), 1e-6)
QUIET = ThermalUnit(
    noise=dict.fromkeys(ThermalUnit().noise, 0.0), resolution=FINE, swing_mw=0.0, fire=0.0,
    vacuum_per_kpa=0.0,
)  # fmt: skip


@functools.cache
def quiet_log(*effects, days=0.1, **changes):
    return simulate_thermal(days, 3, dataclasses.replace(QUIET, **changes), effects=effects)


# Units and their static power.


@pytest.mark.parametrize('number', [0, 1])
@pytest.mark.parametrize('kind', KINDS)
def test_the_static_power_is_of_the_form_it_says(kind, number):
    unit = random_unit(kind, number)
    opening, c, m = np.linspace(10.0, 80.0, 50), unit.no_load_mw, unit.exponent
    one = unit.static_power(opening, np.full(50, 14.0)) + c
    two = unit.static_power(opening * (1.0 if unit.on_opening else 1.4**m), np.full(50, 10.0)) + c
    np.testing.assert_allclose(one / two, 1.4**m if unit.on_opening else 1.0, rtol=1e-12)
    assert np.all(np.diff(one) > 0.0)
    full = unit.static_power(np.array(unit.full_opening_percent), unit.pressure_rated_mpa)
    assert full == pytest.approx(unit.rated_mw, abs=1e-3)
    assert unit.static_power(np.array(0.0), 12.0) == -c


def test_a_smooth_area_is_straight_between_its_knees_and_rounded_at_them():
    area = SmoothArea((40.0, 70.0), (1.0, 0.5, 0.2), 2.0)
    slope = np.gradient(area(np.arange(0.0, 100.0, 0.01)), 0.01)
    expected = {20: 1.0, 55: 0.5, 90: 0.2, 40: 0.75, 39: 0.95, 41: 0.55}
    assert [slope[100 * at] for at in expected] == pytest.approx(list(expected.values()), abs=1e-3)
    assert area(np.array(0.0)) == 0.0


def test_valves_in_sequence_overlap_and_add_up():
    group, demand = SequencedValves(), np.linspace(0.0, 100.0, 1001)
    np.testing.assert_allclose(group(demand), sum(v.area(demand) for v in group.valves))
    assert group(np.array(100.0)) == pytest.approx(sum(v.share for v in group.valves))
    for first, second in zip(group.valves[1:], group.valves[2:], strict=False):
        assert first.from_percent < second.from_percent < first.to_percent
    assert all(list(v.lift_percent(demand[[0, -1]])) == [0.0, 100.0] for v in group.valves)
    straight = GovernorValve(0.0, 100.0, 1.0, 0.0)
    assert straight.area(np.array(50.0)) == pytest.approx(0.25 / 0.6 * 1.1)


@pytest.mark.parametrize('kind', KINDS)
def test_units_of_a_kind_are_plausible_and_different(kind):
    units = [random_unit(kind, number) for number in range(50)]
    assert len({unit.exponent for unit in units}) == 50
    assert unit_of(f'{kind}:number=7, vacuum_per_kpa=0') == dataclasses.replace(
        units[7], vacuum_per_kpa=0.0
    )
    for unit in units:
        assert 1.0 <= unit.exponent <= 1.13
        assert 7.0 <= unit.pressure_low_mpa <= unit.pressure_rated_mpa <= 18.0
        assert (unit.pressure_low_mpa < unit.pressure_rated_mpa) == KINDS[kind][1]
        assert 130.0 <= unit.load_low_mw < unit.load_high_mw <= 335.0
        if isinstance(unit.area, SmoothArea):
            first, second, third = unit.area.slopes
            assert min(first / second, second / third) >= 1.6 - 1e-9


@needs_jit
@pytest.mark.parametrize('kind', KINDS)
def test_a_day_of_a_unit_stays_in_range_and_its_governor_does_not_swing(kind):
    log = simulate_thermal(1.0, 11, random_unit(kind, 11))
    true, error = log.truth, log.demand_mw - log.truth.power
    for column, low, high in (('plug', 5.0, 100.01), ('pressure', 7.0, 18.5), ('power', 125, 338)):
        assert low < getattr(true, column).min() < getattr(true, column).max() < high
    assert np.std(error) < 2.0
    assert np.mean(true.command >= 100.0) < 0.05
    # A loop that swings has its power's error in one narrow band; here it is broad.
    spectrum = np.abs(np.fft.rfft(error - error.mean())) ** 2
    smooth = np.convolve(spectrum, np.ones(200) / 200.0, 'same')
    assert smooth.max() < 0.02 * spectrum.sum()
    assert np.isfinite(log.table.values).all()
    # The pressure moves at a given load as well.
    calm = np.abs(log.demand_mw - np.median(log.demand_mw)) < 5.0
    assert np.std(true.pressure[calm]) > 0.03


@needs_jit
def test_the_condenser_moves_the_power_by_its_share_and_not_at_all_when_switched_off():
    worse, none = quiet_log(days=1.0, vacuum_per_kpa=-0.01), quiet_log(days=1.0)
    shown = worse.extra['condenser_pressure_kpa']
    np.testing.assert_allclose(shown, worse.truth.condenser, atol=1e-6)
    assert 1.0 < shown.min() < shown.max() < 15.0
    relative = [
        log.truth.power / QUIET.static_power(log.truth.plug, log.truth.pressure) - 1.0
        for log in (worse, none)
    ]
    # In means of ten minutes, on which the lags hardly show.
    change, warmer = (
        column.reshape(-1, 600).mean(axis=1)
        for column in (relative[0] - relative[1], worse.water_degc - QUIET.water_degc)
    )
    assert np.corrcoef(change, warmer)[0, 1] < -0.9
    # Near 33 degC the saturation pressure rises by some 0.2 to 0.35 kPa/K.
    assert -0.0035 < np.polyfit(warmer, change, 1)[0] < -0.002
    assert abs(relative[1].mean()) < 2e-4


@pytest.mark.parametrize('recording', ['1s', 'minute', 'compressed'])
def test_the_seed_decides_what_happens_and_the_record_changes_nothing(recording):
    unit, pair = random_unit('sequence', 1), ('backlash', 'opening_offset:b_percent=1')
    historian = Historian(recording, dropouts_per_day=50.0)
    plain, other = (simulate_thermal(0.02, 4, unit, effects=e) for e in (pair, pair[::-1]))
    made = [simulate_thermal(0.02, 4, unit, historian, effects=pair) for _ in range(2)]
    assert plain.table.values.tobytes() == other.table.values.tobytes()
    assert made[0].table.values.tobytes() == made[1].table.values.tobytes()
    assert made[0].to_json() == made[1].to_json()
    np.testing.assert_array_equal(plain.truth, made[0].truth)
    np.testing.assert_array_equal(plain.demand_mw, made[0].demand_mw)
    assert np.isfinite(made[0].readings.value).all() == (recording == 'compressed')
    assert not np.array_equal(plain.truth, simulate_thermal(0.02, 5, unit, effects=pair).truth)


# Effects.


EARLY = {
    'area_step': 't0_days=0.02', 'gain_step': 't0_days=0.02', 'input_step': 't0_days=0.02',
    'flatline': 't0_days=0.05,minutes=30', 'spikes': 'per_day=500',
    'intervals': 'off_low_h=0.1,off_high_h=0.2',
}  # fmt: skip


@pytest.mark.parametrize('name', thermal_catalogue())
def test_an_effect_moves_nothing_outside_the_unit(name):
    log, healthy = quiet_log(f'{name}:{EARLY.get(name, "")}'), quiet_log()
    for outside in ('demand_mw', 'temperature_degc', 'water_degc'):
        np.testing.assert_array_equal(getattr(log, outside), getattr(healthy, outside))
    moved = np.any(log.table.values != healthy.table.values, axis=0)
    # The stop lies above where this valve works within these hours.
    assert moved.any() == (name != 'saturation' or healthy.truth.plug.max() > 84.0)
    if name in ('flatline', 'quantisation', 'spikes', 'clock'):
        assert np.flatnonzero(moved).tolist() == [Signal.GENERATED_POWER]
        np.testing.assert_array_equal(log.truth, healthy.truth)


def test_wrong_sensors_show_what_they_say():
    log = quiet_log('pressure_scale:g=0.02', 'opening_offset:b_percent=-1,drift_percent=10')
    pressure = log.table.column(Signal.MAIN_STEAM_PRESSURE)
    np.testing.assert_allclose(pressure, 1.02 * log.truth.pressure, rtol=1e-6)
    too_high = log.table.column(Signal.VALVE_OPENING) - log.truth.plug
    np.testing.assert_allclose(too_high, -1.0 + np.arange(len(log)) / 86_400.0, atol=1e-5)
    # The control aims at the pressure it reads.
    assert log.truth.pressure.mean() < 0.99 * quiet_log().truth.pressure.mean()
    log = quiet_log('input_step:g=0.02,t0_days=0.05')
    ratio = log.truth.plug / log.table.column(Signal.VALVE_OPENING)
    np.testing.assert_allclose(ratio, np.repeat([1.0, 1.02], 4320), rtol=1e-6)


@pytest.mark.parametrize(('name', 'of_flow'), [('area_step', True), ('gain_step', False)])
def test_area_and_efficiency_change_flow_or_power_at_their_moment(name, of_flow):
    true = quiet_log(f'{name}:g=-0.03,t0_days=0.05').truth
    ratio = true.flow / QUIET.flow(true.plug, true.pressure)
    expected = np.repeat([1.0, 0.97 if of_flow else 1.0], 4320)
    np.testing.assert_allclose(ratio, expected, rtol=1e-9)
    lost = of_flow * QUIET.no_load_mw
    power = 0.97 * (QUIET.static_power(true.plug, true.pressure) + lost) - lost
    assert np.median((true.power - power)[5000:]) == pytest.approx(0.0, abs=0.3)


def test_temperature_changes_the_power_per_kelvin():
    own = quiet_log(temperature_per_k=-0.002)
    hidden = quiet_log(f'temperature:k=-0.002,reference_degc={QUIET.temperature_degc}')
    np.testing.assert_allclose(own.truth.power, hidden.truth.power, rtol=1e-12)
    assert not np.array_equal(own.truth.plug, quiet_log().truth.plug)
