# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow import``: units that fit alike, times without a name, pressures that cannot be."""

from __future__ import annotations

import shlex

import numpy as np
import pandas as pd
import pytest
from logged import values

import valveflow_ros as vf
from valveflow_ros.errors import InputError, UsageError
from valveflow_ros.logs import open_log
from valveflow_ros.records import Signal

ROWS = np.arange(60)


@pytest.fixture
def frame():
    """A unit's log with times in its index."""
    return pd.DataFrame(
        {'valve_opening_percent': 60 + 0.1 * ROWS, 'main_steam_pressure_mpa': 15 + 0.01 * ROWS,
         'main_steam_temperature_degc': 538 + 0.01 * ROWS, 'generated_power_mw': 200.0 + ROWS},
        index=pd.date_range('2026-01-05', periods=len(ROWS), freq='60s'),
    )  # fmt: skip


@pytest.mark.parametrize(
    ('column', 'topic', 'middle', 'units'),
    [
        ('main_steam_temperature_degc', 'main_steam_temperature', 812, ['K', 'degF']),
        ('main_steam_temperature_degc', 'main_steam_temperature', 1000, ['degF']),
        ('main_steam_pressure_mpa', 'main_steam_pressure', 2400, ['psi', 'kPa']),
        ('main_steam_pressure_mpa', 'main_steam_pressure', 5000, ['kPa', 'psi']),
        ('main_steam_pressure_mpa', 'main_steam_pressure', 16500, ['kPa']),
        ('generated_power_mw', 'generated_power', 250_000, ['kW']),
    ],
)
def test_every_unit_that_fits_is_proposed(run, tmp_path, frame, column, topic, middle, units):
    theirs = topic.replace('_', ' ')
    bare = frame.assign(**{column: middle + 0.01 * ROWS}).rename(columns={column: theirs})
    bare.to_csv(tmp_path / 'a.csv', index_label='time')
    ran = run('import', tmp_path / 'a.csv', '-o', tmp_path / 'x.mcap')
    said = ran.refused()
    assert f'They look like {" or ".join(units)}.' in said
    options = [f"--column '{topic}={theirs}:{unit}'" for unit in units]
    assert f'add {" or ".join(options)}' in said
    assert ('with the first of each choice' in said) == (len(units) > 1)
    again = shlex.split(said.splitlines()[-1])[1:]
    assert run(*again).status == 0


def test_a_temperature_that_fits_its_own_unit_is_not_doubted(run, tmp_path, frame):
    frame.to_csv(tmp_path / 'a.csv', index_label='time')
    assert 'look like' not in run('import', tmp_path / 'a.csv', '--dry-run').err


@pytest.mark.parametrize('kind', ['csv', 'parquet'])
def test_an_index_without_a_name_is_the_time(run, tmp_path, frame, kind):
    path = tmp_path / f'a.{kind}'
    frame.to_csv(path) if kind == 'csv' else frame.to_parquet(path)
    ran = run('import', path, '-o', tmp_path / 'x.mcap')
    assert ran.status == 0, ran.err
    assert open_log(tmp_path / 'x.mcap').start_ns == frame.index[0].value


def test_an_index_without_a_name_that_counts_is_no_time(run, tmp_path, frame):
    frame.reset_index(drop=True).to_csv(tmp_path / 'a.csv')
    sentence = run('import', tmp_path / 'a.csv', '--dry-run').refused()
    assert 'no column was recognised as time' in sentence


@pytest.mark.parametrize('said', ['60s', '1min', '60', '1 min', '60000ms'])
def test_a_table_without_times_has_a_period(run, tmp_path, frame, said):
    path, log = tmp_path / 'a.csv', tmp_path / 'x.mcap'
    frame.to_csv(path, index=False)
    ran = run('import', path, '-o', log, '--period', said)
    assert ran.status == 0, ran.err
    assert 'The table has no times; its rows were taken to be 60 s apart' in ran.out + ran.err
    pressure = frame['main_steam_pressure_mpa'].to_numpy()
    assert np.array_equal(values(log, Signal.MAIN_STEAM_PRESSURE), pressure)
    assert vf.open_log(path, period=said).span_s == 60.0 * (len(ROWS) - 1)


def test_blocks_of_a_table_without_times_follow_each_other(tmp_path, frame):
    many = pd.concat([frame] * 4000, ignore_index=True)
    many.to_parquet(tmp_path / 'a.parquet', row_group_size=100_000)
    log = vf.open_log(tmp_path / 'a.parquet', period='1s')
    assert log.span_s == len(many) - 1


@pytest.mark.parametrize('said', ['soon', '0', '-5s', 'nan', '2d', '1e9', ''])
def test_a_period_that_is_none_is_refused(run, tmp_path, frame, said):
    frame.to_csv(tmp_path / 'a.csv', index=False)
    ran = run('import', tmp_path / 'a.csv', '--dry-run', f'--period={said}')
    assert ran.status == (1 if not said else 2)
    if said:
        with pytest.raises(UsageError, match='--period must be'):
            vf.open_log(tmp_path / 'a.csv', period=said)


@pytest.mark.parametrize(
    ('pressure', 'words'),
    [
        (-1.0 * ROWS, 'name the right column'),
        (0.0 * ROWS, 'name the right column'),
        (1e5 + ROWS, 'name the right column'),
        (1.6e7 + ROWS, 'main_steam_pressure_mpa:Pa'),
        (1e9 + ROWS, 'name the right column'),
        (160.0 + ROWS, 'main_steam_pressure_mpa:bar'),
    ],
)
def test_a_log_without_a_possible_pressure_is_refused(run, tmp_path, frame, pressure, words):
    path = tmp_path / 'a.csv'
    frame.assign(main_steam_pressure_mpa=pressure).to_csv(path, index_label='time')
    said = run('import', path, '-o', tmp_path / 'x.mcap').refused()
    assert 'is taken for main_steam_pressure: its values run' in said
    assert words in said
    with pytest.raises(InputError, match='impossible'):
        vf.open_log(path)
    assert not (tmp_path / 'x.mcap').exists()


@pytest.mark.parametrize(('unit', 'scale', 'zero'), [('degF', 1.8, 32.0), ('K', 1.0, 273.15)])
def test_a_temperature_in_another_unit_is_refused(run, tmp_path, frame, unit, scale, zero):
    path = tmp_path / 'a.csv'
    theirs = scale * frame['main_steam_temperature_degc'] + zero
    theirs.iloc[:2] = 60.0
    frame.assign(main_steam_temperature_degc=theirs).to_csv(path, index_label='time')
    said = run('import', path, '-o', tmp_path / 'x.mcap').refused()
    assert f'main_steam_temperature=main_steam_temperature_degc:{unit}' in said
    assert run(*shlex.split(said.splitlines()[-1])[1:]).status == 0


def test_a_log_with_some_possible_pressures_is_read_with_a_warning(run, tmp_path, frame):
    some = np.where(ROWS < 30, 0.0, 15.0)
    frame.assign(main_steam_pressure_mpa=some).to_csv(tmp_path / 'a.csv', index_label='time')
    ran = run('import', tmp_path / 'a.csv', '--dry-run')
    assert ran.status == 0
    assert 'impossible' in ran.err


@pytest.mark.parametrize('said', [[], ['--column', 'main_steam_pressure=Pressure [kPa]']])
def test_the_pressure_of_a_condenser_is_not_advised_as_megapascal(run, tmp_path, write_csv, said):
    table = write_csv(
        'time,Valve position [%],Pressure [kPa],Main steam temperature [degC],Power [MW]',
        [f'{1700000000 + 60 * k},{50 + k % 7},{4 + 0.1 * (k % 9)},540,{200 + k % 5}'
         for k in range(60)],
    )  # fmt: skip
    refused = run('import', table, '-o', tmp_path / 'x.mcap', *said).refused()
    assert (
        'That is the pressure of a condenser, not of main steam, unless kPa is wrong and they are '
        'in MPa. Name the right column with --column main_steam_pressure=THEIRS[:unit]' in refused
    )
    assert 'look like MPa' not in refused
    assert refused.endswith('--column main_steam_pressure=THEIRS')
