# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a diagnosis says of a unit that changed since the model it is given was found."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from diagnosis_records import coarse_unit, diagnosed, record, table
from streams import needs_jit

from valveflow_ros.diagnosis.causes import TO_DO
from valveflow_ros.diagnosis.causes.since_model import since_model
from valveflow_ros.diagnosis.diagnose import diagnose
from valveflow_ros.diagnosis.fitting import Task
from valveflow_ros.diagnosis.grids import ORDER
from valveflow_ros.records import Signal

pytestmark = needs_jit
DAYS, EARLIER, LATER = 3.0, 31, 32


@pytest.fixture(scope='module')
def model():
    """Curve and dynamics as found in an earlier record of the unit."""
    return diagnosed(days=DAYS, seed=EARLIER).final.base


def later(change):
    """Return a record of other days, its columns changed."""
    samples = table(DAYS, LATER, (), coarse_unit())
    values = samples.values.copy()
    change(values)
    return record(replace(samples, values=values))


def since(change, model):
    """Return what the comparison with a model alone says of a record."""
    about = later(change)
    grids = about.grids(about.faults()[0])
    return since_model(Task(grids, grids.open_rows, np.zeros(ORDER), True), model)


def unchanged(values):
    pass


def scaled_power(factor):
    def change(values):
        values[:, Signal.GENERATED_POWER] *= factor

    return change


def moved_zero(mw):
    def change(values):
        values[:, Signal.GENERATED_POWER] += mw

    return change


def scaled_opening(factor):
    def change(values):
        values[:, Signal.VALVE_OPENING] *= factor

    return change


def missing(opening):
    """MW that a unit lacks more and more as it opens."""
    return 8.0 / (1.0 + np.exp(-(opening - np.nanmedian(opening)) / 2.0))


def less_when_open(values):
    values[:, Signal.GENERATED_POWER] -= missing(values[:, Signal.VALVE_OPENING])


def test_a_unit_that_did_not_change_is_healthy(model):
    assert 'as a whole differs from the model given by 0.' in since(unchanged, model)


@pytest.mark.parametrize(
    ('change', 'name', 'parameter', 'truth'),
    [
        (scaled_power(0.98), 'gain_change', 'g', -0.02),
        (scaled_power(1.015), 'gain_change', 'g', 0.015),
        (moved_zero(-5.0), 'offset_change', 'b_mw', -5.0),
        (scaled_opening(1.0 / 0.98), 'input_change', 'g', -0.02),
    ],
    ids=['less power', 'more power', 'zero', 'opening'],
)
def test_a_change_of_the_whole_record_is_named_with_its_size(
    model, change, name, parameter, truth
):
    found = since(change, model)
    assert found.name == name
    assert not found.near
    estimate = found.parameters[parameter]
    assert estimate.low <= truth <= estimate.high
    assert estimate.high - estimate.low < 0.8 * abs(truth)
    assert ('less' if truth < 0.0 else 'more') in found.sentence
    assert 'before this record begins' in found.sentence


def test_a_change_of_the_curve_is_told_at_low_and_at_high_load(model):
    found = since(less_when_open, model)
    assert found.name == 'curve_change'
    samples = table(DAYS, LATER, (), coarse_unit())
    power, opening = (samples.column(s) for s in (Signal.GENERATED_POWER, Signal.VALVE_OPENING))
    for name, share in (('low_load_mw', 0.05), ('high_load_mw', 0.95)):
        at = np.abs(power - np.nanquantile(power, share)) < 3.0
        truth = -float(np.mean(missing(opening)[at]))
        estimate = found.parameters[name]
        assert estimate.low <= truth <= estimate.high


def test_a_diagnosis_compares_with_the_model_as_it_is_given(model):
    found = diagnose(later(scaled_power(0.97)), model, given=True)
    assert [c.name for c in found.causes] == ['gain_change'], found.sentence
    (cause,) = found.causes
    assert cause.to_do == TO_DO['gain_change'].replace('`', '')
    assert cause.gain.p_value < 0.01
    assert cause.meaning.endswith('MW less.')
    # On its flat end the curve hardly shows a change of the reading.
    (read,) = diagnose(later(scaled_opening(0.97)), model, given=True).causes
    full, most = map(float, re.findall(r'([\d.]+) MW more', read.meaning))
    assert most > 1.3 * full, read.meaning
    assert found.rmse_simulation > 1.3 * found.rmse_extended
    # Found in the record itself the model knows of no earlier time.
    assert diagnose(later(scaled_power(0.97)), model).verdict == 'nothing'


def test_a_change_within_three_of_its_errors_is_not_named(model):
    told = since(scaled_opening(1.004), model)
    assert isinstance(told, str)
    assert 'cannot be distinguished' in told
    assert since(scaled_opening(1.02), model).name == 'input_change'


_STEP, _DRIFT = 'input_step:g=0.02,t0_days=1.2', 'gain_drift:g=0.08'


@pytest.mark.parametrize(
    ('change', 'effect'), [(scaled_power(0.97), _STEP), (unchanged, _DRIFT)],
    ids=['a change before and a step', 'a drift'],
)  # fmt: skip
def test_a_change_within_the_record_is_told_from_one_before_it(model, change, effect):
    own = effect.partition(':')[0]
    samples = table(DAYS, LATER, (effect,), coarse_unit())
    values = samples.values.copy()
    change(values)
    found = diagnose(record(replace(samples, values=values)), model, given=True)
    names = {own} if change is unchanged else {own, 'gain_change'}
    assert {c.name for c in found.causes} == names, found.sentence
    sizes = {c.name: c.parameters['g'] for c in found.causes}
    truth = float(re.search(r'g=([\d.]+)', effect)[1])
    assert sizes[own].low <= truth <= sizes[own].high
    if 'gain_change' in sizes:
        assert sizes['gain_change'].low <= -0.03 <= sizes['gain_change'].high
