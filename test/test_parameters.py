# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from streams import examples

from valveflow_ros.errors import InputError, ParameterError, ValveflowError
from valveflow_ros.parameters import PARAMETERS, TABLE, Settings, as_yaml, parameter

NUMBERS = [row for row in TABLE if row.low is not None]


def refusal(values):
    """Return the sentence with which the values are refused."""
    with pytest.raises(ParameterError) as caught:
        Settings(values)
    assert isinstance(caught.value, InputError)
    assert isinstance(caught.value, ValveflowError)
    return str(caught.value)


def read_back(text):
    return yaml.safe_load(text)['/**']['ros__parameters']


WRONG = {
    float: [math.nan, math.inf, -math.inf, True, False, '3', None, [1.0], np.nan, 1j],
    bool: [0, 1, 'true', None, math.nan, []],
    str: [0, True, None, math.nan, b'x', 'a\x00b', 'a\nb', 'a\rb', 'a\x1b[2J', 'x' * 501, 'a\x85b',
          '\ud800'],
}  # fmt: skip
WRONG[int] = [*WRONG[float], 0.5]


def test_a_row_takes_its_default_and_refuses_what_is_of_another_kind_by_name():
    for row in TABLE:
        got = row.check(row.default)
        assert (got, type(got)) == (row.default, type(row.default))
        for wrong in WRONG[type(row.default)]:
            assert f"'{row.name}'" in refusal({row.name: wrong}), wrong
        if type(row.default) is int:
            assert 'whole number' in refusal({row.name: row.low + 0.5})
            assert type(row.check(float(row.default))) is int
        for choice in row.choices:
            assert choice in refusal({row.name: 'nonsense'})
            assert Settings({row.name: choice}).text(row.name) == choice


def test_a_number_is_taken_from_end_to_end_of_its_range_and_no_further():
    for row in NUMBERS:
        assert (row.check(row.low), row.check(row.high)) == (row.low, row.high)
        assert type(row.check(row.high)) is type(row.default)
        step = 1 if isinstance(row.default, int) else max(abs(row.high), 1.0) * 1e-9
        for wrong in (row.low - step, row.high + step):
            sentence = refusal({row.name: wrong})
            for part in (row.name, f'{row.low:g}', f'{row.high:g}'):
                assert part in sentence


def test_an_unknown_name_is_refused_and_the_nearest_one_suggested():
    assert "did you mean 'sample_period'" in refusal({'smaple_period': 1.0})
    # A file can have any key: ``5: 3`` is good YAML.
    for name in ('qqqq', '', 5, None, 2.5, True, ('a',)):
        sentence = refusal({name: 1.0})
        assert ('does not exist' in sentence, 'did you mean' in sentence) == (True, False)


def test_a_choice_in_another_case_or_with_a_slip_is_suggested():
    for name, wrong, right in (
        ('main_steam_pressure_unit', 'Bar', 'bar'), ('main_steam_pressure_unit', 'mpa', 'MPa'),
        ('main_steam_pressure_unit', 'PSIG', 'psig'), ('main_steam_pressure_unit', 'hPa', ''),
        ('main_steam_pressure_unit', 'bara', 'bar'), ('main_steam_temperature_unit', 'C', ''),
        ('input_reliability', 'best-effort', 'best_effort'), ('axis', 'Opening', 'opening'),
    ):  # fmt: skip
        sentence = refusal({name: wrong})
        end = f"not '{wrong}'; did you mean '{right}'?" if right else f"not '{wrong}'."
        assert sentence.endswith(end)


def test_a_topic_is_no_parameter():
    for name in ('valve_opening', 'plant_sample'):
        sentence = refusal({name: '/plc/x'})
        assert f"'{name}' does not exist: it is a topic; remap it with -r {name}:=" in sentence
        assert 'did you mean' not in sentence


def test_a_zone_that_is_none_is_refused_and_one_suggested():
    assert 'Europe/Berlin' in refusal({'time_zone': 'Nowhere'})
    assert Settings({'time_zone': 'UTC'}).zone is Settings().zone is None


AT_ODDS = (
    ({'valve_opening_low': 50.0, 'valve_opening_high': 50.0}, 'valve_opening_low'),
    ({'generated_power_low': 10.0, 'generated_power_high': 5.0}, 'generated_power_low'),
    ({'main_steam_pressure_low': 30.0, 'main_steam_pressure_high': 10.0},
     'main_steam_pressure_low'),
    ({'main_steam_temperature_low': 700.0, 'main_steam_temperature_high': 600.0},
     'main_steam_temperature_low'),
    ({'sample_period': 20.0}, 'hold_limit'),
    ({'sample_period': 20.0, 'hold_limit': 60.0}, 'block'),
    ({'sample_period': 400.0, 'hold_limit': 600.0, 'block': 400.0,
      'longest_segment': 9000.0}, 'alarm_block'),
    ({'sample_period': 400.0, 'hold_limit': 600.0, 'block': 400.0, 'alarm_block': 400.0,
      'longest_segment': 9000.0}, 'alarm_average'),
    ({'block': 1000.0}, 'longest_segment'),
    ({'slope_limit': 2.5}, 'slope_limit'),
    ({'steady_min': 3600.0}, 'steady_min'),
    ({'slope_min': 1800.1}, 'slope_min'),
    ({'longest_segment': 3600.0, 'window_days': 1.0 / 24.0}, 'window_days'),
)  # fmt: skip


def test_values_at_odds_are_refused_by_the_name_of_one_of_them():
    for values, name in AT_ODDS:
        assert f"'{name}'" in refusal(values)
    # All that a longer step needs at once.
    assert refusal({'sample_period': 60.0}) == (
        "Parameter 'hold_limit' (10 s) and block (10 s) must not be below sample_period (60 s)."
    )
    Settings({'sample_period': 60.0, 'hold_limit': 150.0, 'block': 60.0})


def value_of(row):
    """Draw a value in range, as a file could have it."""
    if isinstance(row.default, bool):
        return st.booleans()
    if isinstance(row.default, str):
        return st.sampled_from(row.choices) if row.choices else st.text(max_size=30)
    if isinstance(row.default, int):
        return st.integers(int(row.low), int(row.high))
    ends = [row.low, row.high, max(row.low, min(1e-5, row.high))]
    return st.floats(row.low, row.high) | st.sampled_from(ends)


@examples(60)
@given(st.data())
def test_whatever_passes_stands_in_the_yaml_file_and_is_read_back_unchanged(data):
    rows = data.draw(st.lists(st.sampled_from(TABLE), max_size=12, unique_by=lambda r: r.name))
    try:
        settings = Settings({row.name: data.draw(value_of(row)) for row in rows})
    except ParameterError as error:
        assert str(error).startswith("Parameter '")
        return
    back = read_back(as_yaml(values=settings))
    assert back == dict(settings)
    assert {k: type(v) for k, v in back.items()} == {k: type(v) for k, v in settings.items()}
    assert Settings(back) == settings


def test_the_file_of_defaults_says_unit_range_and_choices_of_everything():
    text = as_yaml()
    assert read_back(text) == {row.name: row.default for row in TABLE}
    lines = text.splitlines()
    for row in TABLE:
        at = next(k for k, line in enumerate(lines) if line.startswith(f'    {row.name}:'))
        about = lines[at - 1]
        assert row.sentence in about
        assert row.low is None or f'{row.low:g} to {row.high:g}' in about
        assert all(choice in about for choice in row.choices)
        assert ('while running' in about) == row.live


def test_settings_are_complete_and_do_not_change():
    settings = Settings({'delay': 12})
    assert list(settings) == [row.name for row in TABLE] == list(PARAMETERS)
    assert all(row.name.isidentifier() and row.sentence.endswith('.') for row in TABLE)
    assert len(settings) == len(TABLE)
    assert type(settings['delay']) is type(Settings({'delay': np.float64(3.0)})['delay']) is float
    assert parameter('delay') is PARAMETERS['delay']
    other = settings.changed({'delay': 20.0, 'autostart': False})
    with pytest.raises(ParameterError):
        settings.changed({'delay': 13.0, 'break_limit': math.nan})
    assert (settings.real('delay'), other.real('delay')) == (12.0, 20.0)
    assert (settings.flag('autostart'), other.flag('autostart')) == (True, False)
    with pytest.raises(TypeError):
        settings['delay'] = 3.0
    with pytest.raises(AttributeError):
        settings.something = 3.0
