# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The terminal view over ROS: it finds the monitor and shows what it says."""

import json

import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from ros_helpers import wait_until
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from valveflow_msgs.msg import Alarm, Diagnosis, DiagnosisCause, FlowCharacteristic, Prediction
from valveflow_msgs.srv import OperateAlarm

from valveflow_ros.report.terminal.board import CURVE, HEALTH
from valveflow_ros.report.terminal.screen import screen
from valveflow_ros.ros import watch_main
from valveflow_ros.ros.node.diagnostics import Item, Level, diagnostics_message
from valveflow_ros.ros.watch_main import WatchNode

pytestmark = pytest.mark.ros

AT_S = 1_700_000_000
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Speaker(Node):
    """Says what a monitor says, once for each that asks."""

    def __init__(self, context, name='valveflow_monitor'):
        super().__init__(name, context=context)
        self.head = Header(stamp=Time(sec=AT_S), frame_id='U1')
        self.health = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self.predictions = self.create_publisher(Prediction, '~/prediction', 10)
        self._latched = [
            self._say('characteristic', FlowCharacteristic(
                header=self.head, status=1, model_id='abc', pieces=1, breakpoints=[1000.0, 2000.0],
                values=[150.0, 290.0], samples=99, window_end=Time(sec=AT_S - 3600),
            )),
            self._say('alarms', Alarm(
                header=self.head, name='residual', state=Alarm.UNACKNOWLEDGED, sentence='Less.'
            )),
            self._say('diagnosis', Diagnosis(
                header=self.head, verdict=Diagnosis.NAMED, sentence='It sticks.',
                causes=[DiagnosisCause(name='stiction')],
            )),
        ]  # fmt: skip

    def _say(self, name, message):
        publisher = self.create_publisher(type(message), f'~/{name}', LATCHED)
        publisher.publish(message)
        return publisher

    def say_health(self):
        self.health.publish(diagnostics_message(
            [Item('input valve_opening', Level.STALE, 'silent for 9 s.'),
             Item('recorder', Level.OK, 'Recording.')], 'monitor', 'U1', AT_S * 10**9,
        ))  # fmt: skip

    def go_on(self):
        """Say what comes again and again."""
        self.say_health()
        self.predictions.publish(
            Prediction(
                header=self.head, state=2, integrated_input=1500.0, measured_mw=220.0,
                residual_mw=1.5, limit_low_mw=216.0, limit_high_mw=221.0,
            )
        )  # fmt: skip


@pytest.fixture
def watch(context, monkeypatch):
    usual = Node.__init__

    def here(self, name, **more):
        usual(self, name, context=context, **more)

    monkeypatch.setattr(Node, '__init__', here)
    node = WatchNode()
    monkeypatch.undo()
    yield node
    node.destroy_node()


@pytest.fixture
def executor(context):
    made = SingleThreadedExecutor(context=context)
    yield made
    made.shutdown()


def test_what_the_monitor_says_is_shown(speaker, watch, executor):
    assert watch.frame().note.startswith('No monitor was found yet.')
    executor.add_node(watch)

    def complete():
        watch.look()
        speaker.go_on()
        executor.spin_once(timeout_sec=0.05)
        frame = watch.frame()
        return frame if len(watch.heard) == 5 and frame.samples else None

    frame = wait_until(complete, 'a whole frame')
    assert watch.monitor == '/valveflow_monitor'
    assert frame.unit == 'U1'
    assert frame.now_ns == AT_S * 10**9
    assert frame.curve is not None
    assert frame.curve.values == (150.0, 290.0)
    assert (frame.last.low_mw, frame.last.high_mw) == (-2.5, 2.5)
    assert [(a.name, a.state) for a in frame.alarms] == [('residual', 1)]
    assert frame.diagnosis.causes == ('stiction',)
    assert [(i.name, i.level, i.sentence) for i in frame.inputs] == [
        ('valve_opening', 3, 'silent for 9 s.')
    ]
    assert frame.recorder.sentence == 'Recording.'
    text = '\n'.join(screen(frame, 80, 24))
    assert 'opening: silent for 9 s.' in text


def test_with_two_monitors_one_has_to_choose(context, speaker, watch):
    other = Speaker(context, 'other')

    def several():
        watch.look()
        return watch.several

    assert wait_until(several, 'both monitors') == ('/other', '/valveflow_monitor')
    assert '/other, /valveflow_monitor. Choose with --node NAME.' in watch.frame().note
    other.destroy_node()


def test_a_monitor_that_is_discovered_first_is_not_taken_for_the_only_one(
    watch, executor, capsys, monkeypatch
):
    seen = iter([['/one'], ['/one'], ['/one', '/other']])
    monkeypatch.setattr(watch_main, 'monitors', lambda node: next(seen, ['/one', '/other']))
    monkeypatch.setattr(watch_main, '_FIND_S', 1.0)
    executor.add_node(watch)
    assert watch_main._ask(watch, executor, 'refit', '') == 1
    assert 'Several monitors run: /one, /other.' in capsys.readouterr().err


def test_one_picture_of_a_real_process(speaker, processes):
    process = processes.start('valveflow_ros.ros.watch_main', '--once', '--json')
    wait_until(lambda: speaker.go_on() or process.poll() is not None, 'the picture')
    assert process.returncode == 0, processes.output(process)
    frame = json.loads(processes.output(process))
    assert frame['curve']['breakpoints'] == [1000.0, 2000.0]
    assert frame['recorder']['sentence'] == 'Recording.'


@pytest.mark.parametrize('sends', [True, False])
def test_one_picture_waits_for_a_sample_or_says_that_none_came(
    speaker, watch, executor, capsys, monkeypatch, sends
):
    monkeypatch.setattr(watch_main, '_HEAR_S', 1.0)
    monkeypatch.setattr(watch_main.time, 'time_ns', lambda: (AT_S + 90) * 10**9)
    executor.add_node(watch)

    def latched():
        watch.look()
        speaker.say_health()
        executor.spin_once(timeout_sec=0.05)
        return {CURVE, HEALTH} <= watch.heard

    wait_until(latched, 'what comes before the first sample')
    if sends:
        speaker.create_timer(0.2, speaker.go_on)
        executor.add_node(speaker)
    assert watch_main._once(watch, executor, True, None) == 0
    frame = json.loads(capsys.readouterr().out)
    if sends:
        assert (frame['note'], frame['last']['residual_mw']) == ('', 1.5)
    else:
        assert frame['last'] is None
        assert frame['note'].startswith('No sample was received within 1 s.')
        assert frame['note'].endswith('The newest message shown is 1 min 30 s old.')


@pytest.mark.parametrize(('success', 'alarm'), [(True, 'residual'), (False, '')])
def test_the_monitor_is_asked_and_its_answer_told(
    speaker, watch, executor, capsys, success, alarm
):
    asked = []

    def answer(request, response):
        asked.append(request)
        response.success, response.message = success, 'There is an answer.'
        return response

    kind, name = (OperateAlarm, 'operate_alarm') if alarm else (Trigger, 'acknowledge_alarms')
    speaker.create_service(kind, f'~/{name}', answer)
    executor.add_node(speaker)
    executor.add_node(watch)
    assert watch_main._ask(watch, executor, 'acknowledge_alarms', alarm) == int(not success)
    (request,) = asked
    assert not alarm or (request.name, request.action) == ('residual', 'acknowledge')
    told = capsys.readouterr()
    assert '/valveflow_monitor: There is an answer.' in (told.out if success else told.err)


@pytest.mark.parametrize('there', [True, False])
def test_a_monitor_that_does_not_answer_is_told(
    context, watch, executor, capsys, monkeypatch, there
):
    monkeypatch.setattr(watch_main, '_FIND_S', 1.0)
    monkeypatch.setattr(watch_main, '_ALONE_S', 0.3)
    speaker = Speaker(context) if there else None
    executor.add_node(watch)
    assert watch_main._ask(watch, executor, 'refit', '') == 1
    told = '/valveflow_monitor does not answer' if there else 'No monitor was found yet.'
    assert told in capsys.readouterr().err
    if speaker is not None:
        speaker.destroy_node()
