"""Every effect does what its physics says, and nothing else."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from valveflow_ros.errors import InputError
from valveflow_ros.plant.effects import catalogue
from valveflow_ros.plant.effects.intervals import intervals_s
from valveflow_ros.plant.recorder import SimulatedLog
from valveflow_ros.plant.simulator import DEFAULT_START_NS, simulate
from valveflow_ros.plant.spec import EffectSpec
from valveflow_ros.plant.step_test import StepPlan, step_test
from valveflow_ros.plant.unit import Programme, Region, UnitDescription
from valveflow_ros.records import NS_PER_S, Signal

# Each effect at an amplitude that is none.
NOTHING = {
    'temperature': 'k=0',
    'exponent': 'dm=0',
    'choked': 'kappa=0',
    'gain_drift': 'g=0',
    'input_drift': 'g=0',
    'output_offset_drift': 'b_mw=0',
    'gain_step': 'g=0,t0_days=0.1',
    'input_step': 'g=0,t0_days=0.1',
    'curve_step': 's_mw=0,t0_days=0.1',
    'intervals': 'g=0,off_low_h=1,off_high_h=2,on_low_h=1,on_high_h=2',
    'diurnal': 'a=0',
    'backlash': 'w_percent=0',
    'stiction': 's_percent=0,j_percent=0',
    'rate_limit': 'r_percent_per_s=1000',
    'saturation': 'max_percent=100',
    'region_lag': 'time_s=80,delay_s=10,level_mw=240',
    'reheater': 'alpha=1',
    'clock': 'd_s=0',
    'curve_shape': 'h_mw=0',
    'flatline': 'minutes=0,t0_days=0.1',
    'quantisation': 'step=0',
    'spikes': 'height=0,per_day=100',
}
# Early and large enough for a short run.
SOMETHING = {
    **dict.fromkeys(NOTHING, ''),
    **dict.fromkeys(('gain_step', 'input_step', 'curve_step', 'flatline'), 't0_days=0.1'),
    'intervals': 'off_low_h=1,off_high_h=2,on_low_h=1,on_high_h=2',
    'spikes': 'per_day=100',
}
FAULTS_OF_THE_RECORD = ('clock', 'flatline', 'quantisation', 'spikes')
TRUTHS = ('true_u', 'true_power_mw', 'noise_mw', 'load_mw', 'plug_percent')
DAYS = 0.25


def spec(name: str, values: str) -> EffectSpec:
    return EffectSpec.parse(f'{name}:{values}')


def differs(one: SimulatedLog, other: SimulatedLog) -> np.ndarray:
    """Return per row whether anything in the table differs."""
    return np.any(one.table.values != other.table.values, axis=1)


@pytest.fixture(scope='module')
def base() -> SimulatedLog:
    return simulate(DAYS, 1)


def test_the_tables_of_this_file_are_complete() -> None:
    assert set(NOTHING) == set(catalogue())


@pytest.mark.parametrize('name', sorted(NOTHING))
def test_an_amplitude_of_nothing_changes_nothing(base: SimulatedLog, name: str) -> None:
    log = simulate(DAYS, 1, effects=[spec(name, NOTHING[name])])
    np.testing.assert_array_equal(log.table.values, base.table.values)
    for truth in TRUTHS:
        np.testing.assert_array_equal(getattr(log, truth), getattr(base, truth))


def test_a_reheater_without_volume_is_none(base: SimulatedLog) -> None:
    log = simulate(DAYS, 1, effects=[spec('reheater', 'time_s=0')])
    np.testing.assert_array_equal(log.true_power_mw, base.true_power_mw)


@pytest.mark.parametrize('name', sorted(SOMETHING))
def test_every_effect_is_seen_in_the_table(base: SimulatedLog, name: str) -> None:
    log = simulate(DAYS, 1, effects=[spec(name, SOMETHING[name])])
    assert differs(log, base).any()
    # Noise, load, pressure and temperature are drawn as without it.
    np.testing.assert_array_equal(log.load_mw, base.load_mw)
    for signal in (Signal.MAIN_STEAM_PRESSURE, Signal.MAIN_STEAM_TEMPERATURE):
        np.testing.assert_array_equal(log.table.column(signal), base.table.column(signal))
    if name != 'clock':
        np.testing.assert_array_equal(log.noise_mw, base.noise_mw)


@pytest.mark.parametrize('name', FAULTS_OF_THE_RECORD)
def test_a_fault_of_the_record_leaves_the_plant_alone(base: SimulatedLog, name: str) -> None:
    log = simulate(DAYS, 1, effects=[spec(name, SOMETHING[name])])
    np.testing.assert_array_equal(log.true_u, base.true_u)
    others = [signal for signal in Signal if signal != Signal.GENERATED_POWER]
    np.testing.assert_array_equal(log.table.values[:, others], base.table.values[:, others])


LINEAR = {
    'temperature': ('k', 1e-3), 'gain_drift': ('g', 0.05), 'output_offset_drift': ('b_mw', 3.0),
    'gain_step': ('g', 0.01), 'intervals': ('g', 0.01), 'diurnal': ('a', 0.01),
    'curve_step': ('s_mw', -2.0), 'curve_shape': ('h_mw', 2.0),
}  # fmt: skip
NEARLY_LINEAR = {
    'exponent': ('dm', 1e-4), 'input_drift': ('g', 1e-3), 'input_step': ('g', 1e-4),
}  # fmt: skip


@pytest.mark.parametrize('name', [*LINEAR, *NEARLY_LINEAR])
def test_twice_the_amplitude_is_twice_the_difference(
    open_loop: UnitDescription, name: str
) -> None:
    key, amplitude = {**LINEAR, **NEARLY_LINEAR}[name]
    rest = SOMETHING[name]
    none, once, twice = (
        simulate(DAYS, 2, open_loop, effects=[spec(name, f'{rest},{key}={a}'.strip(','))])
        for a in (0.0, amplitude, 2.0 * amplitude)
    )
    d1 = once.true_power_mw - none.true_power_mw
    d2 = twice.true_power_mw - none.true_power_mw
    assert np.abs(d1).max() > 1e-4
    if name in LINEAR:
        np.testing.assert_allclose(d2, 2.0 * d1, atol=1e-9)
    else:
        # Where u crosses a knot the slope differs between the two.
        assert np.linalg.norm(d2 - 2.0 * d1) < 0.02 * np.linalg.norm(d2)


@pytest.mark.parametrize('name', ['gain_step', 'input_step', 'curve_step'])
def test_nothing_happens_before_the_onset(base: SimulatedLog, name: str) -> None:
    log = simulate(DAYS, 1, effects=[spec(name, 't0_days=0.1')])
    onset = round(0.1 * 86_400)
    assert not differs(log, base)[:onset].any()
    assert np.mean(log.true_power_mw[onset:] != base.true_power_mw[onset:]) > 0.3


@pytest.mark.parametrize('name', ['gain_drift', 'input_drift', 'output_offset_drift'])
def test_a_drift_starts_from_nothing(open_loop: UnitDescription, name: str) -> None:
    log, none = simulate(1.0, 1, open_loop, effects=[spec(name, '')]), simulate(1.0, 1, open_loop)
    d = np.abs(log.true_power_mw - none.true_power_mw)
    assert d[0] == 0.0
    assert d[-3600:].mean() > 3.0 * d[:7200].mean() > 0.0


# Static effects on a step test without noise: the end of each hold is at rest.
REST = StepPlan(pressure_wander_mpa=0.0, hold_s=1800.0)


def at_rest(unit: UnitDescription, *effects: EffectSpec) -> tuple[np.ndarray, SimulatedLog]:
    """Return the power half a minute before the end of each hold, and the log."""
    log = step_test(1, REST, unit, effects=effects)
    corners_s = REST.corners()[0]
    return log.true_power_mw[np.round(corners_s[1::2]).astype(int) - 31], log


def rest_points(unit: UnitDescription) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return u, x and F' u at the holds."""
    u = REST.corners()[1][1::2] * REST.pressure_mpa**1.125
    piece = np.searchsorted(unit.curve.knots[1:-1], u, side='right')
    return u, unit.curve(u), unit.curve.slopes[piece] * u


@pytest.mark.parametrize('name', ['gain_step', 'input_step'])
def test_gain_and_input_act_in_their_own_load_profile(quiet: UnitDescription, name: str) -> None:
    none, _ = at_rest(quiet)
    power, _ = at_rest(quiet, spec(name, 'g=0.001,t0_days=0'))
    _, x, slope_u = rest_points(quiet)
    expected = 0.001 * (x if name == 'gain_step' else slope_u)
    np.testing.assert_allclose(power - none, expected, rtol=0.01)


def test_input_effects_vanish_on_the_flat_end(quiet: UnitDescription) -> None:
    none, _ = at_rest(quiet)
    u, _, _ = rest_points(quiet)
    change = {
        name: np.abs(at_rest(quiet, spec(name, text))[0] - none)
        for name, text in (
            ('gain_step', 't0_days=0'),
            ('input_step', 't0_days=0'),
            ('exponent', ''),
        )
    }
    flat, steep = u > 2000.0, u < 1200.0
    for name in ('input_step', 'exponent'):
        assert change[name][flat].max() < 0.15 * change[name][steep].min()
    assert change['gain_step'][flat].min() > change['gain_step'][steep].max()


def test_an_offset_is_the_same_at_any_load(open_loop: UnitDescription) -> None:
    none = simulate(DAYS, 3, open_loop)
    log = simulate(DAYS, 3, open_loop, effects=[spec('output_offset_drift', 'b_mw=10')])
    expected = 10.0 * np.arange(len(log)) / 864_000.0
    np.testing.assert_allclose(log.true_power_mw - none.true_power_mw, expected, atol=1e-9)


def test_temperature_follows_the_measured_temperature(prompt: UnitDescription) -> None:
    none = simulate(DAYS, 3, prompt)
    log = simulate(DAYS, 3, prompt, effects=[spec('temperature', 'k=-0.001')])
    relative = log.true_power_mw / none.true_power_mw - 1.0
    measured = log.table.column(Signal.MAIN_STEAM_TEMPERATURE)
    slope, middle = np.polyfit(measured - 539.0, relative, 1)
    # The sensor's noise flattens the line a little.
    assert slope == pytest.approx(-0.001, rel=0.05)
    assert middle == pytest.approx(0.0, abs=1e-4)


def test_the_exponent_acts_on_u_by_the_pressure(open_loop: UnitDescription) -> None:
    none = simulate(DAYS, 3, open_loop)
    log = simulate(DAYS, 3, open_loop, effects=[spec('exponent', 'dm=-0.1')])
    pressure = log.table.column(Signal.MAIN_STEAM_PRESSURE)
    factor = np.log(log.true_u / none.true_u)
    assert np.polyfit(np.log(pressure / 13.0), factor, 1)[0] == pytest.approx(-0.1, rel=0.01)


def test_choked_flow_knows_no_pressure_behind(open_loop: UnitDescription) -> None:
    none = simulate(DAYS, 3, open_loop)
    light = simulate(DAYS, 3, open_loop, effects=[spec('choked', 'kappa=0.01')])
    np.testing.assert_array_equal(light.true_u, none.true_u)
    heavy = simulate(DAYS, 3, open_loop, effects=[spec('choked', '')])
    plan = open_loop.programme
    line = plan.sliding_pressure_mpa(open_loop.curve(none.true_u))
    above = none.table.column(Signal.MAIN_STEAM_PRESSURE) - line
    ratio = heavy.true_u / none.true_u
    # More pressure than usual means less throttling than usual.
    assert np.all(ratio[above > 0.1] > 1.0)
    assert np.all(ratio[above < -0.1] < 1.0)


def test_on_the_sliding_line_choked_shows_nothing(open_loop: UnitDescription) -> None:
    steady = dataclasses.replace(
        open_loop,
        programme=Programme(
            feedback=False, pressure_wander_mpa=0.0, pressure_lag_s=0.01, jitter_percent=0.0,
            pulse_every_s=1e9,
        ),
    )  # fmt: skip
    none = simulate(DAYS, 3, steady)
    log = simulate(DAYS, 3, steady, effects=[spec('choked', '')])
    np.testing.assert_allclose(log.true_u, none.true_u, rtol=1e-9)


def test_a_back_pressure_that_stops_the_flow_is_refused(open_loop: UnitDescription) -> None:
    with pytest.raises(InputError, match=r'kappa must be 0\.05\d* at most for this unit'):
        simulate(0.1, 1, open_loop, effects=[spec('choked', 'kappa=0.06')])


def test_the_day_wave_peaks_at_its_hour(prompt: UnitDescription) -> None:
    for start_h in (0, 9):
        start_ns = DEFAULT_START_NS + start_h * 3600 * NS_PER_S
        none = simulate(1.0, 4, prompt, start_ns)
        log = simulate(1.0, 4, prompt, start_ns, [spec('diurnal', 'a=0.01,peak_h=7')])
        relative = log.true_power_mw / none.true_power_mw - 1.0
        clock_h = start_h + np.arange(len(log)) / 3600.0
        expected = 0.01 * np.cos(2.0 * np.pi * (clock_h - 7.0) / 24.0)
        np.testing.assert_allclose(relative, expected, atol=2e-5)


def test_intervals_have_two_levels(prompt: UnitDescription) -> None:
    effect = spec('intervals', f'g=-0.02,{SOMETHING["intervals"]}')
    none, log = simulate(1.0, 4, prompt), simulate(1.0, 4, prompt, effects=[effect])
    relative = log.true_power_mw / none.true_power_mw - 1.0
    inside = np.zeros(len(log), dtype=bool)
    windows = intervals_s(effect.values, 86_400.0)
    assert len(windows) > 3
    for start, end in windows:
        assert 3600.0 <= end - start <= 7200.0
        inside[int(np.ceil(start)) : int(np.ceil(end))] = True
    settled = np.append(True, inside[1:] == inside[:-1])
    np.testing.assert_allclose(relative[settled], np.where(inside, -0.02, 0.0)[settled], atol=1e-9)


def test_another_pattern_has_other_intervals() -> None:
    windows = [intervals_s(spec('intervals', f'pattern={k}').values, 864_000.0) for k in (1, 2)]
    assert not np.array_equal(*(w[:1] for w in windows))
    assert all(len(w) >= 2 for w in windows)


def test_a_lost_share_is_lost_above_its_opening_only(quiet: UnitDescription) -> None:
    none, _ = at_rest(quiet)
    power, _ = at_rest(quiet, spec('curve_step', 't0_days=0'))
    u, _, _ = rest_points(quiet)
    expected = -2.5 * np.clip((u - 1450.0) / 300.0, 0.0, 1.0)
    np.testing.assert_allclose(power - none, expected, atol=1e-6)


def test_a_bump_has_its_place(quiet: UnitDescription) -> None:
    none, _ = at_rest(quiet)
    power, _ = at_rest(quiet, spec('curve_shape', 'h_mw=2,u0=1500,width_u=200'))
    u, _, _ = rest_points(quiet)
    bump = np.where(np.abs(u - 1500.0) < 200.0, 1.0 + np.cos(np.pi * (u - 1500.0) / 200.0), 0.0)
    np.testing.assert_allclose(power - none, bump, atol=0.005)


def test_curves_add_up(quiet: UnitDescription) -> None:
    one, two = spec('curve_shape', ''), spec('curve_step', 't0_days=0')
    none, _ = at_rest(quiet)
    both, _ = at_rest(quiet, one, two)
    parts = [at_rest(quiet, effect)[0] - none for effect in (one, two)]
    np.testing.assert_allclose(both - none, sum(parts), atol=1e-9)


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


def test_the_power_control_hides_part_of_a_slow_effect() -> None:
    mean = {}
    for feedback in (False, True):
        unit = UnitDescription(
            programme=Programme(feedback=feedback, load_high_mw=280.0, full_load_from_mw=275.0)
        )
        pair = [simulate(1.0, 7, unit, effects=e) for e in ((), [spec('gain_step', 't0_days=0')])]
        mean[feedback] = np.mean(pair[1].true_power_mw - pair[0].true_power_mw)
    assert 0.0 < mean[True] < 0.6 * mean[False]


SEVERAL = ('temperature', 'gain_step', 'backlash', 'diurnal', 'curve_shape', 'spikes')


def test_the_order_of_effects_makes_no_difference() -> None:
    effects = [spec(name, SOMETHING[name]) for name in SEVERAL]
    one, other = (simulate(DAYS, 8, effects=e) for e in (effects, effects[::-1]))
    np.testing.assert_array_equal(one.table.values, other.table.values)
    # Before rounding, too: the last bit of a product knows the order of its factors.
    np.testing.assert_array_equal(one.true_power_mw, other.true_power_mw)
    assert set(one.active) == set(other.active)


def test_effects_compose(prompt: UnitDescription) -> None:
    names = ('temperature', 'diurnal', 'gain_drift', 'gain_step')
    effects = [spec(name, SOMETHING[name]) for name in names]
    none, all_ = simulate(DAYS, 8, prompt), simulate(DAYS, 8, prompt, effects=effects)
    product = np.ones(len(none))
    for effect in effects:
        one = simulate(DAYS, 8, prompt, effects=[effect])
        product *= one.true_power_mw / none.true_power_mw
    np.testing.assert_allclose(all_.true_power_mw / none.true_power_mw, product, rtol=1e-5)


def test_all_effects_run_together() -> None:
    effects = [spec(name, SOMETHING[name]) for name in NOTHING]
    log = simulate(DAYS, 9, effects=effects)
    assert np.isfinite(log.table.values).all()
    assert len(log.active) == len(NOTHING)
