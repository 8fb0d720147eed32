# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow import``: what historians export, and what is wrong with it."""

from __future__ import annotations

import json

import numpy as np
import pytest
from logged import values

import valveflow_ros as vf
from valveflow_ros.interface.logs import read_covariate
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


def mapped(signal, theirs):
    """Return the options with another column for one signal."""
    return [w if not w.startswith(f'{signal}=') else f'{signal}={theirs}' for w in OPTIONS]


def ending(lines, *cells):
    """Return the lines with other last cells from the fourth on."""
    changed = [line.rsplit(',', 1)[0] + f',{c}' for line, c in zip(lines[3:], cells, strict=False)]
    return [*lines[:3], *changed, *lines[3 + len(cells) :]]


NOTICED = {
    'a gap and a time that is repeated': (
        HEADER, [*rows(8), rows(8)[7], *rows(20)[12:]], OPTIONS,
        ['1 row had a time that stood there before', '1 gap, the longest 5 min from'],
    ),
    'missing values': (
        HEADER, ending(rows(20), 'Bad Input', ''), OPTIONS, ['2 values missing', 'Bad Input'],
    ),
    'valve_opening in another unit': (
        HEADER, rows(), mapped('valve_opening', 'CV'),
        ['Warning: ', 'add --column valve_opening=CV:fraction'],
    ),
    'a name with a colon': (
        HEADER.replace('CV', 'U3:CV'), rows(), mapped('valve_opening', 'U3:CV:fraction'), [],
    ),
    'a name with a colon, and no unit': (
        HEADER.replace('CV', 'U3:CV'), rows(), mapped('valve_opening', 'U3:CV'),
        ['add --column valve_opening=U3:CV:fraction'],
    ),
}  # fmt: skip


@pytest.mark.parametrize(('header', 'lines', 'options', 'words'), NOTICED.values(), ids=NOTICED)
def test_what_is_odd_is_said_with_the_option_that_helps(
    run, tmp_path, write_csv, header, lines, options, words
):
    ran = run('import', write_csv(header, lines), '-o', tmp_path / 'x.mcap', *options)
    assert ran.status == 0
    assert ('Warning' in ran.err) == any('add --' in word for word in words)
    for word in words:
        assert word in ran.out + ran.err


@pytest.mark.parametrize(
    ('lines', 'options', 'status', 'words'),
    [
        (rows(), mapped('main_steam_temperature', 'TS'), 1, 'main_steam_temperature=TS:K'),
        (rows(), mapped('generated_power', 'MW'), 1, 'generated_power=MW:kW'),
        (rows(), [], 1, 'no column was recognised as main_steam_temperature'),
        (rows(), ['--column', 'time=Clock', *OPTIONS[2:]], 1, "no column 'Clock'"),
        (rows(), [*OPTIONS[:2], '--column', 'valve_opening=VALVE'], 1, "no column 'VALVE'"),
        (rows(), ['--column', 'time=Spare', *OPTIONS[2:]], 1, 'holds no time'),
        ([f'{1700000000 + k},a,b,c,d,e' for k in range(5)], OPTIONS, 1, 'no number'),
        (rows(), [*OPTIONS[:4], *OPTIONS[6:], '--constant', 'main_steam_pressure=130'], 2,
         '130 MPa is impossible'),
    ],
)  # fmt: skip
def test_what_cannot_be_imported_is_refused_and_nothing_written(
    run, tmp_path, write_csv, lines, options, status, words
):
    history = write_csv(HEADER, lines)
    sentence = run('import', history, '-o', tmp_path / 'x.mcap', *options).refused(status)
    assert words in sentence
    assert '--column' in sentence or 'number' in words or 'bar' in sentence
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


def test_a_further_column_is_kept_as_a_topic_with_its_unit(run, tmp_path, write_csv):
    def row(k):
        return f'{1700000000 + k},50,13,540,200,{5 + 0.01 * (k % 7)},{k},fixed'

    mine = [row(k) for k in (*range(20, 40), *range(20), 5)]
    table = write_csv(
        'time,valve_opening,main_steam_pressure,main_steam_temperature,generated_power,'
        'Vacuum [kPa],temperature,Spare', mine,
    )  # fmt: skip
    ran = run('import', table, '-o', tmp_path / 'without.mcap')
    assert ran.status == 0, ran.err
    assert (
        'Of these Vacuum [kPa], temperature hold numbers; if the power may follow one of them, '
        "keep it with --covariate 'vacuum=Vacuum [kPa]'." in ran.out
    )
    log = tmp_path / 'x.mcap'
    ran = run('import', table, '-o', log, '--covariate', 'vacuum=Vacuum', '--json')
    assert ran.status == 0, ran.err
    assert ran.json['ignored'] == ['temperature', 'Spare']
    (kept,) = ran.json['covariates']
    assert (kept['name'], kept['unit'], kept['low'], kept['high']) == ('vacuum', 'kPa', 5.0, 5.06)
    series = read_covariate(vf.open_log(log), 'vacuum', 'vacuum')
    assert series.unit == 'kPa'
    assert (np.diff(series.time_ns) >= 0).all()
    assert np.allclose(series.at(series.time_ns[0] + np.arange(40) * 10**9)[7:9], [5.0, 5.01])
    assert len(values(log, Signal.GENERATED_POWER)) == 40
    ran = run('import', table, '-o', tmp_path / 'y.mcap', '--covariate', 'vacuum=Vacuum [kPa]')
    assert 'Of these temperature holds numbers' in ran.out
    assert '--covariate further_temperature=temperature.' in ran.out  # a cause has the other name


@pytest.mark.parametrize(
    ('said', 'told'),
    [
        ('vacuum=nothing', "--covariate vacuum: {table} has no column or topic 'nothing'"),
        ('valve_command=Spare', "'valve_command' is the name of a signal; choose another name"),
        ('gain_drift=Spare', 'is a cause of the catalogue already; choose another name'),
    ],
)
def test_a_further_column_that_cannot_be_kept(run, tmp_path, history, said, told):
    ran = run('import', history, '-o', tmp_path / 'x.mcap', *OPTIONS, '--covariate', said)
    assert ran.status != 0
    assert told.format(table=history) in ran.err


def test_a_table_has_no_place_for_a_further_column(run, tmp_path, history):
    ran = run('import', history, '-o', tmp_path / 'x.csv', *OPTIONS, '--covariate', 'v=Spare')
    assert ran.status == 2
    assert '--covariate needs a recording as output' in ran.err


def test_the_command_after_a_refusal_keeps_the_further_column(run, tmp_path, history):
    ran = run('import', history, '-o', tmp_path / 'x.mcap', *OPTIONS[:-2], '--covariate', 'v=MW')
    assert '--covariate v=MW' in ran.err
