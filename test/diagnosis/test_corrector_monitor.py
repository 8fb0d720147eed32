# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The engine on rows freed of causes: what it says, what it finds, and that cutting is nothing."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from diagnosis_records import EXPONENT, STEP_S, record, rough_model, table, unit
from hypothesis import given, settings
from hypothesis import strategies as st
from streams import needs_jit

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.characteristic_json import from_json, to_json
from valveflow_ros.diagnosis.cause import FittedCause
from valveflow_ros.diagnosis.causes import catalogue
from valveflow_ros.diagnosis.corrector import corrector_of
from valveflow_ros.diagnosis.extended import Extended, ExtendedModel, answer
from valveflow_ros.diagnosis.from_window import on_top, without_causes
from valveflow_ros.diagnosis.grids import make_grids
from valveflow_ros.errors import DataError
from valveflow_ros.fit.fit import fit
from valveflow_ros.monitoring.events import FitRequested
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.offline import feed_rows
from valveflow_ros.monitoring.prediction import PredictionBlock
from valveflow_ros.monitoring.rows import Correction, Corrector
from valveflow_ros.parameters import Settings
from valveflow_ros.records import Quality, SampleTable, Signal
from valveflow_ros.signals.static_form import StaticForm

pytestmark = needs_jit
OFF = {'refit_period': 0.0, 'refit_segments': 0, 'diagnosis_hour': -1}
BY_HAND = Settings({'sample_period': STEP_S, **OFF})
OFTEN = Settings({'sample_period': STEP_S, 'refit_segments': 8, 'refine': False,
                  'selection_rule': 'paper', 'diagnosis_hour': -1})  # fmt: skip
HELD = {'backlash': (0.8,), 'exponent': (0.03,), 'gain_step': (0.02, 0.2), 'reheater': (0.4, 25.0)}


def model_of(rows: SampleTable, held: dict[str, tuple[float, ...]]) -> ExtendedModel:
    grids = make_grids(*record(rows).about, np.zeros(rows.values.shape, dtype=bool))
    active = tuple(FittedCause(catalogue()[n], v) for n, v in held.items())
    return ExtendedModel(
        Extended(rough_model(), active),
        StaticForm(exponent=EXPONENT),
        grids.start_ns,
        grids.reference,
    )


@pytest.fixture(scope='module')
def rows() -> SampleTable:
    return table(0.4, 2, (), unit())


@pytest.fixture(scope='module')
def model(rows) -> ExtendedModel:
    return model_of(rows, HELD)


def run(corrector: Corrector | None, rows: SampleTable, settings: Settings, edges=()) -> list:
    monitor = Monitor(settings, corrector)
    cuts = [0, *sorted(edges), len(rows)]
    return [e for a, b in itertools.pairwise(cuts) for e in feed_rows(monitor, rows.part(a, b))]


def columns(events: list) -> dict[str, np.ndarray]:
    """Return the predictions of a run, joined."""
    blocks = [e for e in events if isinstance(e, PredictionBlock)]
    names = ('time_ns', 'u', 'measured_mw', 'static_mw', 'dynamic_mw', 'residual_mw', 'state')
    return {n: np.concatenate([getattr(b, n) for b in blocks]) for n in names}


def others(events: list) -> list[str]:
    return [repr(e) for e in events if not isinstance(e, PredictionBlock | FitRequested)]


def predicted(model: ExtendedModel, rows: SampleTable) -> dict[str, np.ndarray]:
    """Return what a monitor says that runs on the model's own curve from the first row on."""
    monitor = Monitor(BY_HAND, corrector_of(model, STEP_S))
    monitor._refits.pending_ns = 1  # as if a fit had been asked for
    monitor.adopt(1, model.characteristic())
    return columns(monitor.feed(rows).events)


def test_the_prediction_is_that_of_the_extended_model(rows, model):
    """Measured stays measured; the prediction is the extended model's, as the diagnosis has it."""
    said = predicted(model, rows)
    measured = rows.column(Signal.GENERATED_POWER)
    np.testing.assert_array_equal(said['measured_mw'], measured)
    grids = make_grids(*record(rows).about, np.zeros(rows.values.shape, dtype=bool))
    expected = answer(grids, model.model)
    shown = said['dynamic_mw'][: len(grids.u)].reshape(-1, grids.group).mean(axis=1)
    here = grids.scored & np.isfinite(shown)
    assert here.sum() > 0.8 * grids.scored.sum()
    np.testing.assert_allclose(shown[here], expected[here], atol=1e-8)
    known = np.isfinite(said['dynamic_mw'])
    left = (measured - said['dynamic_mw'])[known]
    np.testing.assert_allclose(said['residual_mw'][known], left, atol=1e-9)


def test_a_corrector_without_causes_changes_not_one_bit(rows):
    model, rows = model_of(rows, {}), rows.part(0, 9000)
    plain = run(None, rows, OFTEN)
    same = run(corrector_of(model, STEP_S), rows, OFTEN)
    assert others(plain) == others(same)
    for name, column in columns(plain).items():
        assert column.tobytes() == columns(same)[name].tobytes()


@settings(max_examples=3)
@given(st.lists(st.integers(1, 8_999), min_size=1, max_size=8, unique=True))
def test_any_cutting_gives_the_same_events(rows, model, edges):
    """Also where the engine stops within a block for a fit and is given the rest again."""
    rows = rows.part(0, 9000)
    whole = run(corrector_of(model, STEP_S), rows, OFTEN)
    assert sum(isinstance(e, FitRequested) for e in whole) >= 2
    cut = run(corrector_of(model, STEP_S), rows, OFTEN, edges)
    assert others(cut) == others(whole)
    for name, column in columns(whole).items():
        assert column.tobytes() == columns(cut)[name].tobytes()


def test_rows_are_corrected_once_however_often_they_are_offered(rows, model):
    part = rows.part(0, 900)
    whole = corrector_of(model, STEP_S).correct(part)
    correction = Correction(corrector_of(model, STEP_S))
    taken, chance = 0, np.random.default_rng(5)
    while taken < len(part):
        offered = part.part(taken, min(len(part), taken + int(chance.integers(1, 120))))
        shown = correction.rows(offered)
        expected = whole.part(taken, taken + len(offered))
        assert shown.values.tobytes() == expected.values.tobytes()
        assert np.array_equal(shown.time_ns, expected.time_ns)
        taken += int(chance.integers(0, len(offered) + 1))
    correction.restart()
    again = correction.rows(part)
    assert again.values.tobytes() == whole.values.tobytes()


def test_what_is_missing_stays_missing(rows, model):
    hurt = SampleTable(rows.time_ns, rows.values.copy(), rows.quality.copy())
    hurt.values[500:520, Signal.GENERATED_POWER] = np.nan
    hurt.quality[500:520, Signal.GENERATED_POWER] = Quality.BAD
    hurt.values[900:905, Signal.VALVE_OPENING] = np.nan
    hurt.quality[900:905, Signal.VALVE_OPENING] = Quality.BAD
    after = corrector_of(model, STEP_S).correct(hurt)
    lost = np.isnan(after.column(Signal.GENERATED_POWER))
    assert set(np.flatnonzero(lost)) == {*range(500, 520), *range(900, 905)}
    assert np.array_equal(np.isnan(after.values), after.quality == Quality.BAD)
    said = predicted(model, hurt)
    np.testing.assert_array_equal(said['measured_mw'], hurt.column(Signal.GENERATED_POWER))


def fitted(corrector: Corrector | None, rows: SampleTable) -> Characteristic:
    monitor = Monitor(BY_HAND, corrector)
    feed_rows(monitor, rows)
    (task,) = (e.task for e in monitor.request_fit() if isinstance(e, FitRequested))
    return fit(task)


def test_a_plant_with_an_effect_gives_the_curve_of_the_plant_without():
    """Same chance, once with a slack and a step, once clean: the curves agree, raw ones do not."""
    of = unit()
    clean = fitted(None, table(1.0, 6, (), of))
    hurt_rows = table(1.0, 6, ('backlash:w_percent=1.2', 'gain_step:g=0.03,t0_days=0.5'), of)
    held = {'backlash': (1.2,), 'gain_step': (0.03, 0.5)}
    model = model_of(hurt_rows, held)
    freed, raw = fitted(corrector_of(model, STEP_S), hurt_rows), fitted(None, hurt_rows)
    u = np.linspace(1150.0, 2100.0, 40)
    off = freed.model.static(u) - clean.model.static(u)
    off_raw = raw.model.static(u) / 1.015 - clean.model.static(u)
    assert np.sqrt(np.mean(off**2)) < 0.5
    assert np.sqrt(np.mean(off**2)) < 0.7 * np.sqrt(np.mean(off_raw**2))
    assert freed.residuals.rmse_mw < 1.15 * clean.residuals.rmse_mw
    assert raw.residuals.rmse_mw > 1.3 * clean.residuals.rmse_mw
    times = [[d.time_constant_s for d in c.dynamics] for c in (clean, freed)]
    np.testing.assert_allclose(times[1], times[0], rtol=0.15)
    assert [h.name for h in freed.held] == ['backlash', 'gain_step']
    assert dict(freed.held[1].values) == {'g': 0.03, 't0_days': 0.5}
    assert from_json(to_json(freed)).held == freed.held
    assert 'held' not in to_json(clean)
    with pytest.raises(DataError, match=r"'held\[0\].values' is not an object"):
        from_json({**to_json(clean), 'held': [{'name': 'x', 'values': 1, 'sentence': ''}]})
    assert replace(freed, held=()).with_id().model_id != freed.model_id


def test_an_opening_that_a_held_stop_lets_rest_is_no_fault_of_its_signal(rows):
    stop = float(np.quantile(rows.column(Signal.VALVE_OPENING), 0.8))
    model = model_of(rows, {'saturation': (stop,)})
    corrector = corrector_of(model, STEP_S)
    rests = record(corrector.correct(rows))
    assert not rests.faults()[1]  # its largest value is a stop, held or not
    assert not without_causes(rests, corrector.held).faults()[1]
    assert without_causes(rests, ()) is rests
    assert not on_top(rests, model, rows).faults()[1]


def test_a_command_leads_to_the_position_not_to_the_plug(rows):
    values, quality = rows.values.copy(), np.zeros_like(rows.quality)
    values[:, Signal.VALVE_COMMAND] = values[:, Signal.VALVE_OPENING]
    rows = SampleTable(rows.time_ns, values, quality)
    for held, kept in (({'backlash': (1.0,)}, False), ({'gain_step': (0.02, 0.2)}, True)):
        model = model_of(rows, held)
        on = on_top(
            record(rows), replace(model, model=Extended(rough_model()), on_top_of=model), rows
        )
        assert np.isfinite(on.table.column(Signal.VALVE_COMMAND)).all() == kept
        assert on.measured is not None
