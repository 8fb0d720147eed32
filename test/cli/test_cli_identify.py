# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow identify``: from any log to the curve, its files and its words."""

import json
import re

import numpy as np
import pandas as pd
import pytest
from logged import rewritten
from step_plan import StepPlan, step_test
from streams import needs_jit

from valveflow_ros.curve.characteristic_json import from_json
from valveflow_ros.logs import write_samples, write_table
from valveflow_ros.records import NS_PER_S, SampleTable, Signal
from valveflow_ros.report import drawing

pytestmark = needs_jit
START_NS = 1_700_000_000 * NS_PER_S
# Without the joint fit, where only the way to the curve is of interest.
QUICK = ('--set', 'refine=false', '--set', 'selection_rule=paper')


@pytest.fixture(scope='module')
def quick(run, logs, tmp_path_factory):
    folder = tmp_path_factory.mktemp('quick') / 'out'
    return run('identify', logs / 'plant.csv', '-o', folder, '--json', *QUICK), folder


def test_words_and_report_tell_the_numbers_of_the_json(identification):
    ran, folder = identification
    content = json.loads((folder / 'characteristic.json').read_text())
    report = (folder / 'report.html').read_text()
    for text in (ran.out, report):
        assert f'{len(content["pieces"])} piece' in text
        for piece in content['pieces']:
            assert f'{piece["u_from"]:.1f} to {piece["u_to"]:.1f}' in text
        told = np.array([float(number) for number in re.findall(r'\d+(?:\.\d+)?', text)])
        for region in content['dynamics']:
            # Told no finer than it is known.
            off = np.abs(told - region['time_constant_s']).min()
            assert off <= 0.5 * region['time_constant_stderr_s']
    assert content['model_id'] in report
    assert 'plant.csv' in report
    assert 'Do not rely' not in ran.out
    assert re.search(r'\bnan\b', ran.out) is None


def test_nothing_but_the_result_stands_on_stdout(run, logs, quick):
    ran, folder = quick
    assert ran.json['files']['report.html'] == str(folder / 'report.html')
    assert ran.json['dynamics'] == []
    assert ran.json['sample_period_s'] == 1.0
    assert 'shift' not in ran.json
    assert '\r' not in ran.err, 'a progress bar is for terminals'
    assert sorted(p.name for p in folder.iterdir()) == ['characteristic.json', 'report.html']
    again = run('identify', logs / 'plant.csv', '-o', folder, '--json', *QUICK)
    assert again.json == ran.json, 'a result may be written again'


def test_a_part_of_a_log_is_taken_by_its_times(run, logs, tmp_path):
    start, end = '2023-11-15T02:00', '2023-11-15T08:00Z'
    words = ['identify', logs / 'plant.csv', *QUICK, '-o']
    ran = run(*words, tmp_path / 'a', '--from', start, '--to', end, '--json')
    window = ran.json['window']
    assert window['start_ns'] == pd.Timestamp(start).value
    assert window['end_ns'] == pd.Timestamp(end).value
    again = run(*words, tmp_path / 'a', '--from', start, '--to', end)
    assert 'was replaced' not in again.out  # it is the same curve
    anew = run(*words, tmp_path / 'a', '--to', end, '--time-zone', '+01:00')
    replaced = (
        'The curve of 2023-11-15 03:00:00 UTC+01:00 to 2023-11-15 09:00:00 UTC+01:00 '
        f'(model {ran.json["model_id"]}) that was in characteristic.json was replaced.'
    )
    assert replaced in anew.out
    none = run(*words, tmp_path / 'b', '--from', '2030-01-01')
    assert 'has no readings between these times' in none.refused()
    wrong = run(*words, tmp_path / 'b', '--to', 'noon')
    assert "'noon' is no time such as" in wrong.refused(2)


def table(hours, opening, power=None, pressure=12.0, step_s=1):
    """Make a log by hand; ``opening`` and ``power`` are functions of the seconds."""
    t = np.arange(0, int(hours * 3600), step_s)
    rng = np.random.default_rng(5)
    v = opening(t) + 0.0 * t
    made = 4.0 * v if power is None else power(t, rng) + 0.0 * t
    return SampleTable.from_columns(
        START_NS + t.astype(np.int64) * NS_PER_S,
        {
            Signal.VALVE_OPENING: v,
            Signal.MAIN_STEAM_PRESSURE: np.full(len(t), pressure),
            Signal.MAIN_STEAM_TEMPERATURE: np.full(len(t), 540.0),
            Signal.GENERATED_POWER: made,
        },
    )


def stairs(t):
    """Rest twenty minutes at each of many openings."""
    return 40.0 + 5.0 * ((t // 1200) % 9)


MINUTES = table(
    10, lambda t: 55.0 + 10.0 * np.sin(t / 700.0), step_s=60,
    pressure=12.0 + np.sin(np.arange(600) / 50.0),
)  # fmt: skip


@pytest.mark.parametrize(
    ('log', 'options', 'part'),
    [
        (table(3, lambda t: 55.0), [], 'never changes'),
        (table(0.15, stairs), [], 'holds 9 min of usable data. To learn .* 4 stretches'),
        (table(3, stairs), ['--set', 'steady_min=1500'], 'in 3 h of data: the valve must rest'),
        (table(6, stairs, lambda t, rng: 200.0 + 5.0 * rng.standard_normal(len(t))), [],
         'hardly follows the valve'),
        (table(1, stairs, pressure=120.0), [], 'all of them are impossible'),
        (table(1, lambda t: np.full(len(t), np.nan)), [], 'valve_opening has no usable value'),
        (MINUTES.take(np.flatnonzero(np.arange(600) % 60 < 30)), [],
         'The log holds 308 usable rows, one every 1 min, at most 31 without a gap. To learn the '
         r'noise of the signals it takes 4 stretches of 42 rows \(42 min\) without a gap'),
    ],
    ids=['constant', 'short', 'restless', 'loose', 'impossible', 'absent', 'gaps'],
)  # fmt: skip
def test_what_carries_no_curve_is_refused_and_nothing_is_written(
    run, tmp_path, log, options, part
):
    write_table(log, tmp_path / 'log.parquet')
    sentence = run(
        'identify', tmp_path / 'log.parquet', '-o', tmp_path / 'out', *options
    ).refused()  # fmt: skip
    assert re.search(part, sentence), sentence
    assert [p.name for p in tmp_path.iterdir()] == ['log.parquet']


def test_a_log_without_a_signal_names_the_two_options(run, logs, tmp_path):
    ran = run('identify', logs / 'plant.mcap', '-o', tmp_path, '--column', 'valve_opening=/none')
    assert "no topic '/none'" in ran.refused()
    rewritten(
        logs / 'plant.csv', tmp_path / 'x.csv', 'main_steam_pressure_mpa', lambda _, p: p, 'P'
    )
    sentence = run('identify', tmp_path / 'x.csv', '-o', tmp_path / 'out').refused()
    assert '--column main_steam_pressure=THEIRS[:unit]; for a control valve with' in sentence
    assert sentence.endswith('flow only, add --constant main_steam_pressure=1.')
    option = ('--column', 'main_steam_pressure=P:MPa')
    ran = run('info', tmp_path / 'x.csv', *option, '--json')
    assert ran.json['signals']['main_steam_pressure']['low'] > 0.0


@pytest.mark.parametrize('verb', ['identify', 'info', 'export', 'recover', 'import'])
def test_files_that_are_no_logs(run, tmp_path, verb):
    (tmp_path / 'folder').mkdir()
    (tmp_path / 'empty.mcap').write_bytes(b'')
    (tmp_path / 'text.mcap').write_bytes(b'this is no recording at all')
    (tmp_path / 'cut.mcap').write_bytes(b'\x89MCAP0\r\n')
    (tmp_path / 'log.bag').write_bytes(b'#ROSBAG V2.0')
    (tmp_path / 'empty.csv').write_bytes(b'')
    (tmp_path / 'text.parquet').write_bytes(b'no parquet at all')
    names = sorted(p.name for p in tmp_path.iterdir())
    output = {'identify': 'out', 'export': 'o.csv', 'recover': 'o.mcap', 'import': 'o.mcap'}
    words = ['-o', tmp_path / output[verb]] if verb in output else []
    for name in [*names, 'none.mcap']:
        assert name in run(verb, tmp_path / name, *words).refused()
    assert sorted(p.name for p in tmp_path.iterdir()) == names


def test_a_curve_is_judged_against_a_reference(run, logs, quick, tmp_path):
    first, folder = quick
    assert not (folder / 'shift.json').exists()
    words = ['identify', logs / 'plant.csv', '-o', tmp_path / 'b', *QUICK, '--reference']
    again = run(*words, folder)
    assert again.status == 0, again.err
    assert 'Against the reference: The curve agrees with the reference of 2023-11-15' in again.out
    tables = [line for line in again.out.splitlines() if line.startswith('  ')]
    assert max(map(len, tables)) <= 80, 'a usual terminal'
    now, then, change = re.split(r'  +', tables[-1])[2:]
    assert (now, change.split()[0]) == (then, '0.0')
    shift = json.loads((tmp_path / 'b' / 'shift.json').read_text())
    assert (shift['format'], shift['moved']) == ('valveflow/shift', False)
    assert shift['reference_model_id'] == shift['model_id'] == first.json['model_id']
    assert [p['shift_mw'] for p in shift['pieces']] == [0.0] * len(first.json['pieces'])


def test_pictures_and_tables_stand_beside_the_report(run, logs, tmp_path):
    pytest.importorskip('matplotlib')
    ran = run(
        'identify', logs / 'plant.csv', '-o', tmp_path, '--figures', '--table', *QUICK
    ).done()
    assert f'tables in {tmp_path / "tables"} and pictures in {tmp_path / "figures"}' in ran.out
    stems = {p.stem for p in (tmp_path / 'tables').iterdir()}
    assert {'curve', 'signals', 'choice', 'coverage'} <= stems
    drawn = {p.name for p in (tmp_path / 'figures').iterdir()}
    assert drawn == {f'{stem}.{kind}' for stem in stems for kind in ('png', 'svg')}


@pytest.mark.parametrize('verb', ['identify', 'diagnose', 'compare', 'validate'])
def test_what_cannot_be_drawn_is_told_before_the_long_work(run, tmp_path, monkeypatch, verb):
    """The log cannot even be read: the refusal comes first."""
    log = tmp_path / 'no.mcap'
    log.write_bytes(b'nothing')
    model = ['--model', log] if verb == 'validate' else []
    monkeypatch.setattr(drawing, 'find_spec', lambda name: None)
    told = run(verb, log, *model, '-o', tmp_path, '--figures').refused()
    assert 'pip install matplotlib' in told
    (tmp_path / 'tables').write_text('')
    told = run(verb, log, *model, '-o', tmp_path, '--table').refused()
    assert 'tables' in told


@pytest.fixture(scope='module')
def levels_log(tmp_path_factory):
    path = tmp_path_factory.mktemp('test') / 'test.mcap'
    plan = StepPlan(opening_from_percent=45.0, opening_to_percent=85.0, steps=11)
    write_samples(step_test(3, plan).table, path)
    return path


def test_a_step_test_gives_a_curve_others_can_read(run, levels_log, tmp_path):
    ran = run('identify', levels_log, '-o', tmp_path / 'out', '--step-test').done()
    assert '12 of 12 levels count' in ran.out
    curve = from_json(json.loads((tmp_path / 'out' / 'characteristic.json').read_text()))
    assert curve.choice.rule == 'step_test'
    page = (tmp_path / 'out' / 'report.html').read_text(encoding='utf-8')
    assert 'Manual step test' in page
    assert 'exact partition of the means of the levels' in page
    made = run('compensate', '--model', tmp_path / 'out', '-o', tmp_path / 'table.csv', '--json')
    assert made.json['checks']['passed'] is True


def test_the_way_to_a_step_test_is_told(run, levels_log, tmp_path):
    ran = run('identify', levels_log, '-o', tmp_path / 'out', '--set', 'min_fit_samples=100000')
    refused = ran.refused()
    assert 'at least 100000 needed' in refused
    assert '--step-test identifies it' in refused
    assert 'for data of a closed loop do not use it' in refused


CONSTANTS = ['--constant', 'main_steam_pressure=1', '--constant', 'main_steam_temperature=540']


def test_of_two_measured_loops_one_carries_a_curve(run, shared_data, tmp_path):
    for name, opening, power in (
        ('LIC-106_20241121_27.csv', 'LV_106', 'FT_115'),
        ('FIC-211_20241121_27.csv', 'FV_211', 'FT_211'),
    ):
        table, log = shared_data / 'plant_loops' / name, tmp_path / f'{power}.mcap'
        if not table.is_file():
            pytest.skip(f'{table} is not there')
        ran = run('import', table, '-o', log, '--column', f'valve_opening={opening}',
                  '--column', f'generated_power={power}:t/h', *CONSTANTS).done()  # fmt: skip
        assert '10\u202f080 rows' in ran.out
    found = run('identify', tmp_path / 'FT_115.mcap', '-o', tmp_path / 'out', '--json').json
    (piece,) = found['pieces']
    assert piece['slope'] > 0.0
    assert found['sample_period_s'] == 60.0
    page = (tmp_path / 'out' / 'report.html').read_text(encoding='utf-8')
    assert 'opening (%)' in page
    assert 'The pressure is the same in all rows' in page
    assert not re.search(r'% MPa<sup>|integrated input|differ by|e-1\d', page)
    said = run('identify', tmp_path / 'FT_211.mcap', '-o', tmp_path / 'none').refused()
    assert 'hardly follows the valve' in said
    assert not (tmp_path / 'none').exists()
    said = run('diagnose', tmp_path / 'FT_211.mcap', '-o', tmp_path / 'why').done().out
    first = said.splitlines()[0]
    assert 'something is unexplained. The flow hardly follows the valve' in first
    # The mean of the measured flow is 74.0 t/h before this hour and 94.9 t/h after it.
    assert re.search(r'by \+2\d\.\d t/h about 2024-11-25 13:00 UTC\. Which cause', first)
    assert said.count('region_lag') == 1, 'what could not be checked is listed once'
