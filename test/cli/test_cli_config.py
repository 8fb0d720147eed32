# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow config``: a file that the monitor takes, and what is wrong with one."""

import json

import numpy as np
import pandas as pd
import pytest
import yaml
from monitor_recording import Monitor

from valveflow_ros.interface.settings import read_parameters
from valveflow_ros.parameters import PARAMETERS, Settings
from valveflow_ros.plant.simulator import simulate
from valveflow_ros.records import Signal


@pytest.fixture(scope='module')
def slow_table(tmp_path_factory):
    """A day of the plant, a row every ten seconds, pressure in bar and told so."""
    path = tmp_path_factory.mktemp('config') / 'slow.csv'
    table = simulate(1.0, 3).table
    lines = ['Time (UTC),Valve position [%],Live steam pressure [bar],Live steam temp [degC],MW']
    for k in range(0, len(table), 10):
        u, p, t, w = (table.column(s)[k] for s in list(Signal)[:4])
        stamp = str(table.time_ns[k].astype('datetime64[ns]').astype('datetime64[s]'))
        lines.append(f'{stamp},{u:.3f},{10 * p:.3f},{t:.2f},{w:.3f}')
    path.write_text('\n'.join(lines))
    return path


def test_the_file_is_taken_and_says_what_it_is_from(run, slow_table, tmp_path):
    file = tmp_path / 'monitor.yaml'
    ran = run('config', 'init', slow_table, '-o', file, '--unit-tag', 'U3', '--json').done()
    fitted = ran.json['fitted']
    settings = Settings(read_parameters(file, []))
    assert settings['sample_period'] == 10.0
    assert settings['main_steam_pressure_unit'] == 'bar'
    assert settings['unit_tag'] == 'U3'
    assert settings['window_days'] == PARAMETERS['window_days'].default
    assert settings.real('input_noise') > 0.0
    assert settings.real('power_noise') > 0.0
    changed = {n for n in settings if settings[n] != PARAMETERS[n].default}
    assert changed == set(fitted)
    lines = file.read_text().splitlines()
    for name in PARAMETERS:
        (at,) = (k for k, line in enumerate(lines) if line.startswith(f'    {name}: '))
        assert lines[at - 1].startswith('    # fitted: ') == (name in fitted)
        assert lines[at - 1 - (name in fitted)].startswith(f'    # {PARAMETERS[name].sentence}')
    assert set(yaml.safe_load(file.read_text())['/**']['ros__parameters']) == set(PARAMETERS)
    ran = run('config', 'check', file)
    assert f'{len(fitted)} differ from their defaults' in ran.out
    assert 'sample_period: 10 s, default 1 s' in ran.out
    assert 'exists already' in run('config', 'init', slow_table, '-o', file).refused()


def test_a_short_log_leaves_the_noise_to_the_monitor(run, slow_table, tmp_path):
    short = tmp_path / 'short.csv'
    short.write_text('\n'.join(slow_table.read_text().splitlines()[:30]))
    ran = run('config', 'init', short).done()
    assert '# input_noise and power_noise: the log is too short' in ran.out
    assert '# time_constant and delay: kept at their defaults' in ran.out
    assert 'input_noise: 0.0' in ran.out
    Settings(yaml.safe_load(ran.out)['/**']['ros__parameters'])


# The file, and what is said of it.
BAD_FILES = [
    ('/**:\n  ros__parameters:\n    dellay: 3\n    block: fast\n    delay: 2.0\n',
     [":\n  Parameter 'dellay' does not exist; did you mean 'delay'? The monitor would ignore it.",
      "\n  Parameter 'block' must be a number"]),
    ("/**:\n  ros__parameters:\n    valve_opening: '/plc/x'\n",
     ["'valve_opening' does not exist: it is a topic; remap it with -r valve_opening:=/plc/x"]),
    ('/**:\n  ros__parameters:\n    block: 0.5\n', ['must not be below sample_period']),
    ('/**:\n  ros__parameters:\n    [\n', ['no YAML file']),
    ("/**:\n  ros__parameters:\n    covariates: 'backlash=/x'\n",
     ["Parameter 'covariates' cannot be used: entry 'backlash' is a"]),
    ('/**:\n  ros__parameters:\n    model_file: /no/such/file\n',
     ["'model_file' names '/no/such/file', which cannot be used: no such file"]),
    ('/**:\n  ros__parameters:\n    reference_file: curve.json\n',
     ["'reference_file' names 'curve.json', which cannot be used: ", 'characteristic']),
    ('delay: 3.0\n', ['Put the lines']),
    ('valveflow_monitor:\n  delay: 3.0\n', ['Put the lines']),
    ('/**:\n  ros__parameters: 3\n', ['Put the lines']),
    ('/**:\n  ros__parameters:\n  delay: 3.0\n', ['Put the lines']),
    ('monitor:\n  ros__parameters:\n    delay: 3.0\n/u1/page:\n  ros__parameters:\n    a: 1\n',
     ["no section for the node valveflow_monitor, only 'monitor' and '/u1/page'",
      "Name the section '/**:'."]),
]  # fmt: skip


def test_what_the_monitor_would_refuse_is_named(run, tmp_path, monkeypatch):
    file = tmp_path / 'x.yaml'
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'curve.json').write_text('{"format": "another"}')
    for text, parts in BAD_FILES:
        file.write_text(text)
        sentence = run('config', 'check', file).refused()
        assert all(part in sentence for part in ['x.yaml', *parts]), text


OWN = '/**:\n  ros__parameters:\n    delay: 3.0\n    use_sim_time: true\n    qos_overrides'
# Files that are taken: sections of other nodes, and parameters that every node has, do not count.
GOOD_FILES = [
    ("'/*/valveflow_monitor':\n  ros__parameters:\n    delay: 3.0\n"
     'opcua_gateway:\n  ros__parameters:\n    mapping_file: opcua.yaml\n',
     '1 parameter, 1 differs'),
    (f'{OWN}:\n      /valve_opening:\n        subscription:\n          depth: 5\n',
     '1 parameter, 1 differs'),
    (f'{OWN}./valve_opening.subscription.depth: 5\n', '1 parameter, 1 differs'),
    ('/unit_1:\n  valveflow_monitor:\n    ros__parameters:\n      delay: 3.0\n',
     'the monitor takes it'),
    ('/**:\n  ros__parameters:\n', 'the monitor takes it'),
]  # fmt: skip


def test_what_the_monitor_takes_is_counted(run, tmp_path):
    file = tmp_path / 'x.yaml'
    for text, said in GOOD_FILES:
        file.write_text(text)
        assert said in run('config', 'check', file).out, text


def test_the_tag_of_a_recording_is_kept(run, tmp_path):
    attached = {'parameters.json': json.dumps({'unit_tag': 'U7'}).encode()}
    monitor = Monitor(tmp_path / 'r', **attached)
    monitor.seconds(60)
    monitor.writer.close()
    for words, tag in (((), 'U7'), (('--unit-tag', 'U8'), 'U8')):
        ran = run('config', 'init', tmp_path / 'r', *words).done()
        assert yaml.safe_load(ran.out)['/**']['ros__parameters']['unit_tag'] == tag


def test_a_column_s_name_cannot_write_parameters(run, tmp_path):
    name = "PT\n    unit_tag: 'OWNED'\r\u2028    # [bar]"
    n = 600
    frame = pd.DataFrame({
        'time': pd.date_range('2026-01-01', periods=n, freq='s', tz='UTC'),
        'valve_opening_percent': 70.0 + np.arange(n) % 7, name: 160.0,
        'main_steam_temperature_degc': 540.0, 'generated_power_mw': 230.0 + np.arange(n) % 9,
    })  # fmt: skip
    frame.to_parquet(tmp_path / 'x\n    unit_tag: OWNED.parquet')
    ran = run('config', 'init', *tmp_path.glob('*.parquet')).done()
    lines = [line for line in ran.out.splitlines() if 'OWNED' in line]
    assert len(lines) == 2
    assert all(line.lstrip().startswith('#') for line in lines)
    assert yaml.safe_load(ran.out)['/**']['ros__parameters']['unit_tag'] != 'OWNED'
    ran = run('config', 'init', *tmp_path.glob('*.parquet'), '-o', tmp_path / 'x.yaml')
    assert not any(line.startswith('    unit_tag') for line in ran.out.splitlines())
