"""The shelf in the node: its services, its messages, its recording; alarms as diagnostics."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from ros_helpers import PATIENCE_S, Processes
from test_ros_reference import Listener
from valveflow_msgs.msg import Alarm

from valveflow_ros.curve.characteristic_json import to_json
from valveflow_ros.monitoring.alarms import Judged, ResidualAlarm
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.offline import feed_rows
from valveflow_ros.parameters import Settings
from valveflow_ros.plant.simulator import simulate
from valveflow_ros.records import NS_PER_S
from valveflow_ros.ros.demo import ros_arguments
from valveflow_ros.ros.node.diagnostics import Item, Level
from valveflow_ros.ros.node.health import alarm_item
from valveflow_ros.ros.verify import verify

NERVOUS = {'alarm_on_delay': 0.0, 'alarm_off_delay': 0.0, 'alarm_suppress_time': 60.0}


def after(values: list[float], shelved: bool = False) -> Item:
    """Return what diagnostics say after a second of each value."""
    alarm = ResidualAlarm(Settings(NERVOUS))
    time_ns = np.arange(1, len(values) + 1) * NS_PER_S
    column = np.array(values)
    alarm.feed(time_ns, column, column, 'm')
    if shelved:
        assert alarm.shelve(int(time_ns[-1]), 'm')[0]
    monitor: Any = SimpleNamespace(alarm=alarm, judged=Judged(0, values[-1], values[-1]))
    return alarm_item(monitor)


def test_diagnostics_tell_the_state_that_no_announcement_told() -> None:
    item = after([2.0, 0.0] * 5 + [2.0])
    assert (item.level, item.values['State']) == (Level.ERROR, 'unacknowledged')
    assert (item.values['Occurrences'], item.values['Announcements held back']) == (6, 4)


def test_diagnostics_tell_of_shelf_and_suppression() -> None:
    item = after([2.0], shelved=True)
    assert (item.level, item.values['State']) == (Level.WARN, 'shelved')
    assert item.values['Shelved until (s since 1970)'] == 1 + 28800
    blind = after([0.0] + [float('nan')] * 70)
    assert (blind.level, blind.values['State']) == (Level.WARN, 'suppressed')
    assert 'no alarm can come' in blind.sentence
    assert after([0.0]).level == Level.OK


def states(listener: Listener) -> list[int]:
    """Return how the alarm on a shift went."""
    return [a.state for a in listener.alarms if a.name == 'curve_shift']


@pytest.mark.ros
@pytest.mark.slow
def test_an_alarm_is_put_aside_and_taken_back_and_the_recording_repeats(
    processes: Processes, context: Any, tmp_path: Path
) -> None:
    learnt = Monitor(Settings({'refit_period': 3600.0, 'refit_segments': 0}))
    feed_rows(learnt, simulate(0.1, 7).table)
    curve = learnt.characteristic
    assert curve is not None
    pieces = tuple(replace(p, intercept=p.intercept + 12.0) for p in curve.pieces)
    given = tmp_path / 'reference.json'
    given.write_text(json.dumps(to_json(replace(curve, pieces=pieces))), encoding='utf-8')
    parameters = {
        'record_directory': f'"{tmp_path / "recordings"}"', 'input_reliability': 'reliable',
        'refit_period': 3600.0, 'refit_segments': 0, 'reference_file': f'"{given}"',
        'alarm_limit': 500.0, 'use_sim_time': True,
    }  # fmt: skip
    monitor = processes.start('valveflow_ros.ros.monitor_main', *ros_arguments(parameters))
    listener = Listener(context)
    listener.until(lambda: listener.curves, 'the monitor')
    refused = listener.trigger('shelve_alarms')
    assert (refused.success, refused.message) == (False, 'There is no alarm to shelve.')
    plant = processes.start(
        'valveflow_ros.ros.simulator_main',
        *ros_arguments({'seed': 7, 'rate': 0.0, 'wait': PATIENCE_S, 'days': 0.1,
                        'use_clock': True}),
    )  # fmt: skip
    listener.until(lambda: plant.poll() is not None and states(listener), 'the alarm')
    (raised,) = (a for a in listener.alarms if a.name == 'curve_shift')
    assert raised.first_out == 'curve_shift'
    answer = listener.trigger('shelve_alarms')
    assert (answer.success, 'put aside for 8 h' in answer.message) == (True, True)
    listener.until(lambda: Alarm.SHELVED in states(listener), 'the shelf')
    assert not listener.trigger('acknowledge_alarms').success
    assert listener.trigger('unshelve_alarms').success
    listener.until(
        lambda: states(listener)[-2:] == [Alarm.SHELVED, Alarm.UNACKNOWLEDGED], 'its return'
    )
    again = listener.trigger('unshelve_alarms')
    assert (again.success, again.message) == (False, 'There is no shelved alarm.')
    monitor.terminate()
    assert monitor.wait(20.0) == 0, processes.output(monitor)
    (folder,) = (tmp_path / 'recordings').glob('valveflow_*')
    result = verify(folder)
    assert result.identical, result.difference
    # Where the load leaves the young curve the residual cannot be judged: that is told as well.
    assert states(listener) == [Alarm.UNACKNOWLEDGED, Alarm.SHELVED, Alarm.UNACKNOWLEDGED]
    assert result.compared['alarms'] == len(listener.alarms)
