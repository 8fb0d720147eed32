"""``valveflow import``: what historians export, and what is wrong with it."""

from __future__ import annotations

import json

import numpy as np
import pytest
from logged import values

from valveflow_ros.logs import open_log
from valveflow_ros.records import SIGNALS, Signal

HEADER = 'Zeit,Spare,CV,PS,TS,MW'
OPTIONS = [
    '--column', 'time=Zeit', '--column', 'valve_opening=CV:fraction',
    '--column', 'main_steam_pressure=PS:bar', '--column', 'main_steam_temperature=TS:K',
    '--column', 'generated_power=MW:kW',
]  # fmt: skip


def rows(number=50, step_s=60):
    def row(k):
        values = (1700000000 + k * step_s, 'x', 0.5 + 0.001 * k, 130 + 0.1 * k, 812 + 0.1 * k)
        return ','.join(map(str, (*values, 200000 + k)))

    return [row(k) for k in range(number)]


@pytest.fixture
def history(write_csv):
    return write_csv(HEADER, rows())


def test_columns_are_converted_and_told(run, tmp_path, history):
    log = tmp_path / 'x.mcap'
    ran = run('import', history, '-o', log, *OPTIONS)
    assert ran.status == 0, ran.err
    k = np.arange(50)
    assert np.allclose(values(log, Signal.VALVE_OPENING), 50.0 + 0.1 * k)
    assert np.allclose(values(log, Signal.MAIN_STEAM_PRESSURE), 13.0 + 0.01 * k)
    assert np.allclose(values(log, Signal.MAIN_STEAM_TEMPERATURE), 538.85 + 0.1 * k)
    assert np.allclose(values(log, Signal.GENERATED_POWER), 200.0 + 0.001 * k)
    assert not len(values(log, Signal.VALVE_COMMAND))
    assert 'Not used: Spare.\n' in ran.out
    for word in ('50 rows', '1 min', 'CV', 'from bar', '13.00 to 13.49', '2023-11-14 22:13:20'):
        assert word in ran.out
    data = run('import', history, '-o', tmp_path / 'y.mcap', *OPTIONS, '--json').json
    told = json.loads(open_log(log).attachments['import.json'])
    assert {**data, 'log': '', 'source': 'history.csv'} == {**told, 'log': ''}
    assert (data['rows'], data['period_s'], data['ignored']) == (50, 60.0, ['Spare'])
    assert data['gaps'] == data['duplicates'] == 0
    assert [s['topic'] for s in data['signals']] == [i.topic for i in SIGNALS if i.required]
    assert told['signals'][0]['written_unit'] == 'fraction'


def test_constants_stand_in_every_row(run, tmp_path, history):
    log = tmp_path / 'x.mcap'
    words = [*OPTIONS[:4], *OPTIONS[8:], '--constant', 'main_steam_pressure=120:bar',
             '--constant', 'main_steam_temperature_degc=540']  # fmt: skip
    ran = run('import', history, '-o', log, *words)
    assert ran.status == 0, ran.err
    assert values(log, Signal.MAIN_STEAM_PRESSURE).tolist() == pytest.approx([12.0] * 50)
    assert values(log, Signal.MAIN_STEAM_TEMPERATURE).tolist() == [540.0] * 50
    assert 'constant' in ran.out


def test_gaps_and_repeated_times_are_counted(run, tmp_path, write_csv):
    lines = rows(20)
    history = write_csv(HEADER, [*lines[:8], lines[7], *lines[12:]])
    ran = run('import', history, '-o', tmp_path / 'x.mcap', *OPTIONS)
    assert '1 row had a time that stood there before' in ran.out
    assert '1 gap, the longest 5 min from' in ran.out


def test_missing_values_are_counted(run, tmp_path, write_csv):
    lines = rows(20)
    lines[3] = lines[3].rsplit(',', 1)[0] + ',Bad Input'
    lines[4] = lines[4].rsplit(',', 1)[0] + ','
    history = write_csv(HEADER, lines)
    ran = run('import', history, '-o', tmp_path / 'x.mcap', *OPTIONS)
    assert '2 values missing' in ran.out
    assert 'Bad Input' in ran.err


@pytest.mark.parametrize(
    ('column', 'option'),
    [
        ('valve_opening=CV', 'valve_opening=CV:fraction'),
        ('main_steam_pressure=PS', 'main_steam_pressure=PS:bar'),
        ('main_steam_temperature=TS', 'main_steam_temperature=TS:K'),
        ('generated_power=MW', 'generated_power=MW:kW'),
    ],
)
def test_a_wrong_unit_is_said_aloud_with_the_option_that_helps(
    run, tmp_path, history, column, option
):
    name = column.partition('=')[0]
    words = [w if not w.startswith(f'{name}=') else column for w in OPTIONS]
    ran = run('import', history, '-o', tmp_path / 'x.mcap', *words)
    assert ran.status == 0
    assert f'add --column {option}\n' in ran.err
    assert 'Warning: ' in ran.err
    right = run('import', history, '-o', tmp_path / 'y.mcap', *OPTIONS)
    assert 'Warning' not in right.err


def test_a_column_whose_name_holds_a_colon(run, tmp_path, write_csv):
    history = write_csv(HEADER.replace('CV', 'U3:CV'), rows())
    words = [w.replace('=CV:fraction', '=U3:CV:fraction') for w in OPTIONS]
    assert run('import', history, '-o', tmp_path / 'x.mcap', *words).status == 0
    words = [w.replace('=CV:fraction', '=U3:CV') for w in OPTIONS]
    ran = run('import', history, '-o', tmp_path / 'y.mcap', *words)
    assert ran.status == 0
    assert 'add --column valve_opening=U3:CV:fraction' in ran.err


@pytest.mark.parametrize(
    ('words', 'part'),
    [
        ([], "no column 'main_steam_temperature_degc'"),
        (['--column', 'time=Clock', *OPTIONS[2:]], "no column 'Clock'"),
        ([*OPTIONS[:2], '--column', 'valve_opening=VALVE'], "no column 'VALVE'"),
        (['--column', 'time=Spare', *OPTIONS[2:]], 'holds no time'),
    ],
)
def test_missing_columns_are_named(run, tmp_path, history, words, part):
    sentence = run('import', history, '-o', tmp_path / 'x.mcap', *words).refused()
    assert part in sentence
    assert '--column' in sentence
    assert not (tmp_path / 'x.mcap').exists()


@pytest.mark.parametrize(
    ('name', 'content', 'part'),
    [
        ('none.csv', None, 'no such file'),
        ('empty.csv', '', 'empty'),
        ('empty.parquet', '', 'empty'),
        ('head.csv', HEADER + '\n', 'without rows'),
        ('picture.csv', '\x00\x01\x02\x03', ''),
        ('table.xlsx', 'PK', 'table.xlsx'),
        ('table.ods', 'PK', 'no .csv, .xlsx or .parquet'),
        ('text.parquet', 'no parquet at all', ''),
    ],
)
def test_files_that_are_no_tables(run, tmp_path, name, content, part):
    if content is not None:
        (tmp_path / name).write_text(content)
    sentence = run('import', tmp_path / name, '-o', tmp_path / 'x.mcap', *OPTIONS).refused()
    assert part in sentence
    assert name in sentence


def test_an_impossible_constant_is_refused_with_the_units(run, tmp_path, history):
    words = [*OPTIONS[:4], *OPTIONS[6:], '--constant', 'main_steam_pressure=130']
    sentence = run('import', history, '-o', tmp_path / 'x.mcap', *words).refused(2)
    assert '130 MPa is impossible' in sentence
    assert 'bar' in sentence


def test_a_column_of_words_only_is_refused(run, tmp_path, write_csv):
    lines = [f'{1700000000 + k},a,b,c,d,e' for k in range(5)]
    history = write_csv(HEADER, lines)
    sentence = run('import', history, '-o', tmp_path / 'x.mcap', *OPTIONS).refused()
    assert 'no number' in sentence


def test_the_output_is_checked_before_the_work(run, tmp_path, history):
    log = tmp_path / 'h2.csv'
    log.write_text(history.read_text())
    sentence = run('import', log, '-o', log, *OPTIONS).refused()
    assert 'is the log that is read' in sentence
    assert log.read_text() == history.read_text()


def test_columns_that_are_not_used_are_named_for_parquet_and_semicolons_too(run, tmp_path):
    import pandas as pd

    names = [i.column for i in SIGNALS if i.required]
    frame = pd.DataFrame({'time': 1700000000 + np.arange(5), 'A;B': 1.0, 'Note': 'x'})
    for name, value in zip(names, (50.0, 12.0, 540.0, 200.0), strict=True):
        frame[name] = value
    frame.to_parquet(tmp_path / 'h.parquet')
    frame.drop(columns='A;B').to_csv(tmp_path / 'h.csv', sep=';', decimal=',', index=False)
    ran = run('import', tmp_path / 'h.parquet', '-o', tmp_path / 'a.mcap', '--json')
    assert ran.json['ignored'] == ['A;B', 'Note']
    ran = run('import', tmp_path / 'h.csv', '-o', tmp_path / 'b.mcap', '--json')
    assert ran.json['ignored'] == ['Note']
    assert ran.json['signals'][1]['high'] == 12.0


def test_a_column_that_gives_way_to_a_constant_is_not_used(run, tmp_path, write_csv):
    header = 'time,' + ','.join(i.column for i in SIGNALS if i.required)
    table = write_csv(header, [f'{1700000000 + k},50,12,540,200' for k in range(5)])
    log = tmp_path / 'x.mcap'
    ran = run('import', table, '-o', log, '--constant', 'main_steam_pressure=9')
    assert 'the constant is used instead' in ran.err
    assert 'Not used: main_steam_pressure_mpa.' in ran.out
    assert values(log, Signal.MAIN_STEAM_PRESSURE).tolist() == [9.0] * 5
