# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The curve of health: it comes by itself, follows what is slow, and never learns a fault."""

from __future__ import annotations

import numpy as np
import pytest
from streams import QUICK_MONITOR, of_type, plant_table

from valveflow_ros.monitoring.alarm_state import AlarmAction
from valveflow_ros.monitoring.alarms import AlarmChange
from valveflow_ros.monitoring.events import CurveAdopted, FitRequested, ReferenceSet
from valveflow_ros.monitoring.monitor import BY_ITSELF, Monitor
from valveflow_ros.monitoring.offline import feed_rows
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S, Signal
from valveflow_ros.state import from_bytes, to_bytes

SETTINGS = Settings({**QUICK_MONITOR, 'reference_after': 0.01, 'alarm_off_delay': 600.0})
N = 3000


def after(monitor, seed, n, added_mw=0.0):
    table = plant_table(seed, n, start_ns=monitor.last_ns + NS_PER_S)
    table.values[:, Signal.GENERATED_POWER] += added_mw
    return table


@pytest.fixture(scope='module')
def healthy():
    monitor = Monitor(SETTINGS)
    return monitor, feed_rows(monitor, plant_table(1, N)), to_bytes(monitor.snapshot())


def taken_up(state):
    monitor = Monitor(SETTINGS)
    monitor.restore(from_bytes(state))
    return monitor


def test_a_curve_becomes_the_reference_by_itself_and_is_announced(healthy):
    monitor, events, _ = healthy
    (told, *_) = of_type(events, ReferenceSet)
    assert told.characteristic in [e.characteristic for e in of_type(events, CurveAdopted)]
    assert monitor.predicting is monitor.reference.curve
    assert any(getattr(e, 'text', '') == BY_ITSELF for e in events)


def test_a_reference_after_of_0_leaves_it_to_the_operator():
    monitor = Monitor(SETTINGS.changed({'reference_after': 0.0}))
    events = feed_rows(monitor, plant_table(1, N))
    assert of_type(events, CurveAdopted)
    assert not of_type(events, ReferenceSet)
    assert monitor.reference.curve is None


@pytest.mark.parametrize('added_mw', [-8.0, 6.0, 12.0])
def test_a_fault_that_stays_stands_however_long_it_lasts(healthy, added_mw):
    """Longer than the window, over many fits and over a restart of the monitor."""
    monitor = taken_up(healthy[2])
    reference, began_ns = monitor.reference.curve, monitor.last_ns
    events = feed_rows(monitor, after(monitor, 2, N, added_mw))
    monitor = taken_up(to_bytes(monitor.snapshot()))
    events += feed_rows(monitor, after(monitor, 3, N, added_mw))
    assert monitor.alarm.active
    assert monitor.alarm.occurrence == 1
    assert monitor.reference.curve.model_id == reference.model_id == monitor.predicting.model_id
    raised_ns = next(c.time_ns for c in of_type(events, AlarmChange) if c.name == 'residual')
    fits = [e.task for e in of_type(events, FitRequested) if e.task.request_ns > raised_ns]
    assert fits
    # A block of the alarm is what its onset may be late or early by.
    assert all(task.contents.time_ns[0] > began_ns - 60 * NS_PER_S for task in fits)
    middle = float(np.median(reference.breakpoints))
    change = monitor.characteristic.model.static(np.array([middle])) - reference.model.static(
        np.array([middle])
    )
    assert change[0] == pytest.approx(added_mw, abs=1.0)


def test_a_plant_that_is_mended_returns_and_its_fits_know_nothing_of_the_fault(healthy):
    monitor = taken_up(healthy[2])
    reference = monitor.reference.curve
    feed_rows(monitor, after(monitor, 2, 1200, 8.0))
    assert monitor.alarm.active
    monitor.operate_alarms(AlarmAction.ACKNOWLEDGE)
    feed_rows(monitor, after(monitor, 3, 2 * N))
    assert not monitor.alarm.standing
    assert monitor.reference.fault_ns is None
    middle = np.array([float(np.median(reference.breakpoints))])
    now = monitor.characteristic.model.static(middle)
    assert now[0] == pytest.approx(reference.model.static(middle)[0], abs=1.0)


def test_a_new_reference_accepts_what_was_wrong(healthy):
    monitor = taken_up(healthy[2])
    feed_rows(monitor, after(monitor, 2, N, 8.0))
    monitor.operate_alarms(AlarmAction.ACKNOWLEDGE)
    monitor.set_reference()
    assert not monitor.alarm.active
    events = feed_rows(monitor, after(monitor, 3, 1000, 8.0))
    assert not [c for c in of_type(events, AlarmChange) if c.name == 'residual']


def test_a_state_of_before_goes_on(healthy):
    """States of earlier versions have neither regime nor a curve of its own that predicts."""
    state = from_bytes(healthy[2])
    for key in ('times_ns', 'fault_ns', 'first', 'candidate', 'worn'):
        del state['reference'][key]
    del state['force']['predicting']
    alarm = state['alarm']
    del alarm['span'], alarm['onset_ns']
    alarm['memory'] = alarm['memory'][:-1]
    monitor = Monitor(SETTINGS)
    monitor.restore(state)
    assert monitor.predicting is not None
    feed_rows(monitor, after(monitor, 4, 300))
