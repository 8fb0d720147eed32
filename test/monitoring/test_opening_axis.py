# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A monitor beside a choked valve: curve, prediction, reference and restart over openings."""

import dataclasses
from functools import cache

import numpy as np
import pytest
from streams import column, first_difference, of_type, story, taken_up

from valveflow_ros.curve.segment_residual import segment_residuals
from valveflow_ros.curve.shift import judge_shift
from valveflow_ros.errors import DataError
from valveflow_ros.monitoring.events import FitRequested
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.offline import feed_rows, outcome_of
from valveflow_ros.parameters import Settings
from valveflow_ros.plant.thermal_plant import simulate_thermal
from valveflow_ros.plant.thermal_unit import unit_of
from valveflow_ros.signals.static_form import INTEGRATED_INPUT, OPENING, StaticForm

STEP_S = 4
SETTINGS = Settings({'refit_period': 0.0, 'window_days': 4.0, 'diagnosis_hour': -1,
                     'sample_period': float(STEP_S), 'block': 3.0 * STEP_S})  # fmt: skip
DAY = 86400 // STEP_S


@cache
def plant(*effects):
    """Return four days of a choked unit without weather, its pressure sliding with the load."""
    unit = unit_of('choked:number=2,vacuum_per_kpa=0')
    table = simulate_thermal(4.0, 3, unit, effects=effects).table
    return table.take(np.arange(0, len(table), STEP_S))


def fitted(monitor):
    """Fit now; return what was fitted."""
    (request,) = of_type(monitor.request_fit(), FitRequested)
    outcome_of(monitor, request.task)
    return request.task


@cache
def learnt(axis='auto'):
    """Return a monitor that has a curve of the first two days."""
    monitor = Monitor(SETTINGS.changed({'axis': axis}))
    feed_rows(monitor, plant().part(0, 2 * DAY))
    fitted(monitor)
    return monitor


def again(axis='auto'):
    return taken_up(learnt(axis), Monitor(SETTINGS.changed({'axis': axis})))


def rms(events):
    found = column(events, 'residual_mw')
    assert np.isfinite(found).sum() > DAY
    return float(np.sqrt(np.nanmean(found**2)))


def test_the_curve_has_its_knees_at_openings_and_predicts_better_than_the_paper_s_form():
    monitor, paper = again(), again(INTEGRATED_INPUT)
    curve = monitor.characteristic
    assert (curve.axis, curve.form.told) == (OPENING, True)
    assert paper.characteristic.static_form == StaticForm()
    assert paper.characteristic.form.contradicted
    later = plant().part(2 * DAY, 4 * DAY)
    events = feed_rows(monitor, later)
    assert np.nanmax(column(events, 'u')) <= 100.0, 'the prediction tells the opening as its input'
    assert rms(events) < 1.5
    assert not monitor.alarm.active
    assert rms(feed_rows(paper, later)) > 2.0 * rms(events)


@pytest.mark.parametrize('at', [2 * DAY + 1777])
def test_it_goes_on_bit_for_bit_after_a_restart(at):
    rows = plant()
    whole = again()
    expected = feed_rows(whole, rows.part(2 * DAY, 4 * DAY))
    first = again()
    events = feed_rows(first, rows.part(2 * DAY, at))
    second = taken_up(first, Monitor(SETTINGS))
    events += feed_rows(second, rows.part(at, 4 * DAY))
    assert first_difference(story(expected), story(events)) == ''


def test_a_later_fit_keeps_the_form_of_the_reference_and_tells_what_moved():
    step = 'gain_step:g=-0.03,t0_days=2.0'
    for effects, moved in (((), False), ((step,), True)):
        monitor = again()
        monitor.set_reference()
        feed_rows(monitor, plant(*effects).part(2 * DAY, 4 * DAY))
        assert fitted(monitor).form == monitor.reference.curve.static_form
        shift = monitor.reference.shift
        assert shift is not None, monitor.reference.problem
        assert shift.moved is moved
        if moved:
            sizes = [p.now_mw if np.isfinite(p.now_mw) else p.shift_mw for p in shift.pieces]
            assert min(sizes) < -3.0


def test_segments_lie_about_the_curve_they_were_found_with_and_about_no_other():
    curve, segments = learnt().characteristic, learnt().special_segments()
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
    with pytest.raises(DataError, match='cannot be compared'):
        judge_shift(curve.at_pressure(), curve, ())
