"""What the demo sees on the topics, told in plain words."""

from __future__ import annotations

import time
from collections.abc import Callable

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.task import Future
from std_srvs.srv import Trigger
from valveflow_msgs.msg import Alarm, Diagnosis, FlowCharacteristic

from valveflow_ros.ros.conversions import from_time

_MONITOR = '/valveflow_monitor'
_LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_BEFORE_ACKNOWLEDGING_S = 0.2
_STATES = {
    Alarm.NORMAL: 'cleared',
    Alarm.UNACKNOWLEDGED: 'ALARM',
    Alarm.ACKNOWLEDGED: 'acknowledged',
    Alarm.RETURNED_UNACKNOWLEDGED: 'the alarm has gone by itself',
    Alarm.SHELVED: 'put aside',
    Alarm.SUPPRESSED: 'cannot be judged',
}

_VERDICTS = {
    Diagnosis.NOTHING: 'nothing is wrong',
    Diagnosis.UNEXPLAINED: 'unexplained',
}


class Watch(Node):
    """Listens to the monitor, tells what happens, acknowledges alarms.

    Parameters
    ----------
    start_ns : int
        Time of the plant's first sample.
    tell : callable
        Takes a line for a person.
    """

    def __init__(self, start_ns: int, tell: Callable[[str], None]) -> None:
        super().__init__('valveflow_demo')
        self._start_ns = start_ns
        self._tell = tell
        self._begun_s = time.monotonic()
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

    def plant_time(self, time_ns: int) -> str:
        """Return a time as the plant's day and hour."""
        minutes = max(0, (time_ns - self._start_ns) // 60_000_000_000)
        return f'day {1 + minutes // 1440} {minutes // 60 % 24:02d}:{minutes % 60:02d}'

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
        answer = self._diagnose.call_async(Trigger.Request())
        answer.add_done_callback(lambda future: self._tell_answer('diagnose', future))

    def _on_diagnosis(self, message: Diagnosis) -> None:
        if message.verdict == Diagnosis.UNKNOWN and not message.model_id:
            return
        self.diagnoses.append(message)
        until = self.plant_time(from_time(message.header.stamp))
        names = ', '.join(cause.name for cause in message.causes)
        word = f'named {names}' if names else _VERDICTS.get(message.verdict, 'unknown')
        self._tell(
            f'              diagnosis of the data until {until}: {word}. {message.sentence}'
        )

    def _on_curve(self, message: FlowCharacteristic) -> None:
        when = self.plant_time(from_time(message.window_end))
        if message.status != FlowCharacteristic.FRESH:
            if message.cause:
                self._tell(f'{when}  {message.cause}')
            return
        knees = ', '.join(f'{u:.0f}' for u in message.breakpoints[1:-1]) or 'none'
        if self.curves and self.curves[-1].model_id == message.model_id:
            return
        first = 'first curve' if not self.curves else 'refit'
        self.curves.append(message)
        seconds = time.monotonic() - self._begun_s
        self._tell(
            f'{when}  {first} ({seconds:.0f} s from the start): {message.pieces} pieces, '
            f'knees at u = {knees}, {message.samples} special samples, '
            f'rmse {message.rmse_mw:.2f} MW'
        )

    def _on_alarm(self, message: Alarm) -> None:
        self.alarms.append(message)
        when = self.plant_time(from_time(message.header.stamp))
        self._tell(f'{when}  {_STATES.get(message.state, "alarm")}: {message.sentence}')
        if message.state in (Alarm.UNACKNOWLEDGED, Alarm.RETURNED_UNACKNOWLEDGED):
            self._acknowledge_at_s = time.monotonic() + _BEFORE_ACKNOWLEDGING_S

    def _on_health(self, message: DiagnosticArray) -> None:
        refitting = diagnosing = False
        for status in message.status:
            if status.name.endswith(' fit'):
                values = {item.key: item.value for item in status.values}
                self.samples = int(values.get('Samples taken', '0'))
                refitting = values.get('Refit under way for (s)', 'unknown') != 'unknown'
            elif status.name.endswith(' diagnosis'):
                values = {item.key: item.value for item in status.values}
                diagnosing = values.get('Running', 'no') == 'yes'
        self.busy = refitting or diagnosing
        self.health_seen += 1

    def _on_answer(self, future: Future) -> None:
        response = self._tell_answer('acknowledge_alarms', future)
        self.acknowledged += int(response is not None and response.success)

    def _tell_answer(self, service: str, future: Future) -> Trigger.Response | None:
        response: Trigger.Response | None = future.result()
        if response is not None:
            self._tell(f'              service {service} answers: {response.message}')
        return response
