# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The part of the page that judges the curve against a reference."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from valveflow_ros.curve.shift import judge_shift
from valveflow_ros.records import Signal
from valveflow_ros.report.curve import segments_figure, shift_section
from valveflow_ros.report.figure import Figure
from valveflow_ros.report.identification import identification_report
from valveflow_ros.signals.static_form import integrated_input


def with_means(data):
    """Return the segments of an identification with the means their rows have."""
    u = integrated_input(
        data.table.column(Signal.VALVE_OPENING), data.table.column(Signal.MAIN_STEAM_PRESSURE)
    )
    power = data.table.column(Signal.GENERATED_POWER)
    found = []
    for segment, (a, b) in zip(data.segments, data.rows.tolist(), strict=True):
        mean_u, mean_power = float(u[a:b].mean()), float(power[a:b].mean())
        found.append(
            replace(segment, u_start=mean_u, u_end=mean_u, power_start_mw=mean_power,
                    power_end_mw=mean_power)
        )  # fmt: skip
    return tuple(found)


@pytest.fixture
def judged(make):
    """Return a maker of identifications judged against their own curve, lifted by so many MW."""

    def made(by_mw):
        data = make()
        curve = data.characteristic
        lifted = tuple(replace(p, intercept=p.intercept + by_mw) for p in curve.pieces)
        reference = replace(curve, pieces=lifted)
        segments = with_means(data)
        shift = judge_shift(reference, curve, segments)
        return replace(data, segments=segments, shift=shift, reference=reference)

    return made


def test_without_a_reference_the_page_says_nothing_of_it(identified):
    assert shift_section(identified) is None
    assert 'Against the reference' not in identification_report(identified)


@pytest.mark.parametrize(('by_mw', 'moved'), [(0.0, False), (6.0, True)])
def test_the_judgement_stands_on_the_page(judged, by_mw, moved):
    data = judged(by_mw)
    assert data.shift.moved is moved
    page = identification_report(data)
    assert data.shift.sentence.split('(')[0] in page
    section = shift_section(data)
    lead, table, figure = section.parts
    assert ('class="notice"' in lead) is moved
    assert table.count('<b>yes</b>') == (2 if moved else 0)
    assert isinstance(figure, Figure)


def test_every_segment_is_drawn_at_its_difference(judged):
    figure = shift_section(judged(6.0)).parts[2]
    points = np.concatenate([np.array(t['y'], float) for t in figure.traces])
    assert len(points) > 50
    assert np.median(points) == pytest.approx(-6.0, abs=0.5)
    still = shift_section(judged(0.0)).parts[2]
    assert [t['name'] for t in still.traces] == ['pieces that did not move']


def test_a_dated_change_is_marked(judged):
    data = judged(6.0)
    middle = data.shift.pieces[0]
    at = int(data.table.time_ns[len(data.table) // 2])
    dated = replace(
        data.shift, since_ns=at, since_low_ns=at - 10**12, since_high_ns=at + 10**12,
        pieces=(replace(middle, now_mw=-6.0, now_error_mw=0.3), *data.shift.pieces[1:]),
    )  # fmt: skip
    lead, table, figure = shift_section(replace(data, shift=dated)).parts
    assert lead
    assert '−6.0' in table
    assert [s['type'] for s in figure.layout['shapes']] == ['line', 'rect', 'line']
    assert 'The line marks the change' in figure.caption


def test_a_piece_the_reference_does_not_know_is_said(judged):
    data = judged(0.0)
    nan = float('nan')
    unknown = replace(data.shift.pieces[1], u_from=nan, u_to=nan, middle_mw=nan)
    shift = replace(data.shift, pieces=(data.shift.pieces[0], unknown))
    assert 'not in the reference' in shift_section(replace(data, shift=shift)).parts[1]


def test_what_the_curve_leaves_shows_over_u_and_over_time(make):
    data = make()
    assert segments_figure(data) is None, 'records without means say nothing'
    data = replace(data, segments=with_means(data))
    figure = segments_figure(data)
    over_u, over_time = figure.traces
    assert over_u['y'] == over_time['y']
    assert abs(np.mean(over_u['y'])) < 0.2
    # One point a segment of those inside the curve's range, wherever it is drawn.
    assert len(over_u['x']) == len(over_u['y']) <= len(data.segments)
    lifted = tuple(
        replace(s, power_start_mw=s.power_start_mw + 5.0, power_end_mw=s.power_end_mw + 5.0)
        for s in data.segments
    )
    moved = segments_figure(replace(data, segments=lifted))
    assert np.mean(moved.traces[0]['y']) == pytest.approx(np.mean(over_u['y']) + 5.0, abs=1e-3)
