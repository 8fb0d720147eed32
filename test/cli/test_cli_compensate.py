# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow compensate``: the table, its checks, and what is refused."""

import csv
import json
from functools import partial

import numpy as np
import pytest
from curves import curve

from valveflow_ros.curve.characteristic_json import to_json
from valveflow_ros.curve.compensation import openings_seen

pq = pytest.importorskip('pyarrow.parquet')

# From 150 MW on.
KNOTS = [1060.0, 1250.0, 1600.0, 1900.0, 2280.0]
SLOPES = [0.24, 0.18, 0.09, 0.01]
POWERS = [150.0, 195.6, 258.6, 285.6, 289.4]
FIXED = {'axis': 'opening', 'pressure_exponent': 0.0, 'pressure_scale_exponent': 1.05,
         'offset_mw': -9.0}  # fmt: skip


@pytest.fixture
def compensate(run, tmp_path):
    """Return the verb on a model, writing t.csv anew."""

    def call(model, *words, output='t.csv'):
        return run('compensate', '--model', model, '-o', tmp_path / output, '--overwrite', *words)

    return call


@pytest.fixture
def model(model):
    """Return the writer of curves from 150 MW on."""
    return partial(model, 'characteristic.json', KNOTS, start=150.0)


@pytest.fixture
def at_opening(tmp_path):
    """Return a curve with knees at fixed openings, and its file."""

    def write(**more):
        c = curve([20.0, 45.0, 70.0, 100.0], [0.4, 0.25, 0.1], start=5.0, **FIXED, **more)
        (tmp_path / 'fixed.json').write_text(json.dumps(to_json(c)))
        return c, tmp_path / 'fixed.json'

    return write


def rows_of(path):
    with path.open(newline='') as file:
        return [{k: float(v) for k, v in row.items()} for row in csv.DictReader(file)]


def test_the_table_brings_back_the_power(compensate, model, tmp_path):
    ran = compensate(model(), '--pressure', '16.7').done()
    rows = rows_of(tmp_path / 't.csv')
    assert len(rows) == 16
    power, u = (np.array([row[name] for row in rows]) for name in ('power_mw', 'u'))
    asked = np.linspace(POWERS[0], POWERS[-1], 500)
    got = np.interp(np.interp(asked, power, u), KNOTS, POWERS)
    assert got == pytest.approx(asked, abs=2e-3)
    opening = np.array([row['opening_percent_at_16.7_mpa'] for row in rows])
    assert opening == pytest.approx(u / 16.7**1.125, abs=1e-5)
    assert [row['within_gain_limit'] for row in rows] == (u < 1900.0).astype(float).tolist()
    assert all(row['u_stderr'] > 0.0 for row in rows)
    assert 'Piece 4' in ran.err
    assert 'Checked: F(F^-1(x)) differs from x by at most' in ran.out
    assert 'Below 150.00 MW and above' in ran.out


def test_why_not_to_rely_on_a_curve_is_repeated(compensate, model):
    told = 'The unit changed within these data.'
    file = model(notes=(told,), reference_pressure_mpa=16.0)
    ran = compensate(file, '--pressure', '17')
    assert told in ran.err
    assert 'usual pressure' not in ran.err
    far = compensate(file, '--pressure', '25')
    assert 'The usual pressure of the data was 16.0 MPa. At 25 MPa the table' in far.err


def test_programs_get_the_same_numbers(compensate, model, tmp_path):
    words = ['--points', '7', '--json', '--pressure', '12', '--pressure', '16.7']
    data = compensate(model(), *words, output='t.parquet').json
    assert data['columns'] == pq.read_table(tmp_path / 't.parquet').to_pydict()
    assert list(data['columns']) == [
        'power_mw', 'u', 'u_stderr', 'gain_u_per_mw', 'within_gain_limit',
        'opening_percent_at_12_mpa', 'opening_percent_at_16.7_mpa',
    ]  # fmt: skip
    assert data['checks']['passed'] is True
    assert data['useful_mw'] == pytest.approx([150.0, 285.6])
    # 2280 at 12 MPa would be 139 %: the valve is fully open before the table ends.
    full = np.interp(100.0 * 12.0**1.125, KNOTS, POWERS)
    assert data['full_opening_mw'] == {'12': pytest.approx(full), '16.7': None}
    assert data['power_limits_mw'] == pytest.approx([150.0, 289.4])


def test_a_short_table_says_what_it_costs(compensate, model, tmp_path):
    table = tmp_path / 't.csv'
    for points, tolerance, enough in (('3', '0.01', 5), ('2', '8', 4)):
        words = ['--tolerance', tolerance, '--points']
        assert f'--points {enough} would do' in compensate(model(), *words, points).refused()
        # What is advised is enough, and one point less is not.
        compensate(model(), *words, enough - 1).refused()
        assert not table.exists()
        assert compensate(model(), *words, enough).status == 0
        table.unlink()
    none = compensate(model(), '--tolerance', '1e-9', '--u-to', '1300.123456').refused()
    assert 'from rounding' in none
    wide = compensate(model(), '--points', '3', '--tolerance', '50', '--json')
    assert wide.json['checks']['table_mw'] > 1.0
    assert '5 points would make the table exact' in wide.err


def test_full_opening_below_the_table_is_told(compensate, model):
    # 100 % at 3 MPa is u = 344, far below the first knot.
    words = ['--pressure', '3', '--pressure', '12']
    ran = compensate(model(), *words)
    assert 'At 3 MPa no row of the table is reachable' in ran.out
    assert 'At 12 MPa the valve is fully open at' in ran.out
    data = compensate(model(), *words, '--json').json
    assert data['reachable_rows']['3'] == 0
    assert 0 < data['reachable_rows']['12'] < 16
    assert data['full_opening_mw']['3'] is None


def test_what_is_no_curve_or_has_no_inverse_is_refused(compensate, model, tmp_path, monkeypatch):
    bad = tmp_path / 'bad.json'
    bad.write_text(json.dumps({**json.loads(model().read_text()), 'pieces': []}))
    assert "'pieces' is empty" in compensate(bad).refused()
    outside = compensate(model(), '--u-from', '3000')
    assert 'nothing of it lies between' in outside.refused()
    falling = model([0.24, 0.18, 0.09, -0.01])
    assert 'piece 4 (u 1900.0 to 2280.0) falls' in compensate(falling).refused()
    assert not (tmp_path / 't.csv').exists()
    # The rest of it can be used.
    assert compensate(falling, '--u-to', '1900').status == 0
    assert rows_of(tmp_path / 't.csv')[-1]['u'] == 1900.0
    # The folder of a result stands for the curve in it.
    assert compensate(model().parent).status == 0
    monkeypatch.setattr('valveflow_ros.curve.compensation._identity', lambda curve: 0.5)
    said = compensate(model()).refused()
    assert 'The inverse is not exact: F(F^-1(x)) differs from x by up to 0.5 MW' in said


def test_a_curve_that_depends_on_the_pressure_needs_one(compensate, at_opening):
    """A file of another program states the form and no reference pressure."""
    c, file = at_opening()
    assert 'give one, as in --pressure' in compensate(file).refused(status=2)
    data = compensate(file, '--json', '--pressure', '12').json
    assert {name: data[name] for name in FIXED} == FIXED
    power = c.power(data['columns']['opening_percent_at_12_mpa'], 12.0)
    assert power == pytest.approx(data['columns']['power_mw'], abs=0.01)


def test_knees_at_fixed_openings_are_a_table_for_each_pressure(compensate, at_opening, tmp_path):
    c, file = at_opening(reference_pressure_mpa=13.0)
    words = ['--pressure', '10', '--pressure', '16']
    assert compensate(file, *words).status == 0
    rows = rows_of(tmp_path / 't.csv')
    assert {r['pressure_mpa'] for r in rows} == {10.0, 16.0}
    for row in rows:
        found = c.power(np.array([row['opening_percent']]), row['pressure_mpa'])
        assert found[0] == pytest.approx(row['power_mw'], abs=0.02)
    assert len(compensate(file, *words, '--json').json['tables']) == 2
    # Without a pressure the table is that of the reference.
    columns = compensate(file, '--json').json['columns']
    power = c.power(columns['opening_percent_at_13_mpa'], 13.0)
    assert power == pytest.approx(columns['power_mw'], abs=0.02)


def test_openings_that_were_not_seen_at_a_pressure_are_marked(compensate, model, tmp_path):
    opening, pressure = np.random.default_rng(1).uniform(
        [[40.0], [9.0]], [[60.0], [11.0]], (2, 900)
    )
    opening[pressure > 10.0] += 20.0
    seen = openings_seen(np.append(opening, np.nan), np.append(pressure, 30.0))
    ran = compensate(
        model(openings_seen=seen), *(f'--pressure={p}' for p in ('9.5', '10.5', '20'))
    ).done()
    rows = rows_of(tmp_path / 't.csv')
    for p, low, high in ((9.5, 40.0, 60.0), (10.5, 60.0, 80.0)):
        for row in rows:
            there = low < row[f'opening_percent_at_{p:g}_mpa'] < high
            assert row[f'seen_at_{p:g}_mpa'] == there
    assert not any(row['seen_at_20_mpa'] for row in rows)
    assert 'At about 9.5 MPa identify saw the unit from 40.' in ran.err
    assert 'At about 20 MPa identify saw the unit at no opening: 16 rows' in ran.err
