from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive_stream import noise_of
from streams import examples

from valveflow_ros.segments.kernel import BINS, FORGET_AT, noise_add, noise_level

rms = st.one_of(st.floats(1e-7, 1e3), st.just(0.0))


def histogram_of(numbers):
    histogram = np.zeros(BINS)
    for number in numbers:
        noise_add(histogram, float(number))
    return histogram


@examples(60)
@given(st.lists(rms, min_size=1, max_size=60))
def test_after_every_number_the_level_is_the_slow_quantile(numbers):
    histogram = np.zeros(BINS)
    for n, number in enumerate(numbers, start=1):
        noise_add(histogram, number)
        assert noise_level(histogram) == pytest.approx(noise_of(numbers[:n]), rel=1e-9)


@examples(40)
@given(st.lists(st.floats(1e-4, 1e2), min_size=1, max_size=60))
def test_the_order_does_not_matter_and_ten_times_the_numbers_have_ten_times_the_level(numbers):
    level = noise_level(histogram_of(numbers))
    assert noise_level(histogram_of(numbers[::-1])) == level
    # A number on the edge of a bin may fall to either side.
    assert noise_level(histogram_of([10 * v for v in numbers])) == pytest.approx(
        10 * level, rel=0.06
    )


def test_the_level_lies_near_the_true_quantile():
    numbers = np.exp(np.random.default_rng(5).normal(0.0, 1.0, 2000))
    wanted = np.quantile(numbers, 0.4)
    assert noise_level(histogram_of(numbers)) == pytest.approx(wanted, rel=0.03)


def test_rough_stretches_in_the_minority_do_not_lift_it():
    calm = [1.0] * 70
    assert noise_level(histogram_of(calm + [50.0] * 30)) < 1.06


def test_nothing_learnt_is_no_noise():
    assert noise_level(np.zeros(BINS)) == 0.0


def test_what_stands_still_teaches_nothing():
    assert noise_level(histogram_of([0.0] * 90 + [2.0] * 10)) == pytest.approx(2.0, rel=0.06)
    assert noise_level(histogram_of([0.0] * 90)) == 0.0


def test_old_stretches_fade():
    histogram = histogram_of([1.0] * (int(FORGET_AT) - 1))
    for _ in range(6 * int(FORGET_AT)):
        noise_add(histogram, 10.0)
        assert histogram.sum() < FORGET_AT
    assert noise_level(histogram) == pytest.approx(10.0, rel=0.06)


@pytest.mark.parametrize('number', [float('nan'), float('inf'), -1.0, 1e300])
def test_an_impossible_number_does_not_poison(number):
    level = noise_level(histogram_of([2.0] * 100))
    assert noise_level(histogram_of([2.0] * 100 + [number])) == level
