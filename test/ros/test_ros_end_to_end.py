# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A plant and a monitor as two processes, a listener over DDS, and what is on disk afterwards."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from listener import MONITOR, Listener, start_monitor, start_plant
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message
from ros_helpers import Processes
from std_msgs.msg import Float64MultiArray
from valveflow_msgs.msg import Alarm, Diagnosis, FlowCharacteristic, JournalEntry, Prediction

from valveflow_ros.logs import LogContents, RecordingWriter, open_log
from valveflow_ros.monitoring.events import JournalKind
from valveflow_ros.monitoring.monitor import MIXED
from valveflow_ros.parameters import Settings
from valveflow_ros.plant.simulator import DEFAULT_START_NS, simulate
from valveflow_ros.plant.unit import UnitDescription
from valveflow_ros.records import SIGNALS, SampleTable, Signal
from valveflow_ros.ros.decoding import from_time
from valveflow_ros.ros.encoding import float64_bytes
from valveflow_ros.ros.simulator_main import effects_of
from valveflow_ros.ros.verify import verify

AnyReader = pytest.importorskip('rosbags.highlevel').AnyReader
typesys = pytest.importorskip('rosbags.typesys')

pytestmark = [pytest.mark.ros, pytest.mark.slow]
TAKEN = 'Samples taken in all runs'
DAYS, SEED = 0.22, 7
FAULT = 'gain_step:g=-0.12,t0_days=0.17'
FAULT_NS = DEFAULT_START_NS + round(0.17 * 86400e9)
SENT = [Signal.VALVE_COMMAND, *(info.signal for info in SIGNALS if info.required)]


def test_a_run_from_the_plant_to_the_disk(
    processes: Processes, listener: Listener, tmp_path: Path
) -> None:
    # Never suppressed: however late the operator of this test is, the alarm still stands then.
    monitor = start_monitor(
        processes,
        tmp_path / 'recordings',
        unit_tag='unit 1',
        use_sim_time=True,
        alarm_suppress_time=86400.0,
    )
    plant = start_plant(processes, days=DAYS, use_clock=True, command=True, effects=f'"{FAULT}"')
    live_parameter_and_acknowledgement(listener, monitor)
    listener.until(lambda: plant.poll() is not None, 'the end of the plant')
    assert plant.returncode == 0, processes.output(plant)
    rows = round(DAYS * 86400)
    listener.until(lambda: listener.value('fit', TAKEN) == str(rows), 'the last sample', 60.0)
    nothing_lost(listener, rows)
    the_latched_curve(listener)
    monitor.send_signal(signal.SIGTERM)
    assert monitor.wait(10.0) == 0, processes.output(monitor)
    assert 'Traceback' not in processes.output(monitor)

    (folder,) = (tmp_path / 'recordings').glob('valveflow_*')
    assert 'unit-1' in folder.name
    log = open_log(folder)
    assert log.warnings == ()
    recorded_is_sent(log)
    recorded_is_said(log, listener)
    the_files_own_words(log)
    result = verify(folder)
    assert result.difference == ''
    assert result.rows == rows
    assert result.compared['prediction'] == rows
    assert result.compared['alarms'] == len(listener.alarms)
    others_read_it(folder)
    a_changed_recording_is_noticed(log, tmp_path / 'changed')


def live_parameter_and_acknowledgement(listener: Listener, monitor: Any) -> None:
    """Change a live parameter early, then wait for the alarm of the fault and acknowledge it."""
    listener.until(lambda: listener.value('fit', TAKEN) not in ('', '0'), 'samples')
    wanted = Parameter('alarm_on_delay', value=90).to_parameter_msg()
    answer = listener.call(
        SetParameters, 'set_parameters', SetParameters.Request(parameters=[wanted])
    )
    assert answer.results[0].successful, answer.results[0].reason

    def raised() -> bool:
        assert monitor.poll() is None
        times = [
            from_time(a.header.stamp) for a in listener.alarms if a.state == Alarm.UNACKNOWLEDGED
        ]
        return any(time_ns >= FAULT_NS for time_ns in times)

    listener.until(raised, 'the alarm of the fault')
    alarm = listener.alarms[-1]
    assert (
        'MW less than its valve curve (mean over the loads seen), since about ' in alarm.sentence
    )
    assert (alarm.name, alarm.unit, alarm.header.frame_id) == ('residual', '', 'unit 1')
    assert abs(alarm.value) > alarm.limit == 1.0
    assert alarm.value < -alarm.limit < 0.0
    assert from_time(alarm.header.stamp) < FAULT_NS + 3600 * 10**9
    answer = listener.trigger('acknowledge_alarms')
    assert answer.success, answer.message
    listener.until(lambda: listener.alarms[-1].state == Alarm.ACKNOWLEDGED, 'the acknowledgement')
    again = listener.trigger('acknowledge_alarms')
    assert (again.success, again.message) == (False, 'There is no alarm to acknowledge.')
    answer = listener.trigger('set_reference')
    assert answer.success, answer.message
    answer = listener.trigger('diagnose')
    assert not answer.success
    assert answer.message.startswith('A diagnosis needs a day of data; the window holds ')
    diagnosis = listener.latched(Diagnosis, 'diagnosis')
    assert diagnosis.verdict == Diagnosis.UNKNOWN
    assert diagnosis.sentence.startswith('Not diagnosed yet')
    assert listener.value('diagnosis', 'Running') == 'no'


def nothing_lost(listener: Listener, rows: int) -> None:
    for signal_ in SENT:
        item = f'input {SIGNALS[signal_].topic}'
        assert listener.value(item, 'Messages lost on the way') == '0'
        assert listener.value(item, 'Messages received') == str(rows)
        assert listener.value(item, 'Readings accepted in all runs') == str(rows)
    assert listener.value('recorder', 'Messages dropped') == '0'


def the_latched_curve(listener: Listener) -> None:
    """The curve that one who comes late gets is the last one, and near the truth."""
    curve = listener.latched(FlowCharacteristic, 'characteristic')
    assert repr(curve) == repr(listener.curves[-1])
    # A fit under way when the alarm came is refused; on a busy machine no other follows in time.
    assert curve.status == FlowCharacteristic.FRESH or curve.cause == MIXED
    assert curve.header.frame_id == 'unit 1'
    breakpoints = listener.latched(Float64MultiArray, 'breakpoints')
    slopes = listener.latched(Float64MultiArray, 'slopes')
    assert list(breakpoints.data) == list(curve.breakpoints)
    assert list(slopes.data) == list(curve.slopes)
    clean = [c for c in listener.curves if 0 < from_time(c.window_end) <= FAULT_NS]
    assert clean
    truth = UnitDescription().curve
    u = np.linspace(clean[-1].breakpoints[0], clean[-1].breakpoints[-1], 50)
    off = np.interp(u, clean[-1].breakpoints, clean[-1].values) - truth(u)
    # Some hours of one day: the whole range, to a few MW of 300.
    assert np.sqrt(np.mean(off**2)) < 5.0


def sent_table() -> SampleTable:
    return simulate(DAYS, SEED, effects=effects_of([FAULT])).table


def recorded_is_sent(log: LogContents) -> None:
    """Every value with its time stands in the recording, in the order sent."""
    table = sent_table()
    last_log_ns = 0
    for signal_ in SENT:
        info = SIGNALS[signal_]
        messages = list(log.iter_messages([f'/{info.topic}']))
        assert [m.publish_time_ns for m in messages] == table.time_ns.tolist()
        expected = [float64_bytes(value) for value in table.column(signal_).tolist()]
        assert [m.data for m in messages] == expected
    for message in log.iter_messages():
        assert message.log_time_ns > last_log_ns
        last_log_ns = message.log_time_ns


def recorded_is_said(log: LogContents, listener: Listener) -> None:
    """What was heard over DDS is what stands on disk."""

    def said(kind: Any, name: str) -> list[Any]:
        return [
            deserialize_message(m.data, kind) for m in log.iter_messages([f'{MONITOR}/{name}'])
        ]

    assert [repr(m) for m in said(Alarm, 'alarms')] == [repr(m) for m in listener.alarms]
    recorded = [repr(m) for m in said(FlowCharacteristic, 'characteristic')]
    assert [repr(m) for m in listener.curves] == recorded[-len(listener.curves) :]
    kinds = [m.kind for m in said(JournalEntry, 'journal')]
    for kind in ('FIT_REQUESTED', 'FIT_ADOPTED', 'ACKNOWLEDGE', 'SETTINGS'):
        assert JournalKind[kind] in kinds
    predictions = said(Prediction, 'prediction')
    times = [from_time(m.header.stamp) for m in predictions]
    assert times == sent_table().time_ns.tolist()
    power = sent_table().column(Signal.GENERATED_POWER)
    np.testing.assert_array_equal([m.measured_mw for m in predictions], power)


def the_files_own_words(log: LogContents) -> None:
    settings = Settings(json.loads(log.attachments['parameters.json']))
    assert settings.text('unit_tag') == 'unit 1'
    topics = json.loads(log.attachments['topics.json'])
    assert topics['inputs']['valve_opening'] == '/valve_opening'
    assert topics['outputs']['prediction'] == f'{MONITOR}/prediction'
    for info in log.topics.values():
        assert info.type_hash.startswith('RIHS01_')


def others_read_it(folder: Path) -> None:
    """A reader that is not ours finds the same values."""
    table = sent_table()
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    with AnyReader([folder], default_typestore=store) as reader:
        by_topic = {connection.topic: connection for connection in reader.connections}
        for signal_ in SENT:
            connection = by_topic[f'/{SIGNALS[signal_].topic}']
            found = [
                reader.deserialize(raw, connection.msgtype).data
                for _, _, raw in reader.messages([connection])
            ]
            np.testing.assert_array_equal(found, table.column(signal_))
        connection = by_topic[f'{MONITOR}/characteristic']
        messages = [
            reader.deserialize(raw, connection.msgtype)
            for _, _, raw in reader.messages([connection])
        ]
        assert messages[0].status == FlowCharacteristic.UNKNOWN
        assert len(messages[0].breakpoints) == 0
        assert messages[-1].header.frame_id == 'unit 1'
        assert len(messages[-1].breakpoints) == messages[-1].pieces + 1
        assert by_topic['/diagnostics'].msgcount > 0


def a_changed_recording_is_noticed(log: LogContents, folder: Path) -> None:
    """One bit of one prediction, or one value of one input, and the comparison says where."""
    names = [f'{MONITOR}/prediction', '/generated_power']
    for k, name in enumerate(names):
        place = folder / str(k)
        with RecordingWriter(place, attachments=log.attachments) as writer:
            for info in log.topics.values():
                writer.add_topic(info.name, info.type, definition=info.definition,
                                 type_hash=info.type_hash)  # fmt: skip
            count = 0
            for message in log.iter_messages():
                data = message.data
                count += message.topic == name
                if message.topic == name and count == 12000:
                    # The low end of the number that stands last in either message.
                    data = data[:-8] + bytes([data[-8] ^ 1]) + data[-7:]
                writer.write(message.topic, data, message.log_time_ns, message.publish_time_ns)
        result = verify(place)
        assert not result.identical
        assert 'Prediction number 12000 differs' in result.difference
        field = 'shift_mw' if k == 0 else 'measured_mw'
        assert field in result.difference


def test_ending_during_a_refit_finishes_the_file_at_once(
    processes: Processes, listener: Listener, tmp_path: Path
) -> None:
    monitor = start_monitor(processes, tmp_path / 'recordings', refit_period=0.0)
    plant = start_plant(processes, days=0.15, stamped=True)
    listener.until(lambda: plant.poll() is not None, 'the end of the plant')
    samples = round(0.15 * 86400)
    listener.until(lambda: listener.value('fit', TAKEN) == str(samples), 'the samples')
    (worker,) = [
        child for child in psutil.Process(monitor.pid).children()
        if any('valveflow_ros.ros.node.worker' in word for word in child.cmdline())
    ]  # fmt: skip
    # However fast the machine is, this refit is under way when the monitor has to end.
    worker.suspend()
    answer = listener.trigger('refit')
    assert answer.success, answer.message
    again = listener.trigger('refit')
    assert (again.success, again.message) == (False, 'A fit is running already.')
    begun = time.monotonic()
    monitor.send_signal(signal.SIGTERM)
    os.kill(monitor.pid, signal.SIGINT)
    assert monitor.wait(10.0) == 0, processes.output(monitor)
    assert time.monotonic() - begun < 2.0
    assert not worker.is_running() or worker.status() == psutil.STATUS_ZOMBIE
    (folder,) = (tmp_path / 'recordings').glob('valveflow_*')
    assert not list(folder.glob('*.part'))
    assert (folder / 'metadata.yaml').exists()
    log = open_log(folder)
    assert log.warnings == ()
    assert log.topics['/plant_sample'].count == samples
    assert verify(folder).difference == ''
