# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The page: whole, small, closed to the network, and telling the right numbers."""

from __future__ import annotations

import base64
import gzip
import json
import math
import re
import zoneinfo
from dataclasses import replace
from datetime import timedelta, timezone

import numpy as np
import pytest
from report_stories import diagnosed, history, words_of

from valveflow_ros.curve.characteristic import Support
from valveflow_ros.errors import InputError
from valveflow_ros.parameters import Settings
from valveflow_ros.records import Signal
from valveflow_ros.report import page
from valveflow_ros.report.answer import confidence_table, doubt, gain_by_load
from valveflow_ros.report.curve import band
from valveflow_ros.report.data import gaps, rejected, usable_share
from valveflow_ros.report.diagnosis import diagnosis_page
from valveflow_ros.report.figure import Figure, packed, rounded, time_axis, upright
from valveflow_ros.report.identification import identification_page, identification_report
from valveflow_ros.report.page import Page, Section, packed_plotly, read_text
from valveflow_ros.report.words import in_zone
from valveflow_ros.signals.static_form import OPENING

MEGABYTE = 1_000_000


@pytest.fixture(scope='module')
def report(identified):
    return identification_report(identified)


def figures_of(page):
    text = page.split('<script id="figures" type="application/json">')[1].split('</script>')[0]
    return json.loads(text, parse_constant=pytest.fail)


def test_it_is_one_page_that_asks_for_nothing(report):
    own = report.replace(packed_plotly(), '')
    assert own.startswith('<!DOCTYPE html>')
    assert own.rstrip().endswith('</html>')
    assert not re.search(r'https?:|wss?:', own)
    links = re.findall(r'(?:src|href)\s*=\s*"([^"]*)"', own)
    assert links == ['data:,'], 'only the empty icon'
    assert not re.search(r'@import|url\(', own)
    assert "default-src 'none'" in own


def test_the_drawing_library_inside_is_the_installed_one():
    script = gzip.decompress(base64.b64decode(packed_plotly())).decode()
    assert 'plotly.js' in script[:200]
    assert 'Licensed under the MIT license' in script[:300]


def test_the_answer_comes_first_with_its_numbers(report):
    words = words_of(report)
    assert words.index('The answer') < words.index('The special segments')
    for part in (
        '2 pieces', 'from 800 to 1500', '100 to 195 MW', 'most steeply at 100 to 180 MW',
        '0.2000 ± 0.0024', '−60.0 ± 2.0',
        '800.0 to 1200.0', '1189 to 1211', '4.0 times less', '11.50 ± 0.78', '3.25 ± 0.59',
        '540.0 °C', 'plant.mcap', '2023-11-14 22:13:20 UTC',
    ):  # fmt: skip
        assert part in words, part
    assert not re.search(r'\b(nan|None|inf)\b', words)


def test_gain_of_one_percent_of_opening_is_slope_times_pressure(report):
    words = words_of(report)
    assert 'MW per 1 % of opening' in words
    assert re.search(rf'12\.0 \d+ {0.2 * 12.0**1.125:.2f} ', words), words[:2000]


@pytest.mark.parametrize(
    'form',
    [{}, {'axis': OPENING, 'pressure_exponent': 0.0, 'pressure_scale_exponent': 1.1}],
)
def test_gain_by_load_is_the_slope_of_the_power_over_the_opening(make, form):
    data = make()
    pieces = data.characteristic.pieces
    if form:
        v = data.table.column(Signal.VALVE_OPENING)
        low, high = float(np.nanmin(v)) - 1.0, float(np.nanmax(v)) + 1.0
        pieces = (replace(pieces[0], u_from=low, u_to=high, slope=0.2, slope_stderr=0.01),)
        form = {**form, 'pieces': pieces, 'partition_pieces': pieces}
    data = replace_characteristic(data, **form)
    rows = gain_by_load(data)
    assert rows
    for _, p, v, gain, error, low, high in rows:
        up, down = data.characteristic.power([v + 1e-4, v - 1e-4], [p, p])
        assert gain == pytest.approx((up - down) / 2e-4, rel=1e-3)
        assert error > 0.0
        assert 0.0 < low <= high
    values = data.table.values.copy()
    values[:, Signal.GENERATED_POWER] = 200.0
    assert gain_by_load(replace(data, table=replace(data.table, values=values))) == []


def test_a_valve_without_effect_is_doubted(make, monkeypatch):
    data = make()
    assert doubt(data) == ''
    flat = tuple(replace(piece, slope=1e-6) for piece in data.characteristic.pieces)
    monkeypatch.setattr('valveflow_ros.report.answer.explained', lambda _: 0.99)
    told = doubt(replace_characteristic(data, pieces=flat))
    assert 'the power follows the pressure alone' in told


def test_pictures_hold_the_curve_the_segments_and_the_choice(report, identified):
    figures = figures_of(report)
    assert list(figures) == ['curve', 'opening', 'signals', 'choice', 'dynamics', 'coverage']
    for name in figures:
        assert f'id="{name}"' in report
    curve = next(t for t in figures['curve']['data'] if t['name'] == 'flow characteristic')
    assert curve['x'] == [800.0, 1200.0, None, 1200.0, 1500.0, None]
    assert curve['y'] == [100.0, 180.0, None, 180.0, 195.0, None]
    heat = next(t for t in figures['curve']['data'] if t['type'] == 'heatmap')
    assert sum(c or 0 for row in heat['z'] for c in row) == len(identified.special)
    point = next(t for t in figures['curve']['data'] if t['name'].startswith('breakpoints'))
    assert (point['error_x']['array'], point['error_x']['arrayminus']) == ([11.0], [11.0])
    costs = figures['choice']['data'][0]
    assert dict(zip(costs['x'], costs['y'], strict=True)) == {
        int(j): v for j, v in identified.characteristic.choice.cost.items()
    }
    names = [t['name'] for t in figures['signals']['data']]
    assert names == 2 * ['measured', 'steady state', 'slope response']


def test_the_curve_against_the_opening_is_the_curve_at_pressures_of_the_record(report, identified):
    drawn = figures_of(report)['opening']
    for trace in drawn['data']:
        pressure = float(trace['name'].split()[1])
        v, mw = (np.array(trace[k], dtype=float) for k in ('x', 'y'))
        expected = identified.characteristic.power(v, pressure)
        both = np.isfinite(mw) & np.isfinite(expected)  # the name has three digits
        assert both.sum() > 20
        assert mw[both] == pytest.approx(expected[both], rel=0.01)


def test_colours_of_the_pictures_are_in_the_style_sheet(report):
    style = read_text('style.css')
    tokens = set(re.findall(r'token:([a-z0-9-]+)', json.dumps(figures_of(report))))
    assert 'steady' in tokens
    for look in style.split('@media screen')[:2]:
        for name in tokens:
            assert f'--{name}:' in look, name


def test_a_page_of_ten_days_is_small(make):
    data = make(days=10.0, period_s=1)
    assert len(data.table) == 864_000
    page = identification_report(data)
    assert len(page.encode()) < 5 * MEGABYTE
    assert len(page.encode()) - len(packed_plotly()) < MEGABYTE


def test_what_comes_from_outside_is_escaped(make):
    evil = '<script>alert(1)</script>"\'&'
    data = make(
        source=evil, notes=(evil,), settings=Settings({'unit_tag': evil, 'sample_period': 10.0})
    )
    data = replace_characteristic(data, notes=(evil,))
    page = identification_report(data)
    assert '<script>alert' not in page
    assert page.count('&lt;script&gt;alert(1)') >= 4
    assert page.count('</script>') == 3
    assert 'A &lt;note&gt;.' in page


def replace_characteristic(data, **changes):
    return replace(data, characteristic=replace(data.characteristic, **changes))


def test_what_is_not_known_is_called_unknown(make):
    base = make()
    c = base.characteristic
    unknown = tuple(replace(p, slope_stderr=math.nan, intercept_stderr=math.nan) for p in c.pieces)
    data = replace_characteristic(
        base, pieces=unknown, breakpoint_intervals=((math.nan, math.nan),), dynamics=(),
        source=replace(c.source, temperature_mean_degc=math.nan, temperature_spread_k=math.nan),
    )  # fmt: skip
    page = identification_report(data)
    words = words_of(page)
    assert 'unknown' in words
    assert 'Time constants and delays were not estimated' in words
    assert 'The main steam temperature is not known.' in words
    assert not re.search(r'\bnan\b', words, re.IGNORECASE)
    assert 'dynamics' not in figures_of(page)
    assert not [t for t in figures_of(page)['curve']['data'] if t['name'] == '95 % band']


def test_a_straight_curve_has_no_breakpoints(make):
    base = make()
    c = base.characteristic
    data = replace_characteristic(
        base, pieces=c.pieces[:1], partition_pieces=c.pieces[:1], breakpoint_intervals=()
    )
    page = identification_report(data)
    assert 'It is straight' in words_of(page)
    assert 'break&shy;point' not in page
    names = [t['name'] for t in figures_of(page)['curve']['data']]
    assert 'before refining' not in names


def test_what_endangers_the_answer_stands_beside_it(make):
    base = make()
    c = base.characteristic
    falling = (c.pieces[0], replace(c.pieces[1], slope=-0.05, intercept=240.0))
    data = replace_characteristic(
        base, pieces=falling, notes=('Not refined.',),
        source=replace(c.source, temperature_spread_k=31.0, temperature_flag=True),
    )  # fmt: skip
    words = words_of(identification_report(data))
    answer = words[: words.index('The special segments')]
    for part in ('31.0 K', 'does not rise', 'Not refined.', 'does not raise the power'):
        assert part in answer


def test_confidence_and_support_stand_in_the_page(make):
    c = make().characteristic
    without = identification_report(make())
    assert 'How probable each number of pieces is' not in without
    assert 'rests on' not in without
    choice = replace(c.choice, confidence={1: 0.0001, 2: 0.93, 3: 0.0699})
    support = (
        Support(3, 2, 900, (1100.0, 1150.0), True),
        Support(1, 0, 40, (1300.0,), False),
    )
    page = identification_report(make(characteristic=replace(c, choice=choice, support=support)))
    for part in ('93.0 %', '7.0 %', '3 steady states at 2 levels, 2 slope responses',
                 '1 steady state at 1 level'):  # fmt: skip
        assert part in page
    assert page.count('slope uncertain') + page.count('follows from the pieces beside it') == 1
    assert 'more than 99.9 %' in confidence_table(replace(choice, confidence={2: 1.0}))


def test_a_number_of_pieces_that_is_not_certain_is_said_with_the_curve(make):
    data = make()
    curve = data.characteristic
    chosen = len(curve.pieces)
    likely = {chosen: 0.66, chosen + 1: 0.3, chosen + 2: 0.04}
    unsure = replace(curve, choice=replace(curve.choice, confidence=likely))
    assert (
        f'The number of pieces is not certain: {chosen} has a probability of 66.0 %, '
        f'{chosen + 1} of 30.0 %. The 95 % intervals'
    ) in words_of(identification_report(make(characteristic=unsure)))
    sure = replace(curve, choice=replace(curve.choice, confidence={chosen: 0.96, 9: 0.04}))
    assert 'is not certain' not in words_of(identification_report(make(characteristic=sure)))


def test_no_segment_and_no_value_still_make_a_page(make):
    base = make()
    table = base.table.part(0, 40)
    table.values[:] = np.nan
    page = identification_report(make(table=table, segments=()))
    assert 'unknown' in words_of(page)
    figures_of(page)


def test_quality_tells_what_was_not_used(make):
    counts = {'generated_power': {'accepted': 90, 'impossible': 7, 'late': 3, 'duplicate': 0}}
    data = make(counts=counts)
    words = words_of(identification_report(data))
    assert 'Readings not used: 7 impossible value.' in words
    assert 'too late for its row' in words
    assert 'time given twice' not in words
    assert rejected(counts) == {'impossible': 7}


def test_gaps_are_found_the_longest_first():
    time_ns = np.array([0, 1, 2, 5, 6, 16, 17], dtype=np.int64) * 10**9
    assert [g.seconds for g in gaps(time_ns, 10**9)] == [10.0, 3.0]
    assert gaps(time_ns[:3], 10**9) == []


def test_rows_without_a_needed_value_do_not_count(make):
    data = make()
    table = data.table.part(0, 100)
    values = table.values.copy()
    values[:25, 1] = np.nan
    values[:50, 2] = np.nan
    assert usable_share(replace(table, values=values)) == 0.75


def test_the_band_is_that_of_a_straight_line(identified):
    """Ordinary least squares gives slope error and band; ours must come from the first."""
    rng = np.random.default_rng(2)
    u = rng.uniform(900.0, 1100.0, 400)
    design = np.column_stack([u, np.ones_like(u)])
    inverse = np.linalg.inv(design.T @ design)
    sigma = 1.7
    piece = replace(
        identified.characteristic.pieces[0], u_from=float(u.min()), u_to=float(u.max()),
        slope_stderr=sigma * math.sqrt(inverse[0, 0]),
    )  # fmt: skip
    at = np.linspace(900.0, 1100.0, 7)
    rows = np.column_stack([at, np.ones_like(at)])
    expected = sigma * np.sqrt(np.einsum('ij,jk,ik->i', rows, inverse, rows))
    assert band(piece, u, at) == pytest.approx(expected, rel=1e-9)


def test_numbers_of_a_picture_are_short_and_gaps_are_null():
    assert rounded(np.array([1234.5678, np.nan, 0.1])) == [1234.6, None, 0.1]
    assert rounded(np.array([np.inf])) == [None]
    values = np.array([1.5, np.nan, -2.0])
    raw = np.frombuffer(base64.b64decode(packed(values)['bdata']), '<f8')
    assert np.array_equal(raw, values, equal_nan=True)


def test_a_picture_cannot_close_its_script():
    figure = Figure('x', '', '', [{'name': '</script><b>&', 'y': [float('nan')]}])
    text = figure.to_json()
    assert '<' not in text
    assert json.loads(text)['data'][0] == {'name': '</script><b>&', 'y': [None]}


def test_a_missing_library_is_one_sentence(monkeypatch, tmp_path):
    page.packed_plotly.cache_clear()
    try:
        monkeypatch.setattr(page, 'find_spec', lambda name: None)
        with pytest.raises(InputError, match='pip install plotly'):
            page.packed_plotly()

        class Spec:
            origin = str(tmp_path / '__init__.py')

        monkeypatch.setattr(page, 'find_spec', lambda name: Spec)
        with pytest.raises(InputError, match='incomplete'):
            page.packed_plotly()
    finally:
        page.packed_plotly.cache_clear()


def test_pointing_at_anything_tells_a_unit(identified):
    unit = re.compile(r'MW|%|°C| s<|\bh<|samples|J = |\d{4}-\d\d-\d\d')
    data = replace(identified, history=history(), reference=identified.characteristic)
    for figure in [*identification_page(data).figures, *diagnosis_page(diagnosed()).figures]:
        for trace in figure.traces:
            if trace.get('hoverinfo') == 'skip':
                continue
            told = trace.get('hovertext') or [trace.get('hovertemplate', '')]
            assert all(unit.search(h) or h.startswith('breakpoint') for h in told), (
                figure.name, trace['name'],
            )  # fmt: skip


@pytest.mark.parametrize(
    ('zone', 'said', 'hours'),
    [
        (zoneinfo.ZoneInfo('Europe/Berlin'), '2024-01-02 01:30 CET', 1),
        (zoneinfo.ZoneInfo('America/Sao_Paulo'), '2024-01-01 21:30 -03', -3),
        (timezone(timedelta(hours=5, minutes=30)), '2024-01-02 06:00 UTC+05:30', 5.5),
    ],
)
def test_times_are_told_in_a_zone_in_words_and_along_the_axes(zone, said, hours):
    at_ms = 1_704_155_400_000.0  # 2024-01-02 00:30 UTC
    trace = {'type': 'scatter', 'x': [at_ms, None, at_ms + 1.0], 'y': [at_ms, 2.0, 3.0]}
    layout = {'xaxis': time_axis(range=[at_ms, at_ms]), 'shapes': [upright(at_ms, 'ink', 1.0)]}
    drawn = Figure('one', 'since 2024-01-02 00:30 UTC', 'nothing', [trace], layout)
    made = Page('At 2024-01-02 00:30 UTC', '', [Section('2024-01-02', [drawn])], '', 'identify')
    told = made.in_zone(zone)
    assert told.title == f'At {said}'
    assert told.sections[0].title == '2024-01-02'  # a day has no zone
    (moved,) = told.figures
    shift = 3_600_000.0 * hours
    assert moved.caption == f'since {said}'
    assert moved.traces[0]['x'] == [at_ms + shift, None, at_ms + 1.0 + shift]
    assert moved.traces[0]['y'] == trace['y']
    assert moved.layout['xaxis']['range'] == [at_ms + shift, at_ms + shift]
    assert moved.layout['xaxis']['title']['text'] == f'time ({zone})'
    assert moved.layout['shapes'][0]['x0'] == at_ms + shift
    assert made.in_zone(None) == made


def test_the_hour_that_comes_twice_is_told_by_the_name_of_the_clock():
    zone = zoneinfo.ZoneInfo('Europe/Berlin')
    both = 'from 2024-10-27 00:30 UTC to 2024-10-27 01:30 UTC'
    assert in_zone(both, zone) == 'from 2024-10-27 02:30 CEST to 2024-10-27 02:30 CET'


def test_what_is_told_in_a_zone_already_stays():
    once = in_zone('2024-01-02 00:30 UTC', timezone(timedelta(hours=1)))
    assert once == '2024-01-02 01:30 UTC+01:00'
    assert in_zone(once, timezone(timedelta(hours=5))) == once
