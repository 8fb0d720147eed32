# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from curves import gaps, inputs, models
from hypothesis import given
from hypothesis import strategies as st
from naive_stream import naive_curve, naive_respond
from streams import examples

from valveflow_ros.curve.regional_model import RegionalModel

# --- the curve ------------------------------------------------------------------------------


@examples(60)
@given(models(), st.lists(st.floats(900.0, 3000.0), min_size=1, max_size=20))
def test_the_curve_is_the_slow_one_and_goes_on_beyond_its_ends(model, u):
    u = np.array([*u, *model.knots])
    expected = [naive_curve(v, model.knots, model.left, model.right) for v in u]
    assert model.static(u) == pytest.approx(expected, rel=1e-12)
    lines = model.slopes() * u[:, None] + model.intercepts()
    assert all(np.abs(line - v).min() < 1e-7 for line, v in zip(lines, expected, strict=True))


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize(('last', 'end'), [(2.0, np.inf), (1.0, np.nan), (0.5, -np.inf)])
def test_an_infinite_input_is_answered_without_a_warning(last, end):
    model = RegionalModel(*(
        np.array(a) for a in ([0.0, 1.0, 2.0], [0.0, 1.0], [1.0, last], [], [], [])
    ))  # fmt: skip
    u = np.array([-np.inf, np.inf, np.nan])
    np.testing.assert_array_equal(model.static(u), [-np.inf, end, np.nan])


# --- the response ---------------------------------------------------------------------------


@examples(40)
@given(models(), st.integers(0, 2**32 - 1), st.sampled_from([0.5, 1.0, 2.0]))
def test_the_response_is_the_slow_one(model, seed, step):
    u, usable = inputs(model, seed), gaps(seed, 300)
    x = [naive_curve(v, model.knots, model.left, model.right) for v in u]
    expected = naive_respond(x, usable, model.levels, model.time_constants, model.delays, step)
    got, settled = model.respond(u, usable, step, settle_s=20.0 * step)
    for k in range(300):
        if usable[k]:
            assert got[k] == pytest.approx(expected[k], rel=1e-10)
        else:
            assert np.isnan(got[k])
        recent = usable[max(0, k - 20) : k + 1]
        assert settled[k] == (k >= 20 and recent.all())


def one_region(time_constant, delay):
    return RegionalModel(
        np.array([0.0, 100.0]), np.array([0.0]), np.array([100.0]), np.empty(0),
        np.array([time_constant]), np.array([delay]),
    )  # fmt: skip


@pytest.mark.parametrize('step', [0.1, 1.0, 2.5, 60.0])
@pytest.mark.parametrize('delay', [0.0, 3.0, 7.7])
def test_a_ramp_is_answered_late_by_time_constant_and_delay_at_any_period(step, delay):
    """Eqs. (13) and (14): y(t) = K_f u(t - T - tau) + C once the transient is over."""
    n = 3000
    time_constant = max(4.0, step)
    time_s = step * np.arange(n)
    u = 10.0 + 80.0 * time_s / time_s[-1]
    got, _ = one_region(time_constant, delay).respond(u, np.ones(n, dtype=np.uint8), step, 0.0)
    late = 10.0 + 80.0 * (time_s - time_constant - delay) / time_s[-1]
    settled = time_s > 40.0 * time_constant + delay
    assert settled.any()
    assert got[settled] == pytest.approx(late[settled], rel=1e-9)
