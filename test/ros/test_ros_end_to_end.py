# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A plant and a monitor as two processes, a listener over DDS, and what is on disk afterwards."""

import json
import os
import stat

import numpy as np
import psutil
import pytest
from listener import MONITOR, ended, start_monitor, start_plant
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message
from ros_helpers import LOOPBACK, bound, rtps_ports
from std_msgs.msg import Float64MultiArray
from valveflow_msgs.msg import Alarm, Diagnosis, FlowCharacteristic, JournalEntry, Prediction

from valveflow_ros.logs import RecordingWriter, open_log
from valveflow_ros.monitoring.events import JournalKind
from valveflow_ros.monitoring.monitor import MIXED
from valveflow_ros.parameters import Settings
from valveflow_ros.plant.simulator import DEFAULT_START_NS, simulate
from valveflow_ros.plant.unit import UnitDescription
from valveflow_ros.records import SIGNALS, Signal
from valveflow_ros.ros.decoding import from_time
from valveflow_ros.ros.encoding import float64_bytes
from valveflow_ros.ros.node.state_store import LOCK
from valveflow_ros.ros.simulator_main import effects_of
from valveflow_ros.ros.verify import verify

AnyReader = pytest.importorskip('rosbags.highlevel').AnyReader
typesys = pytest.importorskip('rosbags.typesys')

pytestmark = [pytest.mark.ros, pytest.mark.slow]
TAKEN = 'Samples taken in all runs'
DAYS, SEED, FAULT_DAYS = 0.22, 7, 0.17
FAULT = f'gain_step:g=-0.12,t0_days={FAULT_DAYS}'
FAULT_NS = DEFAULT_START_NS + round(FAULT_DAYS * 86400e9)
SENT = [Signal.VALVE_COMMAND, *(info.signal for info in SIGNALS if info.required)]


def test_a_run_from_the_plant_to_the_disk(processes, listener, ros_environment, tmp_path):
    records = tmp_path / 'home' / 'deep' / 'recordings'
    ros_environment['ROS_LOG_DIR'] = str(tmp_path / 'home' / 'logs')
    before = os.umask(0)
    try:
        # Never suppressed: however late the operator of this test is, the alarm still stands then.
        monitor = start_monitor(
            processes, records, unit_tag='unit 1', use_sim_time=True, alarm_suppress_time=86400.0
        )
    finally:
        os.umask(before)
        del ros_environment['ROS_LOG_DIR']  # the plant's log is not the monitor's
    plant = start_plant(processes, days=DAYS, use_clock=True, command=True, effects=f'"{FAULT}"')
    live_parameter_and_acknowledgement(listener, monitor)
    nobody_else_is_listened_to(monitor, int(ros_environment['ROS_DOMAIN_ID']))
    listener.until(lambda: plant.poll() is not None, 'the end of the plant')
    assert plant.returncode == 0, processes.output(plant)
    rows = round(DAYS * 86400)
    listener.until(lambda: listener.value('fit', TAKEN) == str(rows), 'the last sample', 60.0)
    nothing_lost(listener, rows)
    the_latched_curve(listener)
    ended(processes, monitor, 10.0)

    (folder,) = records.glob('valveflow_*')
    assert 'unit-1' in folder.name
    nobody_else_may_read(tmp_path / 'home')
    log = open_log(folder)
    assert log.warnings == ()
    table = simulate(DAYS, SEED, effects=effects_of([FAULT])).table
    recorded_is_sent(log, table)
    recorded_is_said(log, listener, table)
    the_files_own_words(log)
    result = verify(folder)
    assert (result.difference, result.rows) == ('', rows)
    assert result.compared['prediction'] == rows
    assert result.compared['alarms'] == len(listener.alarms)
    others_read_it(folder, table)
    a_changed_recording_is_noticed(log, tmp_path / 'changed')


def live_parameter_and_acknowledgement(listener, monitor):
    """Change a live parameter early, then wait for the alarm of the fault and acknowledge it."""
    listener.until(lambda: listener.value('fit', TAKEN) not in ('', '0'), 'samples')
    wanted = Parameter('alarm_on_delay', value=90).to_parameter_msg()
    answer = listener.call(
        SetParameters, 'set_parameters', SetParameters.Request(parameters=[wanted])
    )
    assert answer.results[0].successful, answer.results[0].reason

    def raised():
        assert monitor.poll() is None
        standing = (a for a in listener.alarms if a.state == Alarm.UNACKNOWLEDGED)
        return any(from_time(a.header.stamp) >= FAULT_NS for a in standing)

    listener.until(raised, 'the alarm of the fault')
    alarm = listener.alarms[-1]
    assert (
        'MW less than its valve curve (mean over the loads seen), since about ' in alarm.sentence
    )
    assert (alarm.name, alarm.unit, alarm.header.frame_id) == ('residual', '', 'unit 1')
    assert alarm.value < -alarm.limit == -1.0
    assert from_time(alarm.header.stamp) < FAULT_NS + 3600 * 10**9
    assert listener.trigger('acknowledge_alarms')[0]
    listener.until(lambda: listener.alarms[-1].state == Alarm.ACKNOWLEDGED, 'the acknowledgement')
    again = listener.trigger('acknowledge_alarms')
    assert again == (False, 'There is no alarm to acknowledge.')
    assert listener.trigger('set_reference')[0]
    success, sentence = listener.trigger('diagnose')
    assert not success
    assert sentence.startswith('A diagnosis needs a day of data; the window holds ')
    diagnosis = listener.late(Diagnosis, 'diagnosis')
    assert diagnosis.verdict == Diagnosis.UNKNOWN
    assert diagnosis.sentence.startswith('Not diagnosed yet')
    assert listener.value('diagnosis', 'Running') == 'no'


def nobody_else_is_listened_to(monitor, domain):
    process = psutil.Process(monitor.pid)
    family = (process, *process.children(recursive=True))
    found = [place for each in family for place in bound(each)]
    assert len([port for _, port in found if port in rtps_ports(domain)]) >= 2
    assert {address for address, _ in found} == {LOOPBACK}


def nobody_else_may_read(home):
    modes = {path: stat.S_IMODE(path.lstat().st_mode) for path in home.rglob('*')}
    files = {path for path in modes if path.is_file()}
    assert {'metadata.yaml', LOCK} <= {path.name for path in files}
    assert any(path.suffix == '.log' for path in files)
    assert {modes[path] for path in files} == {0o600}
    assert {mode for path, mode in modes.items() if path not in files} == {0o700}


def nothing_lost(listener, rows):
    for signal in SENT:
        item = f'input {SIGNALS[signal].topic}'
        assert listener.value(item, 'Messages lost on the way') == '0'
        assert listener.value(item, 'Messages received') == str(rows)
        assert listener.value(item, 'Readings accepted in all runs') == str(rows)
    assert listener.value('recorder', 'Messages dropped') == '0'


def the_latched_curve(listener):
    """The curve that one who comes late gets is the last one, and near the truth."""
    curve = listener.late(FlowCharacteristic, 'characteristic')
    assert repr(curve) == repr(listener.curves[-1])
    # A fit under way when the alarm came is refused; on a busy machine no other follows in time.
    assert curve.status == FlowCharacteristic.FRESH or curve.cause == MIXED
    assert curve.header.frame_id == 'unit 1'
    for name in ('breakpoints', 'slopes'):
        plain = listener.late(Float64MultiArray, name)
        assert list(plain.data) == list(getattr(curve, name))
    clean = [c for c in listener.curves if 0 < from_time(c.window_end) <= FAULT_NS]
    assert clean
    u = np.linspace(clean[-1].breakpoints[0], clean[-1].breakpoints[-1], 50)
    off = np.interp(u, clean[-1].breakpoints, clean[-1].values) - UnitDescription().curve(u)
    # Some hours of one day: the whole range, to a few MW of 300.
    assert np.sqrt(np.mean(off**2)) < 5.0


def recorded_is_sent(log, table):
    """Every value with its time stands in the recording, in the order sent."""
    for signal in SENT:
        messages = list(log.iter_messages([f'/{SIGNALS[signal].topic}']))
        assert [m.publish_time_ns for m in messages] == table.time_ns.tolist()
        expected = [float64_bytes(value) for value in table.column(signal).tolist()]
        assert [m.data for m in messages] == expected
    log_ns = [message.log_time_ns for message in log.iter_messages()]
    assert log_ns == sorted(set(log_ns))


def recorded_is_said(log, listener, table):
    """What was heard over DDS is what stands on disk."""

    def said(kind, name):
        found = log.iter_messages([f'{MONITOR}/{name}'])
        return [deserialize_message(message.data, kind) for message in found]

    assert [repr(m) for m in said(Alarm, 'alarms')] == [repr(m) for m in listener.alarms]
    recorded = [repr(m) for m in said(FlowCharacteristic, 'characteristic')]
    assert [repr(m) for m in listener.curves] == recorded[-len(listener.curves) :]
    kinds = [m.kind for m in said(JournalEntry, 'journal')]
    for kind in ('FIT_REQUESTED', 'FIT_ADOPTED', 'ACKNOWLEDGE', 'SETTINGS'):
        assert JournalKind[kind] in kinds
    predictions = said(Prediction, 'prediction')
    assert [from_time(m.header.stamp) for m in predictions] == table.time_ns.tolist()
    power = table.column(Signal.GENERATED_POWER)
    np.testing.assert_array_equal([m.measured_mw for m in predictions], power)


def the_files_own_words(log):
    settings = Settings(json.loads(log.attachments['parameters.json']))
    assert settings.text('unit_tag') == 'unit 1'
    topics = json.loads(log.attachments['topics.json'])
    assert topics['inputs']['valve_opening'] == '/valve_opening'
    assert topics['outputs']['prediction'] == f'{MONITOR}/prediction'
    for info in log.topics.values():
        assert info.type_hash.startswith('RIHS01_')


def others_read_it(folder, table):
    """A reader that is not ours finds the same values."""
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    with AnyReader([folder], default_typestore=store) as reader:
        by_topic = {connection.topic: connection for connection in reader.connections}

        def read(topic):
            connection = by_topic[topic]
            found = reader.messages([connection])
            return [reader.deserialize(raw, connection.msgtype) for _, _, raw in found]

        for signal in SENT:
            found = [message.data for message in read(f'/{SIGNALS[signal].topic}')]
            np.testing.assert_array_equal(found, table.column(signal))
        first, *_, last = read(f'{MONITOR}/characteristic')
        assert (first.status, len(first.breakpoints)) == (FlowCharacteristic.UNKNOWN, 0)
        assert last.header.frame_id == 'unit 1'
        assert len(last.breakpoints) == last.pieces + 1
        assert by_topic['/diagnostics'].msgcount > 0


def a_changed_recording_is_noticed(log, folder):
    """One bit of one prediction, or one value of one input, and the comparison says where."""
    names = {'shift_mw': f'{MONITOR}/prediction', 'measured_mw': '/generated_power'}
    for field, name in names.items():
        place = folder / field
        with RecordingWriter(place, attachments=log.attachments) as writer:
            for info in log.topics.values():
                writer.add_topic(info.name, info.type, definition=info.definition)
            count = 0
            for message in log.iter_messages():
                data = message.data
                count += message.topic == name
                if message.topic == name and count == 12000:
                    # The low end of the number that stands last in either message.
                    data = data[:-8] + bytes([data[-8] ^ 1]) + data[-7:]
                if count > 12100:
                    break
                writer.write(message.topic, data, message.log_time_ns, message.publish_time_ns)
        result = verify(place)
        assert not result.identical
        assert 'Prediction number 12000 differs' in result.difference
        assert field in result.difference
