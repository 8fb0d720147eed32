# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Replays a recording and compares every recorded output with that of the replay."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

from rclpy.serialization import deserialize_message
from valveflow_msgs.msg import Alarm, FlowCharacteristic

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.diagnosis import result
from valveflow_ros.errors import DataError, RecordingError, ValveflowError, counted
from valveflow_ros.fit.task import FitTask
from valveflow_ros.interface import parameter_files
from valveflow_ros.logs import LogContents, LoggedMessage, open_log
from valveflow_ros.logs.names import TOPICS
from valveflow_ros.monitoring.events import DiagnosisContent, DiagnosisTask, JournalKind
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.offline import JournalReplayer
from valveflow_ros.monitoring.rows import Corrector
from valveflow_ros.parameters import Settings
from valveflow_ros.records import Readings
from valveflow_ros.ros.decoding import Decoder, from_time, journal_entry
from valveflow_ros.ros.node.outputs import OUTPUTS, Output, Outputs
from valveflow_ros.ros.node.recording import PARAMETERS
from valveflow_ros.ros.node.worker import DiagnosisWorker, FitWorker, Task, Worker
from valveflow_ros.signals.align import Aligner
from valveflow_ros.signals.covariates import entries_of

# Small, so that outputs before a decision that cannot be repeated are still compared.
_BLOCK = 500
_LOOK_S = 0.05
_PATIENCE = 10.0


@dataclass(slots=True)
class Verification:
    """Result of a comparison."""

    # inputs, rows: number of input messages, and of rows of the sample table made of them
    inputs: int = 0
    rows: int = 0
    # Number of messages that were equal byte for byte, by output.
    compared: dict[str, int] = field(default_factory=dict)
    difference: str = ''  # the first difference as a sentence; empty if there was none
    warnings: tuple[str, ...] = ()  # warnings of the reader about the file

    @property
    def identical(self) -> bool:
        """Return True if everything was equal."""
        return not self.difference


class _DifferenceError(Exception):
    """The first difference was found."""


def verify(path: str | Path, progress: Callable[[float], None] = lambda _: None) -> Verification:
    """Compare a recording with its replay.

    ``progress`` is called from time to time with the fraction of the inputs that was processed.
    Raises `RecordingError` if the file cannot be read, or is no recording of the monitor.
    """
    return _Replay(open_log(path), progress).verify()


def corrector_of_run(log: LogContents, settings: Settings) -> Corrector | None:
    """Return the corrector of the rows in the recorded run, None if there was none.

    Raises `RecordingError` if the model is not in the recording, or cannot be used.
    """
    if not settings.text(parameter_files.MODEL_FILE):
        return None
    try:
        model = result.model_from_json(json.loads(log.attachments[parameter_files.ATTACHMENT]))
        return parameter_files.corrector_for(model, settings)
    except KeyError:
        problem = f"lacks the attachment '{parameter_files.ATTACHMENT}' that its run was made with"
        raise RecordingError(log.path, problem) from None
    except (ValueError, ValveflowError) as error:
        problem = f'holds an extended model that cannot be used ({str(error).rstrip(".")})'
        raise RecordingError(log.path, problem) from None


def diagnose_in_process(task: DiagnosisTask) -> str:
    """Compute a diagnosis in a process like that of the run, so that all bits are equal.

    Raises `DataError` if there is no result.
    """
    worker = DiagnosisWorker(task.settings.real('diagnosis_timeout'))
    try:
        content = _result(worker, task)
    finally:
        worker.close()
    if not isinstance(content, DiagnosisContent):
        raise DataError(f'A diagnosis cannot be repeated. {content}')
    return content.text


def _result(worker: Worker, task: Task) -> object:
    worker.submit(task)
    while not (outcomes := worker.poll()):
        time.sleep(_LOOK_S)
    return outcomes[0].result


class _Replay:
    """Replays a recording and compares its outputs."""

    def __init__(self, log: LogContents, progress: Callable[[float], None]) -> None:
        self._log = log
        self._progress = progress
        self._fits: FitWorker | None = None
        self._found = Verification(warnings=log.warnings)
        try:
            self._settings = Settings(json.loads(log.attachments[PARAMETERS]))
            topics = json.loads(log.attachments[TOPICS])
            self._inputs = {str(topic): str(name) for name, topic in topics['inputs'].items()}
            # Ignore topics that this version does not have.
            self._outputs = {str(t): str(n) for n, t in topics['outputs'].items() if n in OUTPUTS}
        except KeyError as error:
            problem = f'is no recording of the monitor (the attachment {error} is missing)'
            raise RecordingError(log.path, problem) from None
        except (ValueError, TypeError, AttributeError, ValveflowError) as error:
            problem = f'holds attachments that cannot be used ({str(error).rstrip(".")})'
            raise RecordingError(log.path, problem) from None

    def verify(self) -> Verification:
        """Compare message by message, until the first difference."""
        if self._is_earlier():
            problem = 'was made by an earlier version, whose first messages were others; it can be'
            raise RecordingError(self._log.path, f'{problem} replayed, not verified')
        recorded = self._messages(self._outputs)
        kept = set(self._outputs.values())
        try:
            for output in self._outputs_now():
                if output.name in kept:
                    self._compare(output, next(recorded, None))
            extra = next(recorded, None)
            if extra is not None:
                name = self._outputs[extra.topic]
                raise _DifferenceError(f'The recording goes on with {name} where the replay ends.')
        except _DifferenceError as error:
            self._found.difference = str(error)
        finally:
            if self._fits is not None:
                self._fits.close()
        return self._found

    def _outputs_now(self) -> Iterator[Output]:
        """Yield the outputs of the engine for the recorded inputs and decisions."""
        found, settings = self._found, self._settings
        journal_topics = [topic for topic, name in self._outputs.items() if name == 'journal']
        messages = list(self._messages(journal_topics))
        try:
            journal = [journal_entry(m.data) for m in messages]
        except ValueError as error:
            problem = f'holds a line of the journal that cannot be read ({error})'
            raise RecordingError(self._log.path, problem) from error
        if journal and journal[0].kind == JournalKind.RESUMED and journal[0].rows:
            first = next(self._messages(self._inputs), None)
            if first is None or first.log_time_ns > messages[0].log_time_ns:
                problem = 'goes on from an earlier recording and cannot be verified without it'
                raise RecordingError(self._log.path, problem)
        outputs = Outputs(
            settings.text('unit_tag'), settings.output_unit, settings.zone, self._begun_ns()
        )
        yield from outputs.latched()
        covariates = entries_of(settings)
        monitor = Monitor(settings, corrector_of_run(self._log, settings), covariates)
        replayer = JournalReplayer(monitor, journal, diagnose_in_process, compute=self._fit)
        aligner, decoder = Aligner(settings, covariates), Decoder(settings)
        inputs = self._messages(self._inputs)
        topics = self._log.topics
        total = sum(topics[topic].count for topic in self._inputs if topic in topics)
        while block := list(islice(inputs, _BLOCK)):
            found.inputs += len(block)
            rows = [
                row for m in block
                for row in decoder.recorded(self._inputs[m.topic], m.data, m.publish_time_ns)
            ]  # fmt: skip
            try:
                # The journal contains clock resets, so only the rows are needed here.
                events = replayer.feed_aligned(aligner.feed(Readings.of(rows)))
            except (KeyError, ValveflowError) as error:
                raise _DifferenceError(
                    f'The replay cannot follow the journal: {str(error).rstrip(".")}.'
                ) from None
            yield from outputs.of(events)
            found.rows = monitor.rows
            self._progress(found.inputs / max(1, total))

    def _fit(self, task: FitTask) -> Characteristic:
        """Compute a fit with one thread as in the run; otherwise the last bits may differ."""
        if self._fits is None:
            # This machine may be slower than that of the run.
            self._fits = FitWorker(_PATIENCE * task.settings.real('refit_timeout'))
        found = _result(self._fits, task)
        if not isinstance(found, Characteristic):
            raise DataError(f'A fit cannot be repeated. {found}')
        return found

    def _is_earlier(self) -> bool:
        """Return True if the recording lacks the initial alarm message of current versions."""
        alarms = [topic for topic, name in self._outputs.items() if name == 'alarms']
        told, first = (next(self._messages(t), None) for t in (alarms, self._outputs))
        if first is None:
            return False
        try:
            return told is None or deserialize_message(told.data, Alarm).occurrence > 0
        except Exception:  # noqa: BLE001 - the comparison says what is wrong with it
            return False

    def _begun_ns(self) -> int:
        """Return the time of the messages before the first data; 0 if unknown."""
        curves = [topic for topic, name in self._outputs.items() if name == 'characteristic']
        first = next(self._messages(curves), None)
        if first is None:
            return 0
        try:
            stamp = deserialize_message(first.data, FlowCharacteristic).header.stamp
        except Exception:  # noqa: BLE001 - the comparison says what is wrong with it
            return 0
        return from_time(stamp)

    def _messages(self, topics: Iterable[str]) -> Iterator[LoggedMessage]:
        there = [topic for topic in topics if topic in self._log.topics]
        return self._log.iter_messages(there) if there else iter(())

    def _compare(self, output: Output, then: LoggedMessage | None) -> None:
        """Raise `_DifferenceError` unless both are the same message."""
        found = self._found
        number = found.compared.get(output.name, 0) + 1
        what = f'{output.name} number {number}'
        if then is None:
            raise _DifferenceError(
                f'The recording ends before {what}, after {counted(found.rows, "row")}.'
            )
        recorded_name = self._outputs[then.topic]
        if recorded_name != output.name:
            raise _DifferenceError(
                f'The replay gives {what} where the recording has {recorded_name}.'
            )
        what = what.capitalize()
        if then.publish_time_ns != (output.time_ns or then.log_time_ns):
            raise _DifferenceError(f'{what} belongs to another time in the recording.')
        if then.data != output.data:
            kind = OUTPUTS[output.name].message_type
            raise _DifferenceError(
                f'{what} differs: {_first_difference(kind, then.data, output.data)}.'
            )
        found.compared[output.name] = number


def _first_difference(kind: type, then: bytes, now: bytes) -> str:
    try:
        old, new = deserialize_message(then, kind), deserialize_message(now, kind)
    except Exception as error:  # noqa: BLE001 - rclpy raises what its C++ gave it
        return f'it cannot be read ({error})'
    for name in old.get_fields_and_field_types():
        before, after = getattr(old, name), getattr(new, name)
        if repr(before) != repr(after):
            return f'{name} was {before!r} and is {after!r}'
    return 'its padding'
