"""The curve's history and the alarms' time line: what the pictures and the words say."""

from __future__ import annotations

import html
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from report_stories import HOUR_NS, KNOTS, START_NS, STEP_MW, history

from valveflow_ros.monitoring.alarm import AlarmState
from valveflow_ros.report.history import (
    AlarmMoment,
    History,
    alarms_table,
    curve_history_figure,
    followed,
    history_sections,
    largest_move,
    powers,
    spans,
    standing_s,
    timeline_figure,
)


def test_a_log_of_no_monitor_has_no_history():
    assert history_sections(None) == []
    assert history_sections(History(0, 1)) == []


def test_the_story_is_told_in_two_sections():
    told = history_sections(history())
    assert [s.title for s in told] == ['How the curve moved', 'What the monitor said']
    words = ' '.join(p for s in told for p in s.parts if isinstance(p, str))
    assert '5 curves' in words
    assert '5 changes of 1 alarm and 1 diagnosis' in words
    # The condition stood from hour 14 to hour 20.
    assert 'Some alarm stood for 6 h in all.' in words
    assert html.escape('6 MW less & it <lasts>') in words


def test_what_could_not_be_read_is_said():
    lame = History(0, 1, notes=('The curves cannot be shown: <why>.',))
    (section,) = history_sections(lame)
    assert '&lt;why&gt;' in section.parts[0]


def test_a_step_shows_at_its_hour_and_only_where_it_was():
    given_ = history()
    figure = curve_history_figure(given_)
    lines = [t for t in figure.traces if t['name'].startswith('u = ')]
    u = followed(given_)
    lifted = np.interp(u, KNOTS, [0.0, 0.0, STEP_MW])
    for line, expected in zip(lines, lifted, strict=True):
        y = np.array([np.nan if v is None else v for v in line['y']])
        assert y[4] - y[2] == pytest.approx(expected, abs=1e-3)
        assert y[-1] == y[-2], 'the last curve holds to the end'
        hours = [(t * 1e6 - START_NS) / HOUR_NS for t in line['x']]
        assert hours == pytest.approx([4, 8, 12, 16, 20, 24])
    # The first curve ends at the first breakpoint: beyond it nothing is claimed.
    assert [line['y'][0] is None for line in lines] == [bool(v > KNOTS[1]) for v in u]
    knees = figure.traces[-1]
    assert knees['y'] == [KNOTS[1]] * 4
    assert knees['error_y']['array'] == [10.0] * 4


def test_the_largest_move_is_that_of_the_last_curve():
    given_ = history()
    at, moved = largest_move(replace(given_, curves=given_.curves[:4]))
    assert (at, moved) == (KNOTS[-1], pytest.approx(STEP_MW))
    assert largest_move(given_)[1] == 0.0


@given(st.lists(st.floats(-50.0, 50.0), min_size=3, max_size=3))
def test_the_largest_move_is_no_smaller_than_any_on_a_fine_grid(change):
    base = history().curves[-1]
    other = replace(base, power_mw=base.power_mw + np.array(change))
    _, moved = largest_move(replace(history(), curves=(base, other)))
    grid = np.linspace(KNOTS[0], KNOTS[-1], 301)
    fine = np.diff(powers((base, other), grid), axis=0)
    assert abs(moved) >= np.abs(fine).max() - 1e-9


def test_bars_last_from_change_to_change():
    figure = timeline_figure(history())
    by_name = {t['name']: t for t in figure.traces if t.get('mode') == 'lines'}
    bar = by_name['stands, acknowledged']
    begin, end, gap = bar['x']
    assert ((begin * 1e6 - START_NS) / HOUR_NS, (end * 1e6 - START_NS) / HOUR_NS) == (15, 20)
    assert gap is None
    assert 'normal' not in by_name
    hovers = [h for t in figure.traces for h in t.get('hovertext', [])]
    assert any('6 MW less &amp; it &lt;lasts&gt;' in h for h in hovers)
    assert figure.layout['yaxis']['categoryarray'] == ['residual', 'diagnosis', 'new curve']


def test_the_name_of_an_alarm_is_no_markup():
    told = History(
        0, HOUR_NS, alarms=(AlarmMoment(0, '<b>x</b>&', AlarmState.UNACKNOWLEDGED, ''),)
    )
    figure = timeline_figure(told)
    name = '&lt;b&gt;x&lt;/b&gt;&amp;'
    assert figure.layout['yaxis']['categoryarray'] == [name]
    assert {cell for t in figure.traces for cell in t['y']} == {name, None}
    assert f'<br>{name}: ' in figure.traces[-1]['hovertext'][0]
    assert alarms_table(told).count(name) == 1


STATES = st.sampled_from(list(AlarmState))


@given(st.lists(st.tuples(st.integers(0, 100), st.sampled_from('ab'), STATES), max_size=30))
def test_every_moment_has_one_state_for_each_alarm(changes):
    """Slow truth: stepping hour by hour, the state in force is that of the last change."""
    changes = sorted(changes, key=lambda c: c[0])
    alarms = tuple(AlarmMoment(h * HOUR_NS, name, state, '') for h, name, state in changes)
    told = History(0, 100 * HOUR_NS, alarms=alarms)
    found = spans(told)
    stands = (AlarmState.UNACKNOWLEDGED, AlarmState.ACKNOWLEDGED)
    hours = 0
    for hour in range(100):
        there = []
        for name in 'ab':
            before = [s for h, n, s in changes if n == name and h <= hour]
            at = hour * HOUR_NS
            now = [s for n, s, a, b, _ in found if n == name and a <= at < b]
            assert now == before[-1:]
            there += now
        hours += any(s in stands for s in there)
    assert standing_s(told) == pytest.approx(3600.0 * hours)
