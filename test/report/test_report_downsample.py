"""Fewer points for the eye keep what the eye looks for."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from valveflow_ros.report.comparison import thin
from valveflow_ros.report.curve import density
from valveflow_ros.report.data import envelope, segment_path

VALUES = hnp.arrays(
    np.float64, st.integers(1, 300), elements=st.floats(-1e6, 1e6) | st.just(np.nan)
)


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


def test_an_envelope_of_nothing_is_empty():
    assert len(envelope(np.empty(0, dtype=np.int64), np.empty(0), 10, 1)[2]) == 0


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


def test_a_density_of_nothing_is_empty():
    assert density(np.empty(0), np.empty(0), 4, 3)[2].sum() == 0


@given(st.integers(0, 5000), st.integers(2, 100))
def test_thinning_keeps_both_ends(number, most):
    places = thin(number, most)
    assert len(places) == min(number, most)
    if number:
        assert (places[0], places[-1]) == (0, number - 1)


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
