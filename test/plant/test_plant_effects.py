# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Effects do what their physics says and nothing else; nothing is nothing, and several compose."""

import dataclasses

import numpy as np
import pytest
from plants import DAYS, REST, UNITS, at_rest, rest, run, same

from valveflow_ros.errors import InputError
from valveflow_ros.plant.effects import catalogue
from valveflow_ros.plant.effects.changes import intervals_s
from valveflow_ros.plant.effects.record import spikes_s
from valveflow_ros.plant.simulator import DEFAULT_START_NS, simulate
from valveflow_ros.plant.spec import EffectSpec
from valveflow_ros.plant.unit import Region, UnitDescription
from valveflow_ros.records import NS_PER_S, SIGNALS, Signal

OFTEN = 'off_low_h=1,off_high_h=2,on_low_h=1,on_high_h=2'
# Each effect at an amplitude that is none.
NOTHING = {
    'temperature': 'k=0', 'exponent': 'dm=0', 'choked': 'kappa=0', 'gain_drift': 'g=0',
    'input_drift': 'g=0', 'output_offset_drift': 'b_mw=0', 'gain_step': 'g=0,t0_days=0.1',
    'input_step': 'g=0,t0_days=0.1', 'curve_step': 's_mw=0,t0_days=0.1',
    'intervals': f'g=0,{OFTEN}', 'diurnal': 'a=0', 'backlash': 'w_percent=0',
    'stiction': 's_percent=0,j_percent=0', 'rate_limit': 'r_percent_per_s=1000',
    'saturation': 'max_percent=100', 'region_lag': 'time_s=80,delay_s=10,level_mw=240',
    'reheater': 'alpha=1', 'clock': 'd_s=0', 'curve_shape': 'h_mw=0',
    'flatline': 'minutes=0,t0_days=0.1', 'quantisation': 'step=0',
    'spikes': 'height=0,per_day=100',
}  # fmt: skip
# Early and large enough for a short run.
SOMETHING = {
    **dict.fromkeys(NOTHING, ''),
    **dict.fromkeys(('gain_step', 'input_step', 'curve_step', 'flatline'), 't0_days=0.1'),
    'intervals': OFTEN,
    'spikes': 'per_day=100',
}


def some(name):
    return f'{name}:{SOMETHING[name]}'


@pytest.mark.parametrize('name', [*catalogue(), 'reheater:time_s=0'])
def test_an_amplitude_of_nothing_changes_nothing(name):
    same(run(name if ':' in name else f'{name}:{NOTHING[name]}'), run())


@pytest.mark.parametrize('name', SOMETHING)
def test_every_effect_is_seen_and_what_comes_from_outside_stays(name):
    log, base = run(some(name)), run()
    assert np.any(log.table.values != base.table.values)
    np.testing.assert_array_equal(log.load_mw, base.load_mw)
    kept = [Signal.MAIN_STEAM_PRESSURE, Signal.MAIN_STEAM_TEMPERATURE]
    if name in ('clock', 'flatline', 'quantisation', 'spikes'):  # faults of the record alone
        np.testing.assert_array_equal(log.true_u, base.true_u)
        kept += [Signal.VALVE_OPENING, Signal.VALVE_COMMAND]
    np.testing.assert_array_equal(log.table.values[:, kept], base.table.values[:, kept])
    if name != 'clock':
        np.testing.assert_array_equal(log.noise_mw, base.noise_mw)


AMPLITUDES = {
    'temperature': ('k', 1e-3), 'gain_drift': ('g', 0.05), 'output_offset_drift': ('b_mw', 3.0),
    'gain_step': ('g', 0.01), 'intervals': ('g', 0.01), 'diurnal': ('a', 0.01),
    'curve_step': ('s_mw', -2.0), 'curve_shape': ('h_mw', 2.0),
    'exponent': ('dm', 1e-4), 'input_drift': ('g', 1e-3), 'input_step': ('g', 1e-4),
}  # fmt: skip


@pytest.mark.parametrize('name', AMPLITUDES)
def test_twice_the_amplitude_is_twice_the_difference(name):
    key, amplitude = AMPLITUDES[name]
    none, once, twice = (
        run(f'{name}:{SOMETHING[name]},{key}={a}'.replace(':,', ':'), unit='open').true_power_mw
        for a in (0.0, amplitude, 2.0 * amplitude)
    )
    assert np.abs(once - none).max() > 1e-4
    if name in ('exponent', 'input_drift', 'input_step'):
        # Where u crosses a knot the slope differs between the two.
        assert np.linalg.norm(twice - 2.0 * once + none) < 0.02 * np.linalg.norm(twice - none)
    else:
        np.testing.assert_allclose(twice - none, 2.0 * (once - none), atol=1e-9)


@pytest.mark.parametrize('name', ['gain_step', 'input_step', 'curve_step'])
def test_nothing_happens_before_the_onset(name):
    log, base, onset = run(some(name)), run(), round(0.1 * 86_400)
    np.testing.assert_array_equal(log.table.values[:onset], base.table.values[:onset])
    assert np.mean(log.true_power_mw[onset:] != base.true_power_mw[onset:]) > 0.3


def test_the_order_of_effects_makes_no_difference():
    effects = [some(name) for name in NOTHING]
    one, other = run(*effects), run(*effects[::-1])
    # Before rounding, too: the last bit of a product knows the order of its factors.
    same(one, other)
    assert set(one.active) == set(other.active)
    assert np.isfinite(one.table.values).all()


def test_effects_compose():
    names = ('temperature', 'diurnal', 'gain_drift', 'gain_step')
    none = run(unit='prompt').true_power_mw
    ratios = [run(some(name), unit='prompt').true_power_mw / none for name in names]
    together = run(*map(some, names), unit='prompt').true_power_mw / none
    np.testing.assert_allclose(together, np.prod(ratios, axis=0), rtol=1e-5)


# On the curve.


def rest_points():
    """Return u, x and F' u at the holds."""
    curve, u = UNITS['quiet'].curve, REST.corners()[1][1::2] * REST.pressure_mpa**1.125
    return u, curve(u), curve.slopes[np.searchsorted(curve.knots[1:-1], u, side='right')] * u


def test_at_rest_the_power_is_the_curve():
    at = np.round(REST.corners()[0][1::2]).astype(int) - 1
    u, x, _ = rest_points()
    for found, expected in ((rest().true_power_mw, x), (rest().load_mw, x), (rest().true_u, u)):
        np.testing.assert_allclose(found[at], expected, atol=1e-6)
    assert np.ptp(rest().true_power_mw[:900]) < 1e-9, 'it begins at rest'


def test_gain_and_input_act_in_their_own_load_profile():
    u, x, slope_u = rest_points()
    for name, profile in (('gain_step', x), ('input_step', slope_u)):
        change = at_rest(f'{name}:g=0.001,t0_days=0')
        np.testing.assert_allclose(change, 0.001 * profile, rtol=0.01)
    # On the flat end what acts on the input is hardly seen.
    change = np.abs(at_rest('exponent'))
    assert change[u > 2000.0].max() < 0.15 * change[u < 1200.0].min()


def test_shares_and_bumps_of_the_curve_have_their_places_and_add_up():
    u, _, _ = rest_points()
    lost = at_rest('curve_step:t0_days=0')
    np.testing.assert_allclose(lost, -2.5 * np.clip((u - 1450.0) / 300.0, 0.0, 1.0), atol=1e-6)
    bump = np.where(np.abs(u - 1500.0) < 200.0, 1.0 + np.cos(np.pi * (u - 1500.0) / 200.0), 0.0)
    found = at_rest('curve_shape:h_mw=2,u0=1500,width_u=200')
    np.testing.assert_allclose(found, bump, atol=0.005)
    both = at_rest('curve_shape:h_mw=2,u0=1500,width_u=200', 'curve_step:t0_days=0')
    np.testing.assert_allclose(both, found + lost, atol=1e-9)


def test_temperature_and_exponent_follow_what_is_measured():
    none, log = (run(*e, unit='prompt') for e in ([], ['temperature:k=-0.001']))
    relative = log.true_power_mw / none.true_power_mw - 1.0
    measured = log.table.column(Signal.MAIN_STEAM_TEMPERATURE)
    # The sensor's noise flattens the line a little.
    slope, middle = np.polyfit(measured - 539.0, relative, 1)
    assert slope == pytest.approx(-0.001, rel=0.05)
    assert middle == pytest.approx(0.0, abs=1e-4)
    factor = np.log(run('exponent:dm=-0.1', unit='prompt').true_u / none.true_u)
    pressure = none.table.column(Signal.MAIN_STEAM_PRESSURE)
    assert np.polyfit(np.log(pressure / 13.0), factor, 1)[0] == pytest.approx(-0.1, rel=0.01)


def test_only_a_nozzle_that_is_not_choked_knows_the_pressure_behind():
    none = run(unit='open')
    np.testing.assert_array_equal(run('choked:kappa=0.01', unit='open').true_u, none.true_u)
    with pytest.raises(InputError, match=r'kappa must be 0\.05\d* at most for this unit'):
        run('choked:kappa=0.06')


def test_the_day_wave_peaks_at_its_hour():
    start_h, effect = 9, [EffectSpec.parse('diurnal:a=0.01,peak_h=7')]
    none, log = (
        simulate(1.0, 4, UNITS['prompt'], DEFAULT_START_NS + start_h * 3600 * NS_PER_S, e)
        for e in ((), effect)
    )
    clock_h = start_h + np.arange(len(log)) / 3600.0
    expected = 0.01 * np.cos(2.0 * np.pi * (clock_h - 7.0) / 24.0)
    relative = log.true_power_mw / none.true_power_mw - 1.0
    np.testing.assert_allclose(relative, expected, atol=2e-5)


def test_intervals_have_two_levels():
    none, log = (run(*e, unit='prompt', days=0.5) for e in ([], [f'intervals:g=-0.02,{OFTEN}']))
    relative = log.true_power_mw / none.true_power_mw - 1.0
    inside = np.zeros(len(log), dtype=bool)
    windows = intervals_s(log.active[0].values, 43_200.0)
    assert len(windows) > 2
    for start, end in windows:
        assert 3600.0 <= end - start <= 7200.0
        inside[int(np.ceil(start)) : int(np.ceil(end))] = True
    settled = np.append(True, inside[1:] == inside[:-1])
    np.testing.assert_allclose(relative[settled], np.where(inside, -0.02, 0.0)[settled], atol=1e-9)


# On actuator, storage and clock.


@pytest.mark.parametrize('name', ['reheater', 'region_lag', 'rate_limit', 'clock'])
def test_dynamics_are_nothing_at_rest(name):
    np.testing.assert_allclose(at_rest(name), 0.0, atol=1e-6)
    change = rest(name).true_power_mw - rest().true_power_mw
    assert np.abs(change).max() > 0.5
    if name == 'reheater':
        assert np.all(change <= 1e-9), 'the test only opens the valve: late is less'


@pytest.mark.parametrize('level', [200.0, 240.0, 270.0])
def test_region_lag_takes_the_place_of_all_regions_above(level):
    first, second = UnitDescription().regions
    below = (first,) if level <= first.power_to_mw else (first, second)
    below = (*below[:-1], dataclasses.replace(below[-1], power_to_mw=level))
    built = UnitDescription(regions=(*below, Region(np.inf, 30.0, 3.0)))
    same(run(f'region_lag:level_mw={level}'), simulate(DAYS, 1, built))


@pytest.mark.parametrize('seconds', [12.0, -12.0, 2.5])
def test_the_clock_moves_the_power_only(seconds):
    none, log = run(), run(f'clock:d_s={seconds}')
    np.testing.assert_array_equal(log.true_u, none.true_u)
    row = np.arange(20, len(log) - 20)
    for truth in ('true_power_mw', 'noise_mw'):
        at = np.interp(row + seconds, np.arange(len(none)), getattr(none, truth))
        np.testing.assert_allclose(getattr(log, truth)[row], at, atol=1e-9)


@pytest.mark.parametrize('name', ['stiction', 'rate_limit', 'saturation'])
def test_where_the_sensor_stands(name):
    behind, before = (run(f'{name}:before_sensor={side}') for side in (0, 1))
    # The plant is the same; only what the sensor sees differs.
    np.testing.assert_array_equal(behind.plug_percent, before.plug_percent)
    for log, hidden in ((behind, True), (before, False)):
        opening = log.table.column(Signal.VALVE_OPENING)
        at_command = np.std(opening - log.table.column(Signal.VALVE_COMMAND))
        at_plug = np.std(opening - log.plug_percent)
        assert (at_command < 0.025 < at_plug) == hidden
        assert (at_plug < 0.025 < at_command) != hidden


# On the record.


@pytest.mark.parametrize('topic', ['valve_opening', 'generated_power'])
def test_a_flat_line_holds_its_first_value(topic):
    log = run(f'flatline:signal={topic},t0_days=0.1,minutes=30')
    expected = run().table.values.copy()
    column = next(info.signal for info in SIGNALS if info.topic == topic)
    expected[8640 : 8640 + 1800, column] = expected[8640, column]
    np.testing.assert_array_equal(log.table.values, expected)


def test_a_coarse_record_knows_multiples_only():
    clean, coarse = (
        log.table.column(Signal.GENERATED_POWER) for log in (run(), run('quantisation:step=5'))
    )
    np.testing.assert_allclose(coarse, 5.0 * np.round(clean / 5.0), atol=1e-9)
    # Coarse enough to be told from a clean record by its repeated values.
    assert np.mean(np.diff(coarse) == 0.0) > 0.5 > 0.1 > np.mean(np.diff(clean) == 0.0)


def test_spikes_are_where_their_pattern_says():
    effect = EffectSpec.parse('spikes:per_day=200,height=30,pattern=2')
    unit = UnitDescription(sample_period_s=2.0)
    none, log = (
        simulate(DAYS, 1, unit, effects=e).table.column(Signal.GENERATED_POWER)
        for e in ((), [effect])
    )
    expected = np.zeros(len(log))
    for second, sign in spikes_s(effect.values, DAYS * 86_400.0):
        expected[int(second / 2.0)] += 30.0 * sign
    assert {-30.0, 30.0} <= set(expected)
    np.testing.assert_allclose(log - none, expected, atol=1e-9)
