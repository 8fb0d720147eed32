# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow fleet``: its options reach the interface, its outcome is told, its refusals too."""

from __future__ import annotations

import json

import pytest

from valveflow_ros.interface.fleets import fleet as interface
from valveflow_ros.interface.fleets.unit_logs import read_options
from valveflow_ros.interface.fleets.unit_month import _diagnosis_facts
from valveflow_ros.report.fleet import fleet_page, story_of, unit_page

DAY_NS = 86_400 * 10**9


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


@pytest.mark.parametrize('known', [True, False])
def test_the_onset_of_a_cause_is_a_time(known):
    from types import SimpleNamespace

    ends = {'low': 1.25, 'high': 1.75} if known else {'low': None, 'high': None}
    size = {'value': 0.9, 'low': 0.8, 'high': 1.0, 'unit': ''}
    onset = {'value': 1.5, 'unit': 'days', 'origin_ns': 10 * DAY_NS, **ends}
    gain = {'rmse_before': 2.0, 'rmse_after': 1.0, 'reduction': 0.5, 'p_value': 0.0}
    causes = [
        {**cause(name), 'parameters': parameters, 'gain': gain}
        for name, parameters in (('gain_step', {'g': size, 't': onset}), ('stiction', {'s': size}))
    ]
    names = ('verdict', 'not_told_apart', 'unexplained_by', 'rmse_simulation', 'rmse_extended',
             'rmse_noise_floor')  # fmt: skip
    content = dict.fromkeys(names) | {'causes': causes}
    dated, undated = _diagnosis_facts(SimpleNamespace(to_json=lambda: content))['causes']
    assert dated['onset'] == 11.5 * DAY_NS
    between = (11.25 * DAY_NS, 11.75 * DAY_NS) if known else (None, None)
    assert (dated['onset_low'], dated['onset_high']) == between
    assert (undated['onset'], undated['onset_low'], undated['onset_high']) == (None,) * 3


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
        return interface.FleetResult(folder, tuple(stories()), 9, 2, 2)

    monkeypatch.setattr(interface, 'fleet', fleet)
    file = tmp_path / 'p.yaml'
    file.write_text('valveflow_monitor:\n  ros__parameters:\n    alarm_floor: 3.0\n')
    ran = run(
        'fleet', 'a', 'b', '-o', tmp_path, '--scheduler', 'tcp://x:1', '--no-diagnosis',
        '--params', file, '--set', 'alarm_floor=2', '--time-zone', '+01:00',
        '--column', 'valve_opening=CV', '--constant', 'main_steam_temperature=540',
    )  # fmt: skip
    assert ran.status == 0, ran.err
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


@pytest.mark.parametrize(
    ('words', 'sentence'),
    [
        (['gone.csv'], 'gone.csv: cannot be opened (no such file or directory)'),
        (['.'], 'There is no log in .'),
        (['fleet.csv'], 'fleet.csv, line 2: u1/2026-01.csv: cannot be opened'),
    ],
)
def test_what_is_not_there_is_one_sentence(words, sentence, run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if 'fleet.csv' in words:
        (tmp_path / 'fleet.csv').write_text('unit,log\nU1,u1/2026-01.csv\n')
    assert sentence in run('fleet', *words, '-o', 'out').refused()
    assert not (tmp_path / 'out').exists()
