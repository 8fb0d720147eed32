# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest
from diagnosis_records import COARSE_S, EXPONENT, coarse_unit, record, rough_model, table, unit
from hypothesis import given, settings
from hypothesis import strategies as st

from valveflow_ros.diagnosis import from_window
from valveflow_ros.diagnosis.cause import Estimate
from valveflow_ros.diagnosis.diagnose import Record, diagnose
from valveflow_ros.diagnosis.from_window import diagnose_window, table_of
from valveflow_ros.diagnosis.result import to_json
from valveflow_ros.monitoring.events import DiagnosisRequested
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.offline import feed_rows
from valveflow_ros.parameters import Settings
from valveflow_ros.records import SampleTable, Signal
from valveflow_ros.segments.window import WindowContents
from valveflow_ros.signals.static_form import integrated_input


def contents_of(samples: SampleTable) -> WindowContents:
    opening = samples.column(Signal.VALVE_OPENING)
    pressure = samples.column(Signal.MAIN_STEAM_PRESSURE)
    return WindowContents(
        samples.time_ns, integrated_input(opening, pressure, EXPONENT),
        samples.column(Signal.GENERATED_POWER), samples.column(Signal.MAIN_STEAM_TEMPERATURE),
        np.empty((0, 3), dtype=np.int64), opening, samples.column(Signal.VALVE_COMMAND),
    )  # fmt: skip


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.integers(-200, 10_500), st.integers(0, 30_000)), min_size=1))
def test_the_pressure_comes_back_as_it_was_read(rows: list[tuple[int, int]]) -> None:
    """Opening in hundredths of a percent, pressure in kPa: bit for bit, or not at all."""
    opening, pressure = np.array(rows).T / np.array([[100.0], [1000.0]])
    nan = np.full(len(rows), np.nan)
    samples = SampleTable.from_columns(
        np.arange(len(rows)),
        {Signal.VALVE_OPENING: opening, Signal.MAIN_STEAM_PRESSURE: pressure,
         Signal.GENERATED_POWER: nan, Signal.VALVE_COMMAND: opening},
    )  # fmt: skip
    found = table_of(contents_of(samples), EXPONENT)
    known = (opening > 0.0) & (pressure > 0.0)
    expected = np.where(known, pressure, np.nan)
    np.testing.assert_array_equal(found.column(Signal.MAIN_STEAM_PRESSURE), expected)
    np.testing.assert_array_equal(found.column(Signal.VALVE_COMMAND), opening)


@pytest.mark.slow
def test_the_window_is_diagnosed_as_the_record_is() -> None:
    """The same rows from a file and from the running monitor give the same diagnosis."""
    samples = table(1.02, 3, ('temperature:k=-0.004',), coarse_unit())
    monitor = Monitor(
        Settings({'sample_period': COARSE_S, 'refit_period': 80_000.0, 'refit_segments': 0})
    )
    feed_rows(monitor, samples)
    curve = monitor.characteristic
    assert curve is not None
    (task,) = (e.task for e in monitor.request_diagnosis() if isinstance(e, DiagnosisRequested))
    assert task.window_end_ns == samples.time_ns[-1]
    found = diagnose_window(task)
    spans = np.array(
        [(task.contents.time_ns[a], task.contents.time_ns[b - 1])
         for a, b, _ in task.contents.spans]
    )  # fmt: skip
    record = Record(samples, COARSE_S, curve.static_form, Settings().settle_s, spans)
    truth = to_json(diagnose(record, curve.model))
    content = json.loads(found.text)
    assert found.window_end_ns == task.window_end_ns
    assert [c['name'] for c in content['causes']] == ['temperature']
    assert content == truth


def test_an_exponent_that_the_causes_had_bent_is_fitted_again(monkeypatch) -> None:
    """It was fitted to the same record without them, so it is no fault of the unit."""
    asked, off = [], Estimate(0.05, 0.04, 0.06, '')

    def found(record, model, progress):
        asked.append((record.form.exponent, model))
        names = ('clock', 'exponent') if len(asked) == 1 else ('clock',)
        return SimpleNamespace(causes=[SimpleNamespace(name=n, parameters={'dm': off})
                                       for n in names])  # fmt: skip

    monkeypatch.setattr(from_window, 'diagnose', found)
    whole = record(table(0.2, 2, (), unit()))
    answer, used = from_window.diagnose_own(whole, rough_model())
    assert [c.name for c in answer.causes] == ['clock']
    assert [exponent for exponent, _ in asked] == [EXPONENT, EXPONENT + 0.05]
    assert used.form.exponent == EXPONENT + 0.05
    # The breakpoints of the second model are at the u of its own exponent.
    assert asked[1][1].knots[-1] == pytest.approx(asked[0][1].knots[-1] * 16.0**0.05, rel=0.1)
