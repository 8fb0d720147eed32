# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
import dataclasses
import json
import math

import numpy as np
import pytest
from curves import DYNAMICS, curve, curves
from hypothesis import given
from hypothesis import strategies as st
from streams import examples

from valveflow_ros.curve.characteristic import FormEvidence
from valveflow_ros.curve.characteristic_json import from_json, to_json
from valveflow_ros.errors import DataError

NAN, INF = math.nan, math.inf


def naive_value(c, u):
    """Evaluate by walking through the pieces; the right piece has a knot."""
    if math.isnan(u) or u < c.pieces[0].u_from or u > c.pieces[-1].u_to:
        return NAN
    piece = [p for p in c.pieces if p.u_from <= u][-1]
    return piece.slope * u + piece.intercept


# --- evaluation and inverse -----------------------------------------------------------------


@examples(80)
@given(curves(rising=False), st.lists(st.floats(-300.0, 5000.0), max_size=20))
def test_it_is_each_pieces_line_and_nothing_outside(c, inputs):
    inputs = [*inputs, *c.breakpoints, NAN, INF, -INF]
    expected = [naive_value(c, u) for u in inputs]
    scale = max(1.0, *(abs(v) for v in expected if math.isfinite(v)))
    assert c(np.array(inputs)) == pytest.approx(expected, abs=1e-9 * scale, nan_ok=True)


@examples(100)
@given(curves(), st.lists(st.floats(0.0, 1.0), min_size=1, max_size=20))
def test_the_inverse_is_the_smallest_input_that_reaches_the_power(c, shares):
    dense = np.unique(
        np.concatenate([np.linspace(p.u_from, p.u_to, 400, endpoint=False) for p in c.pieces])
    )
    reached = c(dense)
    low, high = reached[0], max(reached.max(), c.model.right.max())
    for power in low + np.array(shares) * (high - low):
        (u,) = c.inverse(np.array([power]))
        before = dense[dense < u - 1e-6]
        assert not len(before) or c(before).max() <= power + 1e-6
        value = naive_value(c, u)
        if abs(value - power) > 1e-6:  # only in a jump, or at the end of a piece
            assert np.abs(c.breakpoints - u).min() < 1e-6
            k = int(np.argmin(np.abs(c.breakpoints - u)))
            from_left = c.model.right[k - 1]
            assert from_left - 1e-6 <= power


@examples(60)
@given(curves(jumps=False), st.lists(st.floats(0.0, 1.0), min_size=1, max_size=20))
def test_without_jumps_the_inverse_undoes_the_curve_both_ways(c, shares):
    # The sum may round to a number beyond the end, where there is no curve.
    knots = c.breakpoints
    u = np.minimum(knots[0] + np.array(shares) * (knots[-1] - knots[0]), knots[-1])
    assert c.inverse(c(u)) == pytest.approx(u, abs=1e-6)
    values = c.values()
    power = np.minimum(values[0] + np.array(shares) * (values[-1] - values[0]), values[-1])
    assert c(c.inverse(power)) == pytest.approx(power, abs=1e-6)


@pytest.mark.parametrize(
    ('slopes', 'jump', 'inverse'),
    [
        ([1.0, 2.0], 0.0, {0.0: 0.0, 10.0: 10.0, 30.0: 20.0, -0.1: NAN, 30.1: NAN, INF: NAN}),
        ([1.0, 1.0], 5.0, {10.0: 10.0, 12.0: 10.0, 15.0: 10.0, 16.0: 11.0}),
        ([1.0, 1.0], -4.0, {9.0: 9.0, 10.0: 10.0, 11.0: 15.0, 16.0: 20.0, NAN: NAN, -INF: NAN}),
    ],
    ids=['joined', 'jump up: the knot', 'jump down: where the power is new'],
)
def test_the_inverse_at_the_ends_and_in_a_jump(slopes, jump, inverse):
    c = curve([0.0, 10.0, 20.0], slopes, [jump])
    got = c.inverse(np.array(list(inverse)))
    assert got == pytest.approx(list(inverse.values()), abs=0.0, nan_ok=True)
    assert c.values()[1] == 10.0 + jump / 2.0
    with pytest.raises(DataError, match='no inverse: piece 2 does not rise'):
        curve([0.0, 10.0, 20.0], [1.0, -0.01]).inverse(np.array([10.0]))


# --- the id ---------------------------------------------------------------------------------


@examples(30)
@given(curves())
def test_the_id_follows_from_the_numbers_and_nothing_else(c):
    named = c.with_id()
    assert len(named.model_id) == 12
    assert named.with_id().model_id == named.model_id
    assert dataclasses.replace(c, model_id='other').with_id().model_id == named.model_id
    piece = dataclasses.replace(
        c.pieces[0], intercept=math.nextafter(c.pieces[0].intercept, math.inf)
    )
    moved = dataclasses.replace(c, pieces=(piece, *c.pieces[1:]))
    assert moved.with_id().model_id != named.model_id


# --- JSON -----------------------------------------------------------------------------------


def through_json(c):
    """Write and read as a file would, in strict JSON."""
    text = json.dumps(to_json(c), allow_nan=False)
    return from_json(json.loads(text))


@examples(60)
@given(curves(rising=False), st.booleans())
def test_json_and_back_is_the_same_to_the_last_bit(c, dynamic):
    c = dataclasses.replace(c, dynamics=DYNAMICS if dynamic else ()).with_id()
    back = through_json(c)
    assert repr(back) == repr(c)  # NaN equals NaN in its repr
    assert back.with_id().model_id == c.model_id


GOOD = to_json(curve([0.0, 10.0, 20.0], [1.0, 2.0], dynamics=DYNAMICS).with_id())


def test_what_this_program_adds_to_the_contract_may_be_missing():
    raw = {
        k: v
        for k, v in GOOD.items()
        if k not in ('model_id', 'window', 'temperature', 'residuals', 'partition', 'notes')
    }
    raw['dynamics'] = [
        {k: d[k] for k in ('power_from', 'power_to', 'time_constant_s', 'delay_s')}
        for d in raw['dynamics']
    ]  # fmt: skip
    back = from_json(raw)
    assert back.pieces == from_json(GOOD).pieces
    assert math.isnan(back.residuals.rmse_mw)
    assert back.notes == ()


# --- knees at fixed openings ----------------------------------------------------------------


def choked(exponent=1.05, offset=-9.0, **more):
    """Return a curve of p^e F(V) + c."""
    return curve(
        [20.0, 45.0, 70.0, 100.0], [0.4, 0.25, 0.1], start=5.0, dynamics=DYNAMICS,
        axis='opening', pressure_exponent=0.0, pressure_scale_exponent=exponent, offset_mw=offset,
        reference_pressure_mpa=13.0, **more,
    )  # fmt: skip


@examples(60)
@given(st.floats(0.4, 1.3), st.floats(-40.0, 40.0), st.floats(10.0, 110.0), st.floats(5.0, 20.0))
def test_the_power_is_the_curves_at_the_opening_times_the_pressure(exponent, offset, v, p):
    c = choked(exponent, offset)
    expected = p**exponent * naive_value(c, v) + offset
    assert float(c.power(v, p)) == pytest.approx(expected, nan_ok=True)
    assert from_json(to_json(c.with_id())).power(v, p) == pytest.approx(expected, nan_ok=True)
    assert c.values() == pytest.approx(c.power(c.breakpoints, 13.0))
    there = c.at_pressure(p)
    assert float(there(np.array(v))) == pytest.approx(expected, nan_ok=True)
    assert float(there.power(v, 1.7)) == pytest.approx(expected, nan_ok=True)
    if math.isfinite(expected):
        assert float(c.opening(expected, p)) == pytest.approx(v, abs=1e-6)
        assert math.isnan(c.opening(expected + 5000.0, p))


@pytest.mark.parametrize('form', [None, FormEvidence(
    'opening', True, 321.0, 0.4, 7.5, 'F(V p^1.2)', 6.0, (80.0, 9.0, 21.0), False)])  # fmt: skip
def test_the_form_survives_json(form):
    c = choked(form=form).with_id()
    raw = json.loads(json.dumps(to_json(c), allow_nan=False))
    assert (raw['axis'], raw['pressure_scale_exponent'], raw['offset_mw']) == ('opening', 1.05, -9)
    back = from_json(raw)
    assert back == c
    if form is not None:
        assert {'chosen', 'log_likelihood_gain', 'rmse_other_mw'} <= set(raw['form'])
    # A file of another program has what the contract names and no more.
    bare = {k: v for k, v in raw.items() if k not in ('reference_pressure_mpa', 'model_id')}
    bare['pressure_exponent'] = 1.125
    bare['form'] = {'chosen': 'opening', 'log_likelihood_gain': 3.0, 'rmse_other_mw': 2.0}
    theirs = from_json(bare)
    assert from_json(json.loads(json.dumps(to_json(theirs), allow_nan=False))) is not None
    assert theirs.power(50.0, 11.0) == pytest.approx(c.power(50.0, 11.0))
    assert np.isfinite(theirs.values()).all()


@pytest.mark.parametrize(
    ('change', 'what'),
    [
        ({'axis': 'opening'}, 'pressure_scale_exponent'),
        ({'offset_mw': 3.0}, 'offset_mw'),
        ({'pressure_scale_exponent': 1.0}, 'pressure_scale_exponent'),
        ({'pressure_exponent': 0.0}, 'pressure_exponent'),
        ({'form': {'chosen': 'both', 'log_likelihood_gain': 0.0, 'rmse_other_mw': 0.0}}, 'chosen'),
        ({'form': 3}, 'form'),
    ],
)
def test_exponents_that_do_not_belong_to_the_axis_are_refused(change, what):
    with pytest.raises(DataError, match=what):
        from_json({**GOOD, **change})
