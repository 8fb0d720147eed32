# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow diagnose``: from a log to verdict, extended model and report."""

from __future__ import annotations

import contextlib
import io
import json

import pytest
from streams import needs_jit

from valveflow_ros.cli.main import main
from valveflow_ros.diagnosis.result import model_from_json

pytestmark = needs_jit


@pytest.fixture(scope='module')
def diagnosed(tmp_path_factory):
    """Diagnose a day with a spiky power record; return the folder, with what was printed."""
    folder = tmp_path_factory.mktemp('diagnosed')
    log = str(folder / 'plant.parquet')
    words = ['simulate', '-o', log, '--days', '1.3', '--seed', '2', '--quiet']
    assert main([*words, '--effect', 'spikes:height=60,per_day=60']) == 0
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert main(['diagnose', log, '-o', str(folder / 'out'), '--quiet']) == 0
    (folder / 'printed').write_text(printed.getvalue())
    return folder


def test_the_answer_says_what_to_do(diagnosed):
    content = json.loads((diagnosed / 'out' / 'diagnosis.json').read_text())
    (cause,) = content['causes']
    first, second = (diagnosed / 'printed').read_text().splitlines()[:2]
    assert first == f'plant.parquet: cause found. {content["sentence"]}'
    assert cause['to_do']
    assert second == f'spikes. What to do: {cause["to_do"]}'


def test_the_json_is_the_contract(diagnosed):
    content = json.loads((diagnosed / 'out' / 'diagnosis.json').read_text())
    assert content['format'] == 'valveflow/diagnosis'
    assert content['version'] == 1
    assert content['verdict'] == 'named'
    assert [c['name'] for c in content['causes']] == ['spikes']
    for cause in content['causes']:
        assert set(cause) >= {'name', 'sentence', 'parameters', 'gain'}
        assert set(cause['gain']) == {'rmse_before', 'rmse_after', 'reduction', 'p_value'}
        for value in cause['parameters'].values():
            assert set(value) == {'value', 'low', 'high', 'unit'}
    assert content['disturbance'] is None
    assert {'name', 'reason'} <= set(content['rejected'][0])
    assert content['rmse_noise_floor'] <= content['rmse_extended'] <= content['rmse_simulation']


def test_the_extended_model_can_be_read(diagnosed):
    raw = json.loads((diagnosed / 'out' / 'extended_model.json').read_text())
    assert raw['written_by'] == 'diagnose'
    given = model_from_json(raw)
    model, exponent = given.model, given.pressure_exponent
    assert model.base.pieces >= 2
    assert exponent == 1.125


def test_the_page_tells_four_steps(diagnosed):
    page = (diagnosed / 'out' / 'report.html').read_text()
    for step in (
        '1. What is wrong',
        '2. Why',
        '3. The extended model',
        '4. Check on held-out data',
    ):
        assert step in page
    assert 'single outliers' in page
    assert 'time (UTC)' in page
    assert 'days after' not in page


@pytest.mark.parametrize(
    ('said', 'sentence'),
    [
        (['vacuum'], "--covariate 'vacuum' is not of the form NAME=COLUMN"),
        (['=x'], "--covariate '=x' is not of the form"),
        (['a=x', 'a=y'], '--covariate a is given twice'),
        (['vacuum=nowhere'], "--covariate vacuum: plant.parquet has no column or topic 'nowhere'"),
    ],
)
@pytest.mark.parametrize('verb', ['diagnose', 'monitor'])
def test_a_covariate_that_cannot_be_read_is_refused(diagnosed, capsys, said, sentence, verb):
    words = [word for one in said for word in ('--covariate', one)]
    log, out = str(diagnosed / 'plant.parquet'), str(diagnosed / 'refused')
    assert main([verb, log, '-o', out, '--quiet', *words]) != 0
    assert sentence in capsys.readouterr().err
