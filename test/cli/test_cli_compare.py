# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow compare``: three methods on one log, judged on another."""

from __future__ import annotations

import csv
import io
import json
import re

import numpy as np
import pytest
from streams import needs_jit

pytestmark = needs_jit


@pytest.fixture(scope='module')
def truth(tmp_path_factory):
    """Return the truth of the simulated plant, which is the same for every seed."""
    from valveflow_ros.cli.main import main

    folder = tmp_path_factory.mktemp('truth')
    words = ['simulate', '-o', folder / 'short.csv', '--days', '0.01', '--truth',
             folder / 'truth.json', '--quiet']  # fmt: skip
    assert main([str(w) for w in words]) == 0
    return folder / 'truth.json'


@pytest.fixture(scope='module')
def held_out(logs, truth, tmp_path_factory):
    """Compare once for all tests that look at the result."""
    import contextlib

    from valveflow_ros.cli.main import main

    folder = tmp_path_factory.mktemp('compared') / 'out'
    out, err = io.StringIO(), io.StringIO()
    words = ['compare', str(logs / 'plant.mcap'), '-o', str(folder), '--truth', str(truth),
             '--table']  # fmt: skip
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = main(words)
    assert status == 0, err.getvalue()
    return out.getvalue(), err.getvalue(), folder


def rows_of(path):
    with path.open(newline='') as file:
        return list(csv.DictReader(file))


def test_the_files_hold_the_comparison(held_out):
    _, err, folder = held_out
    assert '\r' not in err, 'a progress bar is for terminals'
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


def test_each_total_is_the_mean_of_its_segments(held_out):
    _, _, folder = held_out
    content = json.loads((folder / 'comparison.json').read_text())
    segments = rows_of(folder / 'segments.csv')
    weights = [int(s['samples']) for s in segments]
    for name, total in content['totals'].items():
        mse = [float(s[f'{name}.mse_mw2']) for s in segments]
        assert total['mse_mw2'] == pytest.approx(np.average(mse, weights=weights))


def test_curves_and_parameters_agree_with_each_other_and_the_truth(held_out, truth):
    _, _, folder = held_out
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
    out, _, folder = held_out
    content = json.loads((folder / 'comparison.json').read_text())
    page = (folder / 'report.html').read_text()
    told = {'confirmed': 'that comes out', 'contradicted': 'contradicts it', 'open': 'neither'}
    assert 'On data that no method had seen, valveflow' in content['words'][1]
    assert told[content['finding']] in ' '.join(content['words'])
    for sentence in content['words']:
        assert sentence in out
        assert sentence.split('.')[0].replace("'", '&#x27;') in page
    assert 'last third' in out
    assert re.search(r'\bnan\b', out) is None
    better = [p['ours_is'] for p in content['pairs'] if p['terms'] == 'as the paper']
    expected = (
        'contradicted'
        if 'worse' in better
        else 'confirmed'
        if set(better) == {'better'}
        else 'open'
    )
    assert content['finding'] == expected
    errors = {m: e['rmse_mw'] for m, e in content['errors_against_truth'].items()}
    (against_truth,) = (w for w in content['words'] if 'true curve' in w)
    nearer = [errors[b] <= errors['paper'] for b in ('hammerstein', 'sparse')]
    told = {0: 'that comes out', 1: 'is further from it, and', 2: 'both are nearer'}
    assert told[sum(nearer)] in against_truth
    names = {'paper': "paper's curve", 'proposed': 'valveflow', 'hammerstein': 'Hammerstein',
             'sparse': 'sparse'}  # fmt: skip
    best = min(errors, key=errors.__getitem__)
    assert names[best] in against_truth.split('The nearest is ')[1].split('.')[0]


def test_other_days_and_json(run, logs, tmp_path):
    """The same log is no other day, but takes the same way; and shows that learnt data flatter."""
    quick = ['--set', 'refine=false', '--set', 'selection_rule=paper']
    ran = run('compare', logs / 'plant.csv', '-o', tmp_path / 'a', '--test', logs / 'plant.csv',
              '--json', *quick)  # fmt: skip
    assert ran.status == 0, ran.err
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
