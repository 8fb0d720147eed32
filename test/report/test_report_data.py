# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What is drawn of the data, thinned for the eye; numbers as people and pictures read them."""

import base64
import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from valveflow_ros.curve.characteristic import RegionDynamics
from valveflow_ros.records import Signal
from valveflow_ros.report import words
from valveflow_ros.report.answer import dynamics_cells, dynamics_figure
from valveflow_ros.report.curve import band, curve_figure, density
from valveflow_ros.report.data import (
    coverage_figure,
    gaps,
    presence_figure,
    segment_path,
    usable_share,
)
from valveflow_ros.report.figure import Figure, envelope, packed, rounded

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
    figure = presence_figure(data)
    (heat,) = figure.traces
    assert figure.layout['xaxis']['tickangle'] == 0, 'inclined times are cut off'
    edges_ns, shares = np.array(heat['x']) * 1e6, np.array(heat['z']) / 100.0
    return 0.5 * (edges_ns[1:] + edges_ns[:-1]), dict(zip(heat['y'], shares, strict=True))


def test_holes_show_when_they_were_and_a_whole_log_needs_no_picture(identified):
    assert presence_figure(identified) is None
    table, n = identified.table, len(identified.table)
    values = table.values.copy()
    values[: n // 4, Signal.GENERATED_POWER] = np.nan
    holes = replace(table, values=values)
    assert usable_share(holes) == 0.75
    middle, share = shares_of(replace(identified, table=holes))
    early = middle < table.time_ns[n // 4]
    assert share['generated power'][early].max() < 0.5
    assert share['generated power'][~early][1:].min() == 1.0
    assert share['valve opening'].min() == share['main steam pressure'].min() == 1.0
    # Rows that are not there count as holes.
    keep = np.ones(n, dtype=bool)
    keep[3000:6000] = False
    short = replace(table, time_ns=table.time_ns[keep], values=table.values[keep])
    _, share = shares_of(replace(identified, table=short))
    assert (1.0 - share['valve opening']).mean() == pytest.approx(3000 / n, rel=0.05)
    assert [g.seconds for g in gaps(short.time_ns, identified.period_ns)] == [30_010.0]


def test_gaps_are_found_the_longest_first():
    time_ns = np.array([0, 1, 2, 5, 6, 16, 17], dtype=np.int64) * 10**9
    assert [g.seconds for g in gaps(time_ns, 10**9)] == [10.0, 3.0]
    assert gaps(time_ns[:3], 10**9) == []


def test_the_last_day_is_shaded_where_the_log_is_longer(identified, make):
    assert not curve_figure(identified).layout.get('shapes')
    data = make(days=2.0)
    (shape,) = curve_figure(data).layout['shapes']
    rows = data.table.time_ns >= data.table.time_ns[-1] - 86400 * 10**9
    inside = (data.u[rows] >= shape['x0']) & (data.u[rows] <= shape['x1'])
    assert inside.mean() == pytest.approx(0.99, abs=0.002)


def test_the_band_is_that_of_a_straight_line(identified):
    """Ordinary least squares gives slope error and band; ours must come from the first."""
    u, sigma = np.random.default_rng(2).uniform(900.0, 1100.0, 400), 1.7
    design = np.column_stack([u, np.ones_like(u)])
    inverse = np.linalg.inv(design.T @ design)
    piece = replace(
        identified.characteristic.pieces[0], u_from=float(u.min()), u_to=float(u.max()),
        slope_stderr=sigma * math.sqrt(inverse[0, 0]),
    )  # fmt: skip
    at = np.linspace(900.0, 1100.0, 7)
    rows = np.column_stack([at, np.ones_like(at)])
    expected = sigma * np.sqrt(np.einsum('ij,jk,ik->i', rows, inverse, rows))
    assert band(piece, u, at) == pytest.approx(expected, rel=1e-9)


@given(VALUES, st.integers(1, 60))
def test_an_envelope_keeps_every_peak_of_every_stretch(values, stretches):
    time_ns = 10**18 + np.arange(len(values), dtype=np.int64) * 1000
    _, step_ns, found = envelope(time_ns, values, stretches, 1000)
    assert len(found) <= 2 * stretches
    pairs = found.reshape(-1, 2)
    places = np.minimum((time_ns - time_ns[0]) / (2.0 * step_ns), len(pairs) - 1).astype(int)
    for k, pair in enumerate(pairs):
        inside = values[(places == k) & np.isfinite(values)]
        expected = [inside.min(), inside.max()] if len(inside) else [np.nan, np.nan]
        np.testing.assert_array_equal(sorted(pair), expected)


def test_a_gap_in_time_is_a_gap_in_the_picture_and_of_nothing_nothing_is_drawn():
    time_ns = np.array([0, 1, 2, 3, 96, 97, 98, 99], dtype=np.int64)
    _, _, found = envelope(time_ns, np.ones(8), 10, 1)
    assert np.isnan(found[4:-4]).all()
    assert np.isfinite(found[[0, 1, -2, -1]]).all()
    assert density(np.empty(0), np.empty(0), 4, 3)[2].sum() == 0
    assert len(envelope(np.empty(0, dtype=np.int64), np.empty(0), 10, 1)[2]) == 0


@given(st.integers(1, 100))
def test_paths_are_block_means_with_gaps_between_segments(points):
    time_ns = np.arange(100, dtype=np.int64) * 10**6
    times, means = segment_path(time_ns, np.arange(100.0), np.array([[5, 15], [40, 80]]), points)
    gaps = np.flatnonzero(np.isnan(means))
    assert np.isnan(times[gaps]).all()
    assert len(gaps) == 2
    assert len(means) - 2 <= points + 2
    first, second = np.split(means[~np.isnan(means)], [gaps[0]])
    assert ((first >= 5) & (first <= 14)).all()
    assert ((second >= 40) & (second <= 79)).all()
    if points >= 50:
        assert [*first, *second] == [*range(5, 15), *range(40, 80)], 'there is room for all'


# Numbers.


def value_of(text):
    return float(text.replace('−', '-').replace('\u202f', ''))


@given(st.floats(), st.floats(-1e12, 1e12), st.integers(1, 8))
def test_a_number_reads_as_itself_and_never_nan_or_inf(any_value, value, digits):
    for text in (
        words.plain(any_value), words.decimals(any_value, 2), words.percent(any_value),
        words.with_error(any_value, any_value), words.interval(any_value, any_value),
        words.duration(abs(any_value)),
    ):  # fmt: skip
        assert text
        assert not re.search(r'nan|inf', text)
    shown = value_of(words.plain(value, digits))
    assert math.isclose(shown, value, rel_tol=0.6 * 10.0 ** (1 - digits))


@given(st.floats(-1e5, 1e5), st.floats(1e-4, 1e3))
def test_error_decides_the_digits(value, error):
    text = words.with_error(value, error, 'MW')
    assert text.endswith(' MW')
    shown, spread = (value_of(part) for part in text.removesuffix(' MW').split(' ± '))
    half = 1.959964 * error
    assert abs(shown - value) <= 0.06 * half + 0.5
    assert math.isclose(spread, half, rel_tol=0.06) or abs(spread - half) <= 0.5


@given(st.floats(0.0, 1e9))
def test_a_duration_is_within_its_smaller_unit(seconds):
    parts = re.findall(r'([0-9.e+-]+) (d|h|min|s)\b', words.duration(seconds))
    assert 1 <= len(parts) <= 2
    sizes = {'d': 86400.0, 'h': 3600.0, 'min': 60.0, 's': 1.0}
    total = sum(float(n) * sizes[unit] for n, unit in parts)
    assert abs(total - seconds) <= {'d': 1800.0, 'h': 30.0}.get(parts[0][1], 0.5)


@given(st.floats(0.0, 1.0, exclude_max=True))
def test_not_quite_all_never_reads_as_all(share):
    assert words.percent(share) != '100 %'


def test_numbers_as_people_read_them():
    for seconds, text in (
        (0.5, '0.5 s'), (1, '1 s'), (60, '1 min'), (61, '1 min 1 s'), (863999, '10 d'),
        (90000, '1 d 1 h'), (86399, '1 d'),
    ):  # fmt: skip
        assert words.duration(seconds) == text
    for shown, text in (
        (words.percent(1.0), '100 %'), (words.percent(0.99954), '99.954 %'),
        (words.with_error(0.2397, 0.00061), '0.2397 ± 0.0012'),
        (words.with_error(5.0, math.nan, 's'), '5.000 s'),
        (words.time_with_error(12.0, 12.1), 'not known'),
        (words.time_with_error(12.0, 11.9), words.with_error(12.0, 11.9)),
        (words.time_with_error(0.0, 1e-9), 'not known'),
        (words.decimals(-0.001, 1), '0.0'), (words.plain(-2.5), '−2.500'),
        (words.interval(1245.2, 1257.9), '1245 to 1258'), (words.counted(1, 'piece'), '1 piece'),
        (words.counted(2300, 'piece'), '2\u202f300 pieces'),
        (words.moment(0), '1970-01-01 00:00:00 UTC'),
        (words.moment(10**29), f'{10**20} s since 1970'),
    ):  # fmt: skip
        assert shown == text


def test_the_table_and_the_figure_of_dynamics_leave_out_what_is_not_known():
    sure = RegionDynamics(0.0, 200.0, 12.0, 2.0, 1.0, 0.5)
    unsure = replace(sure, power_from=200.0, power_to=300.0, time_constant_stderr_s=13.0)
    vague = replace(sure, delay_stderr_s=2.5)
    found = [
        str(dynamics_cells(d)).count('not known') for d in ((sure,), (sure, unsure), (vague,))
    ]
    assert found == [0, 2, 1]
    assert dynamics_figure((unsure,)) is None
    assert len(dynamics_figure((sure, unsure)).traces) == 1


def test_numbers_of_a_picture_are_short_gaps_are_null_and_none_closes_its_script():
    assert rounded(np.array([1234.5678, np.nan, 0.1])) == [1234.6, None, 0.1]
    assert rounded(np.array([np.inf])) == [None]
    values = np.array([1.5, np.nan, -2.0])
    raw = np.frombuffer(base64.b64decode(packed(values)['bdata']), '<f8')
    assert np.array_equal(raw, values, equal_nan=True)
    text = Figure('x', '', '', [{'name': '</script><b>&', 'y': [math.nan]}]).to_json()
    assert '<' not in text
    assert json.loads(text)['data'][0] == {'name': '</script><b>&', 'y': [None]}
