# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow identify --reference`` and ``--step-test``."""

from __future__ import annotations

import json

import pytest
from step_plan import StepPlan, step_test
from streams import needs_jit

from valveflow_ros.curve.characteristic_json import from_json
from valveflow_ros.logs import write_samples

pytestmark = needs_jit


@pytest.fixture(scope='module')
def levels_log(tmp_path_factory):
    """Return the log of a manual test with twelve levels."""
    path = tmp_path_factory.mktemp('test') / 'test.mcap'
    plan = StepPlan(opening_from_percent=45.0, opening_to_percent=85.0, steps=11)
    write_samples(step_test(3, plan).table, path)
    return path


def test_a_step_test_gives_a_curve_others_can_read(run, levels_log, tmp_path):
    ran = run('identify', levels_log, '-o', tmp_path / 'out', '--step-test')
    assert ran.status == 0, ran.err
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
    assert '--step-test identifies it' in refused
    assert 'for data of a closed loop do not use it' in refused


def test_ordinary_operation_is_no_step_test(run, logs, tmp_path):
    said = run('identify', logs / 'plant.mcap', '-o', tmp_path / 'out', '--step-test').refused()
    assert 'This is no step test' in said
    assert not (tmp_path / 'out').exists()


def test_a_curve_is_judged_against_a_reference(run, logs, tmp_path):
    first = run('identify', logs / 'plant.mcap', '-o', tmp_path / 'a', '--json')
    assert 'shift' not in first.json
    assert not (tmp_path / 'a' / 'shift.json').exists()
    model = tmp_path / 'a' / 'characteristic.json'
    again = run('identify', logs / 'plant.mcap', '-o', tmp_path / 'b', '--reference', model)
    assert again.status == 0, again.err
    assert 'Against the reference: The curve agrees with the reference of 2023-11-15' in again.out
    shift = json.loads((tmp_path / 'b' / 'shift.json').read_text())
    assert shift['format'] == 'valveflow/shift'
    assert shift['moved'] is False
    assert shift['reference_model_id'] == shift['model_id'] == first.json['model_id']
    assert [p['shift_mw'] for p in shift['pieces']] == [0.0] * len(first.json['pieces'])

    moved = json.loads(model.read_text())
    for piece in moved['pieces']:
        piece['intercept'] += 9.0
    model.write_text(json.dumps(moved), encoding='utf-8')
    ran = run('identify', logs / 'plant.mcap', '-o', tmp_path / 'b', '--reference', model,
              '--json')  # fmt: skip
    assert ran.json['shift']['moved'] is True
    assert ran.json['shift']['sentence'].startswith('At ')
    sizes = [p['shift_mw'] for p in ran.json['shift']['pieces'] if p['moved']]
    assert sizes == pytest.approx([-9.0] * len(sizes), abs=1.5)
    page = (tmp_path / 'b' / 'report.html').read_text(encoding='utf-8')
    assert 'Against the reference' in page
    assert 'id="shift"' in page
