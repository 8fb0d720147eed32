# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The reference in the node: its file, its service, its messages, its recording."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from listener import Listener, start_monitor, start_plant
from rclpy.serialization import deserialize_message
from ros_helpers import Processes, wait_until
from std_msgs.msg import Float64MultiArray
from valveflow_msgs.msg import Alarm

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.characteristic_json import to_json
from valveflow_ros.curve.shift import judge_shift
from valveflow_ros.errors import DataError
from valveflow_ros.monitoring.alarm_state import AlarmAction
from valveflow_ros.monitoring.alarms import AlarmState
from valveflow_ros.monitoring.curves import CurveStatus
from valveflow_ros.monitoring.events import (
    CurveAdopted,
    Event,
    JournalEntry,
    JournalKind,
    ReferenceSet,
)
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.offline import JournalReplayer, feed_rows
from valveflow_ros.parameters import Settings
from valveflow_ros.plant.simulator import DEFAULT_START_NS, simulate
from valveflow_ros.ros import encoding
from valveflow_ros.ros.decoding import from_time, journal_entry
from valveflow_ros.ros.node.health import reference_item
from valveflow_ros.ros.node.outputs import Outputs
from valveflow_ros.ros.node.parameter_files import given_reference
from valveflow_ros.ros.verify import verify
from valveflow_ros.signals.static_form import OPENING

SETTINGS = Settings({'refit_period': 3600.0, 'refit_segments': 0, 'alarm_limit': 500.0})
TABLE = simulate(0.3, 7).table


@pytest.fixture(scope='module')
def curve() -> Characteristic:
    monitor = Monitor(SETTINGS)
    feed_rows(monitor, TABLE)
    assert monitor.characteristic is not None
    return monitor.characteristic


def lifted(curve: Characteristic, by_mw: float) -> Characteristic:
    pieces = tuple(replace(p, intercept=p.intercept + by_mw) for p in curve.pieces)
    return replace(curve, pieces=pieces, model_id='lifted')


# --- messages ---------------------------------------------------------------------------------


def test_without_a_reference_nothing_is_said_of_a_shift(curve: Characteristic) -> None:
    message = encoding.curve_message(curve, CurveStatus.FRESH, '', 'u')
    assert message.reference_model_id == message.shift_sentence == ''
    assert list(message.shift_mw) == list(message.shift_confidence) == []
    assert from_time(message.shift_since) == 0


def test_the_reference_itself_has_not_moved(curve: Characteristic) -> None:
    message = encoding.curve_message(curve, CurveStatus.FRESH, '', 'u', curve.model_id)
    assert list(message.shift_mw) == list(message.shift_confidence) == [0.0] * len(curve.pieces)
    other = encoding.curve_message(curve, CurveStatus.FRESH, '', 'u', 'another')
    assert all(math.isnan(v) for v in [*other.shift_mw, *other.shift_confidence])
    assert len(other.shift_mw) == len(curve.pieces)
    none = encoding.curve_message(None, CurveStatus.UNKNOWN, 'why', 'u', 'another')
    assert (none.reference_model_id, list(none.shift_mw)) == ('another', [])


def test_a_judgement_stands_in_the_message(curve: Characteristic) -> None:
    shift = replace(
        judge_shift(lifted(curve, 5.0), curve),
        since_ns=DEFAULT_START_NS, since_low_ns=DEFAULT_START_NS - 1,
        since_high_ns=DEFAULT_START_NS + 1,
    )  # fmt: skip
    message = encoding.curve_message(curve, CurveStatus.FRESH, '', 'u', 'lifted', shift)
    assert list(message.shift_mw) == pytest.approx([-5.0] * len(curve.pieces))
    assert list(message.shift_confidence) == [p.confidence for p in shift.pieces]
    assert message.shift_sentence == shift.sentence
    assert from_time(message.shift_since) == DEFAULT_START_NS
    assert from_time(message.shift_since_low) == DEFAULT_START_NS - 1
    assert from_time(message.shift_since_high) == DEFAULT_START_NS + 1


def test_outputs_follow_the_events(curve: Characteristic) -> None:
    outputs = Outputs('u')
    said = list(outputs.of([ReferenceSet(lifted(curve, 5.0))]))
    assert [o.name for o in said] == ['characteristic', 'breakpoints', 'slopes']
    shift = judge_shift(lifted(curve, 5.0), curve)
    list(outputs.of([CurveAdopted(curve, shift)]))
    assert (outputs.reference_id, outputs.shift) == ('lifted', shift)
    list(outputs.of([CurveAdopted(curve)]))
    assert outputs.shift is None


@pytest.mark.parametrize(
    ('form', 'units'),
    [
        ({}, ['% MPa^e', 'MW / (% MPa^e)']),
        (
            {'axis': OPENING, 'pressure_exponent': 0.0, 'pressure_scale_exponent': 1.05},
            ['%', 'MW / (% MPa^s)'],
        ),
    ],
)
def test_plain_arrays_say_their_unit(
    curve: Characteristic, form: dict[str, Any], units: list[str]
) -> None:
    adopted = CurveAdopted(replace(curve, **form))
    said = {o.name: o.data for o in Outputs('u').of([adopted])}
    for name, unit in zip(('breakpoints', 'slopes'), units, strict=True):
        message = deserialize_message(said[name], Float64MultiArray)
        assert message.layout.dim[0].label.endswith(f'[{unit}]')


def test_a_run_with_references_is_repeated_byte_for_byte(curve: Characteristic) -> None:
    """As `verify` does it: rows and journal again, every message compared."""
    monitor = Monitor(SETTINGS)
    calls: list[list[Event]] = [monitor.set_reference(lifted(curve, 5.0))]
    third = len(TABLE) // 3
    for k in range(3):
        calls.append(feed_rows(monitor, TABLE.part(k * third, (k + 1) * third)))
        if k == 1:
            calls.append(monitor.operate_alarms(AlarmAction.ACKNOWLEDGE))
            calls.append(monitor.set_reference())
    events = [event for call in calls for event in call]
    kinds = [e.kind for e in events if isinstance(e, JournalEntry)]
    assert kinds.count(JournalKind.SET_REFERENCE) == 2
    assert JournalKind.ACKNOWLEDGE in kinds
    first, second = Outputs('u'), Outputs('u')
    live = [o for call in calls for o in first.of(call)]
    # Through messages and back, as a recording keeps the journal.
    journal = [
        journal_entry(encoding.encode(encoding.journal_message(e, 'u')))
        for e in events
        if isinstance(e, JournalEntry)
    ]
    replayer = JournalReplayer(Monitor(SETTINGS), journal)
    again = [
        o
        for start in range(0, 3 * third, 777)
        for o in second.of(replayer.feed(TABLE.part(start, min(start + 777, 3 * third))))
    ]
    again += second.of(replayer.feed(TABLE.part(0, 0)))
    assert [(o.name, o.time_ns) for o in again] == [(o.name, o.time_ns) for o in live]
    assert [o.data for o in again] == [o.data for o in live]
    assert any(o.name == 'alarms' for o in live)


# --- health and file --------------------------------------------------------------------------


def test_health_says_how_the_curve_stands_to_its_reference(curve: Characteristic) -> None:
    monitor = Monitor(SETTINGS)
    assert 'There is no reference curve yet' in reference_item(monitor).sentence
    monitor.set_reference(lifted(curve, 5.0))
    assert 'The next curve is judged' in reference_item(monitor).sentence
    feed_rows(monitor, TABLE)
    item = reference_item(monitor)
    assert item.values['Alarm'] == 'unacknowledged'
    assert 'less than the reference' in item.sentence
    monitor.operate_alarms(AlarmAction.ACKNOWLEDGE)
    monitor.set_reference()
    assert monitor.reference.alarm.state == AlarmState.NORMAL


def test_a_reference_is_read_from_its_file(curve: Characteristic, tmp_path: Path) -> None:
    assert given_reference(Settings()) is None
    path = tmp_path / 'characteristic.json'
    path.write_text(json.dumps(to_json(curve)), encoding='utf-8')
    read = given_reference(Settings({'reference_file': str(path)}))
    assert read is not None
    assert to_json(read) == to_json(curve)


# --- the node ---------------------------------------------------------------------------------


@pytest.mark.ros
@pytest.mark.slow
def test_the_node_judges_curves_and_its_recording_repeats(
    processes: Processes, listener: Listener, curve: Characteristic, tmp_path: Path
) -> None:
    given = tmp_path / 'reference.json'
    given.write_text(json.dumps(to_json(lifted(curve, 12.0))), encoding='utf-8')
    monitor = start_monitor(
        processes, tmp_path / 'recordings', reference_file=str(given), alarm_limit=500.0,
        use_sim_time=True,
    )  # fmt: skip
    listener.until(
        lambda: listener.curves and listener.curves[-1].reference_model_id == 'lifted',
        'the reference that was given',
    )
    refused = listener.trigger('set_reference')
    assert not refused.success
    assert 'no curve that could become the reference' in refused.message
    plant = start_plant(processes, days=0.1, use_clock=True)
    listener.until(lambda: plant.poll() is not None, 'the end of the plant')
    raised = listener.until(
        lambda: [a for a in listener.alarms if a.name == 'curve_shift' and a.occurrence],
        'the alarm on the shift',
    )
    assert raised[0].state == Alarm.UNACKNOWLEDGED
    assert 'less than the reference' in raised[0].sentence
    moved = listener.until(lambda: [m for m in listener.curves if m.shift_sentence], 'the shift')
    assert len(moved[-1].shift_mw) == moved[-1].pieces
    assert min(moved[-1].shift_mw) < -5.0
    assert listener.trigger('acknowledge_alarms').success
    answer = listener.trigger('set_reference')
    assert answer.success
    model_id = listener.curves[-1].model_id
    assert model_id in answer.message
    listener.until(lambda: listener.curves[-1].reference_model_id == model_id, 'its message')
    assert set(listener.curves[-1].shift_mw) == {0.0}
    listener.until(lambda: listener.alarms[-1].state == Alarm.NORMAL, 'the end of the alarm')
    monitor.terminate()
    assert monitor.wait(10.0) == 0, processes.output(monitor)
    assert 'Traceback' not in processes.output(monitor)
    (folder,) = (tmp_path / 'recordings').glob('valveflow_*')
    result = verify(folder)
    assert result.identical, result.difference
    assert result.compared['journal'] >= 5


def states(listener: Listener) -> list[int]:
    """Return how the alarm on a shift went."""
    return [a.state for a in listener.alarms if a.name == 'curve_shift' and a.occurrence]


@pytest.mark.ros
@pytest.mark.slow
def test_an_alarm_is_put_aside_and_taken_back_and_the_recording_repeats(
    processes: Processes, listener: Listener, curve: Characteristic, tmp_path: Path
) -> None:
    given = tmp_path / 'reference.json'
    given.write_text(json.dumps(to_json(lifted(curve, 12.0))), encoding='utf-8')
    monitor = start_monitor(
        processes, tmp_path / 'recordings', reference_file=str(given), alarm_limit=500.0,
        use_sim_time=True,
    )  # fmt: skip
    listener.until(lambda: listener.curves, 'the monitor')
    refused = listener.trigger('shelve_alarms')
    assert (refused.success, refused.message) == (False, 'There is no alarm to shelve.')
    plant = start_plant(processes, days=0.1, use_clock=True)
    listener.until(lambda: plant.poll() is not None and states(listener), 'the alarm')
    (raised,) = (a for a in listener.alarms if a.name == 'curve_shift' and a.occurrence)
    assert raised.first_out == 'curve_shift'
    answer = listener.trigger('shelve_alarms')
    assert (answer.success, 'shelved for 8 h' in answer.message) == (True, True)
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


@pytest.mark.ros
@pytest.mark.slow
def test_a_bad_reference_keeps_the_node_from_starting(
    processes: Processes, tmp_path: Path
) -> None:
    gone = tmp_path / 'gone.json'
    monitor = start_monitor(processes, tmp_path, reference_file=str(gone), record=False)
    said = "names '" + str(gone)
    wait_until(lambda: said in processes.output(monitor), 'the sentence')
    assert 'Traceback' not in processes.output(monitor)


def test_what_cannot_be_replayed_is_said() -> None:
    entry = JournalEntry(0, JournalKind.SET_REFERENCE, 0, 0, 'x', '')
    with pytest.raises(DataError, match='no curve that could become the reference'):
        JournalReplayer(Monitor(SETTINGS), [entry]).feed(TABLE.part(0, 3))
