# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow info``, ``export`` and ``recover``."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from logged import rewritten
from monitor_recording import FLOAT64, Monitor, cdr, diagnosis, recording

from valveflow_ros.interface.logs import open_log as open_whole_log
from valveflow_ros.interface.logs import steps_of
from valveflow_ros.interface.settings import settings_for
from valveflow_ros.logs import RecordingWriter, open_log, read_table
from valveflow_ros.records import NS_PER_S, SIGNALS, Signal
from valveflow_ros.signals.align import align_whole


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
    assert 'main_steam_pressure: 1 impossible value' in ran.out
    assert 'valve_opening: 1 gap, the longest 10 min 1 s from' in ran.out
    data = run('info', tmp_path / 'x.csv', '--json').json
    assert data['signals']['valve_opening']['longest_gap_s'] == 601.0
    assert data['readings']['main_steam_pressure']['impossible'] == 1


def test_info_of_a_cut_off_recording_says_so(run, logs, tmp_path):
    whole = (logs / 'plant.mcap').read_bytes()
    (tmp_path / 'cut.mcap').write_bytes(whole[: len(whole) // 2])
    ran = run('info', tmp_path / 'cut.mcap')
    assert ran.status == 0
    assert 'Warning: ' in ran.err


def test_export_gives_the_values_back(run, logs, tmp_path):
    for name in ('a.csv', 'a.parquet'):
        ran = run('export', logs / 'plant.mcap', '-o', tmp_path / name)
        assert ran.status == 0, ran.err
        written, source = read_table(tmp_path / name), read_table(logs / 'plant.csv')
        assert np.array_equal(written.time_ns, source.time_ns)
        for info in SIGNALS:
            assert np.array_equal(written.columns[info.column], source.columns[info.column])
    data = run('export', logs / 'plant.csv', '-o', tmp_path / 'b.csv', '--json').json
    assert data['rows'] == len(source.time_ns)


def test_export_takes_a_step(run, logs, tmp_path):
    words = ['export', logs / 'plant.csv', '-o', tmp_path / 'a.csv', '--set', 'sample_period=10']
    assert run(*words).status == 0
    written = read_table(tmp_path / 'a.csv')
    assert set(np.diff(written.time_ns)) == {10_000_000_000}


def test_export_does_not_replace_by_accident(run, logs, tmp_path):
    table = tmp_path / 'a.csv'
    table.write_text('mine')
    assert '--overwrite' in run('export', logs / 'plant.csv', '-o', table).refused()
    assert table.read_text() == 'mine'
    assert run('export', logs / 'plant.csv', '-o', table, '--overwrite').status == 0
    assert [p.name for p in tmp_path.iterdir()] == ['a.csv']


def test_recover_makes_a_whole_file_of_half_of_one(run, logs, tmp_path):
    whole = (logs / 'plant.mcap').read_bytes()
    broken = tmp_path / 'cut.mcap'
    broken.write_bytes(whole[: len(whole) // 2])
    data = run('recover', broken, '-o', tmp_path / 'b.mcap', '--json').json
    ran = run('recover', broken, '-o', tmp_path / 'c.mcap')
    assert ran.status == 0
    assert 'Kept ' in ran.out
    after = open_log(tmp_path / 'b.mcap')
    assert not after.warnings
    assert len(after.readings) == data['messages'] > 1000
    assert broken.read_bytes() == whole[: len(whole) // 2]
    values = open_log(logs / 'plant.mcap').readings
    mine = after.readings.value[after.readings.signal == Signal.GENERATED_POWER]
    theirs = values.value[values.signal == Signal.GENERATED_POWER]
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
    assert 'holds nothing that a monitor said' in none


def test_recover_says_what_it_cannot_see(run, logs, tmp_path):
    """A byte that flips outside of the chunks costs no message, and is not called undamaged."""
    content = bytearray((logs / 'plant.mcap').read_bytes())
    content[-12] ^= 0x10
    broken = tmp_path / 'a.mcap'
    broken.write_bytes(content)
    said = run('recover', broken, '-o', tmp_path / 'b.mcap').out
    assert 'no chunk is damaged' in said
    assert 'Metadata has no checksum: damage there is not seen.' in said
    assert 'no damage' not in said


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
