# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The node in this process: its life, what it refuses, and what it says meanwhile."""

import os

import pytest
import yaml
from builtin_interfaces.msg import Time
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from listener import Listener
from rcl_interfaces.msg import Parameter as ParameterMsg
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_helpers import wait_until
from std_msgs.msg import Float64, Header
from std_srvs.srv import Trigger
from valveflow_msgs.msg import FlowCharacteristic, PlantSample

from valveflow_ros.errors import ParameterError, RecordingError
from valveflow_ros.logs import open_log
from valveflow_ros.monitoring.events import CurveAdopted, JournalEntry, JournalKind
from valveflow_ros.parameters import Settings
from valveflow_ros.ros.node import monitor_node
from valveflow_ros.ros.node.engine import example_curve
from valveflow_ros.ros.node.monitor_node import MonitorNode
from valveflow_ros.ros.node.outputs import OUTPUTS
from valveflow_ros.ros.node.recording import check_record_directory, new_folder

pytestmark = pytest.mark.ros
DONE = TransitionCallbackReturn.SUCCESS


class Stage(Listener):
    """A monitor that does nothing by itself, and somebody who talks to it."""

    def __init__(self, context, folder, **more):
        given = {
            'record_directory': str(folder), 'diagnostics_period': 0.1, 'unit_tag': 'HV 101/2',
            **more,
        }  # fmt: skip
        overrides = [Parameter(name, value=value) for name, value in given.items()]
        self.told = []
        self.monitor = MonitorNode(context=context, parameter_overrides=overrides)
        usual = self.monitor._log
        self.monitor._log = lambda level, text: self.told.append(text) or usual(level, text)
        super().__init__(context)

    def start(self):
        assert self.monitor.trigger_configure() == self.monitor.trigger_activate() == DONE
        return self.monitor.session

    def turn(self):
        """Let the monitor's loop do a bit of work."""
        self.monitor.step()
        monitor_node.serve_requests(self.monitor, 1.0)

    def until(self, condition, what, patience_s=20.0):
        return super().until(lambda: self.turn() or condition(), what, patience_s)

    def sentence(self, item):
        self.health.clear()
        self.until(lambda: self.health, 'health')
        found = self.status(item)
        return found.message if found else ''

    def close(self):
        self.monitor.end_session()
        super().close()
        self.monitor.destroy_node()


@pytest.fixture
def staged(context, tmp_path):
    """A function that makes a stage; it is closed after the test."""
    made = []

    def make(folder=tmp_path, **more):
        made.append(Stage(context, folder, **more))
        return made[-1]

    yield make
    for stage in made:
        stage.close()


def test_the_whole_life(staged, tmp_path):
    # Each life by itself: with a state the second would go on with the first one's recording.
    stage = staged(keep_state=False, **{
        'qos_overrides./valveflow_monitor/diagnosis.publisher.depth': 7,
        'qos_overrides./main_steam_pressure.subscription.reliability': 'reliable',
        'qos_overrides./valve_openin.subscription.depth': 5,
    })  # fmt: skip
    monitor = stage.monitor
    best_effort = QoSProfile(depth=3, reliability=ReliabilityPolicy.BEST_EFFORT)
    power = stage.node.create_publisher(Float64, '/generated_power', best_effort)

    def reliability(topic):
        (seen,) = monitor.get_subscriptions_info_by_topic(topic)
        return seen.qos_profile.reliability.name.lower()

    assert stage.sentence('fit') == 'The monitor is not configured.'
    answer = stage.call(Trigger, 'refit', Trigger.Request())
    not_active = (False, 'The monitor is not active; activate it first.')
    assert (answer.success, answer.message) == not_active
    for wanted in ('best_effort', 'reliable'):
        set_one = [Parameter('input_reliability', value=wanted)]
        assert monitor.set_parameters_atomically(set_one).successful
        assert monitor.trigger_configure() == DONE
        assert not monitor.session.listening
        assert monitor.trigger_activate() == DONE
        assert monitor.session.listening
        # Each life asks for the reliability of its own parameters; one topic has its override.
        assert reliability('/valve_opening') == wanted
        assert reliability('/main_steam_pressure') == 'reliable'
        answer = stage.call(Trigger, 'refit', Trigger.Request())
        assert answer.message.startswith('There is no special segment (steady state or long')
        assert answer.message.endswith('a fit needs 600 samples in such segments.')
        assert stage.sentence('input valve_opening').startswith('Waiting for /valve_opening')
        unknown = "'qos_overrides./valve_openin.subscription.depth' is for no topic"
        assert unknown in stage.sentence('parameters')
        if wanted == 'best_effort':
            wait_until(lambda: power.get_subscription_count(), 'the subscription', 20.0)
            power.publish(Float64(data=120.0))
            wait_until(lambda: monitor.step(), 'the message', 20.0)
        assert monitor.trigger_deactivate() == DONE
        assert stage.sentence('fit').startswith('No curve yet')
        # Health of before may still be on its way.
        wait_until(lambda: not stage.sentence('input valve_opening'), 'their end', 20.0)
        assert monitor.trigger_cleanup() == DONE
        assert monitor.session is None
    first, second = sorted(tmp_path.glob('valveflow_*'))
    for folder in (first, second):
        assert folder.name.endswith(('_HV-101-2', '_HV-101-2_2'))
        assert folder.stat().st_mode & 0o777 == 0o700
    assert open_log(second).warnings == (
        'None of its topics is an input of the monitor; '
        'name one with --column valve_opening=TOPIC.',
    )
    assert monitor.trigger_shutdown() == DONE
    assert monitor.finalized
    told = yaml.safe_load((first / 'metadata.yaml').read_text())['rosbag2_bagfile_information']
    offered = {
        t['topic_metadata']['name']: t['topic_metadata']['offered_qos_profiles']
        for t in told['topics_with_message_count']
    }
    assert [p['reliability'] for p in offered['/generated_power']] == ['best_effort']
    (diagnosis,) = offered['/valveflow_monitor/diagnosis']
    assert (diagnosis['depth'], diagnosis['durability']) == (7, 'transient_local')
    assert offered['/valveflow_monitor/alarms'][0]['depth'] == OUTPUTS['alarms'].kept


def test_a_quality_of_service_that_there_is_not_is_refused_at_the_start(staged):
    for policy, value, words in (
        ('reliability', 'sure', "must be reliable or best_effort, not 'sure'"),
        ('history', 3, 'must be keep_last or keep_all, not 3'),
        ('depth', 0, 'must be a whole number from 1 to 1000000, not 0'),
    ):
        with pytest.raises(ParameterError, match=words):
            staged(**{f'qos_overrides./valve_opening.subscription.{policy}': value})


def test_an_active_monitor_answers_all_and_tells_what_it_sees(staged, tmp_path, monkeypatch):
    monkeypatch.setattr(monitor_node, '_LOOK_AROUND_S', 0.05)
    stage = staged(main_steam_pressure_unit='bar', record_flush=60.0)
    session = stage.start()
    what_cannot_be_done_is_answered_and_ends_nothing(stage)
    assert session.listening
    another_node_of_the_same_name_is_told(stage)
    a_sample_that_does_not_agree_with_the_parameters_is_told_once(stage)
    a_curve_is_on_disk_before_anybody_is_told(stage, session, tmp_path, monkeypatch)


def what_cannot_be_done_is_answered_and_ends_nothing(stage):
    # A manager that knows no better asks for a transition that is not to be had.
    request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_CONFIGURE))
    assert not stage.call(ChangeState, 'change_state', request).success
    strange = ParameterMsg(name='alarm_flood', value=ParameterValue(type=42))
    good = Parameter('alarm_flood', value=7).to_parameter_msg()
    request = SetParameters.Request(parameters=[good, strange, good])
    results = stage.call(SetParameters, 'set_parameters', request).results
    assert [result.successful for result in results] == [True, False, False]
    assert 'cannot be done' in results[1].reason
    request = SetParametersAtomically.Request(parameters=[strange])
    result = stage.call(SetParametersAtomically, 'set_parameters_atomically', request).result
    assert (result.successful, 'cannot be done' in result.reason) == (False, True)


def another_node_of_the_same_name_is_told(stage):
    assert stage.sentence(' name') == ''
    twin = Node('valveflow_monitor', context=stage.node.context, start_parameter_services=False)
    wait_until(lambda: stage.sentence(' name'), 'the name', 20.0)
    assert stage.sentence(' name').startswith('2 nodes are called /valveflow_monitor: ')
    twin.destroy_node()
    wait_until(lambda: not stage.sentence(' name'), 'its end', 20.0)


def a_sample_that_does_not_agree_with_the_parameters_is_told_once(stage):
    publisher = stage.node.create_publisher(PlantSample, '/plant_sample', 10)
    wait_until(lambda: publisher.get_subscription_count(), 'the subscription', 20.0)
    for second in (1, 2):
        publisher.publish(PlantSample(header=Header(stamp=Time(sec=second), frame_id='U2')))
        wait_until(lambda: stage.monitor.step(), 'the message', 20.0)
    told = [text.split(' ')[0] for text in stage.told if 'PlantSample' in text]
    assert told == ['main_steam_pressure_unit', 'PlantSample']


def a_curve_is_on_disk_before_anybody_is_told(stage, session, folder, monkeypatch):
    told = []
    stage.node.create_subscription(
        FlowCharacteristic, '/valveflow_monitor/characteristic',
        lambda message: told.append(message.status), 10,
    )  # fmt: skip
    curve = example_curve(stage.monitor.settings)
    entry = JournalEntry(5, JournalKind.FIT_ADOPTED, 1, 1, curve.model_id, '')
    on_disk = []

    class Publisher:
        """Looks what a kill at this moment would leave."""

        def publish(self, data):
            (part,) = folder.glob('valveflow_*/*.part')
            on_disk.append(part.read_bytes())

    with monkeypatch.context() as patch:
        patch.setitem(session._publishers, 'journal', Publisher())
        session.publish([entry, CurveAdopted(curve)])
    stage.until(lambda: told, 'the curve')
    (left,) = on_disk
    copy = folder / 'copy' / 'copy_0.mcap'
    copy.parent.mkdir()
    copy.write_bytes(left)
    topics = [m.topic for m in open_log(copy).iter_messages()]
    assert '/valveflow_monitor/journal' in topics
    assert topics.count('/valveflow_monitor/characteristic') == 2


# A folder that cannot be recorded into is reported before the engine is loaded.


def recorded_to(place, record=True):
    return Settings({'record_directory': str(place), 'record': record})


def test_a_recording_that_cannot_be_made_keeps_nobody_from_monitoring(staged, tmp_path):
    (tmp_path / 'file').write_text('')
    stage = staged(tmp_path / 'file' / 'below')
    session = stage.start()
    assert 'cannot be made' in stage.sentence('recorder')
    assert not session.recording.on


def test_a_folder_that_will_do_is_left_as_it_is_and_named_by_its_absolute_path(
    tmp_path, monkeypatch
):
    check_record_directory(recorded_to(tmp_path))
    check_record_directory(recorded_to(tmp_path / 'a' / 'b'))
    assert list(tmp_path.iterdir()) == []
    monkeypatch.chdir(tmp_path)
    for given in ('', 'valveflow_recordings'):
        assert new_folder(recorded_to(given), 1.7e9).parent == tmp_path / 'valveflow_recordings'
    monkeypatch.setattr(os, 'access', lambda *_: False)
    with pytest.raises(RecordingError, match=f'^{tmp_path}/records: cannot be made'):
        check_record_directory(recorded_to('records'))


def test_a_folder_that_cannot_be_recorded_into_is_refused(tmp_path, monkeypatch):
    (tmp_path / 'file').write_text('')
    below = tmp_path / 'file' / 'records'
    check_record_directory(recorded_to(below, record=False))
    for place, words in (
        (below, 'is not a folder; set record_directory'),
        ('~nobody-of-this-name/records', 'not there'),
    ):
        with pytest.raises(RecordingError, match=words):
            check_record_directory(recorded_to(place))
    monkeypatch.setattr(os, 'access', lambda *_: False)
    with pytest.raises(RecordingError, match='may not be written into; set record_directory'):
        check_record_directory(recorded_to(tmp_path))
