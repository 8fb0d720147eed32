# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow import`` sees what can be seen, shows it, and asks for the rest."""

from __future__ import annotations

import json

import numpy as np
import pytest
from logged import values

from valveflow_ros.interface.importing import table_import
from valveflow_ros.logs import open_log
from valveflow_ros.logs.tables import file
from valveflow_ros.records import Signal

GERMAN = 'Zeitstempel;Ventilstellung;Frischdampfdruck;FD-Temperatur;Bruttoleistung;Drehzahl'
N = 90


def number(value):
    return f'{value:.2f}'.replace('.', ',')


def row(k):
    numbers = map(number, (50 + k / 2, 130 + k, 538, 200 + k))
    return ';'.join([f'22.11.2026 14:{k // 60:02}:{k % 60:02}', *numbers, '3000'])


@pytest.fixture
def german(tmp_path):
    path = tmp_path / 'history.csv'
    lines = ['Archiv Block 3', 'von;22.11.2026', '', GERMAN, ';%;bar;°C;MW;1/min',
             *(row(k % 50) if k < 50 else row(k).replace(number(200 + k), 'I/O Timeout')
               if k == 70 else row(k) for k in range(N))]  # fmt: skip
    path.write_bytes('\r\n'.join(lines).encode('cp1252'))
    return path


def test_a_german_export_needs_no_option(run, german, tmp_path):
    log = tmp_path / 'x.mcap'
    ran = run('import', german, '-o', log)
    assert ran.status == 0, ran.err
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


def test_a_table_in_local_time_is_told_in_local_time(run, german, tmp_path):
    log = tmp_path / 'x.mcap'
    said = run('import', german, '-o', log, '--time-zone', 'Europe/Berlin').out
    assert ' UTC,' not in said
    assert 'CET' in said or 'CEST' in said
    assert said.rstrip().endswith(
        'add --time-zone Europe/Berlin to identify and diagnose to see local times.'
    )


def test_a_dry_run_shows_the_same_and_writes_nothing(run, german, tmp_path):
    wet = run('import', german, '-o', tmp_path / 'x.mcap').out.splitlines()
    dry = run('import', german, '--dry-run').out.splitlines()
    assert dry[:-1] == wet[:-1]
    assert 'Nothing was written' in dry[-1]
    (tmp_path / 'x.mcap').unlink()
    assert run('import', german, '-o', tmp_path / 'x.mcap', '--dry-run').status == 0
    assert not (tmp_path / 'x.mcap').exists()
    assert '-o LOG.mcap' in run('import', german).refused(2)


def test_every_verb_reads_it_the_same(run, german, tmp_path):
    ran = run('info', german, '--json')
    assert ran.json['signals']['main_steam_pressure']['low'] == 13.0
    assert "'Frischdampfdruck' is read as main_steam_pressure (by its name, in bar)" in ran.err
    run('export', german, '-o', tmp_path / 'y.csv')
    assert values(tmp_path / 'y.csv', Signal.VALVE_OPENING).tolist() == [
        50 + k / 2 for k in range(N)
    ]


def test_two_columns_that_could_be_meant_are_refused_with_the_options(run, german, tmp_path):
    text = german.read_bytes().replace(b'Drehzahl', b'Nettoleistung').replace(b'1/min', b'MW')
    german.write_bytes(text)
    sentence = run('import', german, '-o', tmp_path / 'x.mcap').refused()
    assert "'Bruttoleistung' and 'Nettoleistung' could each be generated_power" in sentence
    option = '--column generated_power=Bruttoleistung'
    assert option in sentence
    ran = run('import', german, '-o', tmp_path / 'x.mcap', *option.split())
    assert ran.status == 0, ran.err
    assert 'Not used: Nettoleistung.' in ran.out


def test_a_name_whose_values_speak_against_it_is_refused_with_the_option(run, german, tmp_path):
    german.write_bytes(german.read_bytes().replace(b';%;bar', b';%;'))
    sentence = run('import', german, '-o', tmp_path / 'x.mcap').refused()
    assert "'Frischdampfdruck' reads like main_steam_pressure, but" in sentence
    option = '--column main_steam_pressure=Frischdampfdruck:bar'
    assert option in sentence
    ran = run('import', german, '-o', tmp_path / 'x.mcap', *option.split())
    assert ran.status == 0, ran.err
    assert not list(tmp_path.glob('*.draft*'))


def test_a_gauge_pressure_is_made_absolute_and_said(run, german, tmp_path):
    german.write_bytes(german.read_bytes().replace(b';bar;', b';barg;'))
    ran = run('import', german, '-o', tmp_path / 'x.mcap')
    assert 'gauge pressure (barg); 1.01325 bar of air' in ran.out
    assert values(tmp_path / 'x.mcap', Signal.MAIN_STEAM_PRESSURE)[0] == pytest.approx(13.101325)


@pytest.mark.parametrize('order', ['as it stands', 'newest first', 'shuffled'])
def test_blocks_and_order_change_nothing(run, german, tmp_path, monkeypatch, order):
    run('import', german, '-o', tmp_path / 'whole.mcap')
    lines = german.read_bytes().split(b'\r\n')
    head, rows = lines[:5], lines[5:]
    if order == 'newest first':
        rows = rows[::-1]
    elif order == 'shuffled':
        rows = [rows[k] for k in np.random.default_rng(3).permutation(N)]
    german.write_bytes(b'\r\n'.join([*head, *rows]))
    monkeypatch.setattr(file, 'BLOCK_ROWS', 7)
    monkeypatch.setattr(table_import, '_ROWS', 11)
    (tmp_path / 'parts').mkdir()
    ran = run('import', german, '-o', tmp_path / 'parts' / 'x.mcap')
    assert ran.status == 0, ran.err
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
    ran = run('import', table, '-o', tmp_path / 'x.mcap', *constant)
    assert ran.status == 0, ran.err
    readings = open_log(tmp_path / 'x.mcap').readings
    assert [int((readings.signal == s).sum()) for s in Signal] == [30, 30, 30, 30, 0]
    assert np.isfinite(readings.value).all()
    sentence = run('import', table, '-o', tmp_path / 'x.csv', *constant).refused()
    assert 'write an .mcap file' in sentence
