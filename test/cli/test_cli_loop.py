# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow loop`` and ``vf.judge_loop``: tables of every kind, columns, what is refused."""

import json
from pathlib import Path

import pandas as pd
import pytest
from streams import needs_jit

import valveflow_ros as vf
from benchmarks.refinery_loops import simulate_loop
from valveflow_ros.errors import InputError
from valveflow_ros.interface.loop import HEADLINES
from valveflow_ros.logs.tables.loop_columns import roles_of

pytestmark = needs_jit


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
def loop(run, tmp_path):
    """Return the verb on a table written from a frame."""

    def call(frame, *words):
        frame.to_csv(tmp_path / 'FIC101.csv', index=False)
        return run('loop', tmp_path / 'FIC101.csv', '-o', tmp_path / 'out', *words)

    return call


def test_the_file_keeps_its_contract_and_words_say_it(loop, frame, tmp_path):
    data = loop(frame, '--json').json
    content = json.loads((tmp_path / 'out' / 'loop.json').read_text())
    assert {k: data[k] for k in content} == content
    assert (content['format'], content['version']) == ('valveflow/loop', 1)
    assert content['verdict'] == 'stiction'
    assert set(content) >= {'reason', 'sizes'}
    assert content['columns']['set_point'] == 'FIC101.SV'
    out = loop(frame).out
    assert out.startswith('FIC101.csv: stiction or slack, probable: 3 of 100 sound valves')
    study = Path(__file__).parents[2] / 'benchmarks' / 'results' / 'refinery_valves.json'
    counts = json.loads(study.read_text())['simulated']['all']['verdict']
    assert f'{100.0 * counts["falsely_named"]:.0f} of 100 sound valves' in out
    assert f'{10.0 * (1.0 - counts["found"]):.0f} of 10 faults' in HEADLINES['healthy'][0]
    assert '\nThe valve sticks or has slack: ' in out
    assert '\nWhat to do: Put the controller in manual' in out
    assert 'loop.json' in out


def test_every_kind_of_table_says_the_same(tmp_path, frame):
    plain = vf.judge_loop(frame).to_json()
    frame.to_parquet(tmp_path / 'a.parquet')
    frame.to_csv(tmp_path / 'a.txt', sep='\t', index=False)
    frame[::-1].to_csv(tmp_path / 'newest.csv', index=False)
    frame.to_excel(tmp_path / 'a.xlsx', index=False)
    frame.to_csv(tmp_path / 'indexed.csv')
    top = (
        'PROCESSDATA\t2#FIC101\n4\t10\t2026-01-05 00:00:00\t751\n'
        'tagname\tFIC101.MV\tFIC101.PV\tFIC101.SV\tbOpOFL\tbPvOFL\tbSpOFL\tbAutOFL\tMODE\n'
        'desc\tfeed OP\tfeed PV\tfeed SP\tbOpOFL\tbPvOFL\tbSpOFL\tbAutOFL\tMODE\n'
        'fsMax=1\tfsMin=0\tL=24\tx=1\ty=2\tz=3\tv=4\n'
    )
    rows = frame.assign(a=0, b=0, c=0, d=0, e=1).to_csv(sep='\t', index=False, header=False)
    (tmp_path / 'three.txt').write_text(top + rows)
    for source in sorted(tmp_path.iterdir()):
        assert vf.judge_loop(source).to_json() == plain, source
    assert vf.judge_loop(frame.set_index('time')).to_json() == plain
    seconds = frame.assign(time=[time.timestamp() for time in frame['time']])
    assert vf.judge_loop(seconds).to_json() == plain


@pytest.mark.parametrize('case', [str, str.upper, str.title])
def test_common_names_are_recognised_in_either_case(case):
    for words in (
        ('op', 'process', 'setpoint'), ('controller_output', 'process_value', 'set_point'),
        ('co', 'flow', 'flow_setpoint'), ('valve_command', 'level', 'level_sp'),
        ('output', 'processvalue', 'set_value'), ('mv', 'actual_value', 'reference'),
        ('control signal', 'pressure', 'pressure sp'), ('cmd', 'pv', 'sv'),
        ('controller_output', 'valve_position', 'position_setpoint'), ('op', 'travel', 'sp'),
        ('demand', 'stem lift', 'target'),
    ):  # fmt: skip
        found = roles_of([*map(case, words), 'time'], [''] * 4)
        behind = found.get('position') or found.get('process')
        assert (found['command'], behind, found['set_point']) == ([0], [1], [2]), words


def test_another_clock_and_rows_that_are_missing_or_doubled_say_the_same(frame):
    plain = vf.judge_loop(frame).judgement
    later = frame.assign(time=frame['time'] + pd.Timedelta(days=400))
    assert vf.judge_loop(later).judgement == plain
    assert vf.judge_loop(pd.concat([frame, frame[100:200]])).judgement == plain
    slower = frame.assign(time=frame['time'][0] + 3 * (frame['time'] - frame['time'][0]))
    assert vf.judge_loop(slower).judgement.verdict == plain.verdict
    kept = vf.judge_loop(frame.drop(index=[50, 51, 300, 420]))
    assert kept.judgement.verdict == plain.verdict
    assert len(kept.time_s) == len(frame)


def test_columns_are_named_and_the_period_told(loop, frame):
    bare = frame.drop(columns='time').set_axis(['a', 'b', 'c'], axis=1)
    assert '--period' in loop(bare).refused()
    said = loop(bare, '--period', '10s').refused()
    assert '--command COLUMN and --process COLUMN' in said
    given = ['--period', '10s', '--command', 'a', '--process', 'b']
    assert loop(bare, *given, '--json').json['verdict'] == 'stiction'
    assert "'z'" in loop(bare, *given[:-1], 'z').refused()
    assert 'not both' in loop(bare, *given, '--position', 'c').refused(2)


def test_with_a_position_sizes_are_told(loop, frame, tmp_path):
    command = frame['FIC101.MV'].to_numpy()
    place, out = command[0], []
    for c in command:
        place = min(max(place, c - 0.4), c + 0.4)
        out.append(place + 0.01 * (len(out) % 3))
    data = loop(frame.assign(ZT=out), '--position', 'ZT', '--json').json
    assert data['verdict'] == 'backlash'
    assert data['sizes']['w_percent']['value'] == pytest.approx(0.8, abs=0.05)
    assert vf.judge_loop(tmp_path / 'FIC101.csv').to_json()['sizes'] == data['sizes']


def test_what_cannot_be_judged_is_a_result(loop, frame):
    for changed, words in (
        (frame[:199], 'There are 199 rows'),
        (frame.assign(**{'FIC101.MV': 50.0}), 'The command hardly moves'),
        (frame.assign(**{'FIC101.PV': 'Bad Input'}), 'There are 0 rows'),
        (frame.assign(**{'FIC101.PV': 7.5}), 'The process value does not move'),
    ):
        data = loop(changed, '--json').json
        assert data['verdict'] == 'not_judged'
        assert data['reason'].startswith(words)


def test_what_is_no_table_is_refused(run, loop, tmp_path, frame):
    assert 'without rows' in loop(frame[:0]).refused()
    assert 'could each be the command' in loop(frame.assign(**{'FIC102.MV': 1.0})).refused()
    (tmp_path / 'x.csv').write_bytes(b'\x00\x01\x02' * 50)
    for name in ('x.csv', 'nothing.csv'):
        assert name in run('loop', tmp_path / name, '-o', tmp_path).refused()
    bare = frame.drop(columns='time')
    for table, given, said in (
        (frame, {'position': 'a', 'process': 'b'}, 'not both'),
        (frame, {'process': 'a'}, "no column 'a'"),
        (bare, {}, "no column 'time', and its index holds no times"),
        (bare[['FIC101.MV']], {}, 'no columns that are clearly the command'),
    ):
        with pytest.raises(InputError, match=said):
            vf.judge_loop(table, **given)


def test_a_result_is_drawn(frame):
    figure = vf.judge_loop(frame).plot()
    assert [trace.name for trace in figure.data] == ['FIC101.MV', 'FIC101.PV', 'FIC101.SV']
