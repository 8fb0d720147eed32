# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What is true of a plant, and how far a curve is from it."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from valveflow_ros.baselines.truth import Line, curve_error, read_truth
from valveflow_ros.curve.characteristic_json import to_json
from valveflow_ros.errors import DataError

RAW = {
    'pressure_exponent': 1.125,
    'pieces': [
        {'u_from': 0.0, 'u_to': 10.0, 'slope': 2.0, 'intercept': 1.0},
        {'u_from': 10.0, 'u_to': 20.0, 'slope': 1.0, 'intercept': 11.0},
    ],
}


def test_a_truth_is_read_and_evaluated():
    truth = read_truth(RAW)
    np.testing.assert_allclose(truth(np.array([0.0, 5.0, 10.0, 15.0])), [1.0, 11.0, 21.0, 26.0])
    assert truth.pressure_exponent == 1.125


def test_a_characteristic_is_a_truth_too(curve):
    c = curve()
    truth = read_truth(to_json(c))
    u = np.linspace(1000.0, 2200.0, 50)
    np.testing.assert_allclose(truth(u), c.model.static(u))


def test_errors_are_those_of_the_curve_and_of_its_parameters():
    truth = read_truth(RAW)
    found = curve_error(lambda u: truth(u) + 0.5, truth, 0.0, 20.0)
    assert (found.rmse_mw, found.largest_mw, found.known) == pytest.approx((0.5, 0.5, 1.0))
    half = curve_error(lambda u: np.where(u < 10.0, truth(u), np.nan), truth, 0.0, 20.0)
    assert half.rmse_mw == 0.0
    assert half.known == pytest.approx(0.5)
    nothing = curve_error(lambda u: u * np.nan, truth, 0.0, 20.0)
    assert np.isnan(nothing.rmse_mw)
    assert nothing.known == 0.0
    assert np.isnan([found.slope, found.knee, found.intercept]).all()
    moved = Line(np.array([0.0, 11.5, 20.0]), np.array([2.1, 0.8]), np.array([1.0, 12.0]))
    off = curve_error(moved, truth, 0.0, 20.0)
    assert (off.slope, off.knee, off.intercept) == pytest.approx((0.2, 1.5, 1.0))
    one = curve_error(Line(np.array([0.0, 1.0]), np.ones(1), np.ones(1)), truth, 0.0, 20.0)
    assert np.isnan([one.slope, one.knee, one.intercept]).all()


@pytest.mark.parametrize(
    ('change', 'sentence'),
    [
        (lambda raw: [], "a list 'pieces'"),
        (lambda raw: {'pieces': []}, "a list 'pieces'"),
        (lambda raw: {'pieces': [3]}, r"'pieces\[0\]' is not an object"),
        (lambda raw: raw['pieces'][1].pop('slope') and raw, r"'pieces\[1\].slope' is missing"),
        (lambda raw: raw['pieces'][0].update(u_to=-1.0) or raw, r"'pieces\[0\].u_to' is not"),
        (lambda raw: raw['pieces'][1].update(u_from=12.0) or raw, r"'pieces\[1\].u_from' is not"),
        (lambda raw: raw['pieces'][0].update(slope=True) or raw, r"'pieces\[0\].slope' is"),
        (lambda raw: raw['pieces'][0].update(slope=float('nan')) or raw, 'is out of range'),
        (lambda raw: raw | {'pressure_exponent': 'x'}, "'pressure_exponent' is not a number"),
    ],
)
def test_what_is_no_truth_is_refused(change, sentence):
    with pytest.raises(DataError, match=sentence):
        read_truth(change(copy.deepcopy(RAW)))
