# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Mapping options, parameters, and the settings that follow from the data; plausible values."""

import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from valveflow_ros.errors import InputError, RecordingError, UsageError
from valveflow_ros.interface.mapping import read_mapping
from valveflow_ros.interface.plausibility import doubt
from valveflow_ros.interface.settings import (
    fitting,
    read_parameters,
    sample_period,
    settings_for,
)
from valveflow_ros.parameters import PARAMETERS, Settings, as_yaml
from valveflow_ros.records import SIGNALS, Signal
from valveflow_ros.signals.units import UNITS, convert


def test_a_signal_goes_by_its_topic_and_by_its_column():
    for info in SIGNALS:
        for name, unit in itertools.product((info.topic, info.column), UNITS[info.signal]):
            column = read_mapping([f'{name}=TAG:{unit}'], []).columns[info.topic]
            assert (column.theirs, column.unit) == ('TAG', unit)


def test_spellings_of_a_column():
    columns = read_mapping(
        ['valve_opening=A B', 'generated_power=X:Y:mw', 'time=When:ever', 'date=Day'], []
    ).columns
    assert columns['valve_opening'].theirs == 'A B'
    assert (columns['generated_power'].theirs, columns['generated_power'].unit) == ('X:Y', 'MW')
    assert columns['time'].theirs == 'When:ever'
    assert columns['date'].unit == ''


@given(st.floats(-1e3, 1e3), st.sampled_from(SIGNALS), st.data())
def test_a_constant_is_converted(value, info, data):
    unit = data.draw(st.sampled_from(sorted(UNITS[info.signal])))
    found = read_mapping([], [f'{info.topic}={value!r}:{unit}']).constants[info.topic]
    assert found == float(convert(info.signal, unit, value))


def test_wrong_mappings_are_refused():
    for columns, constants, said in (
        (['=X'], [], 'NAME='),
        (['valve_opening='], [], 'NAME='),
        (['valve_openin=X'], [], "did you mean 'valve_opening'"),
        (['foo=X'], [], 'use one of valve_opening'),
        (['valve_opening=X', 'valve_opening_percent=Y'], [], 'twice'),
        ([], ['main_steam_pressure=1', 'main_steam_pressure=2'], 'twice'),
        (['main_steam_pressure=P'], ['main_steam_pressure=2'], 'leave one out'),
        ([], ['main_steam_pressure=high'], "'high' is no number"),
        ([], ['main_steam_pressure=nan'], 'finite'),
        ([], ['main_steam_pressure=1:degC'], 'use one of MPa'),
        ([], ['time=1'], 'there is no signal of that name'),
    ):
        with pytest.raises(UsageError) as refused:
            read_mapping(columns, constants)
        assert said in str(refused.value)


def test_wrong_parameters_are_refused(tmp_path):
    file = tmp_path / 'p.yaml'
    with pytest.raises(RecordingError, match=r'p\.yaml.*no such file'):
        read_parameters(file, ['delay=1'])
    for pair, said in (
        ('time_constant', 'NAME=VALUE'), ('=5', 'NAME=VALUE'),
        ('time_constnt=5', "did you mean 'time_constant'"),
        ('time_constant=fast', 'must be a number'), ('time_constant=nan', 'must be from'),
        ('max_pieces=2.5', 'whole number'), ('refine=perhaps', 'true or false'),
        ('main_steam_pressure_unit=stone', 'must be one of'),
    ):  # fmt: skip
        file.write_text('')
        with pytest.raises(UsageError, match=said):
            read_parameters(file, [pair])
    for text, said in (
        ('a: [1', 'no YAML'), ('- 1\n- 2\n', 'names and values'),
        ('/**:\n  ros__parameters:\n    time_constnt: 1.0\n', 'did you mean'),
    ):  # fmt: skip
        file.write_text(text)
        with pytest.raises(InputError, match=said) as refused:
            read_parameters(file, ['delay=1'])
        assert 'p.yaml' in str(refused.value)


def test_set_stands_above_the_file_which_may_hold_plain_names(tmp_path):
    file = tmp_path / 'p.yaml'
    file.write_text(as_yaml(values={**Settings(), 'time_constant': 33.0, 'unit_tag': 'B2'}))
    found = read_parameters(
        file, ['time_constant=44', 'record=no', 'max_pieces=7', 'pressure_exponent=1.125']
    )
    assert found == {**Settings(), 'unit_tag': 'B2', 'time_constant': 44.0, 'record': False,
                     'max_pieces': 7}  # fmt: skip
    file.write_text('time_constant: 33\n')
    assert read_parameters(file, []) == {'time_constant': 33.0}


def test_a_file_with_every_default_does_not_ask_to_check_the_exponent():
    file = Path(__file__).parents[2] / 'config' / 'monitor.yaml'
    listed = read_parameters(file, [])
    assert 'time_constant' in listed
    assert 'pressure_exponent' not in listed
    assert read_parameters(file, ['pressure_exponent=1.125'])['pressure_exponent'] == 1.125


STEPS = st.dictionaries(st.sampled_from(Signal), st.floats(1e-3, 1e5), max_size=5)


@given(STEPS, st.floats(0.0, 1e9))
def test_what_follows_from_the_data_is_always_valid(steps, span_s):
    settings, said = settings_for(steps, span_s, {})
    assert settings.real('hold_limit') >= settings.real('sample_period')
    assert all(sentence.endswith('.') for sentence in said)
    for name, value in fitting(steps, span_s, {}).items():
        assert PARAMETERS[name].check(value) == value
        assert value != PARAMETERS[name].default


@given(STEPS, st.floats(0.0, 6e4), st.floats(0.01, 3600.0))
def test_any_step_a_person_sets_is_met_with_fitting_parameters(steps, span_s, period):
    settings, _ = settings_for(steps, span_s, {'sample_period': period})
    assert settings.real('sample_period') == period
    assert 86400.0 * settings.real('window_days') >= span_s


@given(STEPS, st.floats(0.0, 1e9), st.sampled_from(['hold_limit', 'block', 'sample_period']))
def test_what_a_person_sets_is_not_adapted(steps, span_s, name):
    assert name not in fitting(steps, span_s, {name: 50.0})


@given(st.floats(1e-3, 3600.0))
def test_slow_data_decide_the_step_and_quick_ones_keep_the_default(step):
    found = sample_period({Signal.VALVE_OPENING: step, Signal.GENERATED_POWER: 2.0 * step})
    assert math.isclose(found, max(step, 1.0), rel_tol=0.0527)


def test_minute_data_as_the_documentation_says():
    adapted = fitting({Signal.VALVE_OPENING: 60.0}, 7 * 86400.0, {})
    told = {'sample_period': 60.0, 'hold_limit': 150.0, 'block': 60.0, 'lateness': 60.0}
    assert {name: adapted[name] for name in told} == told
    assert not {'longest_segment', 'window_days'} & set(adapted)
    assert fitting({}, 30 * 86400.0, {})['window_days'] >= 30.0
    # A finished log is fitted once whatever the file says.
    settings, _ = settings_for({}, 1e5, {'refit_period': 600.0, 'refit_segments': 5})
    assert settings['refit_period'] == settings['refit_segments'] == 0
    _, said = settings_for({Signal.VALVE_OPENING: 60.0}, 1e5, {'sample_period': 1.0})
    assert any('held in between' in sentence for sentence in said)


USUAL = {
    Signal.VALVE_OPENING: (31.0, 94.0),
    Signal.MAIN_STEAM_PRESSURE: (8.0, 17.1),
    Signal.MAIN_STEAM_TEMPERATURE: (525.0, 545.0),
    Signal.GENERATED_POWER: (140.0, 310.0),
    Signal.VALVE_COMMAND: (0.5, 99.0),
}


def written_in(signal, unit):
    """Usual values of a signal as a log in ``unit`` would hold them."""
    low, high = USUAL[signal]
    values = np.linspace(low, high, 1000)
    return (values - UNITS[signal][unit].offset) / UNITS[signal][unit].scale


@pytest.mark.parametrize('signal', Signal)
def test_values_in_another_unit_are_recognised_and_in_their_own_raise_no_doubt(signal):
    for unit, (taken, factor) in itertools.product(UNITS[signal], UNITS[signal].items()):
        written = written_in(signal, unit)
        assert doubt(signal, np.array([np.nan, np.inf]), unit, Settings()) is None
        found = doubt(signal, written, taken, Settings())
        if factor == UNITS[signal][unit]:
            assert found is None, unit
        # 812 K read as degF is 433 degC, which a small unit may have.
        elif (unit, taken) != ('K', 'degF'):
            assert found is not None, (unit, taken)
            assert UNITS[signal][found.looks_like] == UNITS[signal][unit]
            assert found.looks_like in found.sentence


def test_impossible_values_without_a_better_unit():
    found = doubt(Signal.GENERATED_POWER, np.array([200.0] * 9 + [-5000.0]), 'MW', Settings())
    assert found.looks_like == ''
    assert '10 % of them are impossible' in found.sentence
