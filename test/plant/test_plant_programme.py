# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The outside of the plant: what the text of the paper's study asks for, by counting."""

import numpy as np
import pytest
from plants import run, same

from valveflow_ros.plant.effect import DAY_S
from valveflow_ros.plant.plant import LoadProgramme, Pulses, load_knots
from valveflow_ros.plant.simulator import DEFAULT_START_NS, SimulatedLog, simulate, simulate_parts
from valveflow_ros.plant.spec import EffectSpec
from valveflow_ros.plant.unit import Noise, Programme, UnitDescription
from valveflow_ros.records import NS_PER_S, Quality, Signal

LONG_S = 300.0 * DAY_S


@pytest.fixture(scope='module')
def days():
    return simulate(4.0, seed=20)


def test_holds_and_ramps_of_the_load():
    seconds, load = load_knots(np.random.default_rng(1), LONG_S, 0.0, Programme())
    holds, ramps = np.diff(seconds)[0::2], np.diff(seconds)[1::2]
    targets, moves = load[2::2], np.abs(np.diff(load)[1::2])
    assert np.all(np.diff(load)[0::2] == 0.0)
    assert holds.min() >= 600.0
    assert holds.mean() == pytest.approx(1500.0, rel=0.05)
    rates = 60.0 * moves[moves > 1.0] / ramps[moves > 1.0]
    assert 2.5 <= rates.min() < 2.6
    assert 5.9 < rates.max() <= 6.0 + 1e-9
    assert 160.0 <= targets.min() < 161.0
    assert targets.max() <= 293.5
    # Full load is also reached by the daily wave: at least 15 % of targets, not many more.
    assert 0.15 < np.mean(targets >= 286.0) < 0.21


def test_the_load_follows_the_clock():
    plan, clock_h = Programme(full_load_share=0.0), 7.0
    seconds, load = load_knots(np.random.default_rng(2), LONG_S, clock_h * 3600.0, plan)
    t = np.arange(0.0, LONG_S, 600.0)
    phase = 2.0 * np.pi * ((t / 3600.0 + clock_h) - 9.0) / 24.0
    wave = np.interp(t, seconds, load)
    a, b = 2.0 * np.mean(wave * np.sin(phase)), 2.0 * np.mean(wave * np.cos(phase))
    late_h = np.arctan2(-b, a) * 12.0 / np.pi
    # A target holds for a while, so the load follows the wave late, and clipped.
    assert 0.0 < late_h < 1.5
    assert 20.0 < np.hypot(a, b) < 32.0


@pytest.mark.parametrize('start_h', [0, 9])
def test_the_clock_is_read_from_the_stamps(start_h):
    unit, hour_ns = UnitDescription(), 3600 * NS_PER_S
    log = simulate(0.5, 3, start_ns=DEFAULT_START_NS + start_h * hour_ns)
    # The record begins an hour after the plant does.
    drive = LoadProgramme(unit, 3, 13 * 3600.0, (start_h - 1) * 3600.0)
    np.testing.assert_array_equal(log.load_mw, drive.advance(0, 13 * 3600).load_mw[3600:])


def test_pulses_of_primary_frequency_control():
    pulses = Pulses.draw(np.random.default_rng(3), LONG_S, Programme())
    assert pulses.start_s.size == pytest.approx(LONG_S / 1500.0, rel=0.05)
    height = np.abs(pulses.height_percent)
    assert 1.0 <= height.min() < 1.05
    assert 3.95 < height.max() <= 4.0
    assert np.mean(pulses.height_percent > 0.0) == pytest.approx(0.5, abs=0.03)
    assert 30.0 <= pulses.hold_s.min() < 31.0
    assert 119.0 < pulses.hold_s.max() <= 120.0
    pulse = Pulses(np.array([10.0]), np.array([20.0]), np.array([-2.0]))
    shown = pulse.at(np.array([9.0, 10.0, 12.0, 14.0, 20.0, 34.0, 36.0, 38.0, 39.0]))
    np.testing.assert_allclose(shown, [0, 0, -1, -2, -2, -2, -1, 0, 0])


def test_ranges_of_the_paper_unit(days):
    values = days.table.values
    opening, pressure, temperature, power, _ = values.T
    np.testing.assert_allclose(opening * pressure**1.125, days.true_u, rtol=0.01)
    assert 990.0 < days.true_u.min() < 1100.0
    assert 2200.0 < days.true_u.max() < 2400.0
    assert 135.0 < power.min() < 155.0
    assert 295.0 < power.max() < 312.0
    assert 0.08 < np.mean(days.load_mw >= 286.0) < 0.25
    assert pressure.min() > 9.0
    assert pressure.max() < 17.8
    assert temperature.mean() == pytest.approx(539.0, abs=0.8)
    assert 1.5 < temperature.std() < 3.0
    assert opening.min() > 55.0
    assert opening.max() < 100.2


def test_noise_of_the_power(days):
    noise = days.noise_mw
    assert noise.std() == pytest.approx(np.hypot(2.0, 2.2), rel=0.03)
    one_minute = np.mean(noise[60:] * noise[:-60])
    assert one_minute == pytest.approx(4.0 * np.exp(-1.0), rel=0.15)
    np.testing.assert_array_equal(
        days.table.values[:, Signal.GENERATED_POWER], np.round(days.true_power_mw + noise, 2)
    )


def test_noise_and_rounding_of_the_sensors(days):
    values = days.table.values
    error = values[:, Signal.VALVE_OPENING] - days.plug_percent
    assert error.std() == pytest.approx(0.02, rel=0.05)
    for signal, decimals in zip(Signal, (2, 3, 1, 2, 2), strict=True):
        np.testing.assert_array_equal(values[:, signal], np.round(values[:, signal], decimals))
    assert np.all(days.table.quality == Quality.GOOD)
    # Pressure and temperature move slowly: their differences are the sensors' noise.
    for signal, sigma in (
        (Signal.MAIN_STEAM_PRESSURE, 0.01),
        (Signal.MAIN_STEAM_TEMPERATURE, 0.2),
    ):
        assert np.diff(values[:, signal]).std() == pytest.approx(np.sqrt(2) * sigma, rel=0.4)


def test_the_record_begins_in_equilibrium():
    starts = [simulate(0.02, seed) for seed in range(20)]
    error = [np.mean(s.true_power_mw[:60] - s.load_mw[:60]) for s in starts]
    assert np.std(error) < 4.0
    assert abs(np.mean(error)) < 1.5


def test_the_power_control_removes_a_lasting_error():
    effect = [EffectSpec.parse('output_offset_drift:b_mw=50')]
    error = {}
    for feedback in (False, True):
        unit = UnitDescription(
            programme=Programme(feedback=feedback, load_high_mw=280.0, full_load_from_mw=275.0)
        )
        log = simulate(1.5, 4, unit, effects=effect)
        late = log.true_power_mw - log.load_mw
        error[feedback] = abs(np.mean(late[-40_000:]))
    assert error[True] < 0.2 * error[False]


@pytest.mark.parametrize('wanted', [0.0, 0.8])
def test_temperature_and_pressure_correlate_as_asked(wanted):
    plan = Programme(
        temperature_pressure_correlation=wanted, load_daily_mw=0.0, load_spread_mw=0.1,
        full_load_share=0.0,
    )  # fmt: skip
    # Both wander slowly; a coarse step shows it as well.
    log = simulate(18.0, 0, UnitDescription(programme=plan, sample_period_s=20.0))
    _, pressure, temperature, *_ = log.table.values.T
    assert np.corrcoef(pressure, temperature)[0, 1] == pytest.approx(wanted, abs=0.12)


def test_noise_by_load_and_a_slow_wander_change_the_noise_alone():
    base = run(days=0.3)
    log = simulate(0.3, 1, UnitDescription(noise=Noise(load_dependence=0.8)))
    expected = 1.0 + 0.8 * (log.load_mw - 228.0) / (293.5 - 228.0)
    np.testing.assert_allclose(log.noise_mw / base.noise_mw, expected, rtol=1e-9)
    added = simulate(0.3, 1, UnitDescription(noise=Noise(wander_mw=0.6))).noise_mw - base.noise_mw
    assert 0.1 < added.std() < 1.2
    assert np.mean(added[600:] * added[:-600]) / np.mean(added**2) > 0.8


def test_the_seed_decides_everything_and_a_longer_run_begins_with_the_shorter_one():
    effects = ('clock:d_s=2.5', 'spikes:per_day=300', 'diurnal')
    short, long = (run(*effects, days=days, seed=8) for days in (0.1, 0.2))
    n = len(short)
    same(short, simulate(0.1, 8, effects=short.active))
    np.testing.assert_array_equal(short.table.values, long.table.values[:n])
    np.testing.assert_array_equal(short.true_u, long.true_u[:n])
    assert not np.array_equal(short.noise_mw, run(*effects, days=0.1, seed=9).noise_mw)


@pytest.mark.parametrize('part_s', [61.0, 5000.0, np.inf])
@pytest.mark.parametrize('lead', ['7.5', '-7.5'])
def test_any_cutting_into_parts_gives_the_same_run(part_s, lead):
    texts = (
        f'clock:d_s={lead}', 'flatline:t0_days=0.02,minutes=60,signal=valve_opening', 'backlash',
        'stiction:before_sensor=1', 'rate_limit', 'reheater', 'curve_step:t0_days=0.03',
        'temperature', 'spikes:per_day=500,signal=main_steam_pressure', 'choked',
    )  # fmt: skip
    whole = run(*texts, days=0.1, seed=3)
    parts = list(simulate_parts(0.1, 3, effects=whole.active, part_s=part_s))
    assert all(len(part) <= max(part_s, 61.0) for part in parts)
    same(SimulatedLog.joined(parts), whole)


def test_stamps_follow_the_sample_period():
    log = simulate(0.01, 1, UnitDescription(sample_period_s=2.0), start_ns=5 * NS_PER_S)
    np.testing.assert_array_equal(log.table.time_ns, (5 + 2 * np.arange(432)) * NS_PER_S)
    assert DEFAULT_START_NS % int(DAY_S * NS_PER_S) == 0, 'a midnight'
