# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow simulate``."""

from __future__ import annotations

import json

import numpy as np
import pytest

from valveflow_ros.logs import open_log, read_table
from valveflow_ros.plant.effects import catalogue
from valveflow_ros.plant.unit import UnitDescription
from valveflow_ros.records import SIGNALS

SHORT = ['--days', '0.02', '--seed', '4']


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp('simulated')


def test_every_kind_of_log_holds_the_same(run, folder):
    names = ['a.csv', 'a.parquet', 'a.mcap', 'bag']
    for name in names:
        ran = run('simulate', '-o', folder / name, *SHORT)
        assert ran.status == 0, ran.err
        assert name in ran.out
    first = open_log(folder / names[0]).readings
    for name in names[1:]:
        readings = open_log(folder / name).readings
        for info in SIGNALS:
            mine, theirs = first.signal == info.signal, readings.signal == info.signal
            assert np.array_equal(first.value[mine], readings.value[theirs]), (name, info.topic)
            assert np.array_equal(first.time_ns[mine], readings.time_ns[theirs])
    assert (folder / 'bag' / 'metadata.yaml').is_file()


def test_the_files_that_were_written_are_named(run, tmp_path):
    log, beside, truth = (tmp_path / n for n in ('a.mcap', 'metadata.yaml', 'truth.json'))
    ran = run('simulate', '-o', log, '--truth', truth, *SHORT)
    assert ran.out.endswith(f'\nWrote {log}, {beside} and {truth}.\n')
    assert set(tmp_path.iterdir()) == {log, beside, truth}
    table = tmp_path / 'a.csv'
    other = tmp_path / 'b.mcap'
    assert f'Wrote {other}.' in run('simulate', '-o', other, *SHORT).out
    # Nothing but the file.
    assert run('simulate', '-o', table, *SHORT, '--quiet').out == f'Wrote {table}.\n'


def test_months_follow_one_another(run, folder):
    """It begins when it is told to, in UTC where no zone is named; nothing else changes."""
    for unit in ('paper', 'choked'):
        times, logs = ['2026-02-01', '2026-03-01T06:00+02:00'], []
        for k, time in enumerate(times):
            name = folder / f'start-{unit}-{k}.csv'
            ran = run('simulate', '-o', name, *SHORT, '--unit', unit, '--start', time)
            assert ran.status == 0, ran.err
            logs.append(read_table(name))
        starts = [np.datetime64(int(log.time_ns[0]), 'ns') for log in logs]
        assert starts == [np.datetime64('2026-02-01'), np.datetime64('2026-03-01T04:00')]
        assert len(logs[0].time_ns) == len(logs[1].time_ns)


@pytest.mark.parametrize(
    ('time', 'sentence'),
    [
        ('soon', "'soon' is no time such as 2026-01-31T06:00Z."),
        ('1969-01-01', 'A simulation must lie between the years 1970 and 2262.'),
        ('9999-01-01', 'A simulation must lie between the years 1970 and 2262.'),
    ],
)
@pytest.mark.parametrize('unit', ['paper', 'choked'])
def test_a_start_that_cannot_be_meant(run, folder, unit, time, sentence):
    name = folder / 'never.csv'
    ran = run('simulate', '-o', name, *SHORT, '--unit', unit, '--start', time)
    assert (ran.status, sentence in ran.err) == (2, True), ran.err
    assert not name.exists()


def test_truth_is_told_only_when_asked(run, folder):
    words = ['simulate', '-o', folder / 't.mcap', *SHORT, '--effect', 'gain_drift:g=0.02']
    ran = run(*words, '--truth', folder / 'truth.json')
    truth = json.loads((folder / 'truth.json').read_text())
    curve = UnitDescription().curve
    assert [p['slope'] for p in truth['pieces']] == curve.slopes.tolist()
    assert truth['effects'] == [{'name': 'gain_drift', 'parameters': {'g': 0.02}}]
    assert truth['seed'] == 4
    assert 'gain_drift:g=0.02' in ran.out
    contents = open_log(folder / 't.mcap')
    assert not contents.attachments
    assert b'gain_drift' not in (folder / 't.mcap').read_bytes()


def test_json_is_the_truth_with_the_place_of_the_log(run, folder):
    data = run('simulate', '-o', folder / 'j.csv', *SHORT, '--json').json
    assert data['log'] == str(folder / 'j.csv')
    assert data['rows'] == len(read_table(folder / 'j.csv').time_ns)
    assert data['effects'] == []
    assert data['dynamics'][-1]['power_to'] is None


def test_effects_are_listed_with_their_parameters(run):
    ran = run('simulate', '--effects')
    data = run('simulate', '--effects', '--json').json
    assert set(data['effects']) == set(catalogue())
    for name, effect in catalogue().items():
        assert effect.summary in ran.out
        assert set(data['effects'][name]['parameters']) == {p.name for p in effect.parameters}


def test_a_log_that_is_there_is_not_replaced_by_accident(run, tmp_path):
    log = tmp_path / 'x.mcap'
    log.touch()
    assert run('simulate', '-o', log, *SHORT).status == 0, 'an empty file is no loss'
    before = log.read_bytes()
    assert 'add --overwrite' in run('simulate', '-o', log, *SHORT[:2]).refused()
    assert log.read_bytes() == before
    assert run('simulate', '-o', log, *SHORT[:2], '--overwrite').status == 0
    assert log.read_bytes() != before
    bag = tmp_path / 'bag'
    bag.mkdir()
    (bag / 'mine.txt').write_text('keep')
    assert 'not empty' in run('simulate', '-o', bag, *SHORT).refused()


def test_another_unit_and_recording_are_simulated_and_told(run, tmp_path):
    words = ['simulate', '-o', tmp_path / 'a.csv', *SHORT, '--unit', 'choked', '--recording']
    ran = run(*words, 'minute', '--truth', tmp_path / 't.json', '--effect', 'area_step:t0_days=0')
    assert ran.status == 0, ran.err
    assert 'choked: flow p^m f(V)' in ran.out
    assert 'recorded minute' in ran.out
    truth = json.loads((tmp_path / 't.json').read_text())
    assert truth['form'] == 'opening'
    assert truth['effects'][0]['name'] == 'area_step'
    assert len(read_table(tmp_path / 'a.csv').time_ns) == 28
    assert 'no recording' in run(*words, 'hourly', '--overwrite').refused(2)


def test_the_effects_of_another_unit_are_listed(run):
    data = run('simulate', '--effects', '--unit', 'choked', '--json').json
    assert 'pressure_scale' in data['effects']
    assert 'exponent' not in data['effects']
