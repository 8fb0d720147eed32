# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What is drawn of the data: where they are and where they are missing, thinned for the eye."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from valveflow_ros.records import Signal
from valveflow_ros.report.curve import curve_figure, density
from valveflow_ros.report.data import (
    coverage_figure,
    presence_figure,
    segment_path,
)
from valveflow_ros.report.figure import envelope

VALUES = hnp.arrays(
    np.float64, st.integers(1, 300), elements=st.floats(-1e6, 1e6) | st.just(np.nan)
)


def test_hours_add_up_to_the_log(identified):
    figure = coverage_figure(identified)
    other, special = (sum(t['y']) for t in figure.traces)
    step_h = identified.period_ns / 3600e9
    assert special == pytest.approx(len(identified.special) * step_h, rel=1e-3)
    assert other + special == pytest.approx(len(identified.table) * step_h, rel=1e-3)
    assert len(figure.layout['shapes']) == 1, 'one breakpoint'


def shares_of(data):
    """Return the middles of the stretches in ns, and the share there of each signal."""
    (heat,) = presence_figure(data).traces
    edges_ns = np.array(heat['x']) * 1e6
    return 0.5 * (edges_ns[1:] + edges_ns[:-1]), dict(
        zip(heat['y'], np.array(heat['z']) / 100.0, strict=True)
    )


def test_holes_show_when_they_were_and_a_whole_log_needs_no_picture(identified):
    assert presence_figure(identified) is None
    table = identified.table
    values = table.values.copy()
    n = len(table)
    values[: n // 4, Signal.GENERATED_POWER] = np.nan
    middle, share = shares_of(replace(identified, table=replace(table, values=values)))
    early = middle < table.time_ns[n // 4]
    assert share['generated power'][early].max() < 0.5
    assert share['generated power'][~early][1:].min() == 1.0
    assert share['valve opening'].min() == share['main steam pressure'].min() == 1.0


def test_rows_that_are_not_there_count_as_holes(identified):
    table = identified.table
    keep = np.ones(len(table), dtype=bool)
    keep[3000:6000] = False
    short = replace(table, time_ns=table.time_ns[keep], values=table.values[keep])
    _, share = shares_of(replace(identified, table=short))
    assert (1.0 - share['valve opening']).mean() == pytest.approx(3000 / len(table), rel=0.05)


def test_the_last_day_is_shaded_where_the_log_is_longer(make):
    assert not curve_figure(make(days=1.0)).layout.get('shapes')
    data = make(days=2.0)
    (shape,) = curve_figure(data).layout['shapes']
    rows = data.table.time_ns >= data.table.time_ns[-1] - 86400 * 10**9
    inside = (data.u[rows] >= shape['x0']) & (data.u[rows] <= shape['x1'])
    assert inside.mean() == pytest.approx(0.99, abs=0.002)


def test_the_reference_is_drawn_beside_the_curve(identified):
    c = identified.characteristic
    lifted = replace(c, pieces=tuple(replace(p, intercept=p.intercept + 3.0) for p in c.pieces))
    figure = curve_figure(replace(identified, reference=lifted))
    lines = {t['name']: t for t in figure.traces}
    assert lines['reference']['y'][0] == lines['flow characteristic']['y'][0] + 3.0
    assert 'reference' in figure.caption


@given(VALUES, st.integers(1, 60))
def test_an_envelope_keeps_every_peak_of_every_stretch(values, stretches):
    time_ns = 10**18 + np.arange(len(values), dtype=np.int64) * 1000
    _, step_ns, found = envelope(time_ns, values, stretches, 1000)
    assert len(found) <= 2 * stretches
    pairs = found.reshape(-1, 2)
    width = 2.0 * step_ns
    for k, pair in enumerate(pairs):
        inside = [
            v
            for t, v in zip(time_ns, values, strict=True)
            if min(int((t - time_ns[0]) / width), len(pairs) - 1) == k and np.isfinite(v)
        ]
        if inside:
            assert sorted(pair) == [min(inside), max(inside)]
        else:
            assert np.isnan(pair).all()


def test_a_gap_in_time_is_a_gap_in_the_picture():
    time_ns = np.array([0, 1, 2, 3, 96, 97, 98, 99], dtype=np.int64)
    _, _, found = envelope(time_ns, np.ones(8), 10, 1)
    assert np.isnan(found[4:-4]).all()
    assert np.isfinite(found[[0, 1, -2, -1]]).all()


@given(hnp.arrays(np.float64, (2, 40), elements=st.floats(-1e3, 1e3)), st.integers(1, 30))
def test_a_density_counts_each_sample_once(points, cells):
    _, _, counts = density(points[0], points[1], cells, cells)
    assert counts.sum() == points.shape[1]
    assert counts.shape == (cells, cells)


def test_of_nothing_there_is_nothing_to_draw():
    assert density(np.empty(0), np.empty(0), 4, 3)[2].sum() == 0
    assert len(envelope(np.empty(0, dtype=np.int64), np.empty(0), 10, 1)[2]) == 0


@given(st.integers(1, 50))
def test_paths_are_block_means_with_gaps_between_segments(points):
    time_ns = np.arange(100, dtype=np.int64) * 10**6
    values = np.arange(100.0)
    rows = np.array([[5, 15], [40, 80]])
    times, means = segment_path(time_ns, values, rows, points)
    gaps = np.flatnonzero(np.isnan(means))
    assert np.isnan(times[gaps]).all()
    assert len(gaps) == 2
    assert len(means) - 2 <= points + 2
    first, second = np.split(means[~np.isnan(means)], [gaps[0]])
    assert ((first >= 5) & (first <= 14)).all()
    assert ((second >= 40) & (second <= 79)).all()
    assert (np.abs(means - times) <= 100 / points).all() or len(gaps)


def test_all_points_come_back_where_there_is_room():
    time_ns = np.arange(30, dtype=np.int64) * 10**6
    times, means = segment_path(time_ns, np.arange(30.0), np.array([[10, 20]]), 100)
    assert means[:-1].tolist() == list(range(10, 20))
    assert times[:-1].tolist() == list(range(10, 20))
