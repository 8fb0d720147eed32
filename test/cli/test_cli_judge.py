# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow diagnose``, ``compare`` and ``validate``: curves held against data."""

import csv
import json
import re

import numpy as np
import pytest
from streams import needs_jit

from valveflow_ros.diagnosis.result import model_from_json

pytestmark = needs_jit


@pytest.fixture(scope='module')
def diagnosed(run, tmp_path_factory):
    """Diagnose a day with a spiky power record; return what was printed, and the folder."""
    folder = tmp_path_factory.mktemp('diagnosed')
    log, spikes = folder / 'plant.parquet', 'spikes:height=60,per_day=60'
    run('simulate', '-o', log, '--days', '1.3', '--seed', '2', '--effect', spikes)
    ran = run('diagnose', log, '-o', folder / 'out', '--quiet').done()
    return ran.out, folder / 'out'


def test_the_json_of_a_diagnosis_is_the_contract_and_the_words_say_what_to_do(diagnosed):
    printed, folder = diagnosed
    content = json.loads((folder / 'diagnosis.json').read_text())
    assert (content['format'], content['version']) == ('valveflow/diagnosis', 1)
    assert content['verdict'] == 'named'
    (cause,) = content['causes']
    assert cause['name'] == 'spikes'
    assert set(cause) >= {'name', 'sentence', 'parameters', 'gain'}
    assert set(cause['gain']) == {'rmse_before', 'rmse_after', 'reduction', 'p_value'}
    for value in cause['parameters'].values():
        assert set(value) == {'value', 'low', 'high', 'unit'}
    assert content['disturbance'] is None
    assert {'name', 'reason'} <= set(content['rejected'][0])
    assert content['rmse_noise_floor'] <= content['rmse_extended'] <= content['rmse_simulation']
    assert cause['to_do']
    assert printed.splitlines()[:2] == [
        f'plant.parquet: cause found. {content["sentence"]}',
        f'spikes. What to do: {cause["to_do"]}',
    ]
    raw = json.loads((folder / 'extended_model.json').read_text())
    assert raw['written_by'] == 'diagnose'
    model = model_from_json(raw)
    assert model.model.base.pieces >= 2
    assert model.pressure_exponent == 1.125
    page = (folder / 'report.html').read_text()
    for part in ('1. What is wrong', '2. Why', '3. The extended model',
                 '4. Check on held-out data', 'single outliers', 'time (UTC)'):  # fmt: skip
        assert part in page
    assert 'days after' not in page


@pytest.mark.parametrize('verb', ['diagnose', 'monitor'])
def test_a_covariate_that_cannot_be_read_is_refused(run, logs, tmp_path, verb):
    for said, sentence in (
        (['=x'], "--covariate '=x' is not of the form NAME=COLUMN"),
        (['a=x', 'a=y'], '--covariate a is given twice'),
        (['vacuum=nowhere'], "--covariate vacuum: plant.csv has no column or topic 'nowhere'"),
    ):
        words = [word for one in said for word in ('--covariate', one)]
        ran = run(verb, logs / 'plant.csv', '-o', tmp_path, '--quiet', *words)
        assert ran.status != 0
        assert sentence in ran.err


@pytest.fixture(scope='module')
def truth(run, tmp_path_factory):
    """Return the truth of the simulated plant, which is the same for every seed."""
    folder = tmp_path_factory.mktemp('truth')
    run('simulate', '-o', folder / 'a.csv', '--days', '0.01', '--truth', folder / 'truth.json')
    return folder / 'truth.json'


@pytest.fixture(scope='module')
def held_out(run, logs, truth, tmp_path_factory):
    """Compare once for all tests that look at the result."""
    folder = tmp_path_factory.mktemp('compared') / 'out'
    words = ['compare', logs / 'plant.mcap', '-o', folder, '--truth', truth, '--table']
    ran = run(*words).done()
    return ran, folder


def rows_of(path):
    with path.open(newline='') as file:
        return list(csv.DictReader(file))


def test_the_files_hold_the_comparison(held_out):
    _, folder = held_out
    assert sorted(p.name for p in folder.iterdir()) == [
        'comparison.json', 'curves.csv', 'parameters.csv', 'report.html', 'segments.csv', 'tables',
    ]  # fmt: skip
    page = (folder / 'report.html').read_text()
    for title in ('Table II', 'Table III', 'Table IV', 'How the other two were tuned'):
        assert title in page
    assert 'NaN' not in page.split('<script id="figures"')[1].split('</script>')[0]
    tables = {p.stem for p in (folder / 'tables').iterdir()}
    assert {'curves', 'truth', 'choice'} <= tables
    assert tables == set(re.findall(r'class="plot" id="([a-z-]+)"', page))
    drawn = rows_of(folder / 'tables' / 'curves.csv')
    assert {'truth', 'valveflow', 'Hammerstein'} <= {r['line'] for r in drawn}
    content = json.loads((folder / 'comparison.json').read_text())
    assert (content['format'], content['version']) == ('valveflow/comparison', 1)
    assert content['held_out'] is True
    assert content['finding'] in ('confirmed', 'contradicted', 'open')
    assert set(content['methods']) == {'paper', 'proposed', 'hammerstein', 'sparse'}
    assert set(content['errors_against_truth']) == set(content['methods'])
    assert len(content['segments']) == content['judged']['segments'] > 0
    # Each total is the mean of its segments.
    segments = rows_of(folder / 'segments.csv')
    weights = [int(s['samples']) for s in segments]
    for name, total in content['totals'].items():
        mse = [float(s[f'{name}.mse_mw2']) for s in segments]
        assert total['mse_mw2'] == pytest.approx(np.average(mse, weights=weights))


def test_curves_and_parameters_agree_with_each_other_and_the_truth(held_out):
    _, folder = held_out
    content = json.loads((folder / 'comparison.json').read_text())
    curves = rows_of(folder / 'curves.csv')
    u = np.array([float(r['u']) for r in curves])
    for method in ('proposed', 'hammerstein'):
        pieces = [r for r in rows_of(folder / 'parameters.csv') if r['method'] == method]
        inner = [float(p['u_to']) for p in pieces[:-1]]
        k = np.searchsorted(inner, u, side='right')
        made = np.array([float(pieces[i]['slope']) for i in k]) * u + np.array(
            [float(pieces[i]['intercept']) for i in k]
        )
        found = np.array([float(r[method]) for r in curves])
        np.testing.assert_allclose(found, made, atol=1e-6)
        true = np.array([float(r['truth']) for r in curves])
        off = float(np.sqrt(np.mean((found - true) ** 2)))
        assert content['errors_against_truth'][method]['rmse_mw'] == pytest.approx(off, rel=0.02)
    # Ten hours of the paper's plant: every method is somewhere near it.
    for method, error in content['errors_against_truth'].items():
        assert error['rmse_mw'] < (12.0 if method == 'paper' else 5.0), method


def test_words_say_what_the_numbers_say(held_out):
    ran, folder = held_out
    content = json.loads((folder / 'comparison.json').read_text())
    page = (folder / 'report.html').read_text()
    told = {'confirmed': 'that comes out', 'contradicted': 'contradicts it', 'open': 'neither'}
    assert 'On data that no method had seen, valveflow' in content['words'][1]
    assert told[content['finding']] in ' '.join(content['words'])
    for sentence in content['words']:
        assert sentence in ran.out
        assert sentence.split('.')[0].replace("'", '&#x27;') in page
    assert 'last third' in ran.out
    assert re.search(r'\bnan\b', ran.out) is None
    errors = {m: e['rmse_mw'] for m, e in content['errors_against_truth'].items()}
    (against_truth,) = (w for w in content['words'] if 'true curve' in w)
    names = {'paper': "paper's curve", 'proposed': 'valveflow', 'hammerstein': 'Hammerstein',
             'sparse': 'sparse'}  # fmt: skip
    best = min(errors, key=errors.__getitem__)
    assert names[best] in against_truth.split('The nearest is ')[1].split('.')[0]


def test_other_days_and_json(run, logs, tmp_path):
    """The same log is no other day, but takes the same way; and shows that learnt data flatter."""
    quick = ['--set', 'refine=false', '--set', 'selection_rule=paper']
    ran = run('compare', logs / 'plant.csv', '-o', tmp_path / 'a', '--test', logs / 'plant.csv',
              '--json', *quick).done()  # fmt: skip
    content = ran.json
    assert content['held_out'] is False
    assert 'segments' not in content
    assert content['errors_against_truth'] is None
    # Not refined: there are no dynamics to simulate with.
    assert content['methods']['proposed']['dynamics'] == []
    assert 'proposed.dynamic' not in content['totals']
    assert {p['terms'] for p in content['pairs']} == {
        'as the paper', 'curve against curve, steady-state segments',
    }  # fmt: skip
    assert content['files']['comparison.json'] == str(tmp_path / 'a' / 'comparison.json')
    head = (tmp_path / 'a' / 'curves.csv').read_text().splitlines()[0]
    assert head == 'u,paper,proposed,hammerstein,sparse'


def test_too_short_a_log_names_the_part_that_is(run, tmp_path):
    assert run('simulate', '-o', tmp_path / 'a.csv', '--days', '0.06').status == 0
    said = run('compare', tmp_path / 'a.csv', '-o', tmp_path / 'o').refused()
    assert 'third' in said
    assert not (tmp_path / 'o').exists()


def test_the_true_curve_holds_on_its_plant(run, logs, model, tmp_path):
    ran = run(
        'validate', logs / 'plant.mcap', '--model', model(), '-o', tmp_path / 'out',
        '--tolerance', '3', '--table',
    ).done()  # fmt: skip
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


def test_a_curve_that_is_too_short_is_flagged(run, logs, model, tmp_path):
    knots = (1000.0, 1100.0, 1200.0, 1300.0, 1500.0)
    ran = run(
        'validate', logs / 'plant.csv', '--model', model(knots=knots), '-o', tmp_path / 'o'
    ).done()
    content = json.loads((tmp_path / 'o' / 'validation.json').read_text())
    assert 0.05 < content['outside_share'] < 1.0
    assert 'Warning: ' in ran.err
    assert 'beyond the ends' in ran.err
    assert 'class="notice"' in (tmp_path / 'o' / 'report.html').read_text()


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


def test_days_without_segments_are_refused_with_what_would_help(run, model, tmp_path):
    assert run('simulate', '-o', tmp_path / 'a.csv', '--days', '0.02').status == 0
    said = run('validate', tmp_path / 'a.csv', '--model', model(), '-o', tmp_path / 'o').refused()
    assert said.startswith('valveflow: a.csv: ')
    assert 'No steady-state or slope-response segment' in said
