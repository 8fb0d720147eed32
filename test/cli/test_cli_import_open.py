# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a table leaves open is said all together, and the last line is the command that works."""

import json
import shlex

import numpy as np
import pandas as pd
import pytest
from logged import values
from streams import flow_valve

import valveflow_ros as vf
from valveflow_ros.cli.command import TableOption
from valveflow_ros.cli.main import parser_of
from valveflow_ros.errors import InputError, UsageError
from valveflow_ros.logs import open_log
from valveflow_ros.records import Signal
from valveflow_ros.signals.units import convert

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
    by_identify = run('identify', table, '-o', tmp_path / 'result').refused()
    said = run('import', table, '-o', log).refused()
    for refusal in (by_identify, said):
        assert ': 5 things are open' in refusal
        for option in ('--date-order dmy', "'valve_opening=Valve position:fraction'",
                       "'main_steam_pressure=Steam press:bar'",
                       "'main_steam_temperature=Steam temp:K'",
                       "'generated_power=Gross MW:kW'"):  # fmt: skip
            assert refusal.count(option) == 2, option
    assert not log.exists()
    ran = run(*last_command(said)).done()
    assert 'Warning' not in ran.err
    assert np.allclose(values(log, Signal.MAIN_STEAM_PRESSURE), 13.0 + np.arange(N) / 100)


def test_what_was_said_before_stands_in_the_command_too(run, table):
    said = run(
        'import', table, '--dry-run', '--date-order', 'mdy', '--time-zone', '+02:00',
        '--column', 'main_steam_pressure_mpa=Steam press', '--constant', 'valve_opening=50',
        '--quiet', '--covariate', 'v=Gross MW',
    ).refused()  # fmt: skip
    words = last_command(said)
    assert words.count('--column') == 3
    assert 'main_steam_pressure=Steam press:bar' in words
    assert 'main_steam_pressure_mpa=Steam press' not in words
    for pair in (['--date-order', 'mdy'], ['--time-zone', '+02:00'],
                 ['--constant', 'valve_opening=50']):  # fmt: skip
        assert words[words.index(pair[0]) + 1] == pair[1]
    assert {'--dry-run', '--quiet', 'v=Gross MW'} < set(words)
    assert run(*words).status == 0


def test_a_valve_with_opening_and_flow_only_gets_a_command_that_works(run, tmp_path):
    path = tmp_path / 'loop.csv'
    rows = [f'2026-01-01T{k // 60:02}:{k % 60:02}:00,{40 + k % 7},{90 + k % 9}' for k in range(N)]
    path.write_text('\n'.join(['time,FV101.OP (%),FT101 (t/h)', *rows]) + '\n')
    said = run('import', path, '--dry-run').refused()
    ran = run(*last_command(said)).done()
    assert '1.000 MPa' in ran.out
    assert '540.0 degC' in ran.out


def test_beside_a_power_no_constant_pressure_is_proposed(run, tmp_path):
    path = tmp_path / 'unit.csv'
    head = 'time,Valve position (%),Fresh steam,Steam temp (degC),Gross power (MW),Feedwater (t/h)'
    rows = [f'2026-01-01T{k // 60:02}:{k % 60:02}:00,60,130,538,250,800' for k in range(N)]
    path.write_text('\n'.join([head, *rows]) + '\n')
    last = run('import', path, '--dry-run').refused().splitlines()[-1]
    assert '--column main_steam_pressure=THEIRS' in last


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


def test_the_other_verbs_name_all_options_in_one_line(run, table, tmp_path):
    order = ('--date-order', 'dmy')
    last = run('info', table, *order).refused().splitlines()[-1]
    assert last.startswith('Add --column ')
    assert run('info', table, *order, *shlex.split(last)[1:]).status == 0


# All but the pressure, which is another one in each case.
SAID = (
    '--date-order', 'dmy', '--column', 'main_steam_temperature=Steam temp:K',
    '--column', 'generated_power=Gross MW:kW',
    '--column', 'valve_opening=Valve position:fraction', '--column',
)  # fmt: skip


@pytest.mark.parametrize(
    ('header', 'spelt', 'unit'),
    [('P1', 'psi(g)', 'psig'),
     # What the person says stands above the header.
     ('P1 [bar]', 'barg', 'barg'), ('P1 [barg]', 'bar', 'bar')],
)  # fmt: skip
def test_a_gauge_pressure_can_be_said(run, table, tmp_path, header, spelt, unit):
    table.write_text(table.read_text().replace('Steam press', header))
    engine = convert(Signal.MAIN_STEAM_PRESSURE, unit, np.array([130.0]))[0]
    pressure = f'main_steam_pressure={header}:{spelt}'
    ran = run('import', table, '-o', tmp_path / 'x.mcap', *SAID, pressure).done()
    told = f"'{header}' is a gauge pressure ({unit}); "
    assert (told in ran.out) == ('the standard atmosphere, are added' in ran.out)
    assert (told in ran.out) == (unit != 'bar')
    assert values(tmp_path / 'x.mcap', Signal.MAIN_STEAM_PRESSURE)[0] == engine
    if unit in ('bar', 'barg'):  # a monitor is told so too
        ran = run('config', 'init', table, *SAID, pressure)
        assert f"main_steam_pressure_unit: '{unit}'" in ran.out


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


@pytest.mark.parametrize('kind', ['csv', 'parquet'])
def test_an_index_without_a_name_is_the_time(run, tmp_path, frame, kind):
    path = tmp_path / f'a.{kind}'
    frame.to_csv(path) if kind == 'csv' else frame.to_parquet(path)
    run('import', path, '-o', tmp_path / 'x.mcap').done()
    assert open_log(tmp_path / 'x.mcap').start_ns == frame.index[0].value


def test_a_temperature_that_fits_is_not_doubted_and_a_count_is_no_time(run, tmp_path, frame):
    frame.to_csv(tmp_path / 'a.csv', index_label='time')
    assert 'look like' not in run('import', tmp_path / 'a.csv', '--dry-run').err
    frame.reset_index(drop=True).to_csv(tmp_path / 'a.csv')
    sentence = run('import', tmp_path / 'a.csv', '--dry-run').refused()
    assert 'no column was recognised as time' in sentence


@pytest.mark.parametrize(
    ('times', 'said'), [(None, '60'), ('12:01', '1 min'), (range(len(ROWS)), '60000ms')]
)
def test_a_table_without_usable_times_has_a_period(run, tmp_path, frame, times, said):
    path, log = tmp_path / 'a.csv', tmp_path / 'x.mcap'
    table = frame if times is None else frame.assign(time=times)
    table.to_csv(path, index=False)
    if not isinstance(times, range):  # row numbers may be seconds
        assert run('import', path, '-o', log).refused().endswith('--period 60s')
    ran = run('import', path, '-o', log, '--period', said).done()
    assert ('rows were taken to be 60 s apart' in ran.out + ran.err) or times is not None
    pressure = frame['main_steam_pressure_mpa'].to_numpy()
    assert np.array_equal(values(log, Signal.MAIN_STEAM_PRESSURE), pressure)
    assert vf.open_log(log).span_s == 60.0 * (len(ROWS) - 1)
    assert vf.open_log(path, period=said).span_s == 60.0 * (len(ROWS) - 1)


def test_a_period_that_is_none_is_refused(run, tmp_path, frame):
    frame.to_csv(tmp_path / 'a.csv', index=False)
    for said in ('soon', '0', '-5s', 'nan', '2d', '1e9', ''):
        ran = run('import', tmp_path / 'a.csv', '--dry-run', f'--period={said}')
        assert ran.status == (1 if not said else 2), said
        if said:
            with pytest.raises(UsageError, match='--period must be'):
                vf.open_log(tmp_path / 'a.csv', period=said)


@pytest.mark.parametrize(
    ('pressure', 'words'),
    [
        (-1.0 * ROWS, 'name the right column'),
        (1.6e7 + ROWS, 'main_steam_pressure_mpa:Pa'),
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


def test_what_import_understood_of_a_flow_stays_in_its_recording(run, tmp_path):
    columns, _, _ = flow_valve(8.0, 5.0, 20.0)
    table, log = tmp_path / 'x.csv', tmp_path / 'x.mcap'
    rows = np.column_stack(list(columns.values()))[:2000]
    np.savetxt(
        table, rows, delimiter=',', header='time,LV,DP,FT [kg/s],TE', comments='', fmt='%.6f'
    )
    ran = run(
        'import', table, '-o', log, '--column', 'valve_opening=LV', '--column',
        'main_steam_pressure=DP:mbard', '--column', 'generated_power=FT', '--constant',
        'main_steam_temperature=20',
    ).done()  # fmt: skip
    assert 'kg/s' in ran.out
    assert 'MW' not in ran.out + ran.err
    read = vf.open_log(log)
    assert read.output_unit == 'kg/s'
    given, told = read.parameters({})
    assert given['pressure_exponent'] == 0.5
    assert given['generated_power_unit'] == 'kg/s'
    assert 'pressure difference' in told[0]
    assert json.loads(read.contents.attachments['import.json'])['signals'][1]['unit'] == 'MPad'


@pytest.mark.parametrize(
    ('last', 'proposed'),
    [('TE_MS', '--column main_steam_temperature=TE_MS'),
     ('Remark', '--constant main_steam_temperature=540')],
)  # fmt: skip
def test_a_last_column_is_proposed_as_temperature_if_its_tag_is_that_of_a_thermometer(
    run, write_csv, last, proposed
):
    rows = [f'{1700000000 + k},50,13,200,{540 + 0.01 * (k % 7)}' for k in range(20)]
    path = write_csv(f'time,valve_opening,main_steam_pressure,generated_power,{last}', rows)
    assert proposed in run('import', path, '--dry-run').refused().splitlines()[-1]
