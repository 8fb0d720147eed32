# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The comparison as a whole, on data made by hand; the truth of a plant."""

import json
from dataclasses import replace

import numpy as np
import pytest
from streams import needs_jit

from valveflow_ros.baselines import comparison
from valveflow_ros.baselines.comparison import compare, to_json
from valveflow_ros.baselines.judged import OtherData, part_of
from valveflow_ros.baselines.truth import Line, curve_error, read_truth
from valveflow_ros.curve import characteristic_json
from valveflow_ros.errors import DataError, TooFewSamplesError
from valveflow_ros.fit.problem import Samples
from valveflow_ros.records import NS_PER_S, SegmentKind

REST_S, MOVE_S = 420, 180


@pytest.fixture(scope='module')
def plant(curve):
    """Return rows of a unit with one time constant that rests, moves and rests again."""
    rng = np.random.default_rng(21)
    hours = 12
    cycle = REST_S + MOVE_S
    count = hours * 3600 // cycle
    levels = np.repeat(rng.uniform(1020.0, 2180.0, count + 1), 2)
    times = np.concatenate([[0.0], np.cumsum(np.tile([REST_S, MOVE_S], count + 1))])[:-1]
    u = np.interp(np.arange(count * cycle), times, levels)
    everywhere = np.ones(len(u), dtype=np.uint8)
    clean, _ = curve(dynamics=True).model.respond(u, everywhere, 1.0, 110.0)
    power = clean + rng.normal(0.0, 1.0, len(u))
    spans = [(k * cycle + 150, k * cycle + REST_S, int(SegmentKind.STEADY)) for k in range(count)]
    return Samples(u, power, everywhere, 1.0, 110.0, 10), np.array(spans, dtype=np.int64)


def halves(plant):
    samples, spans = plant
    cut = len(samples.u) // 2
    later = spans[spans[:, 0] >= cut] - [cut, cut, 0]
    other = part_of(samples, cut, len(samples.u))
    time_ns = np.arange(len(other.u), dtype=np.int64) * NS_PER_S
    return part_of(samples, 0, cut), OtherData(other, time_ns, later)


@needs_jit
def test_with_one_block_for_all_loads_hammerstein_is_as_good(plant, curve):
    """The plant is a Hammerstein model, so honest tuning must find it as good as the truth."""
    learn, other = halves(plant)
    c = curve(dynamics=True)
    truth = read_truth(characteristic_json.to_json(c))
    steps = []
    found = compare(learn, c, other, truth, lambda share, what: steps.append((share, what)))
    assert found.judgement.mse('hammerstein.dynamic') == pytest.approx(
        found.judgement.mse('proposed.dynamic'), rel=0.02
    )
    assert found.errors['hammerstein'].rmse_mw < 0.3
    assert found.errors['proposed'].rmse_mw == 0.0
    assert found.errors['sparse'].known > 0.9
    assert found.methods == ('paper', 'proposed', 'hammerstein', 'sparse')
    assert [s for s, _ in steps] == sorted(s for s, _ in steps)
    content = json.loads(json.dumps(to_json(found), allow_nan=False))
    assert content['methods']['hammerstein']['denominator'][0] == 1.0
    assert len(content['methods']['sparse']['functions']) == 14
    # Rows of a gap hold no input; they neither get an answer nor change that of others.
    usable = np.ones(len(other.samples.u), dtype=np.uint8)
    usable[5000:5050] = 0
    hurt = replace(other.samples, u=other.samples.u * usable, usable=usable)
    made = comparison._predictions(c, {}, found.hammerstein, found.sparse, hurt)
    there = usable > 0
    assert np.array_equal(np.isfinite(made['sparse.static']), there)
    np.testing.assert_allclose(
        made['sparse.static'][there], found.predictions['sparse.static'][there], atol=1e-9
    )


@needs_jit
def test_without_a_sparse_model_the_rest_is_compared_and_it_says_why(plant, curve, monkeypatch):
    learn, other = halves(plant)

    def refuse(samples, progress):
        raise DataError('No model was found.')

    monkeypatch.setattr(comparison, 'fit_sparse', refuse)
    found = compare(learn, curve(dynamics=True), other)
    assert found.sparse is None
    assert found.failure == 'No model was found.'
    assert found.methods == ('paper', 'proposed', 'hammerstein')
    assert {p.baseline for p in found.pairs} == {'hammerstein'}
    assert to_json(found)['methods']['sparse'] == {'failure': 'No model was found.'}


@needs_jit
def test_a_truth_over_another_input_is_refused(plant, curve):
    learn, other = halves(plant)
    truth = read_truth(characteristic_json.to_json(curve(exponent=1.0)))
    with pytest.raises(DataError, match=r'over V p\^1, the identified one over V p\^1.125'):
        compare(learn, curve(), other, truth)


@needs_jit
def test_too_little_to_learn_from_is_refused(plant, curve):
    learn, other = halves(plant)
    with pytest.raises(TooFewSamplesError):
        compare(part_of(learn, 0, 2000), curve(), other)


# --- the truth of a plant --------------------------------------------------------------------

RAW = {
    'pressure_exponent': 1.125,
    'pieces': [
        {'u_from': 0.0, 'u_to': 10.0, 'slope': 2.0, 'intercept': 1.0},
        {'u_from': 10.0, 'u_to': 20.0, 'slope': 1.0, 'intercept': 11.0},
    ],
}


def test_a_truth_is_read_and_evaluated_and_a_characteristic_is_one_too(curve):
    c, u = curve(), np.linspace(1000.0, 2200.0, 50)
    np.testing.assert_allclose(read_truth(characteristic_json.to_json(c))(u), c.model.static(u))
    truth = read_truth(RAW)
    np.testing.assert_allclose(truth(np.array([0.0, 5.0, 10.0, 15.0])), [1.0, 11.0, 21.0, 26.0])
    assert truth.pressure_exponent == 1.125


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
