# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
from curves import DYNAMICS, curve
from hypothesis import given
from hypothesis import strategies as st
from naive_stream import naive_curve, naive_respond
from streams import (
    blocks_of,
    cuts,
    examples,
    first_difference,
    grid_ns,
    steps_and_ramps,
    story,
)

from valveflow_ros.monitoring.prediction import PredictionState, Predictor
from valveflow_ros.records import NS_PER_S
from valveflow_ros.segments.kernel import NO_DATA, SETTLED_SLOPE, SETTLED_STEADY, TRANSIENT

N = 260
NAN = math.nan
SETTLE, AVERAGE = 25, 40.0


def paper(dynamic=True):
    """Return a curve with a jump, from 1050 to 1900."""
    return curve(
        [1050.0, 1250.0, 1600.0, 1900.0], [0.24, 0.18, 0.09], [0.0, 3.0], 152.0,
        dynamics=DYNAMICS if dynamic else (),
    ).with_id()  # fmt: skip


harm = st.lists(
    st.tuples(st.sampled_from(['nan_u', 'nan_power', 'no_data', 'leap', 'back', 'inf']),
              st.integers(0, N - 1), st.integers(1, 30)),
    max_size=5,
)  # fmt: skip


def rows_of(seed, harms, step_s=1.0):
    """Return time, u, power and kinds of rows, some of them bad; u leaves the curve at times."""
    rng = np.random.default_rng(seed)
    time_ns = grid_ns(N, step_s)
    u = steps_and_ramps(rng, N, 1000.0, 1950.0, hold=(20, 60), rate=8.0)
    power = 0.15 * u + rng.normal(0.0, 1.0, N)
    kinds = rng.choice([TRANSIENT, SETTLED_STEADY, SETTLED_SLOPE], N).astype(np.uint8)
    for what, at, length in harms:
        rows = slice(at, at + length)
        if what == 'nan_u':
            u[rows] = np.nan
        elif what == 'nan_power':
            power[rows] = np.nan
        elif what == 'inf':
            power[at] = np.inf
        elif what == 'no_data':
            kinds[rows] = NO_DATA
        else:
            time_ns[at:] += round((length if what == 'leap' else -length) * step_s * NS_PER_S)
    return time_ns, u, power, kinds


def naive_predictions(c, time_ns, u, power, kinds, step_s=1.0):
    """Return one dict a row, from the words of the records alone."""
    knots, m = c.breakpoints, c.model
    good = np.isfinite(u) & np.isfinite(power) & (kinds != NO_DATA)
    ages, runs = [], []
    for k in range(len(u)):
        step = time_ns[k] - time_ns[k - 1] if k else 0
        joins = ages and ages[-1] > 0 and 0 < step <= 1.5 * step_s * NS_PER_S
        ages.append((ages[-1] if joins else 0) + 1 if good[k] else 0)
        if ages[-1] == 1:
            runs.append([])
        if good[k]:
            runs[-1].append(k)
    answers = {}
    for run in runs if m.regions else []:
        x = [naive_curve(u[k], m.knots, m.left, m.right) for k in run]
        true = [True] * len(run)
        answer = naive_respond(x, true, m.levels, m.time_constants, m.delays, step_s)
        answers.update(zip(run, answer, strict=True))
    rows, mean = [], NAN
    for k in range(len(u)):
        row = dict.fromkeys(('static', 'dynamic', 'residual'), NAN)
        inside = good[k] and knots[0] <= u[k] <= knots[-1]
        if not good[k]:
            row['state'] = PredictionState.BAD_DATA
        elif not inside:
            row['state'] = PredictionState.OUTSIDE
        else:
            row['state'] = {
                SETTLED_STEADY: PredictionState.STEADY, SETTLED_SLOPE: PredictionState.SLOPE,
                TRANSIENT: PredictionState.TRANSIENT,
            }[int(kinds[k])]  # fmt: skip
            row['static'] = naive_curve(u[k], m.knots, m.left, m.right)
            if m.regions and ages[k] > SETTLE:
                row['dynamic'] = answers[k]
                row['residual'] = power[k] - answers[k]
            elif not m.regions and kinds[k] != TRANSIENT:
                row['residual'] = power[k] - row['static']
        if k and not 0 < time_ns[k] - time_ns[k - 1] <= 1.5 * step_s * NS_PER_S:
            mean = NAN  # nobody knows what the mean was in between
        if math.isfinite(row['residual']):
            forget = math.exp(-step_s / AVERAGE)
            mean = forget * (0.0 if math.isnan(mean) else mean)
            mean += (1.0 - forget) * row['residual']
        row['average'] = mean
        rows.append(row)
    return rows


def predictor(c, step_s=1.0):
    return Predictor(c, step_s, SETTLE * step_s, AVERAGE)


@examples(30)
@given(
    st.integers(0, 2**32 - 1), harm, st.booleans(), st.sampled_from([0.5, 1.0, 60.0]), st.data()
)
def test_every_block_gives_what_the_slow_truth_gives_and_any_cutting_the_same_bits(
    seed, harms, dynamic, step_s, data
):
    c = paper(dynamic)
    rows = rows_of(seed, harms, step_s)
    expected = naive_predictions(c, *rows, step_s)
    p, blocks = predictor(c, step_s), []
    for start, end in blocks_of(N, data.draw(cuts(N, most=20))):
        block = p.predict(*(a[start:end] for a in rows))
        assert (len(block), block.model_id) == (end - start, c.model_id)
        assert block.width_mw == pytest.approx(c.residuals.width_mw, nan_ok=True)
        for name in ('static', 'dynamic', 'residual', 'average'):
            wanted = [r[name] for r in expected[start:end]]
            got = getattr(block, f'{name}_mw')
            assert got == pytest.approx(wanted, rel=1e-9, abs=1e-9, nan_ok=True), name
        assert block.state.tolist() == [r['state'] for r in expected[start:end]]
        assert np.array_equal(block.time_ns, rows[0][start:end])
        blocks.append(block)
    whole = predictor(c, step_s).predict(*rows)
    assert not first_difference(story([whole]), story(blocks))


def test_warmed_up_it_goes_on_as_if_it_had_always_run():
    c = paper()
    rows = rows_of(5, [])
    whole = predictor(c).predict(*rows)
    p = predictor(c)
    start = 2 * p.warm_up_rows
    assert p.warm_up_rows > SETTLE
    p.warm_up(*(a[:start] for a in rows[:3]))
    later = p.predict(*(a[start:] for a in rows))
    assert np.array_equal(later.dynamic_mw, whole.dynamic_mw[start:], equal_nan=True)
    first = np.flatnonzero(np.isfinite(later.residual_mw))[0]
    forget = math.exp(-1.0 / AVERAGE)
    assert np.isnan(later.average_mw[:first]).all()
    assert later.average_mw[first] == pytest.approx((1 - forget) * later.residual_mw[first])


def test_the_longest_delay_a_file_may_name_is_remembered():
    slow = curve([0.0, 1000.0], [0.1], dynamics=(
        type(DYNAMICS[0])(0.0, 100.0, 5.0, 600.0, NAN, NAN),))  # fmt: skip
    n = 1500
    u = np.where(np.arange(n) < 700, 200.0, 800.0)
    block = predictor(slow).predict(grid_ns(n), u, np.zeros(n), np.ones(n, dtype=np.uint8))
    assert block.dynamic_mw[700 + 599] == pytest.approx(20.0)
    assert block.dynamic_mw[700 + 660] == pytest.approx(80.0, abs=0.01)
