# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Effects on the curve do what their physics says, and nothing else."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from plants_at_rest import DAYS, at_rest, rest_points, spec

from valveflow_ros.errors import InputError
from valveflow_ros.plant.effects.changes import intervals_s
from valveflow_ros.plant.simulator import DEFAULT_START_NS, simulate
from valveflow_ros.plant.unit import Programme, UnitDescription
from valveflow_ros.records import NS_PER_S, Signal

OFTEN = 'off_low_h=1,off_high_h=2,on_low_h=1,on_high_h=2'


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
    effect = spec('intervals', f'g=-0.02,{OFTEN}')
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
