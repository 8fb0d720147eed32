# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The form of the static power: what a curve is a function of, and what it is multiplied by."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from valveflow_ros.signals.static_form import (
    INTEGRATED_INPUT,
    OPENING,
    StaticForm,
    integrated_input,
    pressure_of,
)

forms = st.builds(StaticForm, st.sampled_from([INTEGRATED_INPUT, OPENING]), st.floats(0.8, 1.4))


def rows(seed, n=50):
    r = np.random.default_rng(seed)
    return r.uniform(5.0, 100.0, n), r.uniform(6.0, 18.0, n)


@given(forms, st.integers(0, 99), st.floats(0.9, 1.3))
def test_rows_and_their_integrated_input_give_the_same(form, seed, exponent):
    opening, pressure = rows(seed)
    u, scale = form.of_rows(opening, pressure)
    again, same = form.of_integrated_input(
        integrated_input(opening, pressure, exponent), opening, exponent
    )
    assert again == pytest.approx(u, rel=1e-12)
    assert (scale is None) is (same is None) is (form.axis == INTEGRATED_INPUT)
    if scale is not None:
        assert u.tolist() == opening.tolist()
        assert scale == pytest.approx(pressure**form.exponent)
        assert same == pytest.approx(scale, rel=1e-12)
    else:
        assert u == pytest.approx(opening * pressure**form.exponent)


@given(st.integers(0, 99), st.integers(0, 50))
def test_cutting_rows_changes_no_bit(seed, at):
    opening, pressure = rows(seed)
    u = integrated_input(opening, pressure)
    whole = pressure_of(u, opening, 1.125)
    parts = [pressure_of(u[s], opening[s], 1.125) for s in (slice(0, at), slice(at, None))]
    assert np.concatenate(parts).tolist() == whole.tolist()
    assert whole == pytest.approx(pressure, rel=1e-12)


@pytest.mark.parametrize(
    'form', [StaticForm(), StaticForm(exponent=1.0), StaticForm(OPENING, 1.0)]
)
def test_what_is_not_known_is_nan(form):
    nan = np.nan
    opening = np.array([50.0, nan, 50.0, 50.0, 50.0])
    pressure = np.array([10.0, 10.0, nan, 0.0, -1.0])
    u, scale = form.of_rows(opening, pressure)
    assert np.isfinite(u).tolist() == [True, False, False, False, False]
    assert scale is None or np.isfinite(scale).tolist() == np.isfinite(u).tolist()
    # A closed valve has no pressure in V p^m.
    assert np.isnan(pressure_of(np.zeros(2), np.array([0.0, -1.0]), 1.125)).all()
