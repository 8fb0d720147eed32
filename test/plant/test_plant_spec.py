# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Effects from what a person writes after --effect, and units other than the paper's."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from plants import OPEN_LOOP

from valveflow_ros.plant import effects
from valveflow_ros.plant.effect import Effect
from valveflow_ros.plant.effects import catalogue
from valveflow_ros.plant.simulator import simulate
from valveflow_ros.plant.spec import EffectSpec, describe
from valveflow_ros.plant.unit import Curve, Noise, UnitDescription, random_unit

NAMES = {
    'temperature', 'exponent', 'choked', 'gain_drift', 'input_drift', 'output_offset_drift',
    'gain_step', 'input_step', 'curve_step', 'intervals', 'diurnal', 'backlash', 'stiction',
    'rate_limit', 'saturation', 'region_lag', 'reheater', 'clock', 'curve_shape', 'flatline',
    'quantisation', 'spikes',
}  # fmt: skip


def test_the_catalogue_has_the_contract_names_and_every_effect_explains_itself():
    assert set(catalogue()) == NAMES
    for name, effect in catalogue().items():
        assert len(effect.install.__doc__.split()) > 15, name
        text = describe(effect)
        for row in effect.parameters:
            assert f'{row.name}={row.default}' in text
            assert row.sentence.endswith('.')
            assert row.check(row.default) == row.default
        assert EffectSpec.parse(name).parameters == {r.name: r.default for r in effect.parameters}


def test_parse_reads_names_and_values():
    spec = EffectSpec.parse('gain_step:g=-0.01,t0_days=5')
    assert (spec.name, spec.parameters) == ('gain_step', {'g': -0.01, 't0_days': 5.0})
    assert EffectSpec.parse('  gain_step : g = -0.01 , t0_days = 5 ') == spec
    assert EffectSpec.of('gain_step', g=-0.01, t0_days=5) == spec
    flat = EffectSpec.parse('flatline:signal=main_steam_pressure')
    assert flat.parameters['signal'] == 'main_steam_pressure'


@st.composite
def specs(draw):
    """Draw an effect with any allowed values."""
    effect = catalogue()[draw(st.sampled_from(sorted(NAMES)))]
    values = {}
    for row in effect.parameters:
        if row.choices:
            values[row.name] = draw(st.sampled_from(row.choices))
        elif isinstance(row.default, int):
            values[row.name] = draw(st.integers(int(row.low), int(row.high)))
        else:
            values[row.name] = draw(st.floats(row.low, row.high))
    pairs = (('j_percent', 's_percent'), ('on_low_h', 'on_high_h'), ('off_low_h', 'off_high_h'))
    for low, high in pairs:
        if low in values:
            values[low], values[high] = sorted((values[low], values[high]))
    if effect.name == 'curve_step':
        values['u_from'], values['u_to'] = 10.0, 20.0
    return EffectSpec.of(effect, **values)


@given(specs())
def test_its_text_is_read_back_as_itself(spec):
    assert EffectSpec.parse(str(spec)) == spec


def test_both_sides_of_the_sensor_are_two_places_and_the_log_says_what_was_active():
    pair = [EffectSpec.of('rate_limit', before_sensor=side) for side in (0, 1)]
    assert simulate(0.1, 1, effects=pair).active == tuple(pair)


NEW_FILE = """
from valveflow_ros.parameters import Parameter
from valveflow_ros.plant.effect import Effect


def install(values, hooks):
    def change(rows):
        rows.offset_mw[:] += values['mw']

    hooks.forcing.append(change)


EFFECT = Effect(
    'own', 'An effect of our own.',
    (Parameter('mw', 1.0, 'MW', 'Added.', 0.0, 9.0),), install,
)
"""


def test_adding_an_effect_is_adding_a_file(tmp_path, monkeypatch):
    (tmp_path / 'own.py').write_text(NEW_FILE)
    monkeypatch.setattr(effects, '__path__', [*effects.__path__, str(tmp_path)])
    catalogue.cache_clear()
    try:
        log = simulate(0.01, 1, OPEN_LOOP, effects=[EffectSpec.parse('own:mw=2')])
    finally:
        catalogue.cache_clear()
    added = log.true_power_mw - simulate(0.01, 1, OPEN_LOOP).true_power_mw
    np.testing.assert_allclose(added, 2.0, atol=1e-9)
    assert isinstance(log.active[0].effect, Effect)


@pytest.mark.parametrize('number', range(3))
def test_other_units_are_plausible(number):
    unit = random_unit(np.random.default_rng(number))
    curve, plan = unit.curve, unit.programme
    ratio = curve.slopes[1:] / curve.slopes[:-1]
    assert np.all((ratio < 0.7501) | (ratio > 1.3499))
    jumps = np.diff(curve.slopes) * curve.knots[1:-1] + np.diff(curve.intercepts)
    np.testing.assert_allclose(jumps, 0.0, atol=1e-9)
    log = simulate(0.5, number, unit)
    inside = (log.true_u > curve.knots[0]) & (log.true_u < curve.knots[-1])
    assert inside.mean() > 0.99
    assert np.mean(log.table.values[:, 4] >= 100.0) < 0.05
    assert abs(np.mean(log.true_power_mw - log.load_mw)) < 0.03 * plan.load_high_mw
    assert log.table.values[:, 4].min() > 40.0


def test_other_units_differ_in_every_respect():
    units = [random_unit(np.random.default_rng(k)) for k in range(60)]
    assert {len(u.curve.slopes) for u in units} == {2, 3, 4, 5, 6}
    assert {len(u.regions) for u in units} == {1, 2, 3}
    assert {u.sample_period_s for u in units} == {1.0, 2.0}
    assert {u.programme.feedback for u in units} == {False, True}
    assert any(np.any(np.diff(u.curve.slopes) > 0.0) for u in units)


def test_a_curve_through_points_passes_through_them():
    u, x = np.array([1.0, 4.0, 9.0]), np.array([2.0, 8.0, 9.0])
    curve = Curve.through(u, x)
    np.testing.assert_allclose(curve(u), x)
    np.testing.assert_allclose(curve.inverse_table()[0], x)


@pytest.mark.parametrize('field', dataclasses.fields(Noise), ids=lambda field: field.name)
def test_every_part_of_the_noise_is_used(field):
    # A field nobody reads would make two units the same.
    noise = Noise(wander_mw=1.0, load_dependence=0.25)
    changed = dataclasses.replace(noise, **{field.name: 2.0 * getattr(noise, field.name)})
    one, two = (
        simulate(0.02, 20, UnitDescription(noise=n)).table.values for n in (noise, changed)
    )
    assert not np.array_equal(one, two)
