# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow loop`` and ``vf.judge_loop``: tables of every kind, columns, what is refused."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
from streams import needs_jit

import valveflow_ros as vf
from benchmarks.refinery_loops import simulate_loop
from valveflow_ros.errors import InputError
from valveflow_ros.logs.tables.loop_columns import roles_of

pytestmark = needs_jit
KEYS = {'format', 'version', 'verdict', 'reason', 'sizes'}


@pytest.fixture(scope='module')
def frame():
    """A loop whose valve sticks, by the names of a control system."""
    loop = simulate_loop(3, True)
    times = pd.date_range('2026-01-05', periods=len(loop.command), freq='10s')
    return pd.DataFrame(
        {'time': times, 'FIC101.MV': loop.command, 'FIC101.PV': loop.response,
         'FIC101.SV': loop.setpoint}
    )  # fmt: skip


@pytest.fixture
def table(tmp_path, frame):
    path = tmp_path / 'FIC101.csv'
    frame.to_csv(path, index=False)
    return path


def test_the_file_keeps_its_contract(run, tmp_path, table):
    ran = run('loop', table, '-o', tmp_path / 'out', '--json')
    assert ran.status == 0, ran.err
    content = json.loads((tmp_path / 'out' / 'loop.json').read_text())
    assert set(content) >= KEYS
    assert (content['format'], content['version']) == ('valveflow/loop', 1)
    assert content['verdict'] == 'stiction'
    assert {k: ran.json[k] for k in content} == content
    assert content['columns']['set_point'] == 'FIC101.SV'


def test_it_is_told_in_words(run, tmp_path, table):
    ran = run('loop', table, '-o', tmp_path / 'out')
    assert ran.out.startswith('FIC101.csv: stiction or slack.\nThe valve sticks or has slack')
    assert 'loop.json' in ran.out


def test_every_kind_of_table_says_the_same(tmp_path, frame, table):
    plain = vf.judge_loop(table).to_json()
    frame.to_parquet(tmp_path / 'a.parquet')
    frame.to_csv(tmp_path / 'a.txt', sep='\t', index=False)
    frame[::-1].to_csv(tmp_path / 'newest.csv', index=False)
    frame.to_excel(tmp_path / 'a.xlsx', index=False)
    frame.to_csv(tmp_path / 'indexed.csv')
    for source in ('a.parquet', 'a.txt', 'newest.csv', 'a.xlsx', 'indexed.csv'):
        assert vf.judge_loop(tmp_path / source).to_json() == plain, source
    assert vf.judge_loop(frame).to_json() == plain
    assert vf.judge_loop(frame.set_index('time')).to_json() == plain


def test_three_lines_above_the_rows_are_a_heading(tmp_path, frame, table):
    top = (
        'PROCESSDATA\t2#FIC101\n4\t10\t2026-01-05 00:00:00\t751\n'
        'tagname\tFIC101.MV\tFIC101.PV\tFIC101.SV\tbOpOFL\tbPvOFL\tbSpOFL\tbAutOFL\tMODE\n'
        'desc\tfeed OP\tfeed PV\tfeed SP\tbOpOFL\tbPvOFL\tbSpOFL\tbAutOFL\tMODE\n'
        'fsMax=1\tfsMin=0\tL=24\tx=1\ty=2\tz=3\tv=4\n'
    )
    rows = frame.assign(a=0, b=0, c=0, d=0, e=1).to_csv(sep='\t', index=False, header=False)
    (tmp_path / 'a.txt').write_text(top + rows)
    assert vf.judge_loop(tmp_path / 'a.txt').to_json() == vf.judge_loop(table).to_json()


@pytest.mark.parametrize('case', [str, str.upper, str.title])
@pytest.mark.parametrize(
    ('command', 'response', 'set_point'),
    [
        ('op', 'process', 'setpoint'), ('controller_output', 'process_value', 'set_point'),
        ('co', 'flow', 'flow_setpoint'), ('valve_command', 'level', 'level_sp'),
        ('output', 'processvalue', 'set_value'), ('mv', 'actual_value', 'reference'),
        ('control signal', 'pressure', 'pressure sp'), ('cmd', 'pv', 'sv'),
        ('controller_output', 'valve_position', 'position_setpoint'), ('op', 'travel', 'sp'),
        ('demand', 'stem lift', 'target'),
    ],
)  # fmt: skip
def test_common_names_are_recognised_in_either_case(case, command, response, set_point):
    names = [case(name) for name in (set_point, response, command, 'time')]
    found = roles_of(names, [''] * 4)
    behind = found.get('position') or found.get('process')
    assert (found['set_point'], behind, found['command']) == ([0], [1], [2])


def test_another_clock_says_the_same(frame):
    plain = vf.judge_loop(frame).judgement
    later = frame.assign(time=frame['time'] + pd.Timedelta(days=400))
    assert vf.judge_loop(later).judgement == plain
    slower = frame.assign(time=frame['time'][0] + 3 * (frame['time'] - frame['time'][0]))
    assert vf.judge_loop(slower).judgement.verdict == plain.verdict
    doubled = pd.concat([frame, frame[100:200]])
    assert vf.judge_loop(doubled).judgement == plain


def test_words_do_as_well_as_tags(frame):
    words = frame.set_axis(['time', 'controller_output', 'flow', 'flow_setpoint'], axis=1)
    assert vf.judge_loop(words).to_json()['sizes'] == vf.judge_loop(frame).to_json()['sizes']


def test_a_few_rows_that_are_missing_change_nothing(frame):
    kept = frame.drop(index=[50, 51, 300, 420])
    assert vf.judge_loop(kept).judgement.verdict == 'stiction'
    assert len(vf.judge_loop(kept).time_s) == len(frame)


def test_columns_are_named_and_the_period_told(run, tmp_path, frame):
    path = tmp_path / 'bare.csv'
    bare = frame.drop(columns='time').set_axis(['a', 'b', 'c'], axis=1)
    bare.to_csv(path, index=False)
    refused = run('loop', path, '-o', tmp_path).refused()
    assert '--period' in refused
    said = run('loop', path, '-o', tmp_path, '--period', '10s').refused()
    assert '--command COLUMN and --process COLUMN' in said
    given = ['--period', '10s', '--command', 'a', '--process', 'b']
    ran = run('loop', path, '-o', tmp_path, *given, '--json')
    assert (ran.status, ran.json['verdict']) == (0, 'stiction')
    assert "'z'" in run('loop', path, '-o', tmp_path, *given[:-1], 'z').refused()
    assert 'not both' in run('loop', path, '-o', tmp_path, *given, '--position', 'c').refused(2)


def test_with_a_position_sizes_are_told(run, tmp_path, frame):
    command = frame['FIC101.MV'].to_numpy()
    place, out = command[0], []
    for c in command:
        place = min(max(place, c - 0.4), c + 0.4)
        out.append(place + 0.01 * (len(out) % 3))
    path = tmp_path / 'a.csv'
    frame.assign(ZT=out).to_csv(path, index=False)
    ran = run('loop', path, '-o', tmp_path, '--position', 'ZT', '--json')
    assert ran.json['verdict'] == 'backlash'
    assert ran.json['sizes']['w_percent']['value'] == pytest.approx(0.8, abs=0.05)
    assert vf.judge_loop(path).to_json() == vf.judge_loop(path, position='ZT').to_json()


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        (lambda f: f[:199], 'There are 199 rows'),
        (lambda f: f.assign(**{'FIC101.MV': 50.0}), 'The command hardly moves'),
        (lambda f: f.assign(**{'FIC101.PV': np.nan}), 'There are 0 rows'),
        (lambda f: f.assign(**{'FIC101.PV': 'Bad Input'}), 'There are 0 rows'),
        (lambda f: f.assign(**{'FIC101.PV': 7.5}), 'The process value stands still'),
    ],
)
def test_what_cannot_be_judged_is_a_result(run, tmp_path, frame, change, words):
    path = tmp_path / 'a.csv'
    change(frame).to_csv(path, index=False)
    ran = run('loop', path, '-o', tmp_path, '--json')
    assert ran.status == 0, ran.err
    assert ran.json['verdict'] == 'not_judged'
    assert ran.json['reason'].startswith(words)


def test_what_is_no_table_is_refused(run, tmp_path, frame):
    (tmp_path / 'empty.csv').write_text('time,MV,PV\n')
    assert 'without rows' in run('loop', tmp_path / 'empty.csv', '-o', tmp_path).refused()
    (tmp_path / 'x.csv').write_bytes(b'\x00\x01\x02' * 50)
    run('loop', tmp_path / 'x.csv', '-o', tmp_path).refused()
    run('loop', tmp_path / 'nothing.csv', '-o', tmp_path).refused()
    twice = frame.assign(**{'FIC102.MV': 1.0})
    twice.to_csv(tmp_path / 'two.csv', index=False)
    assert 'could each be the command' in run('loop', tmp_path / 'two.csv', '-o', '/tmp').refused()
    with pytest.raises(InputError, match='not both'):
        vf.judge_loop(frame, position='a', process='b')
    with pytest.raises(InputError, match="no column 'a'"):
        vf.judge_loop(frame, process='a')


def test_a_result_is_drawn(frame):
    figure = vf.judge_loop(frame).plot()
    assert [trace.name for trace in figure.data] == ['FIC101.MV', 'FIC101.PV', 'FIC101.SV']
