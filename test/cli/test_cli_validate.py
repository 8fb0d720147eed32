# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow validate``: a characteristic held against a log."""

from __future__ import annotations

import csv
import json
import re

import pytest
from streams import needs_jit

pytestmark = needs_jit


def test_the_true_curve_holds_on_its_plant(run, logs, model, tmp_path):
    ran = run(
        'validate', logs / 'plant.mcap', '--model', model(), '-o', tmp_path / 'out',
        '--tolerance', '3', '--table',
    )  # fmt: skip
    assert ran.status == 0, ran.err
    content = json.loads((tmp_path / 'out' / 'validation.json').read_text())
    assert (content['format'], content['version']) == ('valveflow/validation', 1)
    # Ten hours hold few segments a piece, so that some may stay open; none may be off.
    assert content['verdict'] in ('holds', 'open')
    assert content['judged_by'] == 'simulated'
    low, high = content['overall']['interval_mw']
    assert low < 0.7
    assert high > -0.7
    # 2 MW slow and 2.2 MW white noise are 8.8 MW^2.
    assert 5.0 < content['totals']['simulated']['mse_mw2'] < 14.0
    assert sorted(p.name for p in (tmp_path / 'out').iterdir()) == [
        'report.html', 'segments.csv', 'tables', 'validation.json',
    ]  # fmt: skip
    assert f'Wrote tables in {tmp_path / "out" / "tables"}.' in ran.out
    with (tmp_path / 'out' / 'tables' / 'by-input.csv').open(newline='') as file:
        points = [r for r in csv.DictReader(file) if r['line'] != 'mean of each piece']
    assert len(points) == content['judged']['segments']
    with (tmp_path / 'out' / 'segments.csv').open(newline='') as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == content['judged']['segments']
    page = (tmp_path / 'out' / 'report.html').read_text()
    assert re.search(r'[0-9] MW', content['words'][0].split('; ')[0])
    for sentence in content['words']:
        assert sentence in ran.out
        assert sentence.split('.')[0].replace("'", '&#x27;') in page
    assert re.search(r'\bnan\b', ran.out) is None
    assert '\r' not in ran.err


def test_a_wrong_curve_is_off_and_the_right_one_better(run, logs, model, tmp_path):
    shifted = model('shifted.json', model_id='shift6')
    content = json.loads(shifted.read_text())
    for piece in content['pieces']:
        piece['intercept'] += 6.0
    shifted.write_text(json.dumps(content))
    ran = run(
        'validate', logs / 'plant.csv', '--model', shifted, '-o', tmp_path / 'out',
        '--against', model('true.json', model_id='shift0'), '--json',
    )  # fmt: skip
    content = ran.json
    assert content['verdict'] == 'off'
    assert content['overall']['mean_difference_mw']['mean'] == pytest.approx(-6.0, abs=1.0)
    assert content['gain_over_against_mw2']['mean'] == pytest.approx(-36.0, abs=12.0)
    assert 'true.json is better' in ' '.join(content['words'])
    assert (content['model_id'], content['against_model_id']) == ('shift6', 'shift0')
    assert 'segments' not in content


def test_a_curve_that_is_too_short_is_flagged(run, logs, model, tmp_path):
    knots = (1000.0, 1100.0, 1200.0, 1300.0, 1500.0)
    ran = run('validate', logs / 'plant.csv', '--model', model(knots=knots), '-o', tmp_path / 'o')
    assert ran.status == 0, ran.err
    content = json.loads((tmp_path / 'o' / 'validation.json').read_text())
    assert 0.05 < content['outside_share'] < 1.0
    assert 'Warning: ' in ran.err
    assert 'beyond the ends' in ran.err
    assert 'class="notice"' in (tmp_path / 'o' / 'report.html').read_text()


def test_a_curve_for_other_inputs_is_refused_with_both_ranges(run, logs, model, tmp_path):
    knots = (5000.0, 5100.0, 5200.0, 5300.0, 5500.0)
    said = run(
        'validate', logs / 'plant.csv', '--model', model(knots=knots), '-o', tmp_path / 'o'
    ).refused()
    assert 'beyond what the curve is known for' in said
    assert not (tmp_path / 'o').exists()


def test_the_exponent_is_the_models(run, logs, model, tmp_path):
    path = model(pressure_exponent=1.0)
    said = run(
        'validate', logs / 'plant.csv', '--model', path, '-o', tmp_path / 'o',
        '--set', 'pressure_exponent=1.125',
    ).refused(status=2)  # fmt: skip
    assert 'V p^1,' in said
    assert 'the model decides' in said
    said = run(
        'validate', logs / 'plant.csv', '--model', path, '-o', tmp_path / 'o',
        '--against', model('other.json', knots=(100.0, 120.0, 140.0, 160.0, 3000.0)),
    )  # fmt: skip
    assert said.status == 0, 'each curve gets the input that it is a function of'


def test_a_log_without_segments_is_refused_with_what_would_help(run, model, tmp_path):
    assert run('simulate', '-o', tmp_path / 'a.csv', '--days', '0.02').status == 0
    said = run('validate', tmp_path / 'a.csv', '--model', model(), '-o', tmp_path / 'o').refused()
    assert said.startswith('valveflow: a.csv: ')
    assert 'No steady-state or slope-response segment' in said
