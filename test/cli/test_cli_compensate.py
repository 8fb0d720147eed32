# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow compensate``: the table, its checks, and what is refused."""

from __future__ import annotations

import csv
import json
from functools import partial

import numpy as np
import pytest
from curves import curve

from valveflow_ros.curve.characteristic_json import from_json, to_json
from valveflow_ros.curve.compensation import openings_seen

pq = pytest.importorskip('pyarrow.parquet')

# From 150 MW on.
KNOTS = [1060.0, 1250.0, 1600.0, 1900.0, 2280.0]
SLOPES = [0.24, 0.18, 0.09, 0.01]


@pytest.fixture
def model(model):
    """Return the writer of curves from 150 MW on."""
    return partial(model, 'characteristic.json', KNOTS, start=150.0)


def rows_of(path):
    with path.open(newline='') as file:
        return [{k: float(v) for k, v in row.items()} for row in csv.DictReader(file)]


def test_the_table_brings_back_the_power(run, model, tmp_path):
    table = tmp_path / 'table.csv'
    ran = run('compensate', '--model', model(), '-o', table, '--pressure', '16.7')
    assert ran.status == 0, ran.err
    rows = rows_of(table)
    assert len(rows) == 16
    power, u = (np.array([row[name] for row in rows]) for name in ('power_mw', 'u'))
    knots_mw = 150.0 + np.concatenate([[0.0], np.cumsum(np.diff(KNOTS) * SLOPES)])
    asked = np.linspace(knots_mw[0], knots_mw[-1], 500)
    got = np.interp(np.interp(asked, power, u), KNOTS, knots_mw)
    assert got == pytest.approx(asked, abs=2e-3)
    opening = np.array([row['opening_percent_at_16.7_mpa'] for row in rows])
    assert opening == pytest.approx(u / 16.7**1.125, abs=1e-5)
    assert [row['within_gain_limit'] for row in rows] == (u < 1900.0).astype(float).tolist()
    assert all(row['u_stderr'] > 0.0 for row in rows)
    assert 'Piece 4' in ran.err
    assert 'Checked: F(F^-1(x)) differs from x by at most' in ran.out
    assert 'Below 150.00 MW and above' in ran.out


def test_why_not_to_rely_on_a_curve_is_repeated(run, model, tmp_path):
    told = 'The unit changed within these data.'
    file = model(notes=(told,), reference_pressure_mpa=16.0)
    words = ['compensate', '--model', file, '-o', tmp_path / 'x.csv', '--overwrite', '--pressure']
    ran = run(*words, '17')
    assert ran.status == 0
    assert told in ran.err
    assert 'usual pressure' not in ran.err
    far = run(*words, '25')
    assert 'The usual pressure of the data was 16.0 MPa. At 25 MPa the table' in far.err


def test_programs_get_the_same_numbers(run, model, tmp_path):
    table = tmp_path / 'table.parquet'
    ran = run('compensate', '--model', model(), '-o', table, '--points', '7', '--json',
              '--pressure', '12', '--pressure', '16.7')  # fmt: skip
    columns = pq.read_table(table).to_pydict()
    assert ran.json['columns'] == columns
    assert list(columns) == [
        'power_mw',
        'u',
        'u_stderr',
        'gain_u_per_mw',
        'within_gain_limit',
        'opening_percent_at_12_mpa',
        'opening_percent_at_16.7_mpa',
    ]
    assert ran.json['checks']['passed'] is True
    assert ran.json['useful_mw'] == pytest.approx([150.0, 285.6])
    # 2280 at 12 MPa would be 139 %: the valve is fully open before the table ends.
    assert ran.json['full_opening_mw']['12'] == pytest.approx(
        np.interp(100.0 * 12.0**1.125, KNOTS, [150.0, 195.6, 258.6, 285.6, 289.4])
    )
    assert ran.json['full_opening_mw']['16.7'] is None
    assert ran.json['power_limits_mw'] == pytest.approx([150.0, 289.4])


def test_a_short_table_says_what_it_costs(run, model, tmp_path):
    table = tmp_path / 't.csv'
    for points, tolerance, enough in (('2', '0.01', 5), ('3', '0.01', 5), ('2', '8', 4)):
        said = run('compensate', '--model', model(), '-o', table, '--points', points,
                   '--tolerance', tolerance).refused()  # fmt: skip
        assert f'--points {enough} would do' in said
        assert not table.exists()
        # What is advised is enough, and one point less is not.
        run('compensate', '--model', model(), '-o', table, '--points', str(enough - 1),
            '--tolerance', tolerance).refused()  # fmt: skip
        ran = run('compensate', '--model', model(), '-o', table, '--points', str(enough),
                  '--tolerance', tolerance)  # fmt: skip
        assert ran.status == 0, ran.err
        table.unlink()
    none = run('compensate', '--model', model(), '-o', table, '--tolerance', '1e-9',
               '--u-to', '1300.123456').refused()  # fmt: skip
    assert 'from rounding' in none
    assert not table.exists()
    wide = run('compensate', '--model', model(), '-o', tmp_path / 't.csv', '--points', '3',
               '--tolerance', '50', '--overwrite', '--json')  # fmt: skip
    assert wide.json['checks']['passed'] is True
    assert wide.json['checks']['table_mw'] > 1.0
    assert '5 points would make the table exact' in wide.err


def test_full_opening_below_the_table_is_told(run, model, tmp_path):
    # 100 % at 3 MPa is u = 344, far below the first knot.
    words = ['compensate', '--model', model(), '--pressure', '3', '--pressure', '12']
    ran = run(*words, '-o', tmp_path / 't.csv')
    assert 'At 3 MPa no row of the table is reachable' in ran.out
    assert 'At 12 MPa the valve is fully open at' in ran.out
    data = run(*words, '-o', tmp_path / 't2.csv', '--json').json
    assert data['reachable_rows']['3'] == 0
    assert 0 < data['reachable_rows']['12'] < 16
    assert data['full_opening_mw']['3'] is None


def test_an_inverse_that_is_not_exact_is_not_written(run, model, tmp_path, monkeypatch):
    monkeypatch.setattr('valveflow_ros.curve.compensation._identity', lambda curve: 0.5)
    table = tmp_path / 't.csv'
    said = run('compensate', '--model', model(), '-o', table).refused()
    assert 'The inverse is not exact: F(F^-1(x)) differs from x by up to 0.5 MW' in said
    assert not table.exists()


def test_a_falling_piece_is_refused_and_can_be_left_out(run, model, tmp_path):
    path, table = model([0.24, 0.18, 0.09, -0.01]), tmp_path / 't.csv'
    said = run('compensate', '--model', path, '-o', table).refused()
    assert 'piece 4 (u 1900.0 to 2280.0) falls' in said
    assert not table.exists()
    ran = run('compensate', '--model', path, '-o', table, '--u-to', '1900')
    assert ran.status == 0, ran.err
    assert rows_of(table)[-1]['u'] == 1900.0


def test_a_gain_limit_of_ones_own(run, model, tmp_path):
    ran = run('compensate', '--model', model(), '-o', tmp_path / 't.csv', '--max-gain', '6',
              '--json')  # fmt: skip
    assert ran.json['useful_mw'] == pytest.approx([150.0, 258.6])
    none = run('compensate', '--model', model(), '-o', tmp_path / 't2.csv', '--max-gain', '1')
    assert 'Nowhere is the gain within its limit' in none.out


def test_what_is_no_curve_is_refused(run, model, tmp_path):
    table = tmp_path / 't.csv'
    bad = tmp_path / 'bad.json'
    content = json.loads(model().read_text())
    bad.write_text(json.dumps({**content, 'pieces': []}), encoding='utf-8')
    assert "'pieces' is empty" in run('compensate', '--model', bad, '-o', table).refused()
    assert 'must end in .csv' in run('compensate', '--model', model(), '-o', 'a.txt').refused()
    outside = run('compensate', '--model', model(), '-o', table, '--u-from', '3000')
    assert 'nothing of it lies between' in outside.refused()
    table.write_text('mine', encoding='utf-8')
    assert 'exists already' in run('compensate', '--model', model(), '-o', table).refused()
    assert table.read_text(encoding='utf-8') == 'mine'
    # The folder of a result stands for the curve in it.
    ran = run('compensate', '--model', model().parent, '-o', table, '--overwrite')
    assert ran.status == 0


def test_a_curve_that_depends_on_the_pressure_needs_one(run, tmp_path):
    """A file of another program states the form and no reference pressure."""
    file, path = tmp_path / 'characteristic.json', tmp_path / 'table.csv'
    c = curve(
        [20.0, 45.0, 100.0], [0.4, 0.25], start=5.0, axis='opening', pressure_exponent=0.0,
        pressure_scale_exponent=1.05, offset_mw=-9.0,
    )  # fmt: skip
    file.write_text(json.dumps(to_json(c)))
    refused = run('compensate', '--model', file, '-o', path).refused(status=2)
    assert 'give one, as in --pressure' in refused
    assert not path.exists()
    ran = run('compensate', '--model', file, '-o', path, '--json', '--pressure', '12')
    assert [ran.json[k] for k in ('axis', 'pressure_scale_exponent', 'offset_mw')] == [
        'opening', 1.05, -9.0,
    ]  # fmt: skip
    columns = ran.json['columns']
    power = c.power(columns['opening_percent_at_12_mpa'], 12.0)
    assert power == pytest.approx(columns['power_mw'], abs=0.01)


def test_knees_at_fixed_openings_are_a_table_for_each_pressure(run, tmp_path):
    file = tmp_path / 'characteristic.json'
    c = curve(
        [20.0, 45.0, 70.0, 100.0], [0.4, 0.25, 0.1], start=5.0, axis='opening',
        pressure_exponent=0.0, pressure_scale_exponent=1.05, offset_mw=-9.0,
        reference_pressure_mpa=13.0,
    )  # fmt: skip
    file.write_text(json.dumps(to_json(c)))
    both = tmp_path / 'both.csv'
    words = ['compensate', '--model', file, '-o', both, '--pressure', '10', '--pressure', '16']
    assert run(*words).status == 0
    rows = rows_of(both)
    assert {r['pressure_mpa'] for r in rows} == {10.0, 16.0}
    for row in rows:
        found = c.power(np.array([row['opening_percent']]), row['pressure_mpa'])
        assert found[0] == pytest.approx(row['power_mw'], abs=0.02)
    assert len(run(*words, '--overwrite', '--json').json['tables']) == 2
    for pressure, given in ((13.0, []), (10.0, ['--pressure', '10'])):
        path = tmp_path / f'{pressure:g}.csv'
        assert run('compensate', '--model', file, '-o', path, *given).status == 0
        head, *rows = path.read_text().splitlines()
        at = head.split(',').index(f'opening_percent_at_{pressure:g}_mpa')
        table = np.array([[float(x) if x else np.nan for x in r.split(',')] for r in rows])
        assert c.power(table[:, at], pressure) == pytest.approx(table[:, 0], abs=0.02)


def test_openings_that_were_not_seen_at_a_pressure_are_marked(run, model, tmp_path):
    opening, pressure = np.random.default_rng(1).uniform(
        [[40.0], [9.0]], [[60.0], [11.0]], (2, 900)
    )
    opening[pressure > 10.0] += 20.0
    seen = openings_seen(np.append(opening, np.nan), np.append(pressure, 30.0))
    assert sum(band.samples for band in seen) >= 890
    file, table = model(openings_seen=seen), tmp_path / 'x.csv'
    asked = [word for p in ('9.5', '10.5', '20') for word in ('--pressure', p)]
    ran = run('compensate', '--model', file, '-o', table, *asked)
    assert ran.status == 0, ran.err
    rows = rows_of(table)
    for p, low, high in ((9.5, 40.0, 60.0), (10.5, 60.0, 80.0)):
        for row in rows:
            there = low < row[f'opening_percent_at_{p:g}_mpa'] < high
            assert row[f'seen_at_{p:g}_mpa'] == there
    assert not any(row['seen_at_20_mpa'] for row in rows)
    assert 'At about 9.5 MPa identify saw the unit from 40.' in ran.err
    assert 'At about 20 MPa identify saw the unit at no opening: 16 rows' in ran.err
    assert from_json(json.loads(file.read_text())).openings_seen == seen
