# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The page of an identification: whole, closed to the network, and telling the right numbers."""

import base64
import gzip
import itertools
import json
import math
import re
import zoneinfo
from dataclasses import replace
from datetime import timedelta, timezone

import numpy as np
import pytest
from report_stories import words_of

from valveflow_ros.curve.characteristic import Support
from valveflow_ros.curve.segment_residual import segment_residuals
from valveflow_ros.curve.shift import judge_shift
from valveflow_ros.errors import InputError
from valveflow_ros.parameters import Settings
from valveflow_ros.records import SegmentKind, Signal
from valveflow_ros.report import page
from valveflow_ros.report.answer import confidence_table, doubt, gain_by_load
from valveflow_ros.report.curve import (
    opening_figure,
    segments_figure,
    shift_section,
    surface_figure,
)
from valveflow_ros.report.figure import Figure, time_axis, upright
from valveflow_ros.report.identification import identification_report
from valveflow_ros.report.page import Page, Section, packed_plotly, read_text
from valveflow_ros.report.words import in_zone
from valveflow_ros.signals.static_form import OPENING, integrated_input

MEGABYTE = 1_000_000


@pytest.fixture(scope='module')
def report(identified):
    return identification_report(identified)


def figures_of(html):
    text = html.split('<script id="figures" type="application/json">')[1].split('</script>')[0]
    return json.loads(text, parse_constant=pytest.fail)


def with_curve(data, **changes):
    return replace(data, characteristic=replace(data.characteristic, **changes))


def test_it_is_one_page_that_asks_for_nothing(report):
    own = report.replace(packed_plotly(), '')
    assert own.startswith('<!DOCTYPE html>')
    assert own.rstrip().endswith('</html>')
    assert not re.search(r'https?:|wss?:|@import|url\(', own)
    assert re.findall(r'(?:src|href)\s*=\s*"([^"]*)"', own) == ['data:,'], 'only the empty icon'
    assert "default-src 'none'" in own
    script = gzip.decompress(base64.b64decode(packed_plotly())).decode()
    assert re.search(r'plotly\.js.*Licensed under the MIT license', script[:300], re.DOTALL)


def test_the_answer_comes_first_with_its_numbers(report):
    words = words_of(report)
    assert words.index('The answer') < words.index('The special segments')
    for part in (
        '2 pieces', 'from 800 to 1500', '100 to 195 MW', 'One per cent of opening gives from',
        '0.2000 ± 0.0024', '−60.0 ± 2.0', '800.0 to 1200.0', '1189 to 1211',
        '11.50 ± 0.78', '3.25 ± 0.59', '540.0 °C', 'plant.mcap', '2023-11-14 22:13:20 UTC',
        'MW per 1 % of opening', 'A <note>.',
    ):  # fmt: skip
        assert part in words, part
    assert re.search(rf'12\.0 12\.0 to 12\.0 [\d.]+ {0.2 * 12.0**1.125:.2f} ', words), (
        'slope times pressure'
    )
    assert not re.search(r'\b(nan|None|inf)\b', words)
    for absent in ('Against the reference', 'How probable each number', 'rests on', 'not certain'):
        assert absent not in words


@pytest.mark.parametrize(
    'form', [{}, {'axis': OPENING, 'pressure_exponent': 0.0, 'pressure_scale_exponent': 1.1}]
)
def test_gain_by_load_is_the_slope_of_the_power_over_the_opening(identified, form):
    data = identified
    if form:
        v = data.table.column(Signal.VALVE_OPENING)
        slope, intercept = np.polyfit(v, data.power / 12.0**1.1, 1).tolist()
        piece = replace(
            data.characteristic.pieces[0], u_from=float(v.min()) - 1.0,
            u_to=float(v.max()) + 1.0, slope=slope, intercept=intercept, slope_stderr=0.01,
        )  # fmt: skip
        data = with_curve(data, **form, pieces=(piece,), partition_pieces=(piece,))
    rows = gain_by_load(data)
    assert rows
    for load, p, _, _, v, gain, error, low, high in rows:
        assert data.characteristic.power(v, p) == pytest.approx(load)
        power = data.characteristic.power(v + np.array([-1e-4, 0.0, 1e-4]), np.full(3, p))
        sides = np.diff(power) / 1e-4  # they differ at a breakpoint
        assert gain == pytest.approx(sides[np.argmin(np.abs(sides - gain))], rel=1e-3)
        assert error > 0.0
        assert 0.0 < low <= gain <= high
    values = data.table.values.copy()
    values[:, Signal.GENERATED_POWER] = 200.0
    assert gain_by_load(replace(data, table=replace(data.table, values=values))) == []


def test_power_over_opening_ends_where_the_openings_of_each_pressure_end(identified):
    values = identified.table.values.copy()
    u, v = identified.u, values[:, Signal.VALVE_OPENING]
    values[:, Signal.MAIN_STEAM_PRESSURE] = p = np.where(u < 1000.0, 10.0, 14.0)
    values[:, Signal.VALVE_OPENING] = v = u / p**1.125
    data = replace(identified, table=replace(identified.table, values=values))
    for trace, low in zip(opening_figure(data).traces, (False, False, True), strict=True):
        seen = v[data.special][(p[data.special] == 10.0) == low]
        assert np.nanquantile(np.array(trace['x']), (0.0, 1.0)) == pytest.approx(
            [seen.min(), seen.max()], abs=0.01
        )


def test_pictures_hold_the_curve_the_segments_and_the_choice(report, identified):
    figures = figures_of(report)
    assert list(figures) == ['curve', 'opening', 'signals', 'choice', 'dynamics', 'coverage']
    assert all(f'id="{name}"' in report for name in figures)
    named = {t['name']: t for t in figures['curve']['data']}
    curve, points = named['flow characteristic'], named['breakpoints, 95 %']
    assert curve['x'] == [800.0, 1200.0, None, 1200.0, 1500.0, None]
    assert curve['y'] == [100.0, 180.0, None, 180.0, 195.0, None]
    cloud = named['special samples']['z']
    assert sum(c or 0 for row in cloud for c in row) == len(identified.special)
    assert (points['error_x']['array'], points['error_x']['arrayminus']) == ([11.0], [11.0])
    costs = figures['choice']['data'][0]
    assert dict(zip(costs['x'], costs['y'], strict=True)) == identified.characteristic.choice.cost
    names = [t['name'] for t in figures['signals']['data']]
    assert names == 2 * ['measured', 'steady state', 'slope response']
    for trace in figures['opening']['data']:
        v, mw = (np.array(trace[k], dtype=float) for k in ('x', 'y'))
        expected = identified.characteristic.power(v, float(trace['name'].split()[1]))
        both = np.isfinite(mw) & np.isfinite(expected)  # the name has three digits
        assert both.sum() > 20
        assert mw[both] == pytest.approx(expected[both], rel=0.01)


def test_the_surface_is_drawn_over_opening_and_pressure_where_the_pressure_moves(identified):
    assert surface_figure(identified) is None
    moved = tuple(
        replace(
            s, kind=SegmentKind.STEADY, u_start=u, u_end=u, exponent=1.125,
            power_start_mw=150.0, power_end_mw=150.0, pressure_start_mpa=p, pressure_end_mpa=p,
            opening_start_percent=u / p**1.125, opening_end_percent=u / p**1.125,
        )
        for s, u, p in zip(
            identified.segments, np.linspace(820.0, 1480.0, len(identified.segments)),
            itertools.cycle((10.0, 12.0, 15.0)), strict=False,
        )
    )  # fmt: skip
    figure = surface_figure(replace(identified, segments=moved))
    *lines, dots = figure.traces
    assert len(lines) >= 4
    for line, note in zip(lines, figure.layout['annotations'], strict=True):
        v, p = (np.array(line[k], dtype=float) for k in ('x', 'y'))
        power = identified.characteristic.power(v, p)
        assert power[np.isfinite(power)] == pytest.approx(float(note['text'].split()[0]), abs=0.1)
    residuals = segment_residuals(identified.characteristic, moved).residual_mw
    assert np.array(dots['marker']['color']) == pytest.approx(residuals, abs=0.1)
    assert sorted({round(p) for p in dots['y']}) == [10, 12, 15]


def test_colours_of_the_pictures_are_in_the_style_sheet(report):
    tokens = set(re.findall(r'token:([a-z0-9-]+)', json.dumps(figures_of(report))))
    assert 'steady' in tokens
    for look in read_text('style.css').split('@media screen')[:2]:
        assert [name for name in tokens if f'--{name}:' not in look] == []


def test_a_page_of_ten_days_is_small(make):
    html = identification_report(make(days=10.0, period_s=1)).encode()
    assert len(html) < 5 * MEGABYTE
    assert len(html) - len(packed_plotly()) < MEGABYTE


def test_what_comes_from_outside_is_escaped(identified):
    evil = '<script>alert(1)</script>"\'&'
    settings = Settings({'unit_tag': evil, 'sample_period': 10.0})
    data = replace(identified, source=evil, notes=(evil,), settings=settings)
    html = identification_report(with_curve(data, notes=(evil,)))
    assert '<script>alert' not in html
    assert html.count('&lt;script&gt;alert(1)') >= 4
    assert html.count('</script>') == 3


def test_what_is_not_known_is_called_unknown(identified):
    c = identified.characteristic
    unknown = tuple(replace(p, slope_stderr=math.nan, intercept_stderr=math.nan) for p in c.pieces)
    html = identification_report(with_curve(
        identified, pieces=unknown, breakpoint_intervals=((math.nan, math.nan),), dynamics=(),
        source=replace(c.source, temperature_mean_degc=math.nan, temperature_spread_k=math.nan),
    ))  # fmt: skip
    words = words_of(html)
    for part in ('unknown', 'Time constants and delays were not estimated',
                 'The main steam temperature is not known.'):  # fmt: skip
        assert part in words
    assert not re.search(r'\bnan\b', words, re.IGNORECASE)
    assert 'dynamics' not in figures_of(html)
    assert '95 % band' not in [t['name'] for t in figures_of(html)['curve']['data']]
    # And without any segment or value there is still a page.
    table = identified.table.part(0, 40)
    table = replace(table, values=np.full_like(table.values, np.nan))
    html = identification_report(replace(identified, table=table, segments=()))
    assert 'unknown' in words_of(html)
    figures_of(html)


def test_a_power_in_the_head_of_a_table_is_a_superscript():
    for power, shown in (('(9/8)', '9/8'), ('1.168', '1.168'), ('m', 'm')):
        html = page.table([f'u (% MPa^{power})'], [['1']])
        assert f'>u (% MPa<sup>{shown}</sup>)</th>' in html
    assert page.table(['u'], []) == ''


def test_a_straight_curve_has_no_breakpoints(identified):
    pieces = identified.characteristic.pieces[:1]
    html = identification_report(with_curve(
        identified, pieces=pieces, partition_pieces=pieces, breakpoint_intervals=()
    ))  # fmt: skip
    assert 'It is straight' in words_of(html)
    assert '>breakpoint<' not in html
    assert 'before refining' not in [t['name'] for t in figures_of(html)['curve']['data']]


def test_what_endangers_the_answer_stands_beside_it(identified, monkeypatch):
    c = identified.characteristic
    falling = (c.pieces[0], replace(c.pieces[1], slope=-0.05, intercept=240.0))
    words = words_of(identification_report(with_curve(
        identified, pieces=falling, notes=('Not refined.',),
        source=replace(c.source, temperature_spread_k=31.0, temperature_flag=True),
    )))  # fmt: skip
    answer = words[: words.index('The special segments')]
    for part in ('31.0 K', 'does not rise', 'Not refined.', 'does not raise the power'):
        assert part in answer
    assert doubt(identified) == ''
    flat = with_curve(identified, pieces=tuple(replace(p, slope=1e-6) for p in c.pieces))
    assert 'it explains only' in doubt(flat)
    monkeypatch.setattr('valveflow_ros.report.answer.explained', lambda _: 0.7)
    for error, words in ((0.04, 'The slopes are known within 10 %.'), (0.06, 'Do not rely'),
                         (float('nan'), 'Do not rely')):  # fmt: skip
        pieces = tuple(replace(p, slope_stderr=error * p.slope) for p in c.pieces[:1])
        assert words in doubt(with_curve(identified, pieces=pieces, breakpoint_intervals=()))
    monkeypatch.setattr('valveflow_ros.report.answer.explained', lambda _: 0.99)
    assert 'the power follows the pressure alone' in doubt(flat)


def test_confidence_and_support_stand_in_the_page(identified):
    c = identified.characteristic
    choice = replace(c.choice, confidence={1: 0.0001, 2: 0.66, 3: 0.3399})
    support = Support(3, 2, 900, (1100.0, 1150.0), True), Support(1, 0, 40, (1300.0,), False)
    html = identification_report(with_curve(identified, choice=choice, support=support))
    for part in (
        'The number of pieces is not certain: 2 has a probability of 66.0 %, 3 of 34.0 %. The '
        '95 % intervals', 'all others together less than 0.1 %', '1 steady state at 1 level',
        '3 steady states at 2 levels, 2 slope responses',
    ):  # fmt: skip
        assert part in words_of(html), part
    uncertain = ('slope uncertain', 'follows from the pieces beside it')
    assert sum(html.count(words) for words in uncertain) == 1
    assert 'more than 99.9 %' in confidence_table(replace(choice, confidence={2: 1.0}))


def test_quality_tells_what_was_not_used(identified):
    counts = {'generated_power': {'accepted': 90, 'impossible': 7, 'late': 3, 'duplicate': 0}}
    words = words_of(identification_report(replace(identified, counts=counts)))
    assert 'Readings not used: 7 outside the accepted range.' in words
    assert '97 7 outside the accepted range, 3 too late for its row (used later)' in words
    assert 'all used' in words
    assert 'the same time' not in words


# Against a reference.


def with_means(data, lift=0.0):
    """Return the data with the means of the rows of their segments, lifted by so many MW."""
    columns = (data.table.column(s) for s in (Signal.VALVE_OPENING, Signal.MAIN_STEAM_PRESSURE))
    u, power, found = integrated_input(*columns), data.power, []
    for segment, (a, b) in zip(data.segments, data.rows.tolist(), strict=True):
        at, mw = float(u[a:b].mean()), float(power[a:b].mean()) + lift
        found.append(replace(segment, u_start=at, u_end=at, power_start_mw=mw, power_end_mw=mw))
    return replace(data, segments=tuple(found))


@pytest.fixture
def judged(identified):
    """Return a maker of identifications judged against their own curve, lifted by so many MW."""

    def made(by_mw):
        data, curve = with_means(identified), identified.characteristic
        lifted = tuple(replace(p, intercept=p.intercept + by_mw) for p in curve.pieces)
        reference = replace(curve, pieces=lifted)
        shift = judge_shift(reference, curve, data.segments)
        return replace(data, shift=shift, reference=reference)

    return made


@pytest.mark.parametrize(('by_mw', 'moved'), [(0.0, False), (6.0, True)])
def test_the_judgement_against_a_reference_stands_on_the_page(judged, by_mw, moved):
    data = judged(by_mw)
    assert data.shift.moved is moved
    html = identification_report(data)
    assert data.shift.sentence.split('(')[0] in html
    lines = {t['name']: t for t in figures_of(html)['curve']['data']}
    assert lines['reference']['y'][0] == lines['flow characteristic']['y'][0] + by_mw
    lead, loads, table, figure = shift_section(data).parts
    cells = [re.findall(r'<t[hd][^>]*>([^<]*)', row) for row in loads.split('<tr>')[2:]]
    assert float(cells[-1][0]) == pytest.approx(np.nanquantile(data.static_mw, 0.99), abs=1.0)
    for _, now, then, change in cells:
        assert (now, float(change.split()[0].replace('−', '-'))) == (then, -by_mw)
    assert ('class="notice"' in lead) is moved
    assert table.count('<b>yes</b>') == 2 * moved
    points = np.concatenate([np.array(t['y'], float) for t in figure.traces])
    assert len(points) > 50
    assert np.median(points) == pytest.approx(-by_mw, abs=0.5)
    assert ('pieces that did not move' in [t['name'] for t in figure.traces]) is not moved


def test_a_dated_change_is_marked_and_a_piece_that_the_reference_lacks_is_said(judged):
    data = judged(6.0)
    first, second = data.shift.pieces
    at, nan = int(data.table.time_ns[len(data.table) // 2]), math.nan
    dated = replace(
        data.shift, since_ns=at, since_low_ns=at - 10**12, since_high_ns=at + 10**12,
        pieces=(replace(first, now_mw=-6.0, now_error_mw=0.3),
                replace(second, u_from=nan, u_to=nan, middle_mw=nan)),
    )  # fmt: skip
    *_, table, figure = shift_section(replace(data, shift=dated)).parts
    assert '−6.0' in table
    assert 'not in the reference' in table
    assert [s['type'] for s in figure.layout['shapes']] == ['line', 'rect', 'line']
    assert 'The line marks the change' in figure.caption


def test_what_the_curve_leaves_shows_over_u_and_over_time(identified):
    assert segments_figure(identified) is None, 'records without means say nothing'
    over_u, over_time = segments_figure(with_means(identified)).traces
    assert over_u['y'] == over_time['y']
    assert abs(np.mean(over_u['y'])) < 0.2
    # One point a segment of those inside the curve's range, wherever it is drawn.
    assert len(over_u['x']) == len(over_u['y']) <= len(identified.segments)
    moved = segments_figure(with_means(identified, 5.0)).traces[0]['y']
    assert np.mean(moved) == pytest.approx(np.mean(over_u['y']) + 5.0, abs=1e-3)


# Pages in general.


def test_a_missing_library_is_one_sentence(monkeypatch, tmp_path):
    class Spec:
        origin = str(tmp_path / '__init__.py')

    page.packed_plotly.cache_clear()
    for spec, said in ((None, 'pip install plotly'), (Spec, 'incomplete')):
        monkeypatch.setattr(page, 'find_spec', lambda name, spec=spec: spec)
        with pytest.raises(InputError, match=said):
            page.packed_plotly()


@pytest.mark.parametrize(
    ('zone', 'said', 'hours'),
    [
        (zoneinfo.ZoneInfo('America/Sao_Paulo'), '2024-01-01 21:30 -03', -3),
        (timezone(timedelta(hours=5, minutes=30)), '2024-01-02 06:00 UTC+05:30', 5.5),
    ],
)
def test_times_are_told_in_a_zone_in_words_and_along_the_axes(zone, said, hours):
    at_ms = 1_704_155_400_000.0  # 2024-01-02 00:30 UTC
    trace = {'type': 'scatter', 'x': [at_ms, None, at_ms + 1.0], 'y': [at_ms, 2.0, 3.0]}
    layout = {'xaxis': time_axis(range=[at_ms, at_ms]), 'shapes': [upright(at_ms, 'ink', 1.0)],
              'annotations': [{'text': 'day (UTC)', 'xref': 'paper', 'x': 0.5}]}  # fmt: skip
    drawn = Figure('one', 'since 2024-01-02 00:30 UTC', 'nothing', [trace], layout)
    made = Page('At 2024-01-02 00:30 UTC', '', [Section('2024-01-02', [drawn])], '', 'identify')
    told = made.in_zone(zone)
    assert (told.title, told.figures[0].caption) == (f'At {said}', f'since {said}')
    assert told.sections[0].title == '2024-01-02'  # a day has no zone
    (moved,) = told.figures
    at = at_ms + 3_600_000.0 * hours
    assert moved.traces[0]['x'] == [at, None, at + 1.0]
    assert moved.traces[0]['y'] == trace['y']
    assert moved.layout['xaxis']['range'] == [at, at]
    assert moved.layout['xaxis']['title']['text'] == f'time ({zone})'
    assert moved.layout['shapes'][0]['x0'] == at
    assert moved.layout['annotations'][0] == {'text': f'day ({zone})', 'xref': 'paper', 'x': 0.5}
    assert made.in_zone(None) == made


def test_the_hour_that_comes_twice_is_told_by_its_clock_and_no_time_is_converted_twice():
    zone = zoneinfo.ZoneInfo('Europe/Berlin')
    both = 'from 2024-10-27 00:30 UTC to 2024-10-27 01:30 UTC'
    assert in_zone(both, zone) == 'from 2024-10-27 02:30 CEST to 2024-10-27 02:30 CET'
    once = in_zone('2024-01-02 00:30 UTC', timezone(timedelta(hours=1)))
    assert once == '2024-01-02 01:30 UTC+01:00'
    assert in_zone(once, timezone(timedelta(hours=5))) == once
    # A time of day without a date is told in winter time.
    for name, said in (
        ('Europe/Berlin', '06:00 CET'), ('Australia/Sydney', '15:00 AEST'),
        ('Asia/Tokyo', '14:00 JST'),
    ):  # fmt: skip
        told = in_zone('highest at 05:00 UTC (daily)', zoneinfo.ZoneInfo(name))
        assert told == f'highest at {said} (daily)'
