# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Rows freed of causes as they come: against the extended model itself, and by relations."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from diagnosis_records import EXPONENT, SETTLE_S, STEP_S, record, rough_model, table, unit
from hypothesis import given, settings
from hypothesis import strategies as st
from streams import needs_jit
from test_diagnosis_parts import TYPICAL

from valveflow_ros.diagnosis.cause import FittedCause
from valveflow_ros.diagnosis.causes import catalogue
from valveflow_ros.diagnosis.corrector import corrector_of
from valveflow_ros.diagnosis.extended import Extended, ExtendedModel, answer
from valveflow_ros.diagnosis.grids import make_grids
from valveflow_ros.errors import DataError
from valveflow_ros.records import NS_PER_S, Quality, SampleTable, Signal
from valveflow_ros.signals.static_form import StaticForm, integrated_input
from valveflow_ros.state import from_bytes, to_bytes

pytestmark = needs_jit
NAMES = sorted(catalogue())
VALUES = {**TYPICAL, 'clock': (4.0,)}  # a whole number of rows
SEVERAL = ('rate_limit', 'backlash', 'exponent', 'input_drift', 'curve_shape', 'temperature',
           'gain_step', 'region_lag', 'reheater', 'output_offset_drift')  # fmt: skip


@pytest.fixture(scope='module')
def rows() -> SampleTable:
    return table(0.4, 2, (), unit())


@pytest.fixture(scope='module')
def grids(rows):
    return make_grids(*record(rows).about, np.zeros(rows.values.shape, dtype=bool))


def active(name: str) -> FittedCause:
    extra = (3600.0, 9000.0, 20_000.0) if name == 'intervals' else ()
    return FittedCause(catalogue()[name], VALUES[name], extra)


def model_of(grids, *names: str) -> ExtendedModel:
    extended = Extended(rough_model(), tuple(active(n) for n in names))
    return ExtendedModel(extended, StaticForm(exponent=EXPONENT), grids.start_ns, grids.reference)


def corrected(model: ExtendedModel, rows: SampleTable) -> SampleTable:
    return corrector_of(model, STEP_S).correct(rows)


def plain_answer(rows: SampleTable) -> np.ndarray:
    """What curve and dynamics alone say to rows, as the pipeline runs them."""
    u = integrated_input(
        rows.column(Signal.VALVE_OPENING), rows.column(Signal.MAIN_STEAM_PRESSURE), EXPONENT
    )
    usable = np.isfinite(u).astype(np.uint8)
    return rough_model().respond(np.nan_to_num(u), usable, STEP_S, SETTLE_S)[0]


def same(a: SampleTable, b: SampleTable) -> bool:
    return (
        np.array_equal(a.time_ns, b.time_ns)
        and a.values.tobytes() == b.values.tobytes()
        and np.array_equal(a.quality, b.quality)
    )


def means_of(grids, shown: np.ndarray) -> np.ndarray:
    return shown[: len(grids.u)].reshape(-1, grids.group).mean(axis=1)


@pytest.mark.parametrize('names', [*((n,) for n in NAMES), SEVERAL], ids=lambda n: '+'.join(n))
def test_what_is_left_is_what_the_extended_model_leaves(grids, rows, names):
    """y' - plain(u') = y - extended(inputs), by the loops the diagnosis itself uses."""
    model = model_of(grids, *names)
    after = corrected(model, rows)
    measured = rows.column(Signal.GENERATED_POWER)
    left = after.column(Signal.GENERATED_POWER) - plain_answer(after)
    if 'clock' in names:  # the power belongs to inputs two rows later
        left[:-2] = left[2:]
        left[-2:] = 0.0
    expected = answer(grids, model.model)
    told = means_of(grids, measured - left)
    here = np.flatnonzero(grids.scored)[:-1]
    effect = (expected - answer(grids, model.model.without_causes()))[here]
    assert np.abs(effect).max() > 1e-3
    if 'stiction' in names:
        # The catalogue draws the sensor's noise over the record, this row by row: single slips
        # fall on other rows, by far the most of the effect is the same.
        assert np.std((told - expected)[here]) < 0.25 * np.std(effect)
    else:
        assert np.abs(told - expected)[here].max() < 1e-8


def test_sticking_is_drawn_anew_and_means_the_same(grids, rows):
    model = model_of(grids, 'stiction')
    after = corrected(model, rows).column(Signal.VALVE_OPENING)
    act = catalogue()['stiction'].act(grids.v, VALUES['stiction'], grids)
    stays = np.std(rows.column(Signal.VALVE_OPENING) - act)
    assert np.std(after - act) < 0.25 * stays
    assert abs(float(np.mean(after - act))) < 0.05 * stays


def test_without_causes_rows_pass_bit_for_bit(grids, rows):
    assert same(corrected(model_of(grids), rows), rows)
    on_top = replace(model_of(grids), on_top_of=model_of(grids))
    assert same(corrected(on_top, rows), rows)


@settings(max_examples=12)
@given(
    st.sampled_from([('clock', *SEVERAL), ('stiction', 'choked', 'diurnal', 'curve_step'),
                     ('saturation', 'intervals', 'gain_drift', 'input_step')]),
    st.lists(st.integers(1, 1499), max_size=12, unique=True),
    st.lists(st.tuples(st.integers(0, 1499), st.integers(0, 3)), max_size=10),
    st.lists(st.integers(1, 1498), max_size=3, unique=True),
)  # fmt: skip
def test_any_cutting_and_taking_up_again_give_the_same_bits(
    grids, rows, names, cuts, missing, gaps
):
    part = rows.part(0, 1500)
    values, quality = part.values.copy(), part.quality.copy()
    for row, signal in missing:
        values[row, signal] = np.nan
        quality[row, signal] = Quality.BAD
    time_ns = part.time_ns.copy()
    for gap in gaps:
        time_ns[gap:] += 300 * NS_PER_S
    part = SampleTable(time_ns, values, quality)
    model = model_of(grids, *names)
    whole = corrected(model, part)
    corrector = corrector_of(model, STEP_S)
    edges = [0, *sorted(cuts), len(part)]
    pieces = []
    for a, b in itertools.pairwise(edges):
        pieces.append(corrector.correct(part.part(a, b)))
        saved, corrector = corrector.snapshot(), corrector_of(model, STEP_S)
        corrector.restore(from_bytes(to_bytes(saved)))
    assert same(SampleTable.concatenate(pieces), whole)
    corrector.restart()
    assert same(corrector.correct(part), whole)
    # One row at a time, and none.
    corrector.restart()
    single = [corrector.correct(part.part(k, k + 1)) for k in range(150)]
    assert same(SampleTable.concatenate(single), corrected(model, part.part(0, 150)))
    assert len(corrector.correct(part.part(3, 3))) == 0
    with pytest.raises(DataError, match='another model_file'):
        corrector_of(model_of(grids), STEP_S).restore(corrector.snapshot())


def test_pressure_temperature_and_command_stay(grids, rows):
    after = corrected(model_of(grids, *SEVERAL), rows)
    for signal in (Signal.MAIN_STEAM_PRESSURE, Signal.MAIN_STEAM_TEMPERATURE,
                   Signal.VALVE_COMMAND):  # fmt: skip
        np.testing.assert_array_equal(after.column(signal), rows.column(signal))


def test_two_models_on_top_of_each_other_are_one_after_the_other(grids, rows):
    first, second = model_of(grids, 'backlash', 'gain_step'), model_of(grids, 'reheater')
    both = replace(second, on_top_of=first)
    assert same(corrected(both, rows), corrected(second, corrected(first, rows)))
    assert [h.name for h in corrector_of(both, STEP_S).held] == [
        'backlash', 'gain_step', 'reheater',
    ]  # fmt: skip


def shift_of(model: ExtendedModel, rows: SampleTable) -> float:
    """What a correction takes out of the power as a share of it, in the median."""
    after = corrected(model, rows)
    taken = rows.column(Signal.GENERATED_POWER) - after.column(Signal.GENERATED_POWER)
    # Around a change of region the two simulations differ by more than the share.
    return float(np.median(taken / plain_answer(rows)))


def later(rows: SampleTable, days: float) -> SampleTable:
    return replace(rows, time_ns=rows.time_ns + round(days * 86_400 * NS_PER_S))


def test_beyond_its_record_a_drift_goes_on_and_steps_stay(grids, rows):
    drift = model_of(grids, 'gain_drift')
    grown = shift_of(drift, later(rows, 20.0)) - shift_of(drift, rows)
    assert grown == pytest.approx(2.0 * VALUES['gain_drift'][0], rel=1e-3)
    step = model_of(grids, 'gain_step')
    assert shift_of(step, later(rows, 20.0)) == pytest.approx(VALUES['gain_step'][0])
    hidden = model_of(grids, 'intervals')  # 1.5 h of 9.6 on, then on again for good
    on = 1.0 - (5400.0 + (0.4 * 86_400.0 - 20_000.0)) / (0.4 * 86_400.0)
    assert shift_of(hidden, later(rows, 20.0)) == pytest.approx(VALUES['intervals'][0] * on)


def test_a_gap_is_a_new_beginning_of_the_response_but_not_of_the_plug(grids, rows):
    """Rows behind a gap come out as those of a corrector that has seen nothing."""
    held = model_of(grids, 'gain_step', 'reheater')
    first, behind = rows.part(0, 700), later(rows.part(700, 1400), 0.1)
    corrector = corrector_of(held, STEP_S)
    corrector.correct(first)
    assert same(corrector.correct(behind), corrected(held, behind))
    slack = model_of(grids, 'backlash')
    corrector = corrector_of(slack, STEP_S)
    corrector.correct(first)
    assert not same(corrector.correct(behind), corrected(slack, behind))
