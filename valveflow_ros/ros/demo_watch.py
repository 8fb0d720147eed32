"""What the demo sees on the topics."""

from __future__ import annotations

import time

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.task import Future
from std_srvs.srv import Trigger
from valveflow_msgs.msg import Alarm, Diagnosis, FlowCharacteristic

from valveflow_ros.records import NS_PER_S
from valveflow_ros.ros.conversions import from_time
from valveflow_ros.ros.demo_story import Story

_MONITOR = '/valveflow_monitor'
_LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_BEFORE_ACKNOWLEDGING_S = 0.2
_STATES = {
    Alarm.NORMAL: 'the unit follows the curve again; the alarm is cleared',
    Alarm.ACKNOWLEDGED: 'acknowledged, by the service acknowledge_alarms',
    Alarm.RETURNED_UNACKNOWLEDGED: 'the alarm has gone by itself',
}
_VERDICTS = {
    Diagnosis.NOTHING: 'nothing found',
    Diagnosis.UNEXPLAINED: 'something that it cannot name',
}


class Watch(Node):
    """Listens to the monitor and acknowledges alarms.

    Parameters
    ----------
    start_ns : int
        Time of the plant's first sample.
    story : Story
        Chooses what is told.
    """

    def __init__(self, start_ns: int, story: Story) -> None:
        super().__init__('valveflow_demo')
        self._start_ns = start_ns
        self._story = story
        self._acknowledge_at_s: float | None = None
        self._answer: Future | None = None
        self.curves: list[FlowCharacteristic] = []
        self.alarms: list[Alarm] = []
        self.acknowledged = 0
        self.samples = 0
        self.busy = False
        self.diagnoses: list[Diagnosis] = []
        self.asked = False
        self.health_seen = 0
        self.create_subscription(
            FlowCharacteristic, f'{_MONITOR}/characteristic', self._on_curve, _LATCHED
        )
        self.create_subscription(Alarm, f'{_MONITOR}/alarms', self._on_alarm, _LATCHED)
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_health, 10)
        self.create_subscription(Diagnosis, f'{_MONITOR}/diagnosis', self._on_diagnosis, _LATCHED)
        self._client = self.create_client(Trigger, f'{_MONITOR}/acknowledge_alarms')
        self._diagnose = self.create_client(Trigger, f'{_MONITOR}/diagnose')

    def work(self) -> None:
        """Do what is due: acknowledge an alarm that somebody has had time to read."""
        if self._acknowledge_at_s is None or time.monotonic() < self._acknowledge_at_s:
            return
        if self._client.service_is_ready():
            self._acknowledge_at_s = None
            self._answer = self._client.call_async(Trigger.Request())
            self._answer.add_done_callback(self._on_answer)

    def ask_for_diagnosis(self) -> None:
        """Have the monitor diagnose all that it has seen; the health says when it has done so."""
        self.asked = True
        self._diagnose.call_async(Trigger.Request())

    def _on_diagnosis(self, message: Diagnosis) -> None:
        if message.verdict == Diagnosis.UNKNOWN and not message.model_id:
            return
        self.diagnoses.append(message)
        names = tuple(cause.name for cause in message.causes)
        word = _VERDICTS.get(message.verdict, 'unknown')
        self._story.diagnosed(from_time(message.header.stamp), names, word, message.sentence)

    def _on_curve(self, message: FlowCharacteristic) -> None:
        when_ns = from_time(message.window_end)
        if message.status != FlowCharacteristic.FRESH:
            if message.cause and not self.curves:
                self._story.waits(when_ns or self._start_ns, message.cause)
            return
        if self.curves and self.curves[-1].model_id == message.model_id:
            return
        self.curves.append(message)
        self._story.curve(when_ns, message.breakpoints[1:-1])

    def _on_alarm(self, message: Alarm) -> None:
        self.alarms.append(message)
        when_ns = from_time(message.header.stamp)
        if message.state == Alarm.UNACKNOWLEDGED:
            self._story.came(when_ns, message.name, message.occurrence, message.sentence)
        elif message.state in _STATES and message.previous_state != Alarm.SUPPRESSED:
            self._story.went_on(when_ns, _STATES[message.state])
        if message.state in (Alarm.UNACKNOWLEDGED, Alarm.RETURNED_UNACKNOWLEDGED):
            self._acknowledge_at_s = time.monotonic() + _BEFORE_ACKNOWLEDGING_S

    def _on_health(self, message: DiagnosticArray) -> None:
        refitting = diagnosing = False
        for status in message.status:
            if status.name.endswith(' fit'):
                values = {item.key: item.value for item in status.values}
                self.samples = int(values.get('Samples taken', '0'))
                self._story.reached(self._start_ns + self.samples * NS_PER_S)
                refitting = values.get('Refit under way for (s)', 'unknown') != 'unknown'
            elif status.name.endswith(' diagnosis'):
                values = {item.key: item.value for item in status.values}
                diagnosing = values.get('Running', 'no') == 'yes'
        self.busy = refitting or diagnosing
        self.health_seen += 1

    def _on_answer(self, future: Future) -> None:
        response: Trigger.Response | None = future.result()
        self.acknowledged += int(response is not None and response.success)
