"""Where the data are: over u and over time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from valveflow_ros.report.curve import curve_figure, last_range
from valveflow_ros.report.data import coverage_figure, presence, presence_figure


def test_hours_add_up_to_the_log(identified):
    figure = coverage_figure(identified)
    other, special = (sum(t['y']) for t in figure.traces)
    step_h = identified.period_ns / 3600e9
    assert special == pytest.approx(len(identified.special) * step_h, rel=1e-3)
    assert other + special == pytest.approx(len(identified.table) * step_h, rel=1e-3)
    assert len(figure.layout['shapes']) == 1, 'one breakpoint'


def test_a_whole_log_needs_no_picture_of_holes(identified):
    assert presence_figure(identified) is None


def test_holes_show_when_they_were(identified):
    table = identified.table
    values = table.values.copy()
    n = len(table)
    values[: n // 4, 3] = np.nan
    data = replace(identified, table=replace(table, values=values))
    edges, share = presence(data)
    row = share[3]
    middle = 0.5 * (edges[1:] + edges[:-1])
    early = middle < table.time_ns[n // 4]
    assert row[early].max() < 0.5
    assert row[~early][1:].min() == 1.0
    assert share[[0, 1]].min() == 1.0
    assert presence_figure(data) is not None


def test_rows_that_are_not_there_count_as_holes(identified):
    table = identified.table
    keep = np.ones(len(table), dtype=bool)
    keep[3000:6000] = False
    short = replace(table, time_ns=table.time_ns[keep], values=table.values[keep])
    _, share = presence(replace(identified, table=short))
    whole = (1.0 - share[0]).mean()
    assert whole == pytest.approx(3000 / len(table), rel=0.05)


def test_the_last_day_is_shaded_where_the_log_is_longer(make):
    assert last_range(make(days=1.0)) is None
    data = make(days=2.0)
    low, high = last_range(data)
    rows = data.table.time_ns >= data.table.time_ns[-1] - 86400 * 10**9
    inside = (data.u[rows] >= low) & (data.u[rows] <= high)
    assert inside.mean() == pytest.approx(0.99, abs=0.002)
    (shape,) = curve_figure(data).layout['shapes']
    assert (shape['x0'], shape['x1']) == (low, high)


def test_the_reference_is_drawn_beside_the_curve(identified):
    c = identified.characteristic
    lifted = replace(c, pieces=tuple(replace(p, intercept=p.intercept + 3.0) for p in c.pieces))
    figure = curve_figure(replace(identified, reference=lifted))
    lines = {t['name']: t for t in figure.traces}
    assert lines['reference']['y'][0] == lines['flow characteristic']['y'][0] + 3.0
    assert 'reference' in figure.caption
