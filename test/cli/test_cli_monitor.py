"""``valveflow monitor``: what the monitor would have told, as the Python interface says it."""

from __future__ import annotations

import json

import valveflow_ros as vf


def test_a_fault_stands_to_the_end_and_files_and_answer_say_the_same(run, tmp_path):
    log, out = tmp_path / 'plant.mcap', tmp_path / 'out'
    fault = 'curve_step:s_mw=-12,t0_days=0.9'
    assert run('simulate', '-o', log, '--days', '2', '--effect', fault).status == 0
    ran = run('monitor', log, '-o', out, '--no-diagnosis', '--json')
    assert ran.status == 0, ran.err
    content = json.loads((out / 'monitor.json').read_text())
    assert (content['format'], content['version']) == ('valveflow/monitor', 1)
    assert content['diagnoses'] == []
    answer = json.loads(ran.out)
    assert {key: answer[key] for key in content} == content
    assert vf.monitor(log, diagnose=False).to_json() == content
    residual = [a for a in content['alarms'] if a['name'] == 'residual']
    assert [(a['state'], a['cleared']) for a in residual] == [('unacknowledged', None)]
    raised = residual[0]['raised']
    assert content['reference']['set'] >= raised
    # No curve of later is made from rows of before and since.
    later = [c for c in content['curves'] if c['adopted'] > content['reference']['set']]
    assert later
    assert all(c['window_from'] > raised - 2 * 3600 * 10**9 for c in later)
    assert (out / 'report.html').exists()
