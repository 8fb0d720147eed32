# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The verbs with an extended model: identify, validate and diagnose on top of it."""

from __future__ import annotations

import json

import pytest
from extended_file import extended_json, write_extended
from streams import needs_jit

from valveflow_ros.cli.main import main

pytestmark = needs_jit
HELD = {'output_offset_drift': {'b_mw': 8.0}, 'backlash': {'w_percent': 0.1}}


@pytest.fixture(scope='module')
def identified(logs, tmp_path_factory):
    """Identify one log with two causes held, and without."""
    folder = tmp_path_factory.mktemp('extended')
    model = write_extended(folder / 'model.json', **HELD)
    log = str(logs / 'plant.parquet')
    assert main(['identify', log, '-o', str(folder / 'held'), '--model', str(model)]) == 0
    quick = ['--set', 'refine=false', '--set', 'selection_rule=paper']
    assert main(['identify', log, '-o', str(folder / 'plain'), *quick]) == 0
    return folder


def test_the_result_says_what_was_held(identified):
    held, plain = (
        json.loads((identified / n / 'characteristic.json').read_text()) for n in ('held', 'plain')
    )
    assert [(h['name'], h['values']) for h in held['held']] == list(HELD.items())
    assert 'zero of the power meter' in held['held'][0]['sentence']
    assert 'held' not in plain
    assert not (identified / 'plain' / 'extended_model.json').exists()
    page = (identified / 'held' / 'report.html').read_text()
    assert 'output_offset_drift (b_mw = 8)' in page
    assert (
        'The effect of these known causes was removed'
        not in (identified / 'plain' / 'report.html').read_text()
    )


def test_the_extended_model_gets_the_new_curve(identified):
    curve = json.loads((identified / 'held' / 'characteristic.json').read_text())
    extended = json.loads((identified / 'held' / 'extended_model.json').read_text())
    assert extended['curve']['knots'][1:] == [p['u_to'] for p in curve['pieces']]
    assert extended['written_by'] == 'identify'
    given = extended_json(**HELD)
    for key in ('causes', 'reference', 'start_ns', 'pressure_exponent'):
        assert extended[key] == given[key]


def test_the_summary_says_it_too(run, logs, identified, tmp_path):
    how = '--set', f'model_file={identified / "model.json"}', '--set', 'refine=false'
    ran = run(
        'identify', logs / 'plant.parquet', '-o', tmp_path / 'o', *how, '--set',
        'selection_rule=paper',
    )  # fmt: skip
    assert 'The effect of these known causes was removed from the data first' in ran.out
    assert 'backlash (w_percent = 0.1)' in ran.out


def test_validate_takes_both_kinds_of_file(run, logs, identified, tmp_path):
    def checked(model):
        ran = run('validate', logs / 'plant.parquet', '--model', model, '-o', tmp_path / 'v',
                  '--json', '--quiet')  # fmt: skip
        assert ran.status == 0, ran.err
        return ran

    extended = checked(identified / 'held' / 'extended_model.json')
    assert extended.json['held'] == list(HELD)
    assert (
        'The effect of these known causes was removed'
        in (tmp_path / 'v' / 'report.html').read_text()
    )
    plain = checked(identified / 'plain')
    assert plain.json['held'] == []
    half = checked(identified / 'held' / 'characteristic.json')
    assert 'give the extended_model.json beside it' in half.err
    # Its own log, freed of the causes, is what the curve was fitted to.
    assert abs(extended.json['overall']['mean_difference_mw']['mean']) < 0.1


def test_what_the_extended_model_knows_is_no_finding(run, logs, identified, tmp_path):
    """A diagnosis on top of a model says what differs from it, and keeps it inside its own."""
    out = tmp_path / 'd'
    ran = run('diagnose', logs / 'plant.parquet', '-o', out, '--quiet', '--model',
              identified / 'held' / 'extended_model.json')  # fmt: skip
    assert ran.status == 0, ran.err
    assert 'output_offset_drift (b_mw = 8)' in ran.out
    content = json.loads((out / 'extended_model.json').read_text())
    assert [c['name'] for c in content['on_top_of']['causes']] == list(HELD)
    found = json.loads((out / 'diagnosis.json').read_text())
    assert 'backlash' not in [c['name'] for c in found['causes']]


@pytest.mark.parametrize(
    ('change', 'said'),
    [
        ({'format': 'other'}, "'format' must be"),
        ({'version': 9}, 'has version 9'),
        ({'causes': [{'name': 'magic', 'values': {}, 'switches_s': []}]}, 'is no cause'),
        ({'causes': [{'name': 'backlash', 'values': {}, 'switches_s': []}]}, 'is missing'),
        ({'causes': [{'name': 'backlash', 'values': {'w_percent': -1}, 'switches_s': []}]},
         'is out of range'),
        ({'causes': 2 * extended_json(reheater={'alpha': 0.3, 'time_s': 9.0})['causes']},
         'names a cause twice'),
        ({'curve': {'knots': [2.0, 1.0], 'left': [1.0], 'right': [2.0]}}, 'do not rise'),
        ({'curve': {'knots': [1.0], 'left': [], 'right': []}}, 'one knot more'),
        ({'dynamics': {'levels': [], 'time_constants_s': [], 'delays_s': []}}, 'one level less'),
        ({'dynamics': {'levels': [], 'time_constants_s': [0.0], 'delays_s': [1.0]}},
         'out of range'),
        ({'reference': {}}, 'is missing'),
        ({'on_top_of': {}}, 'This is no extended model'),
        ({'start_ns': 'now'}, 'is not a count'),
    ],
)  # fmt: skip
def test_a_bad_model_is_refused_with_a_sentence(run, logs, tmp_path, change, said):
    path = tmp_path / 'model.json'
    path.write_text(json.dumps({**extended_json(), **change}))
    words = ('identify', logs / 'plant.parquet', '-o', tmp_path / 'o', '--model', path)
    assert said in run(*words).refused()


def test_what_does_not_go_together_is_refused(run, logs, identified, tmp_path):
    log, out, model = logs / 'plant.parquet', tmp_path / 'o', identified / 'held'
    extended = model / 'extended_model.json'
    told = run('identify', log, '-o', out, '--model', extended, '--step-test').refused(2)
    assert 'do not go together' in told
    told = run('identify', log, '-o', out, '--model', model / 'characteristic.json').refused()
    assert 'here an extended_model.json is wanted' in told
    for verb in ('identify', 'diagnose'):
        told = run(
            verb, log, '-o', out, '--model', extended, '--set', 'pressure_exponent=1'
        ).refused(2)
        assert 'the model decides' in told
    told = run('validate', log, '-o', out, '--model', extended, '--against',
               model / 'characteristic.json').refused(2)  # fmt: skip
    assert 'freed of its causes' in told
    told = run('compensate', '--model', extended, '-o', tmp_path / 't.csv').refused()
    assert 'here a characteristic.json is wanted' in told
