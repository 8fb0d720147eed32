# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""One run of the monitor from configure to clean-up: inputs, engine, outputs, recording."""

from __future__ import annotations

import contextlib
import functools
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock

from valveflow_ros.interface import parameter_files
from valveflow_ros.logs import Qos, RecorderStatus
from valveflow_ros.monitoring.events import CurveAdopted, Event
from valveflow_ros.parameters import Settings
from valveflow_ros.report.words import in_zone
from valveflow_ros.ros import declare
from valveflow_ros.ros.decoding import PLANT_SAMPLE, Decoder, inputs_of, sample_warnings
from valveflow_ros.ros.node import health
from valveflow_ros.ros.node.diagnostics import Item, Level, line_of
from valveflow_ros.ros.node.engine import LiveEngine, warm_up
from valveflow_ros.ros.node.intake import Intake, LogClock
from valveflow_ros.ros.node.outputs import OUTPUTS, Output, Outputs, OutputTopic
from valveflow_ros.ros.node.polled_subscription import PolledSubscription, qos_overrides
from valveflow_ros.ros.node.recording import BackgroundRecovery, Recording, recorded_qos, tag_of
from valveflow_ros.ros.node.restart import Restart
from valveflow_ros.ros.node.state_store import StateStore
from valveflow_ros.ros.node.worker import DiagnosisWorker, FitWorker
from valveflow_ros.signals.units import in_unit
from valveflow_ros.state import State

DIAGNOSTICS = '/diagnostics'
# Maximum wait for the disk before a service responds; the samples wait, too.
_CONFIRM_S = 0.5
# Period of queries to the ROS graph; each takes a fraction of a millisecond.
_GRAPH_S = 0.5
_DEPTH = 1000


class Session:
    """All objects that exist between configure and clean-up.

    ``stop`` returns True to stop waiting; ``log`` is called with a level and a sentence. `inputs`
    and `outputs` are the full topic names by contract name.
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
        self._reference = parameter_files.given_reference(settings)
        self._model = parameter_files.given_model(settings)
        self._topics = inputs_of(settings)
        self.inputs = declare.inputs(node, settings)
        self.outputs = {name: node.resolve_topic_name(f'~/{name}') for name in OUTPUTS}
        self._store = StateStore(settings)
        self._restart = Restart(settings, self._store, self.inputs, self.outputs, log)
        self._fit_worker = FitWorker(settings.real('refit_timeout'))
        self._fit_worker.start()
        self._diagnosis_worker = DiagnosisWorker(settings.real('diagnosis_timeout'))
        self._messages = Outputs(
            settings.text('unit_tag'), settings.output_unit, settings.zone,
            node.get_clock().now().nanoseconds,
        )  # fmt: skip
        self._recovery: BackgroundRecovery | None = None
        try:
            # Event handlers cost executor time in every cycle, and these events are not used.
            silent = PublisherEventCallbacks(use_default_callbacks=False)
            self._publishers: dict[str, Publisher] = {
                name: node.create_publisher(
                    topic.message_type,
                    f'~/{name}',
                    _qos(topic),
                    event_callbacks=silent,
                    qos_overriding_options=qos_overrides(node, f'~/{name}', 'publisher'),
                )
                for name, topic in OUTPUTS.items()
            }
            self.engine = self._restart.engine(self._make_engine)
            if self._restart.continues:
                self._messages.begun_ns = self._restart.begun_ns
                self._messages.restore(self.engine.monitor)
            if self._restart.continues and not self._restart.adopted:
                # The curve of the earlier run is published at once; its alarms may have changed.
                for output in self._messages.latched():
                    if output.name != 'alarms':
                        self._publishers[output.name].publish(output.data)
            warm_up(settings, self._fit_worker, stop, wait=not self._restart.continues)
            self._log_clock = LogClock(self._restart.log_ns)
            self.recording = self._open_recording()
        except BaseException:
            self._fit_worker.close()
            self._store.close()
            raise
        self._subscriptions: list[PolledSubscription] = []
        self._intake: Intake | None = None
        by_host = not node.get_parameter('use_sim_time').value
        self._health = health.InputHealth(settings, self.inputs, by_host=by_host)
        self._publishers_seen: dict[str, health.Publishers] = {}
        self._looked_s = self._listening_since_s = 0.0
        # A state saved before the recording of an earlier run was processed would lose it.
        self._begun = False
        self._sample_checked = False

    @property
    def listening(self) -> bool:
        """Return True while the inputs are subscribed."""
        return self._intake is not None

    def subscribe(self) -> None:
        """Subscribe to the inputs; the first time, continue where an earlier run ended."""
        node, settings = self._node, self._settings
        reliable = settings.text('input_reliability') == 'reliable'
        names = {topic: name for name, topic in self.inputs.items()}

        def mismatch(topic: str) -> None:
            self._health.mismatched.add(names.get(topic, topic))

        def subscription(message_type: type, topic: str) -> PolledSubscription:
            made = PolledSubscription(
                node, message_type, topic, reliable=reliable, on_mismatch=mismatch
            )
            self._subscriptions.append(made)
            return made

        sources = {t.name: subscription(t.message_type, t.topic) for t in self._topics}
        clock = None
        if node.get_parameter('use_sim_time').value:
            clock = subscription(Clock, '/clock')
        intake = Intake(
            sources, Decoder(settings), self._log_clock, settings.text('stamp_source'), clock,
            self._health.note,
        )  # fmt: skip
        if not self._begun:
            self._begin()
            self._health.begin(self.engine.aligner.counts())
            self._begun = True
        self._intake = intake
        self._listening_since_s = time.monotonic()

    def unsubscribe(self) -> None:
        """Process the messages that have arrived, then unsubscribe."""
        if self._intake is None:
            return
        self.step(last=True)
        for subscription in self._subscriptions:
            subscription.close()
        self._subscriptions.clear()
        self._intake = None

    def step(self, last: bool = False) -> int:
        """Receive, record and process messages; return their number."""
        self.publish(self.engine.poll())
        for level, sentence in self._recovery.reports() if self._recovery else ():
            self._log(level, sentence)
        if self._begun:
            self._store.watch()
            if self._store.due:
                self._save_state()
        if self._intake is None:
            return 0
        arrivals = self._intake.collect(time.monotonic(), time.time_ns(), last)
        for arrival in arrivals:
            self.recording.write(
                self.inputs[arrival.name], arrival.data, arrival.log_ns, arrival.time_ns
            )
            if arrival.name == PLANT_SAMPLE and not self._sample_checked:
                self._check_sample(arrival.data)
        self.publish(self.engine.feed(self._intake.rows(arrivals)))
        return len(arrivals)

    def _check_sample(self, data: bytes) -> None:
        """Warn, at the first PlantSample, of parameters that do not agree with it."""
        with contextlib.suppress(ValueError):  # counted where it is read
            for sentence in sample_warnings(data, self._settings):
                self._log(Level.WARN, sentence)
            self._sample_checked = True

    def publish(self, events: Sequence[Event]) -> None:
        """Log, publish and record the events of a call of the engine."""
        for line in filter(None, map(line_of, events)):
            self._log(*line)
        self._store.note(events)
        outputs = list(self._messages.of(events))
        if not any(isinstance(event, CurveAdopted) for event in events):
            self._send(outputs)
            return
        # A curve is written to disk before it is published, so that it survives a kill.
        for output in outputs:
            self._record(output)
        if not self.confirm():
            self._log(Level.WARN, 'The new curve is not on disk yet; see recorder and state.')
        for output in outputs:
            self._publishers[output.name].publish(output.data)

    def confirm(self) -> bool:
        """Write all changes to disk; return False if they are not on disk.

        After a kill, the next run processes the recording since the saved state. If there is no
        complete recording or no saved state, the current state is saved now.
        """
        written = self.recording.flush(_CONFIRM_S)
        follows = written and self.recording.whole and self._store.saved_s is not None
        if follows or not self._store.on:
            return written or not self.recording.on
        if self._store.busy:
            # An older state is being written, and must be finished first.
            self._store.finish()
        if self._store.busy:
            return False
        self._save_state()
        self._store.finish()
        return not (self._store.busy or self._store.problem)

    def reconfigure(self, settings: Settings) -> None:
        """Apply settings in which only live parameters have changed."""
        self._settings = self._health.settings = settings
        self.publish(self.engine.monitor.reconfigure(settings))

    def items(self) -> list[Item]:
        """Return all health items."""
        now_s = time.monotonic()
        engine, monitor = self.engine, self.engine.monitor
        items: list[Item] = []
        if self._intake is not None:
            statistics = self._intake.statistics
            if now_s - self._looked_s >= _GRAPH_S:
                self._looked_s = now_s
                for topic in self._topics:
                    full_name = self.inputs[topic.name]
                    seen = health.publishers(self._node, full_name, topic.type_name)
                    self._publishers_seen[topic.name] = seen
                    statistics[topic.name].note_publishers(seen.right)
            items += self._health.items(
                statistics, engine.aligner.counts(), self._publishers_seen,
                now_s, now_s - self._listening_since_s, engine.aligner.newest_ns,
            )  # fmt: skip
        items += [
            health.fit_item(monitor, self._fit_worker, engine.last_fit_s),
            health.alarm_item(monitor),
            health.reference_item(monitor),
            health.model_item(monitor),
            health.diagnosis_item(monitor, self._diagnosis_worker, engine.last_diagnosis_s),
            health.recorder_item(self.recording),
            self._store.item(),
        ]
        unit, zone = self._settings.output_unit, self._settings.zone
        return [
            replace(
                item, sentence=in_zone(in_unit(item.sentence, unit), zone),
                values={in_unit(key, unit): value for key, value in item.values.items()},
            )
            for item in items
        ]  # fmt: skip

    def record(self, topic: str, data: bytes, time_ns: int) -> None:
        """Record a message; if ``time_ns`` is 0, the log time is used for it."""
        log_ns = self._log_clock.stamp(time.time_ns())
        # Otherwise a viewer that uses this time would begin in 1970.
        self.recording.write(topic, data, log_ns, time_ns or log_ns)

    def close(self) -> RecorderStatus | None:
        """End the session and finish the recording."""
        self.unsubscribe()
        self._fit_worker.close()
        self._diagnosis_worker.close()
        # If the recording is incomplete, only the state holds what happened since the last save.
        whole, state = self.recording.whole, self._state() if self._begun else None
        # Closed before the state is saved, so that it holds everything that the state holds.
        status = self.recording.close()
        if state is not None and (not whole or self._store.altered):
            self._store.write(state, lambda: True)
        self._store.close()
        if self._store.problem:
            self._log(Level.ERROR, self._store.problem)
        for publisher in self._publishers.values():
            self._node.destroy_publisher(publisher)
        return status

    def _begin(self) -> None:
        """Publish the first outputs, or continue where an earlier run ended."""
        self._send(self._restart.begin(self._settings, self.engine, self._messages))
        monitor, given = self.engine.monitor, self._reference
        if self.recording.folder is not None:
            self._recovery = BackgroundRecovery(self.recording.folder, tag_of(self._settings))
        if self._model is not None:
            names = ', '.join(h.name for h in self._model.held) or 'nothing'
            self._log(Level.OK, f'Taken out of the rows, by model_file: {names}.')
        kept = monitor.reference.first
        if given is not None and (kept is None or kept.model_id != given.model_id):
            self.publish(monitor.set_reference(given))

    def _make_engine(self, settings: Settings) -> LiveEngine:
        corrector = parameter_files.corrector_for(self._model, settings)
        return LiveEngine(settings, self._fit_worker, self._diagnosis_worker, corrector)

    def _save_state(self) -> None:
        self._store.write(self._state(), self.recording.settled())

    def _state(self) -> State:
        recording = self.recording
        folder = recording.folder if recording.on else None
        return {
            'settings': dict(self._settings),
            'engine': self.engine.snapshot(),
            # Log time of the newest message in the state.
            'log_ns': self._log_clock.last_ns,
            'topics': {**self.inputs, **self.outputs},
            'began': recording.began,
            'begun_ns': self._messages.begun_ns,
            'recording': None if folder is None else str(folder),
        }

    def _send(self, outputs: Iterable[Output]) -> None:
        for output in outputs:
            self._publishers[output.name].publish(output.data)
            self._record(output)

    def _record(self, output: Output) -> None:
        self.record(self.outputs[output.name], output.data, output.time_ns)

    def _open_recording(self) -> Recording:
        topics: dict[str, Any] = {'inputs': self.inputs, 'outputs': self.outputs}
        attachments = parameter_files.model_attachment(self._model)
        folder, began = self._restart.folder, self._restart.began
        recording = Recording(self._settings, topics, time.time(), attachments, folder, began)
        for topic in self._topics:
            full_name, kind = self.inputs[topic.name], topic.type_name
            recording.offer(
                full_name, kind, functools.partial(health.offered, self._node, full_name, kind)
            )
        for name, output in OUTPUTS.items():
            profile = recorded_qos(self._publishers[name].qos_profile)
            recording.offer(
                self.outputs[name], output.type_name, lambda p=profile: (p,),
                latched=output.latched,
            )  # fmt: skip
        recording.offer(DIAGNOSTICS, 'diagnostic_msgs/msg/DiagnosticArray', lambda: (Qos(),))
        return recording


def _qos(topic: OutputTopic) -> QoSProfile:
    """Return the QoS of an output: reliable, and kept for late subscribers if latched."""
    kept = DurabilityPolicy.TRANSIENT_LOCAL if topic.latched else DurabilityPolicy.VOLATILE
    return QoSProfile(
        depth=topic.kept if topic.latched else _DEPTH,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=kept,
    )
