# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A monitor beside a choked valve: curve, prediction, reference and restart over openings."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest
from streams import first_difference, story

from valveflow_ros.curve.segment_residual import segment_residuals
from valveflow_ros.curve.shift import judge_shift
from valveflow_ros.errors import DataError
from valveflow_ros.monitoring.events import FitRequested
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.offline import feed_rows, outcome_of
from valveflow_ros.monitoring.prediction import PredictionBlock
from valveflow_ros.parameters import Settings
from valveflow_ros.plant.thermal_plant import simulate_thermal
from valveflow_ros.plant.thermal_unit import unit_of
from valveflow_ros.signals.static_form import INTEGRATED_INPUT, OPENING, StaticForm
from valveflow_ros.state import from_bytes, to_bytes

STEP_S = 4
SETTINGS = Settings({'refit_period': 0.0, 'window_days': 4.0, 'diagnosis_hour': -1,
                     'sample_period': float(STEP_S), 'block': 3.0 * STEP_S})  # fmt: skip
DAY = 86400 // STEP_S


@cache
def plant(*effects: str):
    """Return four days of a choked unit without weather, its pressure sliding with the load."""
    unit = unit_of('choked:number=2,vacuum_per_kpa=0')
    table = simulate_thermal(4.0, 3, unit, effects=effects).table
    return table.take(np.arange(0, len(table), STEP_S))


@cache
def learnt() -> tuple[Monitor, bytes]:
    """Return a monitor that has a curve of the first two days, and its state."""
    monitor = Monitor(SETTINGS)
    feed_rows(monitor, plant().part(0, 2 * DAY))
    (task,) = (e.task for e in monitor.request_fit() if isinstance(e, FitRequested))
    outcome_of(monitor, task)
    return monitor, to_bytes(monitor.snapshot())


def again() -> Monitor:
    monitor = Monitor(SETTINGS)
    monitor.restore(from_bytes(learnt()[1]))
    return monitor


def residuals(events) -> np.ndarray:
    found = np.concatenate([e.residual_mw for e in events if isinstance(e, PredictionBlock)])
    return found[np.isfinite(found)]


def test_the_curve_has_its_knees_at_openings_and_predicts_days_it_has_not_seen():
    monitor = again()
    curve = monitor.characteristic
    assert curve is not None
    assert curve.axis == OPENING
    assert curve.form is not None
    assert curve.form.told
    events = feed_rows(monitor, plant().part(2 * DAY, 4 * DAY))
    blocks = [e for e in events if isinstance(e, PredictionBlock)]
    u = np.concatenate([b.u for b in blocks])
    assert u[np.isfinite(u)].max() <= 100.0, 'the prediction tells the opening as its input'
    rest = residuals(events)
    assert len(rest) > DAY
    assert np.sqrt(np.mean(rest**2)) < 1.5
    assert not monitor.alarm.active


def test_the_paper_s_form_predicts_the_same_days_worse():
    held = SETTINGS.changed({'axis': INTEGRATED_INPUT})
    monitor = Monitor(held)
    feed_rows(monitor, plant().part(0, 2 * DAY))
    (task,) = (e.task for e in monitor.request_fit() if isinstance(e, FitRequested))
    outcome_of(monitor, task)
    assert monitor.characteristic is not None
    assert monitor.characteristic.static_form == StaticForm()
    assert monitor.characteristic.form is not None
    assert monitor.characteristic.form.contradicted
    paper = residuals(feed_rows(monitor, plant().part(2 * DAY, 4 * DAY)))
    ours = residuals(feed_rows(again(), plant().part(2 * DAY, 4 * DAY)))
    assert np.sqrt(np.mean(paper**2)) > 2.0 * np.sqrt(np.mean(ours**2))


@pytest.mark.parametrize('at', [2 * DAY + 1, 2 * DAY + 1777, 3 * DAY])
def test_it_goes_on_bit_for_bit_after_a_restart(at):
    rows = plant()
    whole = again()
    expected = feed_rows(whole, rows.part(2 * DAY, 4 * DAY))
    first = again()
    events = feed_rows(first, rows.part(2 * DAY, at))
    second = Monitor(SETTINGS)
    second.restore(from_bytes(to_bytes(first.snapshot())))
    events += feed_rows(second, rows.part(at, 4 * DAY))
    assert first_difference(story(expected), story(events)) == ''


def test_a_later_fit_keeps_the_form_of_the_reference_and_tells_what_moved():
    step = 'gain_step:g=-0.03,t0_days=2.0'
    for effects, moved in (((), False), ((step,), True)):
        monitor = again()
        monitor.set_reference()
        feed_rows(monitor, plant(*effects).part(2 * DAY, 4 * DAY))
        (task,) = (e.task for e in monitor.request_fit() if isinstance(e, FitRequested))
        reference = monitor.reference.curve
        assert reference is not None
        assert task.form == reference.static_form
        outcome_of(monitor, task)
        shift = monitor.reference.shift
        assert shift is not None, monitor.reference.problem
        assert shift.moved is moved
        if moved:
            sizes = [p.now_mw if np.isfinite(p.now_mw) else p.shift_mw for p in shift.pieces]
            assert min(sizes) < -3.0


def test_segments_lie_about_the_curve_they_were_found_with():
    monitor, _ = learnt()
    curve, segments = monitor.characteristic, monitor.special_segments()
    assert curve is not None
    found = segment_residuals(curve, segments)
    assert len(found) > 20
    assert np.sqrt(np.mean(found.residual_mw**2)) < 1.5
    assert np.isfinite([s.opening_start_percent for s in segments]).all()
    # Without their openings nothing can be said of segments on this axis.
    bare = [
        dataclasses.replace(s, opening_start_percent=np.nan, opening_end_percent=np.nan)
        for s in segments
    ]
    assert len(segment_residuals(curve, bare)) == 0


def test_curves_of_different_axes_are_not_held_against_each_other():
    curve = learnt()[0].characteristic
    assert curve is not None
    paper = curve.at_pressure()
    with pytest.raises(DataError, match='cannot be compared'):
        judge_shift(paper, curve, ())
