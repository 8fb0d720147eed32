# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The thermal unit as a whole: its truth, its ranges, and what effects do to it alone."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
from streams import needs_jit

from valveflow_ros.errors import InputError
from valveflow_ros.plant.effects import catalogue
from valveflow_ros.plant.historian import Historian
from valveflow_ros.plant.simulator import simulate
from valveflow_ros.plant.spec import EffectSpec
from valveflow_ros.plant.thermal_effects import AREA_STEP, thermal_catalogue
from valveflow_ros.plant.thermal_plant import ThermalLog, simulate_thermal
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

DAYS = 0.1
QUIET = ThermalUnit(
    noise=dict.fromkeys(ThermalUnit().noise, 0.0), resolution={}, swing_mw=0.0, fire=0.0,
    vacuum_per_kpa=0.0,
)  # fmt: skip


def quiet_log(*effects: str, unit: ThermalUnit = QUIET, days: float = DAYS) -> ThermalLog:
    """Simulate a unit whose instruments show what they see."""
    fine = dict.fromkeys(
        (*ThermalUnit().resolution, 'valve_command_percent', 'grid_frequency_hz'), 1e-6
    )
    return simulate_thermal(days, 3, dataclasses.replace(unit, resolution=fine), effects=effects)


@pytest.fixture(scope='module')
def healthy() -> ThermalLog:
    return quiet_log()


# The static power.


@pytest.mark.parametrize('number', range(5))
@pytest.mark.parametrize('kind', KINDS)
def test_the_static_power_is_of_the_form_it_says(kind: str, number: int) -> None:
    unit = random_unit(kind, number)
    opening = np.linspace(10.0, 80.0, 50)
    one = unit.static_power(opening, np.full(50, 14.0)) + unit.no_load_mw
    m = unit.exponent
    if unit.on_opening:
        two = unit.static_power(opening, np.full(50, 10.0)) + unit.no_load_mw
        np.testing.assert_allclose(one / two, 1.4**m, rtol=1e-12)
    else:
        further = opening * 1.4**m
        two = unit.static_power(further, np.full(50, 10.0)) + unit.no_load_mw
        np.testing.assert_allclose(one, two, rtol=1e-12)
    assert np.all(np.diff(one) > 0.0)
    full = unit.static_power(np.array(unit.full_opening_percent), unit.pressure_rated_mpa)
    assert full == pytest.approx(unit.rated_mw, abs=1e-3)
    assert unit.static_power(np.array(0.0), 12.0) == -unit.no_load_mw


def test_a_smooth_area_is_straight_between_its_knees_and_rounded_at_them() -> None:
    area = SmoothArea((40.0, 70.0), (1.0, 0.5, 0.2), 2.0)
    slope = np.gradient(area(np.arange(0.0, 100.0, 0.01)), 0.01)
    for place, expected in ((20.0, 1.0), (55.0, 0.5), (90.0, 0.2)):
        assert slope[int(place * 100)] == pytest.approx(expected, abs=1e-4)
    assert slope[4000] == pytest.approx(0.75, abs=1e-3), 'half-way at the knee'
    assert area(np.array(0.0)) == 0.0
    assert slope[4000 - 100] == pytest.approx(0.95, abs=1e-3)
    assert slope[4000 + 100] == pytest.approx(0.55, abs=1e-3)


def test_valves_in_sequence_overlap_and_add_up() -> None:
    group = SequencedValves()
    demand = np.linspace(0.0, 100.0, 1001)
    np.testing.assert_allclose(group(demand), sum(v.area(demand) for v in group.valves))
    assert group(np.array(100.0)) == pytest.approx(sum(v.share for v in group.valves))
    for first, second in zip(group.valves[1:], group.valves[2:], strict=False):
        assert first.from_percent < second.from_percent < first.to_percent
    for valve in group.valves:
        lift = valve.lift_percent(demand)
        assert lift[0] == 0.0
        assert lift[-1] == 100.0
    straight = GovernorValve(0.0, 100.0, 1.0, 0.0)
    assert straight.area(np.array(50.0)) == pytest.approx(0.25 / 0.6 * 1.1)


# Units.


@pytest.mark.parametrize('kind', KINDS)
def test_a_hundred_units_of_a_kind_are_plausible_and_different(kind: str) -> None:
    units = [random_unit(kind, number) for number in range(100)]
    assert len({unit.exponent for unit in units}) == 100
    assert random_unit(kind, 7) == units[7]
    for unit in units:
        assert 1.0 <= unit.exponent <= 1.13
        assert 7.0 <= unit.pressure_low_mpa <= unit.pressure_rated_mpa <= 18.0
        assert (unit.pressure_low_mpa < unit.pressure_rated_mpa) == KINDS[kind][1]
        low = np.array([unit.load_low_mw, unit.load_high_mw])
        assert 130.0 <= low[0] < low[1] <= 335.0
        assert 8.0 <= unit.reheater_s <= 15.0
        if isinstance(unit.area, SmoothArea):
            first, second, third = unit.area.slopes
            assert min(first / second, second / third) >= 1.6 - 1e-9
        else:
            assert 3 <= len(unit.area.valves) <= 4


@needs_jit
@pytest.mark.parametrize('number', [0, 11, 42])
@pytest.mark.parametrize('kind', KINDS)
def test_a_day_of_a_unit_stays_in_range_and_its_governor_does_not_swing(
    kind: str, number: int
) -> None:
    unit = random_unit(kind, number)
    log = simulate_thermal(1.0, number, unit)
    true = log.truth
    assert true.plug.min() > 5.0
    assert true.plug.max() <= 100.0
    assert true.pressure.min() > 7.0
    assert true.pressure.max() < 18.5
    assert true.power.min() > 125.0
    assert true.power.max() < 338.0
    assert np.std(log.demand_mw - true.power) < 2.0
    assert np.mean(true.command >= 100.0) < 0.05
    # A loop that swings has its power's error in one narrow band; here it is broad.
    error = log.demand_mw - true.power
    spectrum = np.abs(np.fft.rfft(error - error.mean())) ** 2
    smooth = np.convolve(spectrum, np.ones(200) / 200.0, 'same')
    assert smooth.max() < 0.02 * spectrum.sum()
    columns = log.table.values
    assert np.isfinite(columns).all()
    # The pressure moves at a given load as well.
    calm = np.abs(log.demand_mw - np.median(log.demand_mw)) < 5.0
    assert np.std(true.pressure[calm]) > 0.03


@needs_jit
def test_steady_rows_lie_on_the_static_power_to_within_noise() -> None:
    unit = dataclasses.replace(random_unit('sequence', 2), vacuum_per_kpa=0.0)
    log = simulate_thermal(0.5, 8, unit)
    true = log.truth
    away = true.power - unit.static_power(true.plug, true.pressure)
    still = np.abs(true.flow[300:] - true.flow[:-300]) < 0.002
    assert still.sum() > 1000
    assert abs(away[300:][still].mean()) < 0.1
    assert away[300:][still].std() < 1.5


def test_steam_is_neither_made_nor_lost(healthy: ThermalLog) -> None:
    true, unit = healthy.truth, healthy.unit
    rise = np.diff(true.drum) * unit.storage_s / unit.pressure_rated_mpa
    np.testing.assert_allclose(rise, true.heat[1:] - true.flow[:-1], atol=1e-12)


@needs_jit
def test_the_condenser_moves_the_power_by_its_share_and_not_at_all_when_switched_off() -> None:
    unit = dataclasses.replace(QUIET, vacuum_per_kpa=-0.01)
    worse, none = quiet_log(unit=unit, days=1.0), quiet_log(days=1.0)
    shown = worse.extra['condenser_pressure_kpa']
    np.testing.assert_allclose(shown, worse.truth.condenser, atol=1e-6)
    assert 1.0 < shown.min() < shown.max() < 15.0
    relative = [
        log.truth.power / unit.static_power(log.truth.plug, log.truth.pressure) - 1.0
        for log in (worse, none)
    ]
    # In means of ten minutes, on which the lags hardly show.
    change, warmer = (
        column.reshape(-1, 600).mean(axis=1)
        for column in (relative[0] - relative[1], worse.water_degc - unit.water_degc)
    )
    assert np.corrcoef(change, warmer)[0, 1] < -0.9
    # Near 33 degC the saturation pressure rises by some 0.2 to 0.35 kPa/K.
    per_kelvin = np.polyfit(warmer, change, 1)[0]
    assert -0.0035 < per_kelvin < -0.002
    assert abs(relative[1].mean()) < 2e-4


# One seed, one plant.


def test_the_same_seed_gives_the_same_bytes_and_another_does_not() -> None:
    unit = random_unit('choked', 1)
    one, two, other = (simulate_thermal(0.02, seed, unit) for seed in (4, 4, 5))
    assert one.table.values.tobytes() == two.table.values.tobytes()
    assert one.to_json() == two.to_json()
    assert one.table.values.tobytes() != other.table.values.tobytes()


@pytest.mark.parametrize('recording', ['minute', 'compressed'])
def test_how_it_is_recorded_changes_nothing_of_what_happened(recording: str) -> None:
    plain = simulate_thermal(0.02, 4)
    other = simulate_thermal(0.02, 4, historian=Historian(recording, dropouts_per_day=50.0))
    for mine, theirs in zip(plain.truth, other.truth, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    np.testing.assert_array_equal(plain.demand_mw, other.demand_mw)


def test_the_order_of_effects_makes_no_difference() -> None:
    pair = ('backlash', 'opening_offset:b_percent=1')
    one, two = (simulate_thermal(0.02, 4, effects=e) for e in (pair, pair[::-1]))
    assert one.table.values.tobytes() == two.table.values.tobytes()


# Effects.


def test_a_healthy_valve_stands_where_its_sensor_says(healthy: ThermalLog) -> None:
    np.testing.assert_array_equal(healthy.truth.stem, healthy.truth.plug)
    opening = healthy.table.column(Signal.VALVE_OPENING)
    np.testing.assert_allclose(opening, healthy.truth.plug, atol=2e-6)
    pressure = healthy.table.column(Signal.MAIN_STEAM_PRESSURE)
    np.testing.assert_allclose(pressure, healthy.truth.pressure, atol=2e-6)


@pytest.mark.parametrize('name', sorted(set(thermal_catalogue()) - {'flatline', 'quantisation'}))
def test_an_effect_moves_nothing_outside_the_unit(name: str, healthy: ThermalLog) -> None:
    row = thermal_catalogue()[name]
    given = {p.name: 0.02 for p in row.parameters if p.name == 't0_days'}
    given |= {'per_day': 500.0} if name == 'spikes' else {}
    if name == 'intervals':
        given |= {'off_low_h': 0.1, 'off_high_h': 0.2}
    log = simulate_thermal(DAYS, 3, healthy.unit, effects=[EffectSpec.of(row, **given)])
    np.testing.assert_array_equal(log.demand_mw, healthy.demand_mw)
    np.testing.assert_array_equal(log.temperature_degc, healthy.temperature_degc)
    np.testing.assert_array_equal(log.water_degc, healthy.water_degc)
    same = log.table.values.tobytes() == healthy.table.values.tobytes()
    # The stop lies above where this valve works within these hours.
    assert same == (name == 'saturation' and healthy.truth.plug.max() < 84.0)


def test_slack_lies_behind_the_sensor_and_is_as_wide_as_said() -> None:
    true = quiet_log('backlash:w_percent=1.2').truth
    assert np.abs(true.stem - true.plug).max() == pytest.approx(0.6, abs=1e-9)
    assert np.ptp(true.stem - true.plug) == pytest.approx(1.2, abs=1e-9)


@pytest.mark.parametrize('before', [0, 1])
def test_friction_sits_on_the_side_of_the_sensor_that_was_asked_for(before: int) -> None:
    log = quiet_log(f'stiction:s_percent=2,j_percent=1,before_sensor={before}')
    true = log.truth
    behind = np.abs(true.stem - true.plug)
    rests = np.mean(np.diff(true.stem) == 0.0), np.mean(np.diff(true.plug) == 0.0)
    if before:
        assert behind.max() == 0.0
        assert rests[0] > 0.05
    else:
        assert behind.max() <= 1.5 + 1e-9
        assert behind.max() > 0.9
        assert rests[0] < 0.05 < rests[1]


def test_a_stop_and_a_slow_servo_keep_the_plug_to_their_limits() -> None:
    true = quiet_log('saturation:max_percent=60', 'rate_limit:r_percent_per_s=0.1').truth
    assert true.plug.max() == 60.0
    assert np.abs(np.diff(true.plug)).max() <= 0.1 + 1e-9


def test_wrong_sensors_show_what_they_say(healthy: ThermalLog) -> None:
    log = quiet_log('pressure_scale:g=0.02', 'opening_offset:b_percent=-1,drift_percent=10')
    pressure = log.table.column(Signal.MAIN_STEAM_PRESSURE)
    np.testing.assert_allclose(pressure, 1.02 * log.truth.pressure, rtol=1e-6)
    time_days = np.arange(len(log)) / 86_400.0
    too_high = log.table.column(Signal.VALVE_OPENING) - log.truth.plug
    np.testing.assert_allclose(too_high, -1.0 + time_days, atol=1e-5)
    # The control aims at the pressure it reads.
    assert log.truth.pressure.mean() < 0.99 * healthy.truth.pressure.mean()


def test_a_recalibrated_position_reads_otherwise_from_its_day_on() -> None:
    log = quiet_log('input_step:g=0.02,t0_days=0.05')
    ratio = log.truth.plug / log.table.column(Signal.VALVE_OPENING)
    np.testing.assert_allclose(ratio[:4320], 1.0, rtol=1e-6)
    np.testing.assert_allclose(ratio[4320:], 1.02, rtol=1e-6)


@pytest.mark.parametrize(('name', 'of_flow'), [('area_step', True), ('gain_step', False)])
def test_area_and_efficiency_change_flow_or_power_at_their_moment(
    name: str, of_flow: bool
) -> None:
    log = quiet_log(f'{name}:g=-0.03,t0_days=0.05')
    true, unit = log.truth, log.unit
    ratio = true.flow / unit.flow(true.plug, true.pressure)
    np.testing.assert_allclose(ratio[:4320], 1.0, rtol=1e-9)
    np.testing.assert_allclose(ratio[4320:], 0.97 if of_flow else 1.0, rtol=1e-9)
    later = slice(5000, None)
    expected = 0.97 * (unit.static_power(true.plug, true.pressure) + of_flow * unit.no_load_mw)
    expected -= of_flow * unit.no_load_mw
    assert np.median(true.power[later] - expected[later]) == pytest.approx(0.0, abs=0.3)


@pytest.mark.parametrize('lead_s', [12.0, -7.5])
def test_another_clock_moves_the_power_only(lead_s: float, healthy: ThermalLog) -> None:
    log = quiet_log(f'clock:d_s={lead_s}')
    for signal in set(Signal) - {Signal.GENERATED_POWER}:
        np.testing.assert_array_equal(log.table.column(signal), healthy.table.column(signal))
    seconds = np.arange(len(log))
    expected = np.interp(seconds + lead_s, seconds, healthy.table.column(Signal.GENERATED_POWER))
    inner = slice(20, -20)
    shown = log.table.column(Signal.GENERATED_POWER)
    np.testing.assert_allclose(shown[inner], expected[inner], atol=2e-6)


def test_temperature_changes_the_power_per_kelvin(healthy: ThermalLog) -> None:
    own = quiet_log(unit=dataclasses.replace(QUIET, temperature_per_k=-0.002))
    hidden = quiet_log(f'temperature:k=-0.002,reference_degc={QUIET.temperature_degc}')
    np.testing.assert_allclose(own.truth.power, hidden.truth.power, rtol=1e-12)
    assert not np.array_equal(own.truth.plug, healthy.truth.plug)


@pytest.mark.parametrize('text', ['flatline:signal=generated_power,t0_days=0.05,minutes=30',
                                  'quantisation:signal=generated_power,step=5',
                                  'spikes:signal=generated_power,per_day=500'])  # fmt: skip
def test_a_fault_of_the_record_is_in_the_record_only(text: str, healthy: ThermalLog) -> None:
    log = quiet_log(text)
    np.testing.assert_array_equal(log.truth.power, healthy.truth.power)
    for signal in Signal:
        same = np.array_equal(log.table.column(signal), healthy.table.column(signal))
        assert same == (signal != Signal.GENERATED_POWER)


# What is refused.

REFUSED = [
    *(
        (lambda a=arguments: simulate_thermal(**{'days': 0.01, 'seed': 1, **a}), words)
        for arguments, words in (
            ({'days': 0.0}, 'more than 0 and at most 60 days, not 0'),
            ({'days': np.nan}, 'more than 0'),
            ({'days': 61.0}, 'at most 60 days, not 61'),
            ({'seed': -1}, 'seed must be 0 or more, not -1'),
            ({'start_ns': 0}, 'between the years'),
            ({'effects': ['gain_stp']}, r"'gain_stp' is unknown: use one of area_step.*gain_step"),
            ({'effects': ['area_step:h=1']}, "'area_step' has no parameter 'h'"),
            ({'effects': ['backlash', 'backlash']}, "'backlash' is given twice"),
            ({'effects': ['pressure_scale', 'pressure_scale']}, 'given twice'),
            ({'effects': ['area_step']}, 'would begin after 5 days'),
        )
    ),
    *(
        (lambda n=name: simulate_thermal(0.01, 1, effects=[n]), 'no meaning on the unit')
        for name in sorted(set(catalogue()) - set(thermal_catalogue()))
    ),
    (lambda: simulate(6.0, 1, effects=[EffectSpec.of(AREA_STEP)]), 'thermal unit only'),
    *(
        (lambda c=change: dataclasses.replace(ThermalUnit(), **c), words)
        for change, words in (
            ({'kind': 'chocked'}, "no unit 'chocked': use one of choked, "),
            ({'reheater_s': 0.0}, 'times must be above 0 s'),
            ({'exponent': np.nan}, 'exponent must be'),
            ({'no_load_mw': -1.0}, 'no_load_mw'),
            ({'load_low_mw': 325.0}, 'loads must be'),
            ({'slide_from_mw': 310.0}, 'slide_from_mw'),
            ({'pressure_low_mpa': 17.0}, 'pressures must be'),
            ({'full_opening_percent': 101.0}, 'full_opening_percent'),
            ({'reserve_hours': 1.1}, 'reserve_hours'),
            ({'high_pressure_share': 1.1}, 'high_pressure_share'),
            ({'droop': 0.0}, 'droop'),
            ({'vacuum_per_kpa': -1.0}, 'vacuum_per_kpa'),
        )
    ),
    *(
        (lambda t=text: unit_of(t), words)
        for text, words in (
            ('', "no unit ''"),
            ('choked:n=1', "Unit 'choked' has no option 'n': it has number, "),
            ('choked:number', "number must be a number, not ''"),
            ('choked:number=1.5', 'number must be a whole number, not 1.5'),
            ('choked:number=-1', 'must be 0 or more, not -1'),
            ('choked:number=inf', 'finite'),
            ('choked:number=1,number=2', 'number is given twice'),
        )
    ),
    (lambda: SmoothArea((70.0, 50.0)), 'rising knees'),
    (lambda: SequencedValves((GovernorValve(50.0, 50.0, 1.0),)), '1 to 8 valves'),
]  # fmt: skip


@pytest.mark.parametrize(('make', 'words'), REFUSED)
def test_what_cannot_be_simulated_is_refused(make, words: str) -> None:
    with pytest.raises(InputError) as caught:
        make()
    assert re.search(words, str(caught.value)), caught.value
    assert str(caught.value)[-1] in '.?'


def test_a_unit_is_read_from_its_text() -> None:
    assert unit_of('choked') == random_unit('choked', 0)
    made = unit_of('sequence:number=7, vacuum_per_kpa=0')
    assert made == dataclasses.replace(random_unit('sequence', 7), vacuum_per_kpa=0.0)
