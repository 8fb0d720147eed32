# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import rclpy
import yaml
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import Parameter as ParameterMsg
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_helpers import wait_until
from std_msgs.msg import Float32, Float64, Header
from std_srvs.srv import Trigger
from valveflow_msgs.msg import FlowCharacteristic, PlantSample

from valveflow_ros.errors import ParameterError, RecordingError
from valveflow_ros.logs import open_log
from valveflow_ros.monitoring.events import CurveAdopted, JournalEntry, JournalKind
from valveflow_ros.parameters import TABLE, Settings
from valveflow_ros.ros import demo, replay_main, simulator_main, watch_main
from valveflow_ros.ros.node import monitor_node
from valveflow_ros.ros.node.engine import example_curve
from valveflow_ros.ros.node.monitor_node import MonitorNode
from valveflow_ros.ros.node.outputs import OUTPUTS
from valveflow_ros.ros.node.recording import check_record_directory, new_folder

pytestmark = pytest.mark.ros
_MODULES = ('monitor_main', 'simulator_main', 'replay_main', 'watch_main', 'demo')
DONE = TransitionCallbackReturn.SUCCESS


class Stage:
    """A monitor that does nothing by itself, and somebody who talks to it."""

    def __init__(self, context: Any, folder: Path, **more: object) -> None:
        given = {
            'record_directory': str(folder), 'diagnostics_period': 0.1, 'unit_tag': 'HV 101/2',
            **more,
        }  # fmt: skip
        overrides = [Parameter(name, value=value) for name, value in given.items()]
        self.monitor = MonitorNode(context=context, parameter_overrides=overrides)
        self.other = Node('other', context=context)
        self.executor = SingleThreadedExecutor(context=context)
        for node in (self.monitor, self.other):
            self.executor.add_node(node)
        self.health: list[DiagnosticArray] = []
        self.other.create_subscription(DiagnosticArray, '/diagnostics', self.health.append, 10)

    def turn(self) -> None:
        self.monitor.step()
        self.executor.spin_once(timeout_sec=0.01)

    def trigger(self, name: str) -> Trigger.Response:
        client = self.other.create_client(Trigger, f'/valveflow_monitor/{name}')
        wait_until(client.service_is_ready, name, 20.0)
        future = client.call_async(Trigger.Request())
        wait_until(lambda: self.turn() or future.done(), name, 20.0)
        return future.result()

    def sentence(self, item: str) -> str:
        self.health.clear()
        wait_until(lambda: self.turn() or self.health, 'health', 20.0)
        found = [s.message for s in self.health[-1].status if s.name.endswith(item)]
        return found[0] if found else ''

    def close(self) -> None:
        self.monitor.end_session()
        self.executor.shutdown()
        self.monitor.destroy_node()
        self.other.destroy_node()


def test_the_whole_life(context: Any, tmp_path: Path) -> None:
    # Each life by itself: with a state the second would go on with the first one's recording.
    stage = Stage(context, tmp_path, keep_state=False)
    monitor = stage.monitor
    try:
        assert stage.sentence('fit') == 'The monitor is not configured.'
        answer = stage.trigger('refit')
        assert not answer.success
        assert answer.message == 'The monitor is not active; activate it first.'
        for _ in range(2):
            assert monitor.trigger_configure() == DONE
            assert monitor.session is not None
            assert not monitor.session.listening
            assert monitor.trigger_activate() == DONE
            assert monitor.session.listening
            assert stage.trigger('refit').message == ('There is no special segment to fit yet.')
            assert stage.sentence('input valve_opening').startswith('Waiting for /valve_opening')
            assert monitor.trigger_deactivate() == DONE
            assert stage.sentence('fit').startswith('No curve yet')
            assert stage.sentence('input valve_opening') == ''
            assert monitor.trigger_activate() == DONE
            assert monitor.trigger_deactivate() == DONE
            assert monitor.trigger_cleanup() == DONE
            assert monitor.session is None
        folders = sorted(tmp_path.glob('valveflow_*'))
        assert len(folders) == 2
        for folder in folders:
            assert folder.name.endswith(('_HV-101-2', '_HV-101-2_2'))
            assert folder.stat().st_mode & 0o777 == 0o700
            assert open_log(folder).warnings == (
                'None of its topics is an input of the monitor; '
                'name one with --column valve_opening=TOPIC.',
            )
        assert monitor.trigger_shutdown() == DONE
        assert monitor.finalized
    finally:
        stage.close()


def test_the_quality_of_service_is_set_from_outside_and_recorded_as_offered(
    context: Any, tmp_path: Path
) -> None:
    override = {
        'qos_overrides./valveflow_monitor/diagnosis.publisher.depth': 7,
        'qos_overrides./valve_opening.subscription.reliability': 'reliable',
        'qos_overrides./valve_openin.subscription.depth': 5,
    }
    stage = Stage(context, tmp_path, **override)
    try:
        best_effort = QoSProfile(depth=3, reliability=ReliabilityPolicy.BEST_EFFORT)
        pressure = stage.other.create_publisher(Float64, '/main_steam_pressure', best_effort)
        stage.monitor.trigger_configure()
        stage.monitor.trigger_activate()
        (seen,) = stage.other.get_subscriptions_info_by_topic('/valve_opening')
        assert seen.qos_profile.reliability == ReliabilityPolicy.RELIABLE
        assert "'qos_overrides./valve_openin.subscription.depth' is for no topic" in (
            stage.sentence('parameters')
        )
        wait_until(lambda: pressure.get_subscription_count(), 'the subscription', 20.0)
        pressure.publish(Float64(data=12.0))
        wait_until(lambda: stage.monitor.step(), 'the message', 20.0)
        assert stage.monitor.trigger_deactivate() == DONE
    finally:
        stage.close()
    (folder,) = tmp_path.glob('valveflow_*')
    told = yaml.safe_load((folder / 'metadata.yaml').read_text())['rosbag2_bagfile_information']
    offered = {
        t['topic_metadata']['name']: t['topic_metadata']['offered_qos_profiles']
        for t in told['topics_with_message_count']
    }
    assert [p['reliability'] for p in offered['/main_steam_pressure']] == ['best_effort']
    (diagnosis,) = offered['/valveflow_monitor/diagnosis']
    assert (diagnosis['depth'], diagnosis['durability']) == (7, 'transient_local')
    assert offered['/valveflow_monitor/alarms'][0]['depth'] == OUTPUTS['alarms'].kept


def test_a_sample_that_does_not_agree_with_the_parameters_is_told_once(
    context: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = Stage(context, tmp_path, main_steam_pressure_unit='bar')
    told: list[str] = []
    monkeypatch.setattr(stage.monitor, '_log', lambda _, text: told.append(text))
    try:
        stage.monitor.trigger_configure()
        stage.monitor.trigger_activate()
        publisher = stage.other.create_publisher(PlantSample, '/plant_sample', 10)
        wait_until(lambda: publisher.get_subscription_count(), 'the subscription', 20.0)
        for second in (1, 2):
            header = Header(stamp=Time(sec=second), frame_id='U2')
            publisher.publish(PlantSample(header=header))
            wait_until(lambda: stage.monitor.step(), 'the message', 20.0)
    finally:
        stage.close()
    assert [text.split(' ')[0] for text in told if 'PlantSample' in text] == [
        'main_steam_pressure_unit',
        'PlantSample',
    ]


@pytest.mark.parametrize(
    ('policy', 'value', 'words'),
    [
        ('reliability', 'sure', "must be reliable or best_effort, not 'sure'"),
        ('history', 3, 'must be keep_last or keep_all, not 3'),
        ('depth', 0, 'must be a whole number from 1 to 1000000, not 0'),
    ],
)
def test_a_quality_of_service_that_there_is_not_is_refused_at_the_start(
    context: Any, tmp_path: Path, policy: str, value: object, words: str
) -> None:
    name = f'qos_overrides./valve_opening.subscription.{policy}'
    with pytest.raises(ParameterError, match=words):
        Stage(context, tmp_path, **{name: value})


def test_a_curve_is_on_disk_before_anybody_is_told(
    context: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = Stage(context, tmp_path, record_flush=60.0)
    told: list[int] = []
    stage.other.create_subscription(
        FlowCharacteristic, '/valveflow_monitor/characteristic',
        lambda message: told.append(message.status), 10,
    )  # fmt: skip
    try:
        stage.monitor.trigger_configure()
        stage.monitor.trigger_activate()
        session = stage.monitor.session
        assert session is not None
        curve = example_curve(stage.monitor.settings)
        entry = JournalEntry(5, JournalKind.FIT_ADOPTED, 1, 1, curve.model_id, '')
        publisher = session._publishers['journal']
        on_disk: list[bytes] = []

        class Publisher:
            """Looks what a kill at this moment would leave."""

            def publish(self, data: bytes) -> None:
                (part,) = tmp_path.glob('valveflow_*/*.part')
                on_disk.append(part.read_bytes())

        monkeypatch.setitem(session._publishers, 'journal', Publisher())
        session.publish([entry, CurveAdopted(curve)])
        monkeypatch.setitem(session._publishers, 'journal', publisher)
        wait_until(lambda: stage.turn() or len(told) > 1, 'the curve', 20.0)
        (left,) = on_disk
        copy = tmp_path / 'copy' / 'copy_0.mcap'
        copy.parent.mkdir()
        copy.write_bytes(left)
        topics = [m.topic for m in open_log(copy).iter_messages()]
        assert topics.count('/valveflow_monitor/journal') == 1
        assert topics.count('/valveflow_monitor/characteristic') == 2
    finally:
        stage.close()


def test_requests_that_wait_are_all_answered_in_one_turn(context: Any, tmp_path: Path) -> None:
    stage = Stage(context, tmp_path)
    try:
        stage.executor.remove_node(stage.monitor)
        names = ('refit', 'acknowledge_alarms')
        clients = [stage.other.create_client(Trigger, f'/valveflow_monitor/{n}') for n in names]
        wait_until(lambda: all(c.service_is_ready() for c in clients), 'the services', 20.0)
        asked = [client.call_async(Trigger.Request()) for client in clients * 5]
        time.sleep(0.5)  # until all have arrived; nothing takes them meanwhile
        monitor_node.serve_requests(stage.monitor, 10.0)
        for answer in asked:
            wait_until(
                lambda a=answer: stage.executor.spin_once(timeout_sec=0.01) or a.done(),
                'the answer', 20.0,
            )  # fmt: skip
        assert not any(a.result().success for a in asked)
    finally:
        stage.close()


def ask(stage: Stage, kind: Any, name: str, request: Any) -> Any:
    """Ask what the loop of the monitor answers, not the executor."""
    client = stage.other.create_client(kind, f'/valveflow_monitor/{name}')
    wait_until(client.service_is_ready, name, 20.0)
    future = client.call_async(request)

    def turn() -> bool:
        monitor_node.serve_requests(stage.monitor, 1.0)
        stage.executor.spin_once(timeout_sec=0.01)
        return future.done()

    wait_until(turn, name, 20.0)
    return future.result()


def test_a_request_that_cannot_be_done_is_answered_and_ends_nothing(
    context: Any, tmp_path: Path
) -> None:
    stage = Stage(context, tmp_path)
    try:
        stage.executor.remove_node(stage.monitor)
        stage.monitor.trigger_configure()
        stage.monitor.trigger_activate()
        # A manager that knows no better asks for a transition that is not to be had.
        request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_CONFIGURE))
        assert not ask(stage, ChangeState, 'change_state', request).success
        strange = ParameterMsg(name='alarm_flood', value=ParameterValue(type=42))
        good = Parameter('alarm_flood', value=7).to_parameter_msg()
        request = SetParameters.Request(parameters=[good, strange, good])
        results = ask(stage, SetParameters, 'set_parameters', request).results
        assert [result.successful for result in results] == [True, False, False]
        assert 'cannot be done' in results[1].reason
        request = SetParametersAtomically.Request(parameters=[strange])
        result = ask(stage, SetParametersAtomically, 'set_parameters_atomically', request).result
        assert not result.successful
        assert 'cannot be done' in result.reason
        assert stage.monitor.session is not None
        assert stage.monitor.session.listening
    finally:
        stage.close()


def test_another_life_asks_for_the_reliability_of_its_own_parameters(
    context: Any, tmp_path: Path
) -> None:
    stage = Stage(context, tmp_path, input_reliability='best_effort')
    try:
        for wanted in ('best_effort', 'reliable'):
            set_one = [Parameter('input_reliability', value=wanted)]
            assert stage.monitor.set_parameters_atomically(set_one).successful
            assert stage.monitor.trigger_configure() == DONE
            assert stage.monitor.trigger_activate() == DONE
            (seen,) = stage.monitor.get_subscriptions_info_by_topic('/valve_opening')
            assert seen.qos_profile.reliability.name.lower() == wanted
            assert stage.monitor.trigger_deactivate() == DONE
            assert stage.monitor.trigger_cleanup() == DONE
    finally:
        stage.close()


def test_another_node_of_the_same_name_is_told(
    context: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(monitor_node, '_LOOK_AROUND_S', 0.05)
    stage = Stage(context, tmp_path)
    try:
        stage.monitor.trigger_configure()
        assert stage.sentence(' name') == ''
        twin = Node('valveflow_monitor', context=context, start_parameter_services=False)
        wait_until(lambda: stage.sentence(' name'), 'the name', 20.0)
        assert stage.sentence(' name').startswith('2 nodes are called /valveflow_monitor: ')
        twin.destroy_node()
        wait_until(lambda: not stage.sentence(' name'), 'its end', 20.0)
    finally:
        stage.close()


def test_what_is_wrong_with_an_input_is_seen_from_outside(context: Any, tmp_path: Path) -> None:
    stage = Stage(context, tmp_path)
    elsewhere = Context()
    try:
        stage.monitor.trigger_configure()
        stage.monitor.trigger_activate()
        # One participant cannot publish one topic as two types: this is another machine's.
        rclpy.init(context=elsewhere, domain_id=context.get_domain_id())
        gateway = Node('gateway', context=elsewhere)
        gateway.create_publisher(Float32, '/valve_opening', 10)
        wait_until(
            lambda: 'published as std_msgs/msg/Float32' in stage.sentence('input valve_opening'),
            'the wrong type', 20.0,
        )  # fmt: skip
    finally:
        rclpy.try_shutdown(context=elsewhere)
        stage.close()


def test_a_recording_that_cannot_be_made_keeps_nobody_from_monitoring(
    context: Any, tmp_path: Path
) -> None:
    (tmp_path / 'file').write_text('')
    stage = Stage(context, tmp_path / 'file' / 'below')
    try:
        assert stage.monitor.trigger_configure() == DONE
        assert stage.monitor.trigger_activate() == DONE
        assert 'cannot be made' in stage.sentence('recorder')
        session = stage.monitor.session
        assert session is not None
        assert not session.recording.on
    finally:
        stage.close()


@pytest.mark.parametrize('name', ['monitor_main', 'simulator_main', 'replay_main'])
def test_help_is_a_page_and_starts_nothing(name: str, tmp_path: Path) -> None:
    module = f'valveflow_ros.ros.{name}'
    asked = subprocess.run(
        [sys.executable, '-m', module, '--help'], cwd=tmp_path, capture_output=True, text=True,
        timeout=240.0, check=False,
    )  # fmt: skip
    assert asked.returncode == 0, asked.stderr
    assert asked.stdout.startswith('usage: ')
    table = {'monitor_main': TABLE, 'simulator_main': simulator_main.TABLE}.get(name, ())
    for row in table:
        assert row.name in asked.stdout
        assert row.sentence in asked.stdout
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize('module', _MODULES)
def test_help_that_nobody_reads_to_its_end_is_no_accident(module):
    """As by ``monitor --help | head -1``: the pipe is closed before a letter is written."""
    reader, writer = os.pipe()
    os.close(reader)
    words = [sys.executable, '-m', f'valveflow_ros.ros.{module}', '--help']
    with os.fdopen(writer, 'w') as closed:
        ended = subprocess.run(
            words, stdout=closed, stderr=subprocess.PIPE, text=True, timeout=120, check=False
        )
    assert ended.returncode == 0, ended.stderr
    assert ended.stderr == ''


@pytest.mark.parametrize(
    ('parser', 'words', 'said'),
    [
        (
            replay_main.parser,
            ['x.mcap', '--rate', 'fast'],
            '--rate must be a number of seconds of the log',
        ),
        (replay_main.parser, ['x.mcap', '--wait', 'nan'], "such as --wait 60; 'nan' is not"),
        (watch_main.parser, ['--interval', '0'], "from 0.1 to 3600, such as --interval 5; '0' is"),
        (
            demo.parser,
            ['--output', 'd', '--days', '-1'],
            '--days must be a number of days',
        ),
        (demo.parser, ['--output', 'd', '--seed', 'x'], "'x' is no whole number"),
    ],
)
def test_what_is_no_number_is_refused_in_words(parser, words, said, capsys):
    with pytest.raises(SystemExit) as ended:
        parser().parse_args(words)
    assert ended.value.code == 2
    assert said in capsys.readouterr().err


# A folder that cannot be recorded into is reported before the engine is loaded.


def recorded_to(place: object, record: bool = True) -> Settings:
    return Settings({'record_directory': str(place), 'record': record})


def test_a_folder_that_will_do_is_left_as_it_is(tmp_path: Path) -> None:
    check_record_directory(recorded_to(tmp_path))
    check_record_directory(recorded_to(tmp_path / 'a' / 'b'))
    assert list(tmp_path.iterdir()) == []


def test_a_folder_is_named_by_its_absolute_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for given in ('', 'valveflow_recordings'):
        folder = new_folder(recorded_to(given), 1.7e9)
        assert folder.parent == tmp_path / 'valveflow_recordings'
    monkeypatch.setattr(os, 'access', lambda *_: False)
    with pytest.raises(RecordingError, match=f'^{tmp_path}/records: cannot be made'):
        check_record_directory(recorded_to('records'))


def test_a_folder_that_cannot_be_recorded_into_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / 'file').write_text('')
    below = tmp_path / 'file' / 'records'
    with pytest.raises(RecordingError, match='is not a folder; set record_directory'):
        check_record_directory(recorded_to(below))
    check_record_directory(recorded_to(below, record=False))
    with pytest.raises(RecordingError, match='not there'):
        check_record_directory(recorded_to('~nobody-of-this-name/records'))
    if os.geteuid() != 0:
        tmp_path.chmod(0o500)
        with pytest.raises(RecordingError, match='may not be written into'):
            check_record_directory(recorded_to(tmp_path / 'records'))
    monkeypatch.setattr(os, 'access', lambda *_: False)
    with pytest.raises(RecordingError, match='may not be written into; set record_directory'):
        check_record_directory(recorded_to(tmp_path))
