# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow monitor`` and ``fleet``: what the interface found, in words, files and JSON."""

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import pytest

from valveflow_ros.interface import monitor as monitoring
from valveflow_ros.interface.fleets import fleet as fleets
from valveflow_ros.interface.fleets.unit_logs import read_options
from valveflow_ros.interface.monitor import MonitorResult
from valveflow_ros.monitoring.alarm_state import AlarmChange, AlarmState, Priority
from valveflow_ros.monitoring.events import Diagnosed
from valveflow_ros.monitoring.reference import Wear
from valveflow_ros.parameters import Settings
from valveflow_ros.report.fleet import fleet_page, story_of, unit_page

DAY_NS = 86_400 * 10**9
HOUR_NS = DAY_NS // 24


def ended(hour, verdict, sentence, **causes):
    named = [{'name': k, 'meaning': m, 'to_do': d} for k, (m, d) in causes.items()]
    content = {'verdict': verdict, 'sentence': sentence, 'causes': named}
    task = SimpleNamespace(window_end_ns=hour * HOUR_NS)
    return Diagnosed(task, json.dumps(content), '')


@pytest.fixture
def told(run, logs, tmp_path, monkeypatch):
    """Return what the verb and its page say of events of a month."""

    def tell(*events, wear=None):
        made = MonitorResult('plant.csv', events, 0, 31 * HOUR_NS, Settings(), wear)
        monkeypatch.setattr(monitoring, 'monitor', lambda log, **_: made)
        ran = run('monitor', logs / 'plant.csv', '-o', tmp_path)
        return ran.out, (tmp_path / 'report.html').read_text(), made

    return tell


def test_each_diagnosis_is_told_with_its_time_and_each_cause_once(told):
    lines = told(
        ended(1, 'nothing', 'All agrees.'),
        ended(2, 'named', 'First.', gain_step=('It is 2 MW less.', 'Look at the meter.')),
        ended(30, 'named', 'Last.', gain_step=('It is 3 MW less.', 'Look at the meter.'),
              spikes=('', 'Mend the wire.')),
    )[0].splitlines()  # fmt: skip
    first = next(k for k, line in enumerate(lines) if 'verdict' in line)
    assert [re.split(' {2,}', line)[1:] for line in lines[first + 1 : first + 4]] == [
        ['1970-01-01 01:00:00 UTC', 'no cause found', '-'],
        ['1970-01-01 02:00:00 UTC', 'cause found', 'gain_step'],
        ['1970-01-02 06:00:00 UTC', 'cause found', 'gain_step, spikes'],
    ]
    assert lines[first + 4 : first + 9] == [
        'gain_step was named by 2 of 3 diagnoses, first with data up to 1970-01-01 02:00:00 UTC.',
        'spikes was named by 1 of 3 diagnoses, first with data up to 1970-01-02 06:00:00 UTC.',
        'The last diagnosis: Last.',
        'gain_step: It is 3 MW less. What to do: Look at the meter.',
        'spikes. What to do: Mend the wire.',
    ]


def test_a_cause_that_the_last_diagnosis_does_not_name_is_in_the_answer(told):
    """With its advice; for a covariate there is nothing to do."""
    found = {'vacuum': ('It falls.', ''), 'gain_step': ('It is 2 MW less.', 'Look at the meter.')}
    out, page, _ = told(
        ended(1, 'named', 'First.', **found), ended(2, 'nothing', 'All agrees.')
    )  # fmt: skip
    sentence = (
        'gain_step was named by 1 of 2 diagnoses, first with data up to 1970-01-01 01:00:00 UTC. '
        'The last one does not name it.'
    )
    advice = 'gain_step: It is 2 MW less. What to do: Look at the meter.'
    assert f'{sentence}\nThe last diagnosis: All agrees.\n{advice}\n' in out
    assert 'vacuum: ' not in out
    assert page.index(sentence) < page.index('The last diagnosis: All agrees.')


def raised(hour, name, sentence):
    return AlarmChange(
        hour * HOUR_NS, name, AlarmState.UNACKNOWLEDGED, AlarmState.NORMAL, Priority.HIGH, 5.0,
        1.0, 'MW', sentence, 1, hour * HOUR_NS, 'abc',
    )  # fmt: skip


@pytest.mark.parametrize(('onset_days', 'dated'), [
    (0.75, ' The diagnosis dates it to about 1970-01-01 18:00 UTC.'),
    (1.5, ''),  # later than the alarm: another change
    (None, ''),
])  # fmt: skip
def test_a_shift_has_the_date_of_the_cause_that_the_last_diagnosis_names(told, onset_days, dated):
    found = ended(30, 'named', 'Last.', gain_step=('It is 3 MW less.', ''))
    content = json.loads(found.content)
    content['causes'][0]['parameters'] = {'t0_days': {'value': onset_days, 'origin_ns': 0}}
    events = (
        raised(20, 'residual', 'Less power.'),
        raised(24, 'curve_shift', 'Less, onset unknown.'),
        replace(found, content=json.dumps(content)),
    )
    out, page, made = told(*events)
    assert f'Less power.\nLess, onset unknown.{dated}\n' in out
    assert f'<b>curve shift</b>: Less, onset unknown.{dated}<' in page
    # Without a named cause in the last diagnosis there is no date.
    gone = replace(made, events=(*events, ended(31, 'nothing', 'All agrees.')))
    assert [words for _, words in gone.standing][1] == 'Less, onset unknown.'


def test_slow_wear_is_told(told, run, logs, tmp_path):
    wear = Wear(DAY_NS, -3.04, -1.013)
    out, page, _ = told(wear=wear)
    sentence = (
        'Since 1970-01-02 00:00:00 UTC the curve has changed slowly by −3.0 MW, −1.01 MW a month.'
    )
    assert sentence in out
    assert sentence in page
    content = json.loads((tmp_path / 'monitor.json').read_text())
    drift = {'since_ns': wear.since_ns, 'total_mw': -3.04, 'mw_per_month': -1.013}
    assert content['wear'] == drift
    answer = run('monitor', logs / 'plant.csv', '-o', tmp_path, '--json').json
    assert {key: answer[key] for key in content} == content


# The fleet.


def row(month, **more):
    """Return the row of a month whose curve is the first one's."""
    start = month * 30 * DAY_NS
    found = {
        'log': f'2026-{month:02d}', 'status': 'done', 'sentences': [], 'start': start,
        'end': start + 29 * DAY_NS, 'curve': 'a file', 'model_id': 'abc', 'output_unit': 'MW',
        'pressure_exponent': 1.125, 'u': [1000.0, 1500.0, 2000.0],
        'power_mw': [150.0, 250.0, 290.0], 'breakpoint_low': [1490.0],
        'breakpoint_high': [1510.0], 'rmse_mw': 1.0, 'change_moved': False, 'change_mw': None,
        'change_mean_mw': 0.1, 'causes': [], 'alarms': [], 'verdict': 'nothing',
        'shift_sentence': 'The curve agrees.',
    }  # fmt: skip
    return found | more


def lost(month, mw, **more):
    moved = {'change_moved': True, 'change_mw': mw, 'change_mean_mw': mw / 2.0,
             'change_u_from': 1500.0, 'change_u_to': 2000.0}  # fmt: skip
    return row(month, **moved, **more)


def cause(name):
    return {'name': name, 'sentence': f'It is {name}.', 'meaning': '', 'to_do': ''}


def stories():
    since = {f'shift_since{end}': (90 + k) * DAY_NS for k, end in ((5, ''), (4, '_low'),
                                                                  (6, '_high'))}  # fmt: skip
    alarm = [{'name': 'residual', 'cleared': None}, {'name': 'curve_shift', 'cleared': 7}]
    failed = {'log': '2026-02', 'status': 'failed', 'sentences': ['It is <empty>.']}
    return [
        story_of('sound', [row(1), failed, row(3)]),
        story_of('gains', [row(1), lost(2, 4.0)]),
        story_of('U<1>', [
            row(1), lost(2, -5.0, causes=[cause('spikes')]), row(3),
            lost(4, -6.0, causes=[cause('gain_step')], **since), lost(5, -6.5, alarms=alarm),
        ]),
        story_of('nothing', [failed]),
    ]  # fmt: skip


def test_a_change_lasts_since_the_first_month_that_shows_it_to_the_end():
    sound, gains, loses, nothing = stories()
    assert (sound.moved, sound.since, sound.failed) == (False, '', 1)
    assert (gains.moved, gains.since) == (True, 'before 1970-03-02 00:00 UTC')
    assert loses.change_mw == -3.25
    # What was named before it came back to normal does not count.
    assert loses.causes == ('gain_step',)
    assert loses.alarms == ('residual',)
    assert loses.since == '1970-04-06 00:00 UTC (95 %: 1970-04-05 00:00 to 1970-04-07 00:00)'
    assert (nothing.change_mw, nothing.changes) == (None, ())


def test_a_change_that_a_cause_dates_lasts_since_its_onset():
    """The first cause with a date; the shift tells the same more widely."""
    since = {f'shift_since{end}': (90 + k) * DAY_NS for k, end in ((5, ''), (1, '_low'),
                                                                  (9, '_high'))}  # fmt: skip
    onset = {'onset': 96 * DAY_NS, 'onset_low': 95 * DAY_NS, 'onset_high': 97 * DAY_NS}
    undated = {'onset': None, 'onset_low': None, 'onset_high': None}
    causes = [cause('stiction') | undated, cause('gain_step') | onset]
    dated = story_of('U', [row(1), lost(3, -5.0, causes=causes, **since), lost(4, -5.0)])
    assert dated.since == '1970-04-07 00:00 UTC (95 %: 1970-04-06 00:00 to 1970-04-08 00:00)'
    assert dated.causes == ('stiction', 'gain_step')
    # Of a later log a cause says nothing of when the change began.
    later = story_of('U', [row(1), lost(3, -5.0, **since), lost(4, -5.0, causes=causes)])
    assert later.since == '1970-04-06 00:00 UTC (95 %: 1970-04-02 00:00 to 1970-04-10 00:00)'
    of_another_day = [cause('input_step') | onset | {'onset': 20 * DAY_NS}]
    other = story_of('U', [row(1), lost(3, -5.0, causes=of_another_day, **since)])
    assert other.since == later.since
    open_end = [cause('gain_step') | onset | {'onset_high': None}]
    assert story_of('U', [row(1), lost(3, -5.0, causes=open_end)]).since == '1970-04-07 00:00 UTC'


def test_the_overview_begins_with_what_loses_most():
    page = fleet_page(stories())
    told = page.to_html()
    assert '1 unit gives less power than in the first log, 1 unit gives more' in told
    places = [told.index(f'href="units/{unit}/') for unit in ('U%3C1%3E', 'gains', 'sound')]
    assert places == sorted(places)
    assert 'It is &lt;empty&gt;.' in told
    assert '<1>' not in told.replace('\\u003c1\\u003e', '')
    changes = next(f for f in page.figures if f.name == 'changes')
    assert len(changes.traces[0]['y']) == 3
    assert unit_page('none', [{'log': 'a', 'status': 'failed', 'sentences': ['No.']}]).to_html()
    assert fleet_page([]).to_html()


def test_options_reach_every_log_and_the_outcome_is_told(run, tmp_path, monkeypatch):
    given = {}

    def fleet(logs, folder, **more):
        given.update(more, logs=logs)
        return fleets.FleetResult(folder, tuple(stories()), 9, 2, 2)

    monkeypatch.setattr(fleets, 'fleet', fleet)
    file = tmp_path / 'p.yaml'
    file.write_text('valveflow_monitor:\n  ros__parameters:\n    alarm_floor: 3.0\n')
    ran = run(
        'fleet', 'a', 'b', '-o', tmp_path, '--scheduler', 'tcp://x:1', '--no-diagnosis',
        '--params', file, '--set', 'alarm_floor=2', '--time-zone', '+01:00',
        '--column', 'valve_opening=CV', '--constant', 'main_steam_temperature=540',
    ).done()  # fmt: skip
    how = read_options(given['options'])
    assert (how.parameters, how.diagnosis) == ({'alarm_floor': 2.0}, False)
    assert how.mapping.names() == {'valve_opening': 'CV'}
    assert how.mapping.table.time_zone == '+01:00'
    assert given['scheduler'] == 'tcp://x:1'
    assert ran.out.startswith('4 units: 9 logs done now, 2 unchanged, 2 without a result.')
    assert 'sound 2026-02: It is <empty>.' in ran.out
    data = run('fleet', 'a', '-o', tmp_path, '--json').json
    assert data['tasks'] == {'anew': 9, 'unchanged': 2, 'failed': 2}
    assert json.dumps(data['units'][2]['causes']) == '["gain_step"]'
