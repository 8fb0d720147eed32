# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow identify``: from any log to the curve, its files and its words."""

from __future__ import annotations

import json
import re

import numpy as np
import pandas as pd
import pytest
from logged import rewritten
from streams import needs_jit

from valveflow_ros.curve.characteristic_json import from_json
from valveflow_ros.logs import open_log, write_table
from valveflow_ros.plant.unit import UnitDescription
from valveflow_ros.records import NS_PER_S, SampleTable, Signal

pytestmark = needs_jit
START_NS = 1_700_000_000 * NS_PER_S


@pytest.fixture(scope='module')
def results(tmp_path_factory):
    return tmp_path_factory.mktemp('results')


@pytest.fixture(scope='module')
def curves():
    """Hold what was identified in this module, so that no log is identified twice."""
    return {}


def identified(run, logs, results, curves, name):
    if name not in curves:
        ran = run('identify', logs / name, '-o', results / name)
        assert ran.status == 0, ran.err
        curves[name] = (ran, json.loads((results / name / 'characteristic.json').read_text()))
    return curves[name]


def test_the_curve_is_the_plants(run, logs, results, curves):
    _, content = identified(run, logs, results, curves, 'plant.mcap')
    found = from_json(content)
    truth = UnitDescription().curve
    u = np.linspace(found.breakpoints[0], found.breakpoints[-1], 200)
    # Ten hours under 3 MW of noise: the curve is near, its pieces need not be all there.
    assert np.sqrt(np.mean((found(u) - truth(u)) ** 2)) < 4.0
    assert content['format'] == 'valveflow/characteristic'
    assert content['version'] == 2
    assert content['optimal'] is True


def test_a_part_of_a_log_is_taken_by_its_times(run, logs, tmp_path):
    start, end = '2023-11-15T02:00', '2023-11-15T08:00Z'
    words = ['identify', logs / 'plant.csv', '-o']
    ran = run(*words, tmp_path / 'a', '--from', start, '--to', end, '--json')
    assert ran.status == 0, ran.err
    window = json.loads(ran.out)['window']
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


@pytest.mark.parametrize('name', ['plant.csv', 'plant.parquet'])
def test_any_kind_of_log_gives_the_same_curve_to_the_last_bit(run, logs, results, curves, name):
    _, first = identified(run, logs, results, curves, 'plant.mcap')
    _, other = identified(run, logs, results, curves, name)
    assert other == first


def test_there_and_back_again_gives_the_same_curve(run, logs, results, curves, tmp_path):
    _, first = identified(run, logs, results, curves, 'plant.mcap')
    assert run('export', logs / 'plant.mcap', '-o', tmp_path / 'a.parquet').status == 0
    assert run('import', tmp_path / 'a.parquet', '-o', tmp_path / 'b.mcap').status == 0
    ran = run('identify', tmp_path / 'b.mcap', '-o', tmp_path / 'out', '--json')
    assert ran.json['model_id'] == first['model_id']
    assert {k: ran.json[k] for k in first} == first


def test_words_and_report_tell_the_numbers_of_the_json(run, logs, results, curves):
    ran, content = identified(run, logs, results, curves, 'plant.mcap')
    report = (results / 'plant.mcap' / 'report.html').read_text()
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
    assert 'plant.mcap' in report
    assert re.search(r'\bnan\b', ran.out) is None


def test_nothing_but_the_result_stands_on_stdout(run, logs, tmp_path):
    quick = ['--set', 'refine=false', '--set', 'selection_rule=paper']
    ran = run('identify', logs / 'plant.csv', '-o', tmp_path / 'out', '--json', *quick)
    assert ran.json['files']['report.html'] == str(tmp_path / 'out' / 'report.html')
    assert ran.json['dynamics'] == []
    assert ran.json['sample_period_s'] == 1.0
    assert '\r' not in ran.err, 'a progress bar is for terminals'
    assert sorted(p.name for p in (tmp_path / 'out').iterdir()) == [
        'characteristic.json', 'report.html',
    ]  # fmt: skip
    again = run('identify', logs / 'plant.csv', '-o', tmp_path / 'out', '--json', *quick)
    assert again.json == ran.json, 'a result may be written again'


def test_units_and_constants_reach_the_engine(run, logs, results, curves, tmp_path):
    """The same plant written in other units, under other names, gives the same curve."""
    _, first = identified(run, logs, results, curves, 'plant.csv')
    other = rewritten(
        logs / 'plant.csv', tmp_path / 'other.csv', 'generated_power_mw',
        lambda _, mw: repr(float(mw) * 1000.0), 'P gross',
    )  # fmt: skip
    ran = run('identify', other, '-o', tmp_path / 'out', '--column', 'generated_power=P gross:kW')
    assert ran.status == 0, ran.err
    content = json.loads((tmp_path / 'out' / 'characteristic.json').read_text())
    assert len(content['pieces']) == len(first['pieces'])
    for mine, theirs in zip(content['pieces'], first['pieces'], strict=True):
        assert mine['slope'] == pytest.approx(theirs['slope'], rel=1e-6)


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
        (table(6, stairs), ['--set', 'min_fit_samples=1000000'], 'at least 1000000 needed'),
    ],
    ids=['constant', 'short', 'restless', 'loose', 'impossible', 'absent', 'few'],
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


def test_many_rows_with_gaps_are_told_by_their_longest_stretch(run, tmp_path):
    pressure = 12.0 + np.sin(np.arange(600) / 50.0)
    log = table(10, lambda t: 55.0 + 10.0 * np.sin(t / 700.0), pressure=pressure, step_s=60)
    log = log.take(np.flatnonzero(np.arange(600) % 60 < 30))
    write_table(log, tmp_path / 'log.csv')
    told = run('identify', tmp_path / 'log.csv', '-o', tmp_path / 'out').refused()
    assert (
        'The log holds 308 usable rows, one every 1 min, at most 31 without a gap. To learn the '
        'noise of the signals it takes 4 stretches of 42 rows (42 min) without a gap' in told
    )


def test_a_log_without_a_signal_names_the_two_options(run, logs, tmp_path):
    ran = run('identify', logs / 'plant.mcap', '-o', tmp_path, '--column', 'valve_opening=/none')
    assert "no topic '/none'" in ran.refused()
    rewritten(
        logs / 'plant.csv', tmp_path / 'x.csv', 'main_steam_pressure_mpa', lambda _, p: p, 'P'
    )
    sentence = run('identify', tmp_path / 'x.csv', '-o', tmp_path / 'out').refused()
    assert '--column main_steam_pressure=THEIRS[:unit], or give --constant' in sentence
    option = ('--column', 'main_steam_pressure=P:MPa')
    ran = run('info', tmp_path / 'x.csv', *option, '--json')
    assert ran.json['signals']['main_steam_pressure']['low'] > 0.0


@pytest.mark.parametrize(
    ('name', 'content'),
    [
        ('none.mcap', None),
        ('empty.mcap', b''),
        ('text.mcap', b'this is no recording at all'),
        ('cut.mcap', b'\x89MCAP0\r\n'),
        ('folder', 'folder'),
        ('log.bag', b'#ROSBAG V2.0'),
    ],
)
@pytest.mark.parametrize('verb', ['identify', 'info', 'export', 'recover'])
def test_files_that_are_no_logs(run, tmp_path, verb, name, content):
    place = tmp_path / name
    if content == 'folder':
        place.mkdir()
    elif content is not None:
        place.write_bytes(content)
    output = {'identify': 'out', 'export': 'o.csv', 'recover': 'o.mcap'}.get(verb)
    words = [verb, place] + (['-o', tmp_path / output] if output else [])
    sentence = run(*words).refused()
    assert name in sentence
    if output:
        assert not (tmp_path / output).exists()


def test_slow_data_are_met_with_fitting_parameters(run, tmp_path):
    log = table(240, stairs, lambda t, rng: 4.0 * stairs(t) + rng.standard_normal(len(t)),
                step_s=60)  # fmt: skip
    write_table(log, tmp_path / 'log.csv')
    ran = run('identify', tmp_path / 'log.csv', '-o', tmp_path / 'out', '--json')
    assert ran.status == 0, ran.err
    assert ran.json['sample_period_s'] == 60.0
    assert 'a value every 60 s' in ran.err
    assert 'hold_limit 150 s' in ran.err
    slope = 4.0 / 12.0**1.125
    for piece in ran.json['pieces']:
        assert piece['slope'] == pytest.approx(slope, rel=0.05)


def test_readings_that_were_not_used_are_told(run, logs, tmp_path):
    odd = range(5000, 5010)
    rewritten(
        logs / 'plant.csv', tmp_path / 'x.csv', 'generated_power_mw',
        lambda k, mw: '99999' if k in odd else mw,
    )  # fmt: skip
    quick = ['--set', 'refine=false', '--set', 'selection_rule=paper']
    ran = run('identify', tmp_path / 'x.csv', '-o', tmp_path / 'out', *quick)
    assert 'generated_power: 10 impossible value' in ran.out


def test_a_curve_that_explains_little_is_not_to_be_relied_on(run, logs, tmp_path):
    """The power is that of another time."""
    power = open_log(logs / 'plant.csv').readings.by_signal()[Signal.GENERATED_POWER].value
    shifted = np.roll(power, -(len(power) // 3))
    rewritten(
        logs / 'plant.csv', tmp_path / 'x.csv', 'generated_power_mw',
        lambda k, _: repr(float(shifted[k])),
    )  # fmt: skip
    sound = run('identify', logs / 'plant.csv', '-o', tmp_path / 'a')
    assert 'Do not rely' not in sound.out
    ran = run('identify', tmp_path / 'x.csv', '-o', tmp_path / 'b')
    assert ran.status == 0
    assert 'Do not rely on this curve: it explains only' in ran.out
    assert 'Do not rely on this curve' in (tmp_path / 'b' / 'report.html').read_text()
