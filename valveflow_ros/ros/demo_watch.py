"""What the demo sees on the topics."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from datetime import datetime, timedelta, timezone

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.task import Future
from std_srvs.srv import Trigger
from valveflow_msgs.msg import Alarm, Diagnosis, FlowCharacteristic

from valveflow_ros.errors import counted
from valveflow_ros.records import NS_PER_S
from valveflow_ros.ros.conversions import from_time

# What the demo tells while it runs: one story, each thing when it first happens.


_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)
_HOUR_NS = 3600 * 10**9


def moment(time_ns: int) -> str:
    """Return a time as the monitor's own sentences write it."""
    at = _EPOCH + timedelta(microseconds=time_ns // 1000)
    return at.strftime('%Y-%m-%d %H:%M')


def knees_of(knees: Sequence[float]) -> str:
    """Return where a curve bends."""
    return f'knees at u = {", ".join(f"{u:.0f}" for u in knees)}' if len(knees) else 'no knee'


class Story:
    """Chooses what is worth a line.

    A fault of one valve shows only while that valve is at work, so its alarm comes and goes with
    the load; a monitor learns a curve anew every few hours. The first of each is told in full,
    and of the others that they came.

    Parameters
    ----------
    fault_ns : int
        When the hidden fault begins.
    tell : callable
        Takes a line for a person.

    Attributes
    ----------
    curves : int
        Curves so far.
    raised : list of int
        When the alarm came, each time.
    """

    def __init__(self, fault_ns: int, tell: Callable[[str], None]) -> None:
        self._fault_ns = fault_ns
        self._tell = tell
        self._begun = False
        self._last = ''
        self._occurrences: dict[str, int] = {}
        self._named: tuple[str, ...] = ()
        self.curves = 0
        self.raised: list[int] = []

    def reached(self, time_ns: int) -> None:
        """Say that the fault begins, once the plant has come so far."""
        if self._begun or time_ns < self._fault_ns:
            return
        self._begun = True
        known = 'no curve so far'
        if self.curves:
            known = f'{counted(self.curves, "curve")} so far, the last with {self._last}'
        self._say(self._fault_ns, f'--- the fault begins; {known} ---')

    def waits(self, time_ns: int, cause: str) -> None:
        """Say why there is no curve."""
        self._say(time_ns, cause)

    def curve(self, time_ns: int, knees: Sequence[float]) -> None:
        """Tell of a curve: of the first one, or one with another number of pieces."""
        self.reached(time_ns)
        before, bends = self._last.partition(',')[0], len(knees)
        self._last = f'{counted(bends + 1, "piece")}, {knees_of(knees)}'
        self.curves += 1
        if self.curves == 1:
            self._say(time_ns, f'first curve: {self._last}')
        elif not self._begun and self._last.partition(',')[0] != before:
            self._say(time_ns, f'new curve: {self._last}')

    def came(self, time_ns: int, name: str, occurrence: int, sentence: str) -> None:
        """Tell that an alarm came, or came again."""
        self.reached(time_ns)
        # One that could not be judged for a while and stands again is not a new one.
        if occurrence == self._occurrences.get(name):
            return
        self._occurrences[name] = occurrence
        self.raised.append(time_ns)
        if len(self.raised) == 1:
            self._say(time_ns, f'ALARM {name}: {sentence}')
        else:
            self._say(time_ns, f'the alarm comes again, the {_nth(len(self.raised))} time')

    def went_on(self, time_ns: int, word: str) -> None:
        """Tell how the first alarm went on."""
        if len(self.raised) == 1:
            self._say(time_ns, word)

    def diagnosed(self, until_ns: int, names: tuple[str, ...], word: str, sentence: str) -> None:
        """Tell of a diagnosis of the data until a time."""
        self.reached(until_ns)
        if names:
            told = f'named {", ".join(names)}'
            told += ', as before' if names == self._named else f'. {sentence}'
            self._named = names
        elif self._begun:
            hours = (until_ns - self._fault_ns) / _HOUR_NS
            told = f'{word}; {hours:.0f} h of them are with the fault'
        else:
            told = word
        self._say(until_ns, f'diagnosis of the data until then: {told}')

    def outcome(self) -> str:
        """Return how the fault was met, in a sentence."""
        told = [time_ns for time_ns in self.raised if time_ns >= self._fault_ns]
        if not told:
            return 'The fault raised no alarm.'
        hours = (told[0] - self._fault_ns) / _HOUR_NS
        text = f'The fault began {moment(self._fault_ns)}; the alarm came {hours:.1f} h later'
        if len(told) > 1:
            text += (
                f', and {len(told)} times in all: the fault is that of one valve, and shows only '
                'while that valve is at work'
            )
        return f'{text}.'

    def _say(self, time_ns: int, words: str) -> None:
        self._tell(f'{moment(time_ns)}  {words}')


def _nth(n: int) -> str:
    return {2: 'second', 3: 'third'}.get(n, f'{n}th')


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
