from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive_stream import leverage, straight_line
from streams import examples

from valveflow_ros.segments.kernel import LINE_SIZE, line_add, line_ahead, line_fit, line_reset

values = st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=60)


def line_through(points):
    line = np.zeros(LINE_SIZE)
    for value in points:
        line_add(line, float(value))
    return line


@examples(80)
@given(values)
def test_after_every_point_the_line_is_polyfits(points):
    line = np.zeros(LINE_SIZE)
    for n, value in enumerate(points, start=1):
        line_add(line, value)
        at, slope, rms = straight_line(points[:n])
        mean, got_slope, got_rms = line_fit(line)
        scale = max(1e-9, float(np.ptp(points[:n])), 1e-9 * abs(value))
        assert mean == pytest.approx(at((n - 1) / 2.0), abs=1e-9 * scale + 1e-12 * abs(mean))
        assert got_slope == pytest.approx(slope, abs=1e-8 * scale)
        assert got_rms == pytest.approx(rms, abs=1e-6 * scale)


@examples(40)
@given(values, st.floats(0.0, 20.0))
def test_ahead_is_the_line_and_the_leverage_there(points, steps):
    line = line_through(points)
    value, factor = line_ahead(line, steps)
    n = len(points)
    at, _, _ = straight_line(points)
    assert value == pytest.approx(at(n - 1 + steps), abs=1e-7 * max(1.0, float(np.ptp(points))))
    if n > 1:
        assert factor == pytest.approx(math.sqrt(1.0 + leverage(n, n - 1 + steps)), rel=1e-12)


@examples(40)
@given(values, st.sampled_from([1e3, -1e5, 1e6]))
def test_an_offset_moves_the_mean_and_nothing_else(points, offset):
    rounded = [float(np.float32(round(v, 2))) for v in points]
    shifted = [v + offset for v in rounded]
    mean, slope, rms = line_fit(line_through(rounded))
    mean_there, slope_there, rms_there = line_fit(line_through(shifted))
    lost = 1e-16 * abs(offset) * len(points)
    assert mean_there == pytest.approx(mean + offset, abs=10 * lost + 1e-9)
    assert slope_there == pytest.approx(slope, abs=10 * lost + 1e-9)
    assert rms_there**2 == pytest.approx(rms**2, abs=1e-6 + 1e3 * lost)


@examples(40)
@given(values, st.sampled_from([0.5, 4.0, -2.0, 1024.0]))
def test_scaling_by_a_power_of_two_scales_every_bit(points, factor):
    mean, slope, rms = line_fit(line_through(points))
    got = line_fit(line_through([factor * v for v in points]))
    if all(v == 0.0 or abs(v) > 1e-100 for v in points):
        assert got == (factor * mean, factor * slope, abs(factor) * rms)


@examples(40)
@given(values)
def test_reversed_points_have_the_reversed_slope(points):
    mean, slope, rms = line_fit(line_through(points))
    mean_back, slope_back, rms_back = line_fit(line_through(points[::-1]))
    assert mean_back == pytest.approx(mean, abs=1e-9)
    assert slope_back == pytest.approx(-slope, abs=1e-9)
    assert rms_back == pytest.approx(rms, abs=1e-4)


def test_a_straight_line_has_no_residual_even_far_from_zero():
    line = line_through([1e6 + 0.25 * k for k in range(200)])
    mean, slope, rms = line_fit(line)
    assert (mean, slope) == (1e6 + 0.25 * 199 / 2, 0.25)
    assert rms < 1e-6


def test_no_point_one_point_two_points():
    line = np.zeros(LINE_SIZE)
    assert math.isnan(line_fit(line)[0])
    line_add(line, 7.0)
    assert line_fit(line) == (7.0, 0.0, 0.0)
    line_add(line, 9.0)
    assert line_fit(line) == (8.0, 2.0, 0.0)
    line_reset(line)
    assert not line.any()
