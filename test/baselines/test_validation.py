# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Does a characteristic hold on other data."""

import numpy as np
import pytest
from streams import needs_jit

from valveflow_ros.baselines.validation import Verdict, validate
from valveflow_ros.errors import DataError

pytestmark = needs_jit


def test_the_right_curve_holds(curve, data):
    for seed in range(5):
        found = validate(curve(), data(seed=seed), 1.0)
        assert found.verdict is Verdict.HOLDS
        assert found.judged_by == 'curve'
        assert abs(found.overall.test.mean) < 0.1
        assert sum(c.segments for c in found.pieces) == found.overall.segments == 30


def test_a_shift_is_found_with_its_sign_and_size(curve, data):
    found = validate(curve(shift_mw=-3.0), data(), 1.0)
    assert found.verdict is Verdict.OFF
    assert found.overall.test.mean == pytest.approx(3.0, abs=0.1)
    assert found.overall.low_mw < 3.0 < found.overall.high_mw + 0.1
    assert validate(curve(shift_mw=-3.0), data(), 5.0).verdict is Verdict.HOLDS
    assert validate(curve(), data(noise_mw=20.0), 0.5).verdict is Verdict.OPEN
    moving = validate(curve(dynamics=True), data(), 1.0)
    assert (moving.judged_by, moving.verdict) == ('simulated', Verdict.HOLDS)
    assert set(moving.predictions) == {'curve', 'simulated'}


def test_a_shift_of_one_piece_is_found_on_it(curve, data):
    found = validate(curve(), data(shift_mw=-4.0, above=1800.0), 1.0)
    assert found.verdict is Verdict.OFF
    means = [c.test.mean for c in found.pieces]
    assert means[2] == pytest.approx(-4.0, abs=0.2)
    assert np.abs(means[:2]).max() < 0.2


def test_the_better_of_two_is_told(curve, data):
    found = validate(curve(), data(), 1.0, against=curve(shift_mw=2.0))
    assert found.gain is not None
    assert found.gain.zero_is_rejected()
    assert found.gain.mean == pytest.approx(4.0, rel=0.2)
    turned = validate(curve(shift_mw=2.0), data(), 1.0, against=curve())
    assert turned.gain is not None
    assert turned.gain.mean == pytest.approx(-found.gain.mean)
    same = validate(curve(), data(), 1.0, against=curve())
    assert same.gain is not None
    assert not same.gain.zero_is_rejected()


def test_curves_over_different_inputs_are_not_mixed(curve, data):
    with pytest.raises(DataError, match='different inputs'):
        validate(curve(), data(), 1.0, against=curve(exponent=1.0))


def test_the_share_beyond_the_curve_is_told(curve, data):
    found = validate(curve(), data(u_shift=600.0), 1.0)
    u = data(u_shift=600.0).samples.u
    rows = np.concatenate([np.arange(a, b) for a, b, _ in data().spans])
    assert found.outside_share == pytest.approx(np.mean(u[rows] > 2200.0))
    assert 0.1 < found.outside_share < 0.9
