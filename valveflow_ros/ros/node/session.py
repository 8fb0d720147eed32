"""One run of the monitor, from configure to clean-up: inputs, engine, outputs, recording."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from valveflow_ros.logs import RecorderStatus
from valveflow_ros.monitoring.events import Event
from valveflow_ros.parameters import Settings
from valveflow_ros.ros.diagnostics import Item, Level, line_of
from valveflow_ros.ros.inputs import INPUTS, Decoder
from valveflow_ros.ros.node import given_files, health, input_health
from valveflow_ros.ros.node.given_files import reference_of
from valveflow_ros.ros.node.input_health import InputHealth
from valveflow_ros.ros.node.intake import Clock, Intake, LogClock
from valveflow_ros.ros.node.live import LiveEngine
from valveflow_ros.ros.node.recording import Recording
from valveflow_ros.ros.node.restart import Continuity
from valveflow_ros.ros.node.warmup import warm_up
from valveflow_ros.ros.outputs import OUTPUTS, Output, Outputs, OutputTopic
from valveflow_ros.ros.polled_subscription import Taker
from valveflow_ros.ros.worker.worker import DiagnosisWorker, FitWorker

DIAGNOSTICS = '/diagnostics'
# A look costs a fraction of a millisecond.
_GRAPH_S = 0.5
_DEPTH = 1000


class Session:
    """Everything that lives between configure and clean-up.

    Parameters
    ----------
    node : Node
    settings : Settings
    stop : callable
        Tells whether to give up waiting.
    log : callable
        Takes how grave something is and a sentence.
    """

    def __init__(
        self,
        node: Node,
        settings: Settings,
        stop: Callable[[], bool],
        log: Callable[[Level, str], None],
    ) -> None:
        self._node = node
        self._log = log
        self._settings = settings
        self._reference = reference_of(settings)
        self._extended = given_files.extended_of(settings)
        self.inputs = {topic.name: node.resolve_topic_name(topic.name) for topic in INPUTS}
        self.outputs = {name: node.resolve_topic_name(f'~/{name}') for name in OUTPUTS}
        self._continuity = Continuity(settings, self.inputs, self.outputs, log)
        self.worker = FitWorker(settings.real('refit_timeout'))
        self.worker.start()
        self.diagnosis_worker = DiagnosisWorker(settings.real('diagnosis_timeout'))
        self._outputs = Outputs(settings.text('unit_tag'))
        try:
            # Each event costs the executor time at every look, and nobody listens to these.
            silent = PublisherEventCallbacks(use_default_callbacks=False)
            self._publishers = {
                name: node.create_publisher(
                    topic.message_type, f'~/{name}', _qos(topic), event_callbacks=silent
                )
                for name, topic in OUTPUTS.items()
            }
            self.engine = self._made_engine()
            warm_up(settings, self.worker, stop, wait=not self._continuity.goes_on)
            self._log_clock = LogClock(self._continuity.log_ns)
            self.recording = self._open_recording()
        except BaseException:
            self.worker.close()
            self._continuity.close()
            raise
        self._takers: list[Taker] = []
        self._intake: Intake | None = None
        by_host = not node.get_parameter('use_sim_time').value
        self._health = InputHealth(settings, self.inputs, by_host=by_host)
        self._seen: dict[str, input_health.Publishers] = {}
        self._looked_s = self._listening_since_s = 0.0
        self._begun = False

    def _made_engine(self) -> LiveEngine:
        """Return the engine; where it goes on from an earlier run its curve is there at once."""

        def make(settings: Settings) -> LiveEngine:
            corrector = given_files.ready(self._extended, settings)
            return LiveEngine(settings, self.worker, self.diagnosis_worker, corrector)

        engine = self._continuity.engine(make)
        if self._continuity.goes_on:
            self._outputs.take_up(engine.monitor)
            for output in self._outputs.latched():
                self._publishers[output.name].publish(output.data)
        return engine

    @property
    def listening(self) -> bool:
        """Tell whether inputs are taken."""
        return self._intake is not None

    def listen(self) -> None:
        """Subscribe."""
        node, settings = self._node, self._settings
        reliable = settings.text('input_reliability') == 'reliable'
        names = {topic: name for name, topic in self.inputs.items()}

        def mismatch(topic: str) -> None:
            self._health.mismatched.add(names.get(topic, topic))

        def taker(message_type: type, topic: str) -> Taker:
            made = Taker(node, message_type, topic, reliable=reliable, on_mismatch=mismatch)
            self._takers.append(made)
            return made

        sources = {topic.name: taker(topic.message_type, topic.name) for topic in INPUTS}
        clock = None
        if node.get_parameter('use_sim_time').value:
            clock = taker(Clock, '/clock')
        intake = Intake(
            sources, Decoder(settings), self._log_clock, settings.text('stamp_source'), clock,
            self._health.note,
        )  # fmt: skip
        if not self._begun:
            self._begin()
            self._begun = True
        self._intake = intake
        self._listening_since_s = time.monotonic()

    def _begin(self) -> None:
        """Say what stands there at the start, or go on where an earlier run ended."""
        self._say(self._continuity.begin(self._settings, self.engine, self._outputs))
        self._continuity.look_after(self.recording)
        if self._extended is not None:
            names = ', '.join(h.name for h in self._extended.held) or 'nothing'
            self._log(Level.OK, f'Taken out of the rows, by model_file: {names}.')
        kept = self.engine.monitor.reference.curve
        given = self._reference
        if given is not None and (kept is None or kept.model_id != given.model_id):
            self.tell(self.engine.set_reference(given))

    def hush(self) -> None:
        """Unsubscribe, after taking what is there."""
        if self._intake is None:
            return
        self.step(last=True)
        for taker in self._takers:
            taker.close()
        self._takers.clear()
        self._intake = None

    def step(self, last: bool = False) -> int:
        """Take, record and feed what has arrived; return how many messages that was."""
        self.tell(self.engine.poll())
        self._continuity.step(self._settings, self.engine, self._log_clock.last_ns, self.recording)
        if self._intake is None:
            return 0
        arrivals = self._intake.collect(time.monotonic(), time.time_ns(), last)
        for arrival in arrivals:
            self.recording.write(
                self.inputs[arrival.name], arrival.data, arrival.log_ns, arrival.time_ns
            )
        self.tell(self.engine.feed(self._intake.rows(arrivals)))
        return len(arrivals)

    def tell(self, events: Sequence[Event]) -> None:
        """Publish and record what a call of the engine brought."""
        for event in events:
            line = line_of(event)
            if line is not None:
                self._log(*line)
        self._continuity.note(events)
        self._say(self._outputs.of(events))

    def reconfigure(self, settings: Settings) -> None:
        """Take settings of which only live ones differ."""
        self._settings = self._health.settings = settings
        self.tell(self.engine.reconfigure(settings))

    def items(self) -> list[Item]:
        """Return how everything is."""
        now_s = time.monotonic()
        monitor = self.engine.monitor
        items: list[Item] = []
        if self._intake is not None:
            if now_s - self._looked_s >= _GRAPH_S:
                self._looked_s = now_s
                types = {topic.name: topic.type_name for topic in INPUTS}
                wanted = {name: (topic, types[name]) for name, topic in self.inputs.items()}
                self._seen = input_health.publishers(self._node, wanted)
                for name, seen in self._seen.items():
                    self._intake.tallies[name].note_publishers(seen.right)
            items += self._health.items(
                self._intake.tallies, self.engine.aligner.counts(), self._seen,
                now_s, now_s - self._listening_since_s, self.engine.aligner.newest_ns,
            )  # fmt: skip
        items.append(health.fit_item(monitor, self.worker, self.engine.last_fit_s))
        items.append(health.alarm_item(monitor))
        items.append(health.reference_item(monitor))
        items.append(health.model_item(monitor))
        items.append(
            health.diagnosis_item(monitor, self.diagnosis_worker, self.engine.last_diagnosis_s)
        )
        items.append(health.recorder_item(self.recording))
        items.append(self._continuity.item())
        return items

    def record(self, topic: str, data: bytes, time_ns: int) -> None:
        """Record a message that no engine event stands behind."""
        log_ns = self._log_clock.stamp(time.time_ns())
        # What is said before the first row belongs to no time of the plant; a viewer that goes by
        # this time would else begin in 1970.
        self.recording.write(topic, data, log_ns, time_ns or log_ns)

    def close(self) -> RecorderStatus | None:
        """End everything; the recording is a finished file afterwards."""
        self.hush()
        self.worker.close()
        self.diagnosis_worker.close()
        # Where not all is recorded, nothing else tells what happened since it was saved last.
        if not self.recording.whole:
            self._continuity.save(
                self._settings, self.engine, self._log_clock.last_ns, self.recording
            )
        status = self.recording.close()
        self._continuity.close()
        for publisher in self._publishers.values():
            self._node.destroy_publisher(publisher)
        return status

    def _say(self, outputs: Iterable[Output]) -> None:
        for output in outputs:
            publisher: Publisher = self._publishers[output.name]
            publisher.publish(output.data)
            self.record(self.outputs[output.name], output.data, output.time_ns)

    def _open_recording(self) -> Recording:
        topics: dict[str, Any] = {'inputs': self.inputs, 'outputs': self.outputs}
        model = given_files.attached(self._extended)
        recording = Recording(
            self._settings, topics, time.time(), model, self._continuity.folder,
            self._continuity.began,
        )  # fmt: skip
        reliable = self._settings.text('input_reliability') == 'reliable'
        for topic in INPUTS:
            recording.offer(
                self.inputs[topic.name], topic.type_name, reliable=reliable, latched=False
            )
        for name, output in OUTPUTS.items():
            recording.offer(
                self.outputs[name], output.type_name, reliable=True, latched=output.latched
            )
        recording.offer(
            DIAGNOSTICS, 'diagnostic_msgs/msg/DiagnosticArray', reliable=True, latched=False
        )
        return recording


def _qos(topic: OutputTopic) -> QoSProfile:
    """Return what outputs are offered with: reliable, and kept for who comes late if latched."""
    kept = DurabilityPolicy.TRANSIENT_LOCAL if topic.latched else DurabilityPolicy.VOLATILE
    return QoSProfile(
        depth=topic.kept if topic.latched else _DEPTH,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=kept,
    )
