# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``Characteristic.power`` and ``.opening``: each undoes the other, and says what it knows."""

import math

import curves
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st


def curve(knots, left, right, exponent=1.125):
    left, right = np.asarray(left), np.asarray(right)
    slopes = (right - left) / np.diff(knots)
    return curves.curve(knots, slopes, left[1:] - right[:-1], left[0], pressure_exponent=exponent)


@st.composite
def rising(draw):
    """A continuous curve that rises, and its exponent."""
    n = draw(st.integers(1, 5))
    widths = draw(st.lists(st.floats(50.0, 500.0), min_size=n, max_size=n))
    steps = draw(st.lists(st.floats(0.5, 80.0), min_size=n, max_size=n))
    knots = np.cumsum([draw(st.floats(100.0, 1000.0)), *widths])
    powers = np.cumsum([draw(st.floats(0.0, 200.0)), *steps])
    return curve(knots, powers[:-1], powers[1:], draw(st.floats(0.5, 1.5)))


@given(rising(), st.floats(-1e4, 1e4), st.floats(2.0, 30.0))
def test_a_power_is_attained_or_nan(c, power, pressure):
    opening = float(c.opening(power, pressure))
    low, high = c.values()[[0, -1]]
    if (
        low <= power <= high
        and c.inverse(np.array([power]))[0] < 99.0 * pressure**c.pressure_exponent
    ):
        assert 0.0 <= opening <= 100.0
    if power < low - 1e-6 or power > high + 1e-6:
        assert math.isnan(opening)


def test_what_is_known_and_what_is_not():
    c = curve([1000.0, 1500.0, 2000.0], [150.0, 250.0], [250.0, 300.0], exponent=1.0)
    assert c.power(60.0, 20.0) == pytest.approx(190.0)
    table = c.power(np.array([[60.0], [90.0]]), np.array([20.0, 10.0]))
    assert table.shape == (2, 2)
    assert np.isnan(table).tolist() == [[False, True], [False, True]]
    for opening, pressure in ((60.0, np.nan), (np.nan, 20.0), (60.0, 0.0), (60.0, -3.0), (1, 20)):
        assert math.isnan(c.power(opening, pressure))
        assert math.isnan(c.opening(opening + 140.0, 0.0))
    assert c.opening([190.0, 149.0, 301.0, np.nan], 20.0).tolist() == pytest.approx(
        [60.0, np.nan, np.nan, np.nan], nan_ok=True
    )
    # 300 MW at 19 MPa would need 105 %.
    assert math.isnan(c.opening(300.0, 19.0))
    assert c.opening(300.0, 20.0) == pytest.approx(100.0)


@pytest.mark.parametrize(
    ('left', 'right', 'known', 'unknown'),
    [
        ((150.0, 250.0, 250.0), (250.0, 250.0, 300.0), (200.0, 275.0), (250.0,)),
        ((150.0, 260.0, 280.0), (250.0, 280.0, 300.0), (200.0, 270.0), (255.0,)),
        ((150.0, 250.0, 240.0), (250.0, 240.0, 300.0), (200.0, 275.0), (245.0,)),
        ((150.0, 240.0, 280.0), (250.0, 280.0, 300.0), (200.0, 270.0), (245.0,)),
    ],
    ids=['flat piece', 'jump up', 'falling piece', 'jump down'],
)
def test_a_power_of_no_or_of_several_openings_has_none(left, right, known, unknown):
    c = curve([500.0, 1000.0, 1500.0, 2000.0], left, right, exponent=1.0)
    openings = c.opening(np.array(known), 20.0)
    assert c.power(openings, 20.0) == pytest.approx(known)
    assert np.isnan(c.opening(np.array(unknown), 20.0)).all()
