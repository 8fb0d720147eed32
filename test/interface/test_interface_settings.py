# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Mapping options, parameters, and the settings that follow from the data."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from valveflow_ros.errors import InputError, RecordingError, UsageError
from valveflow_ros.interface.mapping import read_mapping
from valveflow_ros.interface.settings import (
    fitting,
    read_parameters,
    sample_period,
    settings_for,
)
from valveflow_ros.parameters import PARAMETERS, Settings, as_yaml
from valveflow_ros.records import SIGNALS, Signal
from valveflow_ros.signals.units import UNITS, convert


@pytest.mark.parametrize('info', SIGNALS, ids=lambda i: i.topic)
def test_a_signal_goes_by_its_topic_and_by_its_column(info):
    for name in (info.topic, info.column):
        for unit in UNITS[info.signal]:
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


@pytest.mark.parametrize(
    ('columns', 'constants', 'part'),
    [
        (['valve_opening'], [], 'NAME='),
        (['=X'], [], 'NAME='),
        (['valve_opening='], [], 'NAME='),
        (['valve_openin=X'], [], "did you mean 'valve_opening'"),
        (['foo=X'], [], 'use one of valve_opening'),
        (['valve_opening=X', 'valve_opening_percent=Y'], [], 'twice'),
        ([], ['main_steam_pressure=1', 'main_steam_pressure=2'], 'twice'),
        (['main_steam_pressure=P'], ['main_steam_pressure=2'], 'leave one out'),
        ([], ['main_steam_pressure=high'], "'high' is no number"),
        ([], ['main_steam_pressure=inf'], 'finite'),
        ([], ['main_steam_pressure=nan'], 'finite'),
        ([], ['main_steam_pressure=1:degC'], 'use one of MPa'),
        ([], ['time=1'], 'there is no signal of that name'),
    ],
)
def test_wrong_mappings_are_refused(columns, constants, part):
    with pytest.raises(UsageError) as refused:
        read_mapping(columns, constants)
    assert part in str(refused.value)


@pytest.mark.parametrize(
    ('pair', 'part'),
    [
        ('time_constant', 'NAME=VALUE'),
        ('=5', 'NAME=VALUE'),
        ('time_constnt=5', "did you mean 'time_constant'"),
        ('time_constant=fast', 'must be a number'),
        ('time_constant=nan', 'must be from'),
        ('time_constant=-1', 'must be from'),
        ('max_pieces=2.5', 'whole number'),
        ('refine=perhaps', 'true or false'),
        ('main_steam_pressure_unit=stone', 'must be one of'),
    ],
)
def test_wrong_parameters_are_refused(pair, part):
    with pytest.raises(UsageError) as refused:
        read_parameters(None, [pair])
    assert part in str(refused.value)


def test_set_stands_above_the_file(tmp_path):
    file = tmp_path / 'p.yaml'
    file.write_text(as_yaml(values={**Settings(), 'time_constant': 33.0, 'unit_tag': 'B2'}))
    found = read_parameters(file, ['time_constant=44', 'record=no', 'max_pieces=7'])
    assert found['time_constant'] == 44.0
    assert found['unit_tag'] == 'B2'
    assert found['record'] is False
    assert found['max_pieces'] == 7
    assert Settings(found).real('time_constant') == 44.0


def test_a_file_may_hold_plain_names(tmp_path):
    file = tmp_path / 'p.yaml'
    file.write_text('time_constant: 33\n')
    assert read_parameters(file, []) == {'time_constant': 33.0}
    file.write_text('')
    assert read_parameters(file, []) == {}


@pytest.mark.parametrize(
    ('text', 'part'),
    [
        ('a: [1', 'no YAML'),
        ('- 1\n- 2\n', 'names and values'),
        ('/**:\n  ros__parameters:\n    time_constnt: 1.0\n', 'did you mean'),
        ('time_constant: fast\n', 'must be a number'),
    ],
)
def test_wrong_files_are_refused_with_their_name(tmp_path, text, part):
    file = tmp_path / 'p.yaml'
    file.write_text(text)
    with pytest.raises(InputError) as refused:
        read_parameters(file, [])
    assert part in str(refused.value)
    assert 'p.yaml' in str(refused.value)


def test_an_absent_file_is_refused(tmp_path):
    with pytest.raises(RecordingError, match='no such file'):
        read_parameters(tmp_path / 'none.yaml', [])


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


@given(st.floats(1e-3, 1.05))
def test_quick_data_keep_the_default_step(step):
    assert sample_period({Signal.VALVE_OPENING: step}) == PARAMETERS['sample_period'].default


@given(st.floats(1.06, 3600.0))
def test_slow_data_decide_the_step(step):
    found = sample_period({Signal.VALVE_OPENING: step, Signal.GENERATED_POWER: 2.0 * step})
    assert math.isclose(found, step, rel_tol=0.0527)


def test_minute_data_as_the_documentation_says():
    adapted = fitting({Signal.VALVE_OPENING: 60.0}, 7 * 86400.0, {})
    assert adapted['sample_period'] == 60.0
    assert adapted['hold_limit'] == 150.0
    assert adapted['block'] == 60.0
    assert adapted['lateness'] == 60.0
    assert 'longest_segment' not in adapted
    assert 'window_days' not in adapted
    assert fitting({}, 30 * 86400.0, {})['window_days'] >= 30.0


def test_a_finished_log_is_fitted_once_whatever_the_file_says():
    settings, _ = settings_for({}, 1e5, {'refit_period': 600.0, 'refit_segments': 5})
    assert settings['refit_period'] == settings['refit_segments'] == 0


def test_a_table_finer_than_the_data_is_said_aloud():
    _, said = settings_for({Signal.VALVE_OPENING: 60.0}, 1e5, {'sample_period': 1.0})
    assert any('held in between' in sentence for sentence in said)
