# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow monitor``: what the monitor would have told, as the Python interface says it."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import pytest

import valveflow_ros as vf
from valveflow_ros.interface import monitor as interface
from valveflow_ros.monitoring.alarm_state import AlarmChange, AlarmState, Priority
from valveflow_ros.monitoring.events import Diagnosed
from valveflow_ros.monitoring.reference import Wear
from valveflow_ros.parameters import Settings

HOUR_NS = 3600 * 10**9


def test_a_fault_stands_to_the_end_and_files_and_answer_say_the_same(run, tmp_path):
    log, out = tmp_path / 'plant.mcap', tmp_path / 'out'
    fault = 'curve_step:s_mw=-12,t0_days=0.9'
    assert run('simulate', '-o', log, '--days', '1.5', '--effect', fault).status == 0
    ran = run('monitor', log, '-o', out, '--no-diagnosis', '--json', '--set', 'sample_period=10')
    assert ran.status == 0, ran.err
    content = json.loads((out / 'monitor.json').read_text())
    assert (content['format'], content['version']) == ('valveflow/monitor', 1)
    assert content['diagnoses'] == []
    answer = json.loads(ran.out)
    assert {key: answer[key] for key in content} == content
    slow = {'sample_period': 10.0}
    assert vf.monitor(log, diagnose=False, parameters=slow).to_json() == content
    residual = [a for a in content['alarms'] if a['name'] == 'residual']
    assert [(a['state'], a['cleared']) for a in residual] == [('unacknowledged', None)]
    raised = residual[0]['raised']
    assert content['reference']['set'] >= raised
    # No curve of later is made from rows of before and since.
    later = [c for c in content['curves'] if c['adopted'] > content['reference']['set']]
    assert later
    assert all(c['window_from'] > raised - 2 * 3600 * 10**9 for c in later)
    assert (out / 'report.html').exists()


def ended(hour, verdict, sentence, **causes):
    """Return a diagnosis that ended, with the meaning and the to-do of each cause."""
    named = [{'name': k, 'meaning': m, 'to_do': d} for k, (m, d) in causes.items()]
    content = {'verdict': verdict, 'sentence': sentence, 'causes': named}
    task = SimpleNamespace(window_end_ns=hour * HOUR_NS)
    return Diagnosed(task, json.dumps(content), '')


def test_each_diagnosis_is_told_with_its_time_and_each_cause_once(
    run, logs, tmp_path, monkeypatch
):
    events = (
        ended(1, 'nothing', 'All agrees.'),
        ended(2, 'named', 'First.', gain_step=('It is 2 MW less.', 'Look at the meter.')),
        ended(30, 'named', 'Last.', gain_step=('It is 3 MW less.', 'Look at the meter.'),
              spikes=('', 'Mend the wire.')),
    )  # fmt: skip
    made = interface.MonitorResult('plant.csv', events, 0, 31 * HOUR_NS, Settings())
    monkeypatch.setattr(interface, 'monitor', lambda log, **_: made)
    told = run('monitor', logs / 'plant.csv', '-o', tmp_path).out.splitlines()
    first = next(k for k, line in enumerate(told) if 'verdict' in line)
    assert [re.split(' {2,}', line)[1:] for line in told[first + 1 : first + 4]] == [
        ['1970-01-01 01:00:00 UTC', 'no cause found', '-'],
        ['1970-01-01 02:00:00 UTC', 'cause found', 'gain_step'],
        ['1970-01-02 06:00:00 UTC', 'cause found', 'gain_step, spikes'],
    ]
    assert told[first + 4 : first + 9] == [
        'gain_step was named by 2 of 3 diagnoses, first with data up to 1970-01-01 02:00:00 UTC.',
        'spikes was named by 1 of 3 diagnoses, first with data up to 1970-01-02 06:00:00 UTC.',
        'The last diagnosis: Last.',
        'gain_step: It is 3 MW less. What to do: Look at the meter.',
        'spikes. What to do: Mend the wire.',
    ]


def test_a_cause_that_the_last_diagnosis_does_not_name_is_in_the_answer(
    run, logs, tmp_path, monkeypatch
):
    events = (
        ended(1, 'named', 'First.', gain_step=('It is 2 MW less.', 'Look at the meter.')),
        ended(2, 'nothing', 'All agrees.'),
    )
    made = interface.MonitorResult('plant.csv', events, 0, 31 * HOUR_NS, Settings())
    monkeypatch.setattr(interface, 'monitor', lambda log, **_: made)
    told = run('monitor', logs / 'plant.csv', '-o', tmp_path).out
    sentence = (
        'gain_step was named by 1 of 2 diagnoses, first with data up to 1970-01-01 01:00:00 UTC. '
        'The last one does not name it.'
    )
    assert f'{sentence}\nThe last diagnosis: All agrees.' in told
    page = (tmp_path / 'report.html').read_text()
    assert page.index(sentence) < page.index('The last diagnosis: All agrees.')


def raised(hour, name, sentence):
    """Return the rise of an alarm."""
    return AlarmChange(
        hour * HOUR_NS, name, AlarmState.UNACKNOWLEDGED, AlarmState.NORMAL, Priority.HIGH, 5.0,
        1.0, 'MW', sentence, 1, hour * HOUR_NS, 'abc',
    )  # fmt: skip


@pytest.mark.parametrize(('onset_days', 'told'), [
    (0.75, ' The diagnosis dates it to about 1970-01-01 18:00 UTC.'),
    (1.5, ''),  # later than the alarm: another change
    (None, ''),
])  # fmt: skip
def test_a_shift_has_the_date_of_the_cause_that_the_last_diagnosis_names(
    run, logs, tmp_path, monkeypatch, onset_days, told
):
    found = ended(30, 'named', 'Last.', gain_step=('It is 3 MW less.', ''))
    content = json.loads(found.content)
    content['causes'][0]['parameters'] = {'t0_days': {'value': onset_days, 'origin_ns': 0}}
    events = (
        raised(20, 'residual', 'Less power.'),
        raised(24, 'curve_shift', 'Less, since when cannot be told.'),
        replace(found, content=json.dumps(content)),
    )
    made = interface.MonitorResult('plant.csv', events, 0, 31 * HOUR_NS, Settings())
    monkeypatch.setattr(interface, 'monitor', lambda log, **_: made)
    answer = run('monitor', logs / 'plant.csv', '-o', tmp_path).out
    assert f'Less power.\nLess, since when cannot be told.{told}\n' in answer
    page = (tmp_path / 'report.html').read_text()
    assert f'<b>curve shift</b>: Less, since when cannot be told.{told}<' in page
    # Without a named cause in the last diagnosis there is no date.
    gone = replace(made, events=(*events, ended(31, 'nothing', 'All agrees.')))
    assert [words for _, words in gone.standing][1] == 'Less, since when cannot be told.'


def test_slow_wear_is_told(run, logs, tmp_path, monkeypatch):
    wear = Wear(86_400 * 10**9, -3.04, -1.013)
    made = interface.MonitorResult('plant.csv', (), 0, 31 * HOUR_NS, Settings(), wear)
    monkeypatch.setattr(interface, 'monitor', lambda log, **_: made)
    ran = run('monitor', logs / 'plant.csv', '-o', tmp_path)
    sentence = (
        'Since 1970-01-02 00:00:00 UTC the curve has changed slowly by −3.0 MW, −1.01 MW a month.'
    )
    assert sentence in ran.out
    assert sentence in (tmp_path / 'report.html').read_text()
    told = json.loads((tmp_path / 'monitor.json').read_text())['wear']
    assert told == {'since_ns': wear.since_ns, 'total_mw': -3.04, 'mw_per_month': -1.013}
