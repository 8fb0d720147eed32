# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The verbs with an extended model: identify, validate and diagnose on top of it."""

import json

import pytest
from extended_file import extended_json, write_extended
from streams import needs_jit

pytestmark = needs_jit
HELD = {'output_offset_drift': {'b_mw': 8.0}, 'backlash': {'w_percent': 0.1}}
REMOVED = 'The effect of these known causes was removed'


@pytest.fixture(scope='module')
def held(run, logs, tmp_path_factory):
    """Identify one log with two causes held; return the folder."""
    folder = tmp_path_factory.mktemp('extended')
    model = write_extended(folder / 'model.json', **HELD)
    words = '--set', f'model_file={model}'
    ran = run('identify', logs / 'plant.parquet', '-o', folder / 'out', *words).done()
    assert f'{REMOVED} from the data first' in ran.out
    assert 'backlash (w_percent = 0.1)' in ran.out
    return folder / 'out'


def test_the_result_says_what_was_held_and_the_model_gets_the_new_curve(held, identified):
    curve, plain = (json.loads((f / 'characteristic.json').read_text())
                    for f in (held, identified.parent))  # fmt: skip
    assert [(h['name'], h['values']) for h in curve['held']] == list(HELD.items())
    assert 'zero of the power meter' in curve['held'][0]['sentence']
    assert 'output_offset_drift (b_mw = 8)' in (held / 'report.html').read_text()
    assert 'held' not in plain
    assert not (identified.parent / 'extended_model.json').exists()
    assert REMOVED not in (identified.parent / 'report.html').read_text()
    extended = json.loads((held / 'extended_model.json').read_text())
    assert extended['curve']['knots'][1:] == [p['u_to'] for p in curve['pieces']]
    assert extended['written_by'] == 'identify'
    given = extended_json(**HELD)
    for key in ('causes', 'reference', 'start_ns', 'pressure_exponent'):
        assert extended[key] == given[key]


def test_validate_takes_both_kinds_of_file(run, logs, held, tmp_path):
    def checked(model):
        return run('validate', logs / 'plant.parquet', '--model', model, '-o', tmp_path / 'v',
                   '--json', '--quiet')  # fmt: skip

    extended = checked(held / 'extended_model.json')
    assert extended.json['held'] == list(HELD)
    # Its own log, freed of the causes, is what the curve was fitted to.
    assert abs(extended.json['overall']['mean_difference_mw']['mean']) < 0.1
    assert REMOVED in (tmp_path / 'v' / 'report.html').read_text()
    half = checked(held / 'characteristic.json')
    assert 'give the extended_model.json beside it' in half.err


def test_what_the_extended_model_knows_is_no_finding(run, logs, held, tmp_path):
    """A diagnosis on top of a model says what differs from it, and keeps it inside its own."""
    out = tmp_path / 'd'
    ran = run('diagnose', logs / 'plant.parquet', '-o', out, '--quiet', '--model',
              held / 'extended_model.json').done()  # fmt: skip
    assert 'output_offset_drift (b_mw = 8)' in ran.out
    content = json.loads((out / 'extended_model.json').read_text())
    assert [c['name'] for c in content['on_top_of']['causes']] == list(HELD)
    found = json.loads((out / 'diagnosis.json').read_text())
    assert 'backlash' not in [c['name'] for c in found['causes']]


def test_what_does_not_go_together_is_refused(run, logs, held, tmp_path):
    log, extended, curve = (
        logs / 'plant.parquet', held / 'extended_model.json', held / 'characteristic.json',
    )  # fmt: skip
    for status, words, told in (
        (2, ['identify', log, '--model', extended, '--step-test'], 'do not go together'),
        (1, ['identify', log, '--model', curve], 'here an extended_model.json is wanted'),
        (2, ['identify', log, '--model', extended, '--set', 'pressure_exponent=1'], 'decides'),
        (2, ['diagnose', log, '--model', extended, '--set', 'pressure_exponent=1'], 'decides'),
        (2, ['validate', log, '--model', extended, '--against', curve], 'freed of its causes'),
        (1, ['compensate', '--model', extended], 'here a characteristic.json is wanted'),
    ):
        output = tmp_path / ('t.csv' if words[0] == 'compensate' else 'o')
        assert told in run(*words, '-o', output).refused(status)
