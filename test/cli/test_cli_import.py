# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow import``: what historians export, what is seen in it, and what is wrong with it."""

import json

import numpy as np
import pytest
from logged import values

import valveflow_ros as vf
from valveflow_ros.errors import InputError
from valveflow_ros.interface.importing import table_import
from valveflow_ros.interface.logs import read_covariate
from valveflow_ros.logs import open_log
from valveflow_ros.logs.tables import file
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
    ran = run('import', history, '-o', log, *OPTIONS).done()
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


def mapped(signal, theirs):
    """Return the options with another column for one signal."""
    return [w if not w.startswith(f'{signal}=') else f'{signal}={theirs}' for w in OPTIONS]


NOTICED = {
    'a gap and a time that is repeated': (
        HEADER, [*rows(8), rows(8)[7], *rows(20)[12:]], OPTIONS,
        ['1 row had a time that stood there before', '1 gap, the longest 5 min from'],
    ),
    'valve_opening in another unit': (
        HEADER, rows(), mapped('valve_opening', 'CV'),
        ['Warning: ', 'add --column valve_opening=CV:fraction'],
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
        (rows(), ['--column', 'time=Clock', *OPTIONS[2:]], 1, "no column 'Clock'"),
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


def test_the_output_is_checked_before_the_work(run, history):
    before = history.read_bytes()
    assert 'is the log that is read' in run('import', history, '-o', history, *OPTIONS).refused()
    assert history.read_bytes() == before


def test_a_further_column_is_kept_as_a_topic_with_its_unit(run, tmp_path, write_csv):
    def row(k):
        return f'{1700000000 + k},50,13,540,200,{5 + 0.01 * (k % 7)},{k},fixed'

    mine = [row(k) for k in (*range(20, 40), *range(20), 5)]
    table = write_csv(
        'time,valve_opening,main_steam_pressure,main_steam_temperature,generated_power,'
        'Vacuum [kPa],temperature,Spare', mine,
    )  # fmt: skip
    ran = run('import', table, '-o', tmp_path / 'without.mcap').done()
    assert (
        'Of these Vacuum [kPa], temperature hold numbers; if the power may follow one of them, '
        "keep it with --covariate 'vacuum=Vacuum [kPa]'." in ran.out
    )
    log = tmp_path / 'x.mcap'
    ran = run('import', table, '-o', log, '--covariate', 'vacuum=Vacuum', '--json').done()
    assert ran.json['ignored'] == ['temperature', 'Spare']
    (kept,) = ran.json['covariates']
    assert (kept['name'], kept['unit'], kept['low'], kept['high']) == ('vacuum', 'kPa', 5.0, 5.06)
    with pytest.raises(InputError, match='; it has vacuum: --covariate x=vacuum'):
        read_covariate(vf.open_log(log), 'x', 'condenser')
    series = read_covariate(vf.open_log(log), 'vacuum', 'vacuum')
    assert series.unit == 'kPa'
    assert (np.diff(series.time_ns) >= 0).all()
    assert np.allclose(series.at(series.time_ns[0] + np.arange(40) * 10**9)[7:9], [5.0, 5.01])
    assert len(values(log, Signal.GENERATED_POWER)) == 40
    ran = run('import', table, '-o', tmp_path / 'y.mcap', '--covariate', 'vacuum=Vacuum [kPa]')
    assert 'Of these temperature holds numbers' in ran.out
    assert '--covariate further_temperature=temperature.' in ran.out  # a cause has the other name


@pytest.mark.parametrize(
    ('output', 'said', 'told'),
    [
        ('x.mcap', 'vacuum=nothing', "--covariate vacuum: {} has no column or topic 'nothing'"),
        ('x.mcap', 'valve_command=Spare', "'valve_command' is the name of a signal; choose"),
        ('x.mcap', 'gain_drift=Spare', 'is a cause of the catalogue already; choose another'),
        ('x.csv', 'v=Spare', '--covariate needs a recording as output'),
    ],
)
def test_a_further_column_that_cannot_be_kept(run, tmp_path, history, output, said, told):
    ran = run('import', history, '-o', tmp_path / output, *OPTIONS, '--covariate', said)
    assert ran.status != 0
    assert told.format(history) in ran.err


GERMAN = 'Zeitstempel;Ventilstellung;Frischdampfdruck;FD-Temperatur;Bruttoleistung;Drehzahl'
N = 90


def number(value):
    return f'{value:.2f}'.replace('.', ',')


def line_of(k):
    numbers = map(number, (50 + k / 2, 130 + k, 538, 200 + k))
    return ';'.join([f'22.11.2026 14:{k // 60:02}:{k % 60:02}', *numbers, '3000'])


@pytest.fixture
def german(tmp_path):
    path = tmp_path / 'history.csv'
    lines = ['Archiv Block 3', 'von;22.11.2026', '', GERMAN, ';%;bar;°C;MW;1/min',
             *(line_of(k % 50) if k < 50 else line_of(k).replace(number(200 + k), 'I/O Timeout')
               if k == 70 else line_of(k) for k in range(N))]  # fmt: skip
    path.write_bytes('\r\n'.join(lines).encode('cp1252'))
    return path


def test_a_german_export_needs_no_option(run, german, tmp_path):
    log = tmp_path / 'x.mcap'
    ran = run('import', german, '-o', log).done()
    k = np.arange(N)
    assert np.allclose(values(log, Signal.MAIN_STEAM_PRESSURE), 13.0 + 0.1 * k)
    power = values(log, Signal.GENERATED_POWER)
    assert np.isnan(power[70])
    assert np.allclose(np.delete(power, 70), 200.0 + np.delete(k, 70))
    for word in ("'Zeitstempel'", 'the times name no zone', '--time-zone Europe/Berlin',
                 'by its name', 'from bar', "1 'I/O Timeout'", 'Not used: Drehzahl.'):  # fmt: skip
        assert word in ran.out
    told = json.loads(open_log(log).attachments['import.json'])
    assert told['signals'][1]['column'] == 'Frischdampfdruck'
    assert told['signals'][3]['words'] == {'I/O Timeout': 1}
    # A dry run shows the same and writes nothing.
    log.unlink()
    dry = run('import', german, '-o', log, '--dry-run').out.splitlines()
    assert dry[:-1] == ran.out.splitlines()[:-1]
    assert 'Nothing was written' in dry[-1]
    assert not log.exists()
    assert '-o LOG.mcap' in run('import', german).refused(2)
    # Times are told in the zone that is named.
    said = run('import', german, '-o', log, '--time-zone', 'Europe/Berlin').out
    assert ' UTC,' not in said
    assert 'CET' in said or 'CEST' in said
    assert said.rstrip().endswith(
        'add --time-zone Europe/Berlin to identify and diagnose to see local times.'
    )


def test_every_verb_reads_it_the_same(run, german, tmp_path):
    ran = run('info', german, '--json')
    assert ran.json['signals']['main_steam_pressure']['low'] == 13.0
    assert "'Frischdampfdruck' is read as main_steam_pressure (by its name, in bar)" in ran.err
    run('export', german, '-o', tmp_path / 'y.csv')
    assert values(tmp_path / 'y.csv', Signal.VALVE_OPENING).tolist() == [
        50 + k / 2 for k in range(N)
    ]


@pytest.mark.parametrize(
    ('change', 'said', 'option', 'unused'),
    [
        ({b'Drehzahl': b'Nettoleistung', b'1/min': b'MW'},
         "'Bruttoleistung' and 'Nettoleistung' could each be generated_power",
         '--column generated_power=Bruttoleistung', 'Nettoleistung'),
        ({b';%;bar': b';%;'}, "'Frischdampfdruck' reads like main_steam_pressure, but",
         '--column main_steam_pressure=Frischdampfdruck:bar', 'Drehzahl'),
    ],
)  # fmt: skip
def test_what_can_be_read_in_two_ways_is_refused_with_the_option(
    run, german, tmp_path, change, said, option, unused
):
    text = german.read_bytes()
    for old, new in change.items():
        text = text.replace(old, new)
    german.write_bytes(text)
    sentence = run('import', german, '-o', tmp_path / 'x.mcap').refused()
    assert said in sentence
    assert option in sentence
    ran = run('import', german, '-o', tmp_path / 'x.mcap', *option.split()).done()
    assert f'Not used: {unused}.' in ran.out
    assert not list(tmp_path.glob('*.draft*'))


@pytest.mark.parametrize('order', ['as it stands', 'shuffled'])
def test_blocks_and_order_change_nothing(run, german, tmp_path, monkeypatch, order):
    run('import', german, '-o', tmp_path / 'whole.mcap')
    lines = german.read_bytes().split(b'\r\n')
    head, rows = lines[:5], lines[5:]
    if order == 'shuffled':
        rows = [rows[k] for k in np.random.default_rng(3).permutation(N)]
    german.write_bytes(b'\r\n'.join([*head, *rows]))
    monkeypatch.setattr(file, 'BLOCK_ROWS', 7)
    monkeypatch.setattr(table_import, '_ROWS', 11)
    (tmp_path / 'parts').mkdir()
    ran = run('import', german, '-o', tmp_path / 'parts' / 'x.mcap').done()
    assert ('sorted' in ran.err) == (order != 'as it stands')
    one, two = open_log(tmp_path / 'whole.mcap'), open_log(tmp_path / 'parts' / 'x.mcap')
    assert np.array_equal(one.readings.time_ns, two.readings.time_ns)
    assert np.array_equal(one.readings.value, two.readings.value, equal_nan=True)
    assert np.array_equal(one.readings.signal, two.readings.signal)
    assert np.array_equal(one.log_time_ns, two.log_time_ns)


def test_a_row_for_each_value_becomes_a_log(run, tmp_path):
    lines = ['Tag,Timestamp,Value']
    for k in range(30):
        for tag, value, second in (('CV_POS', 50 + k, 0), ('MS_PRESS_MPa', 13, 3), ('MW', 200, 7)):
            lines.append(f'{tag},2026-11-22 14:{k:02}:{second:02},{value}')
    table = tmp_path / 'long.csv'
    table.write_text('\n'.join(lines))
    constant = ('--constant', 'main_steam_temperature=540')
    run('import', table, '-o', tmp_path / 'x.mcap', *constant).done()
    readings = open_log(tmp_path / 'x.mcap').readings
    assert [int((readings.signal == s).sum()) for s in Signal] == [30, 30, 30, 30, 0]
    assert np.isfinite(readings.value).all()
    sentence = run('import', table, '-o', tmp_path / 'x.csv', *constant).refused()
    assert 'write an .mcap file' in sentence
