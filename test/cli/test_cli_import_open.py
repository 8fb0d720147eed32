# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a table leaves open is said all together, and the last line is the command that works."""

from __future__ import annotations

import shlex

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from logged import values

from valveflow_ros.cli.command import Console, TableOption
from valveflow_ros.cli.main import Parser, parser_of
from valveflow_ros.cli.verbs import import_table
from valveflow_ros.interface.mapping import LOOKING_ON
from valveflow_ros.logs import open_log
from valveflow_ros.logs.tables.refusal import Remedy
from valveflow_ros.records import Signal
from valveflow_ros.signals.units import AIR_MPA, convert, unit_of

HEAD = 'Date,Valve position,Steam press,Steam temp,Gross MW'
N = 120


@pytest.fixture
def table(tmp_path):
    path = tmp_path / 'an export.csv'
    rows = [
        f'01/02/2026 {k // 60:02}:{k % 60:02}:00,{0.5 + k / 500:.3f},{130 + k / 10:.1f},'
        f'{812 + k / 100:.2f},{200000 + 10 * k}'
        for k in range(N)
    ]
    path.write_text('\n'.join([HEAD, *rows]) + '\n')
    return path


def last_command(text):
    words = shlex.split(text.splitlines()[-1])
    assert words[:2] == ['valveflow', 'import']
    return words[1:]


def test_everything_comes_together_and_the_last_line_works(run, table, tmp_path):
    log = tmp_path / 'x.mcap'
    said = run('import', table, '-o', log).refused()
    assert ': 5 things are open' in said
    for option in ('--date-order dmy', "'valve_opening=Valve position:fraction'",
                   "'main_steam_pressure=Steam press:bar'",
                   "'main_steam_temperature=Steam temp:K'",
                   "'generated_power=Gross MW:kW'"):  # fmt: skip
        assert said.count(option) == 2, option
    assert not log.exists()
    ran = run(*last_command(said))
    assert ran.status == 0, ran.err
    assert 'Warning' not in ran.err
    assert np.allclose(values(log, Signal.MAIN_STEAM_PRESSURE), 13.0 + np.arange(N) / 100)


def test_what_was_said_before_stands_in_the_command_too(run, table):
    said = run(
        'import', table, '--dry-run', '--date-order', 'mdy', '--time-zone', '+02:00',
        '--column', 'main_steam_pressure_mpa=Steam press', '--constant', 'valve_opening=50',
        '--quiet',
    ).refused()  # fmt: skip
    words = last_command(said)
    assert words.count('--column') == 3
    assert 'main_steam_pressure=Steam press:bar' in words
    assert 'main_steam_pressure_mpa=Steam press' not in words
    for pair in (['--date-order', 'mdy'], ['--time-zone', '+02:00'],
                 ['--constant', 'valve_opening=50']):  # fmt: skip
        assert words[words.index(pair[0]) + 1] == pair[1]
    assert {'--dry-run', '--quiet'} < set(words)
    assert run(*words).status == 0


def test_what_only_the_person_knows_is_left_to_be_filled_in(run, table, tmp_path):
    table.write_text(table.read_text().replace('Steam temp', 'X1').replace('Gross MW', 'X2'))
    said = run('import', table, '-o', tmp_path / 'x.mcap').refused()
    assert 'with your names in place of THEIRS' in said
    assert 'recognised as main_steam_temperature or generated_power' in said
    words = last_command(said)
    # The temperature is often not recorded, and taken as constant.
    assert {'main_steam_temperature=540', 'generated_power=THEIRS'} < set(words)
    assert 'main_steam_pressure=Steam press:bar' in words
    filled = [w.replace('THEIRS', 'X2:kW') for w in words]
    assert run(*filled).status == 0


def test_two_columns_and_their_unit_are_one_option(run, table, tmp_path):
    text = table.read_text().splitlines()
    text = [text[0] + ',Net MW', *(f'{line},190000' for line in text[1:])]
    table.write_text('\n'.join(text))
    said = run('import', table, '-o', tmp_path / 'x.mcap').refused()
    assert 'with the first of each choice' in said
    assert sum('generated_power' in word for word in last_command(said)) == 1
    assert run(*last_command(said)).status == 0


def test_a_suggested_command_holds_with_values_that_begin_with_a_dash(
    run, table, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    table.rename(tmp_path / '-x.csv')
    said = run('import', './-x.csv', '-o', './-x.mcap', '--time-zone=-05:00').refused()
    words = last_command(said)
    assert words[:4] == ['import', './-x.csv', '-o', './-x.mcap']
    parsed = parser_of('import').parse_args(words[1:])
    assert (parsed.table.name, parsed.output.name) == ('-x.csv', '-x.mcap')
    assert TableOption('time-zone', '-05:00') in parsed.column
    assert run(*words).status == 0
    readings = open_log(tmp_path / '-x.mcap').readings
    first = np.datetime64('2026-02-01T05:00:00', 'ns').astype(np.int64)
    assert readings.time_ns.min() == first


@pytest.mark.parametrize(('option', 'value'), [
    ('sheet', '-Data'), ('sheet', "- it's"), ('time-zone', '-05:00'), ('date-order', 'dmy'),
    ('column', 'generated_power=-MW:kW'),
])  # fmt: skip
def test_an_option_that_is_suggested_is_read_back(option, value):
    parser = Parser('valveflow import')
    import_table.arguments(parser)
    words = shlex.split(str(Remedy(option, value)))
    (said,) = parser.parse_args(['x.csv', *words]).column
    assert said == (value if option == 'column' else TableOption(option, value))


@pytest.mark.parametrize('verb', ['import', 'info'])
def test_looking_on_shows_that_it_is_at_work(run, table, monkeypatch, verb):
    told = []
    monkeypatch.setattr(Console, '__call__', lambda _, share, what: told.append(what))
    run(verb, table, *(['--dry-run'] if verb == 'import' else [])).refused()
    assert LOOKING_ON in told


def test_the_other_verbs_name_all_options_in_one_line(run, table, tmp_path):
    order = ('--date-order', 'dmy')
    last = run('info', table, *order).refused().splitlines()[-1]
    assert last.startswith('Add --column ')
    assert run('info', table, *order, *shlex.split(last)[1:]).status == 0


@pytest.mark.parametrize(
    ('spelt', 'unit'),
    [('barg', 'barg'), ('BARG', 'barg'), ('bar(g)', 'barg'), ('barü', 'barg'), ('kpag', 'kPag'),
     ('psi(g)', 'psig')],
)  # fmt: skip
def test_a_gauge_pressure_can_be_said(run, table, tmp_path, spelt, unit):
    table.write_text(table.read_text().replace('Steam press', 'P1'))
    engine = convert(Signal.MAIN_STEAM_PRESSURE, unit, np.array([130.0]))[0]
    ran = run(
        'import', table, '-o', tmp_path / 'x.mcap', '--date-order', 'dmy',
        '--column', f'main_steam_pressure=P1:{spelt}',
        '--column', 'main_steam_temperature=Steam temp:K',
        '--column', 'generated_power=Gross MW:kW',
        '--column', 'valve_opening=Valve position:fraction',
    )  # fmt: skip
    assert ran.status == 0, ran.err
    assert f"'P1' is a gauge pressure ({unit}); " in ran.out
    assert 'the standard atmosphere, are added' in ran.out
    assert values(tmp_path / 'x.mcap', Signal.MAIN_STEAM_PRESSURE)[0] == engine


@pytest.mark.parametrize('header', ['barg', 'bar'])
def test_what_the_person_says_stands_above_the_header(run, table, tmp_path, header):
    table.write_text(table.read_text().replace('Steam press', f'P1 [{header}]'))
    for said, more in (('bar', 0.0), ('barg', AIR_MPA)):
        path = tmp_path / f'{said}.mcap'
        ran = run(
            'import', table, '-o', path, '--date-order', 'dmy',
            '--column', f'main_steam_pressure=P1 [{header}]:{said}',
            '--column', 'main_steam_temperature=Steam temp:K',
            '--column', 'generated_power=Gross MW:kW',
            '--column', 'valve_opening=Valve position:fraction',
        )  # fmt: skip
        assert ran.status == 0, ran.err
        assert values(path, Signal.MAIN_STEAM_PRESSURE)[0] == pytest.approx(13.0 + more)


@pytest.mark.parametrize('unit', ['bar', 'barg'])
def test_a_monitor_is_told_whether_its_pressure_is_gauge(run, table, unit):
    ran = run(
        'config', 'init', table, '--date-order', 'dmy',
        '--column', f'main_steam_pressure=Steam press:{unit}',
        '--column', 'main_steam_temperature=Steam temp:K',
        '--column', 'generated_power=Gross MW:kW',
        '--column', 'valve_opening=Valve position:fraction',
    )  # fmt: skip
    assert ran.status == 0, ran.err
    assert f"main_steam_pressure_unit: '{unit}'" in ran.out


@settings(max_examples=50)
@given(st.floats(0.0, 300.0), st.sampled_from(['barg', 'MPag', 'kPag', 'psig']))
def test_gauge_is_absolute_less_the_air(value, unit):
    signal = Signal.MAIN_STEAM_PRESSURE
    gauge = convert(signal, unit, np.array([value]))[0]
    absolute = convert(signal, unit[:-1], np.array([value]))[0]
    assert gauge - absolute == pytest.approx(AIR_MPA)
    assert unit_of(signal, unit[:-1]).offset == 0.0
