# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow simulate``, ``info``, ``export``, ``recover``: logs made, looked at, converted."""

import json
import struct

import numpy as np
import pytest
from logged import rewritten, values
from monitor_recording import FLOAT64, Monitor, cdr, diagnosis, recording

from valveflow_ros.interface.logs import open_log as open_whole_log
from valveflow_ros.interface.logs import steps_of
from valveflow_ros.interface.settings import settings_for
from valveflow_ros.logs import RecordingWriter, open_log, read_table
from valveflow_ros.plant.effects import catalogue
from valveflow_ros.plant.unit import UnitDescription
from valveflow_ros.records import NS_PER_S, SIGNALS, Signal
from valveflow_ros.signals.align import align_whole

SHORT = ['--days', '0.02', '--seed', '4']


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


@pytest.mark.parametrize('unit', ['paper', 'choked'])
def test_a_simulation_begins_when_it_is_told_to(run, tmp_path, unit):
    """In UTC where no zone is named; nothing else changes."""
    path, rows = tmp_path / 'a.csv', set()
    words = ['simulate', '-o', path, *SHORT, '--unit', unit, '--overwrite', '--start']
    for time, utc in (('2026-02-01',) * 2, ('2026-03-01T06:00+02:00', '2026-03-01T04:00')):
        assert run(*words, time).status == 0
        times = read_table(path).time_ns
        rows.add(len(times))
        assert np.datetime64(int(times[0]), 'ns') == np.datetime64(utc)
    assert len(rows) == 1
    for time, sentence in (
        ('soon', "'soon' is no time such as 2026-01-31T06:00Z."),
        ('1969-01-01', 'A simulation must lie between the years 1970 and 2262.'),
        ('9999-01-01', 'A simulation must lie between the years 1970 and 2262.'),
    ):
        assert sentence in run(*words, time).refused(2)


def test_truth_is_told_only_when_asked(run, tmp_path):
    log, file = tmp_path / 't.mcap', tmp_path / 'truth.json'
    words = ['simulate', '-o', log, *SHORT, '--effect', 'gain_drift:g=0.02', '--json']
    data = run(*words, '--truth', file).json
    truth = json.loads(file.read_text())
    assert data == {'log': str(log), 'rows': 1728, **truth}
    assert [p['slope'] for p in truth['pieces']] == UnitDescription().curve.slopes.tolist()
    assert truth['effects'] == [{'name': 'gain_drift', 'parameters': {'g': 0.02}}]
    assert truth['dynamics'][-1]['power_to'] is None
    assert not open_log(log).attachments
    assert b'gain_drift' not in log.read_bytes()


def test_effects_are_listed_with_their_parameters(run):
    ran = run('simulate', '--effects')
    data = run('simulate', '--effects', '--json').json
    assert set(data['effects']) == set(catalogue())
    for name, effect in catalogue().items():
        assert effect.summary in ran.out
        assert set(data['effects'][name]['parameters']) == {p.name for p in effect.parameters}
    data = run('simulate', '--effects', '--unit', 'choked', '--json').json
    assert 'pressure_scale' in data['effects']
    assert 'exponent' not in data['effects']


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


def test_info_tells_what_is_there(run, logs):
    ran = run('info', logs / 'plant.mcap')
    data = run('info', logs / 'plant.mcap', '--json').json
    readings = open_log(logs / 'plant.mcap').readings
    assert data['duration_s'] == pytest.approx(0.4 * 86400.0 - 1.0, abs=1e-6)
    assert {t['name'] for t in data['topics']} == {f'/{i.topic}' for i in SIGNALS}
    for info in SIGNALS:
        values = readings.value[readings.signal == info.signal]
        told = data['signals'][info.topic]
        assert (told['low'], told['high']) == (values.min(), values.max())
        assert told['median'] == np.median(values)
        assert told['readings'] == len(values)
        assert told['step_s'] == 1.0
        assert data['readings'][info.topic]['accepted'] == len(values)
        assert f'/{info.topic}' in ran.out
    assert 'std_msgs/msg/Float64' in ran.out
    assert 'No gaps.' in ran.out
    assert 'Every reading was used.' in ran.out


def test_info_of_a_table_tells_gaps_and_values_that_will_be_rejected(run, logs, tmp_path):
    table = tmp_path / 'x.csv'
    rewritten(
        logs / 'plant.csv', table, 'main_steam_pressure_mpa', lambda k, p: '-5' if k == 49 else p
    )
    lines = table.read_text().splitlines()
    table.write_text('\n'.join([*lines[:100], *lines[700:1000]]) + '\n')
    ran = run('info', tmp_path / 'x.csv')
    assert 'main_steam_pressure: 1 outside the accepted range (0.05 to 40 MPa)' in ran.out
    assert (
        ran.out.count('1 gap') == ran.out.count('every signal: 1 gap, the longest 10 min 1 s') == 1
    )
    data = run('info', tmp_path / 'x.csv', '--json').json
    assert data['signals']['valve_opening']['longest_gap_s'] == 601.0
    assert data['readings']['main_steam_pressure']['impossible'] == 1


def test_export_gives_the_values_back(run, logs, tmp_path):
    source = read_table(logs / 'plant.csv')
    for name in ('a.csv', 'a.parquet'):
        data = run('export', logs / 'plant.mcap', '-o', tmp_path / name, '--json').json
        written = read_table(tmp_path / name)
        assert data['rows'] == len(source.time_ns)
        assert np.array_equal(written.time_ns, source.time_ns)
        for info in SIGNALS:
            assert np.array_equal(written.columns[info.column], source.columns[info.column])
    # A table that is there is not replaced by accident.
    table = tmp_path / 'a.csv'
    table.write_text('mine')
    words = ['export', logs / 'plant.csv', '-o', table, '--set', 'sample_period=10']
    assert '--overwrite' in run(*words).refused()
    assert table.read_text() == 'mine'
    assert run(*words, '--overwrite').status == 0
    assert set(np.diff(read_table(table).time_ns)) == {10_000_000_000}


def test_recover_makes_a_whole_file_of_half_of_one(run, logs, tmp_path):
    whole = (logs / 'plant.mcap').read_bytes()
    broken = tmp_path / 'cut.mcap'
    broken.write_bytes(whole[: len(whole) // 2])
    assert 'Warning: ' in run('info', broken).err
    data = run('recover', broken, '-o', tmp_path / 'b.mcap', '--json').json
    assert 'Kept ' in run('recover', broken, '-o', tmp_path / 'c.mcap').out
    after = open_log(tmp_path / 'b.mcap')
    assert not after.warnings
    assert len(after.readings) == data['messages'] > 1000
    assert broken.read_bytes() == whole[: len(whole) // 2]
    mine = values(tmp_path / 'b.mcap', Signal.GENERATED_POWER)
    theirs = values(logs / 'plant.mcap', Signal.GENERATED_POWER)
    assert np.array_equal(mine, theirs[: len(mine)])
    assert 'exists already' in run('recover', broken, '-o', tmp_path / 'b.mcap').refused()


USUAL = {
    '/valve_opening': 55.0, '/main_steam_pressure': 13.0, '/main_steam_temperature': 538.0,
    '/generated_power': 240.0,
}  # fmt: skip


@pytest.mark.parametrize(
    ('wrong', 'reason'),
    [
        ('', ''), ('no reading', ''), ('not a number', 'not_finite'), ('impossible', 'impossible'),
        ('told twice', 'duplicate'), ('a leap ahead', ''), ('everything', 'duplicate'),
    ],
)  # fmt: skip
def test_info_counts_what_the_engine_accepts(run, tmp_path, wrong, reason):
    """The quick look may ask the engine too often, but may never say other than it."""
    rng, monitor = np.random.default_rng(5), Monitor(tmp_path / 'r')
    odd = {'not a number': np.nan, 'impossible': 1e9}
    monitor.say('diagnosis', diagnosis(monitor.now_ns, 1, 'All is well.'))
    for row in range(0 if wrong == 'no reading' else 80):
        here = wrong if row == 40 else ''
        if wrong == 'everything':
            here = str(rng.choice(['', 'not a number', 'impossible', 'told twice']))
        monitor.now_ns += (7200 if here == 'a leap ahead' else 1) * NS_PER_S
        for topic, usual in USUAL.items():
            value = odd.get(here, usual) if topic == '/generated_power' else usual
            for _ in range(1 + (here == 'told twice')):
                monitor.say(topic, cdr(FLOAT64, {'data': value}))
    monitor.writer.close()
    told = run('info', tmp_path / 'r', '--json').json['readings']
    readings = open_log(tmp_path / 'r').readings
    _, _, counts = align_whole(readings, settings_for(steps_of(readings.by_signal()), 0.0, {})[0])
    for topic, by_reason in counts.items():
        for name, n in by_reason.items():
            if name != 'late':
                assert told.get(topic, {}).get(name, 0) == n, (topic, name)
    assert not reason or told['generated_power'][reason]


def test_info_names_what_is_attached(run, logs, tmp_path):
    assert run('import', logs / 'plant.csv', '-o', tmp_path / 'a.mcap').status == 0
    assert 'Attached: import.json (' in run('info', tmp_path / 'a.mcap').out
    data = run('info', tmp_path / 'a.mcap', '--json').json
    attached = open_log(tmp_path / 'a.mcap').attachments
    assert data['attachments'] == {name: len(text) for name, text in attached.items()}


def test_export_writes_what_a_monitor_said(run, logs, tmp_path):
    said, out = recording(tmp_path / 'said', seconds=3), tmp_path / 'said.csv'
    ran = run('export', said, '-o', out, '--outputs', '--json')
    assert ran.json['tables'] == {
        str(tmp_path / f'said_{kind}.csv'): n
        for kind, n in (('curves', 1), ('predictions', 3), ('alarms', 1), ('diagnoses', 1))
    }
    assert (tmp_path / 'said_alarms.csv').read_text().count('The unit gives less.') == 1
    assert '--overwrite' in run('export', said, '-o', out, '--outputs').refused()
    assert run('export', said, '-o', out, '--outputs', '--overwrite').status == 0
    none = run('export', logs / 'plant.csv', '-o', out, '--outputs').refused()
    assert 'contains no monitor output' in none


def test_a_folder_named_by_a_dot_has_its_name(logs, tmp_path, monkeypatch):
    home = tmp_path / 'unit7'
    home.mkdir()
    (home / 'plant.mcap').write_bytes((logs / 'plant.mcap').read_bytes())
    monkeypatch.chdir(home)
    assert open_whole_log('.').name == 'unit7'


def test_the_times_of_the_data_stand_before_those_of_the_recording(run, tmp_path):
    """A day that was replayed in two minutes."""
    start, replay = 1_700_000_000 * NS_PER_S, 1_750_000_000 * NS_PER_S
    with RecordingWriter(tmp_path / 'replay') as writer:
        topics = [info.topic for info in SIGNALS if info.required]
        for topic in topics:
            writer.add_topic(f'/{topic}', FLOAT64)
        data = bytes((0, 1, 0, 0)) + struct.pack('<d', 12.0)
        for k in range(121):
            for topic in topics:
                times = replay + k * NS_PER_S, start + k * 720 * NS_PER_S
                writer.write(f'/{topic}', data, *times)
    ran = run('info', tmp_path / 'replay')
    lines = ran.out.splitlines()
    assert lines[1] == '  data: 2023-11-14 22:13:20 UTC to 2023-11-15 22:13:20 UTC (1 d)'
    assert lines[2].startswith('  recorded: 2025-06-15 15:06:40 UTC to 2025-06-15 15:08:40 UTC')
