# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What holds for every effect: nothing is nothing, twice is twice, and several compose."""

from __future__ import annotations

import numpy as np
import pytest
from plants_at_rest import DAYS, spec

from valveflow_ros.plant.effects import catalogue
from valveflow_ros.plant.simulator import SimulatedLog, simulate
from valveflow_ros.plant.unit import Programme, UnitDescription
from valveflow_ros.records import Signal

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


def differs(one: SimulatedLog, other: SimulatedLog) -> np.ndarray:
    """Return per row whether anything in the table differs."""
    return np.any(one.table.values != other.table.values, axis=1)


@pytest.fixture(scope='module')
def base() -> SimulatedLog:
    return simulate(DAYS, 1)


def test_the_tables_of_this_file_are_complete() -> None:
    assert set(NOTHING) == set(catalogue())


@pytest.mark.parametrize(('name', 'values'), [*sorted(NOTHING.items()), ('reheater', 'time_s=0')])
def test_an_amplitude_of_nothing_changes_nothing(
    base: SimulatedLog, name: str, values: str
) -> None:
    log = simulate(DAYS, 1, effects=[spec(name, values)])
    np.testing.assert_array_equal(log.table.values, base.table.values)
    for truth in TRUTHS:
        np.testing.assert_array_equal(getattr(log, truth), getattr(base, truth))


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


def test_the_power_control_hides_part_of_a_slow_effect() -> None:
    mean = {}
    for feedback in (False, True):
        unit = UnitDescription(
            programme=Programme(feedback=feedback, load_high_mw=280.0, full_load_from_mw=275.0)
        )
        pair = [simulate(1.0, 7, unit, effects=e) for e in ((), [spec('gain_step', 't0_days=0')])]
        mean[feedback] = np.mean(pair[1].true_power_mw - pair[0].true_power_mw)
    assert 0.0 < mean[True] < 0.6 * mean[False]


def test_the_order_of_effects_makes_no_difference() -> None:
    effects = [spec(name, SOMETHING[name]) for name in NOTHING]
    one, other = (simulate(DAYS, 8, effects=e) for e in (effects, effects[::-1]))
    np.testing.assert_array_equal(one.table.values, other.table.values)
    # Before rounding, too: the last bit of a product knows the order of its factors.
    np.testing.assert_array_equal(one.true_power_mw, other.true_power_mw)
    assert set(one.active) == set(other.active)
    assert np.isfinite(one.table.values).all()


def test_effects_compose(prompt: UnitDescription) -> None:
    names = ('temperature', 'diurnal', 'gain_drift', 'gain_step')
    effects = [spec(name, SOMETHING[name]) for name in names]
    none, all_ = simulate(DAYS, 8, prompt), simulate(DAYS, 8, prompt, effects=effects)
    product = np.ones(len(none))
    for effect in effects:
        one = simulate(DAYS, 8, prompt, effects=[effect])
        product *= one.true_power_mw / none.true_power_mw
    np.testing.assert_allclose(all_.true_power_mw / none.true_power_mw, product, rtol=1e-5)
