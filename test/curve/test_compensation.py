# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The inverse table against the curve it came from, and against obvious loops."""

import itertools

import numpy as np
import pytest
from curves import curve
from hypothesis import given
from hypothesis import strategies as st
from streams import examples

from valveflow_ros.curve.compensation import compensate
from valveflow_ros.errors import DataError, InputError


def curve_of(knots, slopes, jumps=None, stderr=5e-4):
    return curve(knots, slopes, jumps, 150.0, stderr)


@st.composite
def rising(draw):
    """Draw a joined rising curve."""
    count = draw(st.integers(1, 6))
    widths = draw(st.lists(st.floats(20.0, 400.0), min_size=count, max_size=count))
    slopes = draw(st.lists(st.floats(0.02, 0.4), min_size=count, max_size=count))
    return curve_of([1000.0, *(1000.0 + np.cumsum(widths)).tolist()], slopes)


PAPER = curve_of([1060.0, 1250.0, 1600.0, 1900.0, 2280.0], [0.24, 0.18, 0.09, 0.01])


@examples(60)
@given(rising(), st.integers(2, 40))
def test_interpolating_the_table_gives_the_power_asked_for(c, points):
    made = compensate(c, points)
    asked = np.linspace(made.power_mw[0], made.power_mw[-1], 997)
    got = made.curve.model.static(np.interp(asked, made.power_mw, made.u))
    worst = float(np.abs(got - asked).max())
    # What is said of the error holds, and with a point at each knee there is none.
    assert worst <= made.table_mw + 1e-9
    knees = len(c.breakpoints)
    if points >= knees:
        assert made.table_mw < 1e-4
        assert len(made.power_mw) == points
        # No gap could be divided to better use.
        reach = made.power_mw[-1] - made.power_mw[0]
        assert np.diff(made.power_mw).max() <= 2.0 * reach / (points - knees + 1) + 1e-3
    assert made.identity_mw < 1e-9
    assert np.all(np.diff(made.power_mw) > 0.0)
    assert np.all(np.diff(made.u) > 0.0)
    assert made.u[[0, -1]] == pytest.approx(c.breakpoints[[0, -1]], abs=1e-4)
    assert made.power_mw[[0, -1]] == pytest.approx(c.values()[[0, -1]], abs=1e-4)


@examples(30)
@given(rising(), st.data())
def test_too_few_points_stand_where_trying_every_choice_puts_them(c, data):
    x, y = c.values(), c.breakpoints
    count = data.draw(st.integers(2, len(x)))

    def worst(kept):
        return float(np.abs(np.interp(y, y[list(kept)], x[list(kept)]) - x).max())

    best = min(
        worst((0, *chosen, len(x) - 1))
        for size in range(count - 1)
        for chosen in itertools.combinations(range(1, len(x) - 1), size)
    )
    made = compensate(c, count)
    assert len(made.u) <= count
    assert made.table_mw == pytest.approx(best, abs=1e-4)


def test_a_flat_end_is_named_and_the_useful_part_stops_before_it():
    made = compensate(PAPER)
    assert made.gain_limit == pytest.approx(5.0 / 0.24)
    assert made.useful_mw == pytest.approx((150.0, float(PAPER.values()[3])))
    assert any('Piece 4 (u 1900 to 2280' in note for note in made.notes)
    flat = made.u >= 1900.0 - 1e-6
    assert not made.within[flat].any()
    assert made.within[~flat].all()
    assert made.largest_step == pytest.approx(9.0)
    generous = compensate(PAPER, gain_limit=1000.0)
    assert generous.within.all()
    assert generous.useful_mw[1] == pytest.approx(float(PAPER.values()[-1]))


@pytest.mark.parametrize(
    ('slopes', 'words'), [([0.2, -0.01, 0.1], 'piece 2 (u 1200.0 to 1500.0) falls'),
                          ([0.2, 0.1, 0.0], 'piece 3 (u 1500.0 to 1800.0) is level')]
)  # fmt: skip
def test_a_piece_that_does_not_rise_is_named(slopes, words):
    with pytest.raises(DataError) as caught:
        compensate(curve_of([1000.0, 1200.0, 1500.0, 1800.0], slopes))
    assert words in str(caught.value)
    assert '--u-to' in str(caught.value)


def test_what_is_left_out_needs_no_inverse():
    c = curve_of([1000.0, 1200.0, 1500.0, 1800.0], [0.2, 0.1, -0.01])
    made = compensate(c, u_to=1500.0)
    assert made.u[-1] == 1500.0
    assert made.identity_mw < 1e-9
    assert made.first_piece == 1
    assert compensate(PAPER, u_from=1700.0).first_piece == 3
    assert any('Piece 4' in note for note in compensate(PAPER, u_from=1300.0).notes)
    with pytest.raises(InputError, match='nothing of it lies between'):
        compensate(c, u_from=1900.0)
    with pytest.raises(InputError, match='2 points or more'):
        compensate(c, 1)


def test_a_jump_down_has_no_inverse_and_one_up_is_told():
    knots, slopes = [1000.0, 1200.0, 1500.0], [0.2, 0.1]
    with pytest.raises(DataError, match=r'between pieces 1 and 2, it falls by 3 MW'):
        compensate(curve_of(knots, slopes, [-3.0]))
    made = compensate(curve_of(knots, slopes, [3.0]), 10)
    ((u, low, high),) = made.jumps
    assert (u, low, high) == pytest.approx((1200.0, 190.0, 193.0))
    assert any('jumps from 190.00 to 193.00 MW' in note for note in made.notes)
    assert np.all(np.diff(made.power_mw) >= 0.0)
    assert made.identity_mw < 1e-9
    outside = np.r_[np.linspace(150.0, 189.9, 50), np.linspace(193.1, 222.9, 50)]
    back = made.curve.model.static(np.interp(outside, made.power_mw, made.u))
    assert back == pytest.approx(outside, abs=1e-3)
