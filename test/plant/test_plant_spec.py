# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a person may write after --effect, and what is said when it makes no sense."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from valveflow_ros.errors import InputError
from valveflow_ros.plant import effects
from valveflow_ros.plant.effect import Effect
from valveflow_ros.plant.effects import catalogue
from valveflow_ros.plant.simulator import simulate
from valveflow_ros.plant.spec import EffectSpec, describe

NAMES = {
    'temperature', 'exponent', 'choked', 'gain_drift', 'input_drift', 'output_offset_drift',
    'gain_step', 'input_step', 'curve_step', 'intervals', 'diurnal', 'backlash', 'stiction',
    'rate_limit', 'saturation', 'region_lag', 'reheater', 'clock', 'curve_shape', 'flatline',
    'quantisation', 'spikes',
}  # fmt: skip


def test_the_catalogue_has_the_contract_names() -> None:
    assert set(catalogue()) == NAMES


@pytest.mark.parametrize('name', sorted(NAMES))
def test_every_effect_explains_itself(name: str) -> None:
    effect = catalogue()[name]
    assert len(effect.install.__doc__.split()) > 15
    text = describe(effect)
    for row in effect.parameters:
        assert f'{row.name}={row.default}' in text
        assert row.sentence.endswith('.')
        assert row.check(row.default) == row.default
    assert EffectSpec.parse(name).parameters == {r.name: r.default for r in effect.parameters}


def test_parse_reads_names_and_values() -> None:
    spec = EffectSpec.parse('gain_step:g=-0.01,t0_days=5')
    assert spec.name == 'gain_step'
    assert spec.parameters == {'g': -0.01, 't0_days': 5.0}
    assert EffectSpec.parse('  gain_step : g = -0.01 , t0_days = 5 ') == spec
    assert EffectSpec.of('gain_step', g=-0.01, t0_days=5) == spec
    assert EffectSpec.parse('flatline:signal=main_steam_pressure').parameters['signal'] == (
        'main_steam_pressure'
    )


@st.composite
def specs(draw: st.DrawFn) -> EffectSpec:
    """Draw an effect with any allowed values."""
    effect = catalogue()[draw(st.sampled_from(sorted(NAMES)))]
    given_values: dict = {}
    for row in effect.parameters:
        if row.choices:
            given_values[row.name] = draw(st.sampled_from(row.choices))
        elif isinstance(row.default, int):
            given_values[row.name] = draw(st.integers(int(row.low), int(row.high)))
        else:
            given_values[row.name] = draw(st.floats(row.low, row.high))
    for low, high in (
        ('j_percent', 's_percent'),
        ('on_low_h', 'on_high_h'),
        ('off_low_h', 'off_high_h'),
    ):
        if low in given_values:
            pair = sorted((given_values[low], given_values[high]))
            given_values[low], given_values[high] = pair
    if effect.name == 'curve_step':
        given_values['u_from'], given_values['u_to'] = 10.0, 20.0
    return EffectSpec.of(effect, **given_values)


@given(specs())
def test_its_text_is_read_back_as_itself(spec: EffectSpec) -> None:
    assert EffectSpec.parse(str(spec)) == spec


@pytest.mark.parametrize(
    ('text', 'sentence'),
    [
        ('gain_stp', r"Effect 'gain_stp' is unknown: use one of backlash, .*'gain_step'\?$"),
        ('', r"Effect '' is unknown: use one of backlash, "),
        (':g=1', r"Effect '' is unknown"),
        ('gain_step:h=1', r"'gain_step' has no parameter 'h': it has g, t0_days \(d\)\.$"),
        ('gain_step:g=a', r"'gain_step': g must be a number, not 'a'\.$"),
        ('gain_step:g=0.3', r"'gain_step': g must be from -0\.2 to 0\.2, not 0\.3\.$"),
        ('gain_step:g=nan', r"'gain_step': g must be from .* not nan\.$"),
        ('gain_step:g=inf', r'g must be from'),
        ('gain_step:t0_days=-1', r't0_days must be from 0 to 400 d, not -1\.0\.$'),
        ('gain_step:g', r"'gain_step': 'g' is not of the form key=value\.$"),
        ('gain_step:g=', r"'g=' is not of the form key=value"),
        ('gain_step:=1', r"'=1' is not of the form key=value"),
        ('gain_step:g=1,,', r'must be from|not of the form'),
        ('gain_step:g=0.1,g=0.1', r"'gain_step': g is given twice\.$"),
        ('rate_limit:before_sensor=0.5', r"before_sensor must be a whole number, not '0\.5'"),
        ('rate_limit:before_sensor=2', r'before_sensor must be from 0 to 1, not 2'),
        ('flatline:signal=power', r'signal must be one of valve_opening, .* not .power.\.$'),
        ('stiction:s_percent=0.5', r"'stiction': j_percent must not exceed s_percent\.$"),
        ('curve_step:u_from=1800', r"'curve_step': u_from must be less than u_to\.$"),
        ('intervals:on_low_h=30', r'on_low_h must not exceed on_high_h'),
        ('intervals:off_low_h=90', r'off_low_h must not exceed off_high_h'),
    ],
)
def test_nonsense_gets_one_sentence(text: str, sentence: str) -> None:
    with pytest.raises(InputError) as caught:
        EffectSpec.parse(text)
    assert re.search(sentence, str(caught.value)), caught.value
    assert str(caught.value)[-1] in '.?'


@given(st.text(max_size=40))
def test_any_text_is_either_an_effect_or_a_sentence(text: str) -> None:
    for candidate in (text, f'gain_step:{text}', f'gain_step:g={text}'):
        said = ''
        try:
            EffectSpec.parse(candidate)
        except InputError as error:
            said = str(error)
        assert said == '' or said.startswith('Effect ')


@pytest.mark.parametrize(
    'text',
    ['gain_step', 'input_step', 'curve_step', 'flatline', 'intervals', 'spikes:per_day=0.01'],
)
def test_an_effect_that_would_never_act_is_refused(text: str) -> None:
    with pytest.raises(InputError, match=r'would begin after .* lasts 0\.5: simulate longer'):
        simulate(0.5, 1, effects=[EffectSpec.parse(text)])


@pytest.mark.parametrize(
    'name', ['backlash', 'stiction', 'rate_limit', 'saturation', 'region_lag', 'choked', 'clock']
)
def test_what_can_act_once_is_refused_twice(name: str) -> None:
    with pytest.raises(InputError, match=f"'{name}'.* is given twice"):
        simulate(0.1, 1, effects=[EffectSpec.parse(name)] * 2)


def test_both_sides_of_the_sensor_are_two_places() -> None:
    pair = [EffectSpec.of('rate_limit', before_sensor=side) for side in (0, 1)]
    log = simulate(0.1, 1, effects=pair)
    assert log.active == tuple(pair)


def test_the_log_says_what_was_active() -> None:
    log = simulate(0.1, 1, effects=[EffectSpec.parse('diurnal:a=0.01')])
    assert [spec.name for spec in log.active] == ['diurnal']
    assert log.active[0].parameters == {'a': 0.01, 'peak_h': 5.0}
    assert simulate(0.1, 1).active == ()


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


def test_adding_an_effect_is_adding_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / 'own.py').write_text(NEW_FILE)
    monkeypatch.setattr(effects, '__path__', [*effects.__path__, str(tmp_path)])
    catalogue.cache_clear()
    try:
        log = simulate(0.01, 1, effects=[EffectSpec.parse('own:mw=2')])
    finally:
        catalogue.cache_clear()
    assert log.active[0].name == 'own'


def test_an_effect_outside_the_catalogue_can_be_given_as_an_object() -> None:
    def install(values: object, hooks: object) -> None:
        hooks.forcing.append(lambda rows: np.add(rows.offset_mw, 3.0, out=rows.offset_mw))

    effect = Effect('unheard_of', 'Three megawatts more.', (), install)
    from valveflow_ros.plant.unit import Programme, UnitDescription

    unit = UnitDescription(programme=Programme(feedback=False))
    base = simulate(0.05, 1, unit)
    log = simulate(0.05, 1, unit, effects=[EffectSpec.of(effect)])
    np.testing.assert_allclose(log.true_power_mw - base.true_power_mw, 3.0, atol=1e-9)
