"""Feed a recording again and compare every message the monitor sent then with what it says now."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

from rclpy.serialization import deserialize_message

from valveflow_ros.diagnosis import result
from valveflow_ros.errors import DataError, RecordingError, ValveflowError, counted
from valveflow_ros.logs import LogContents, LoggedMessage, open_log
from valveflow_ros.monitoring.events import (
    DiagnosisContent,
    DiagnosisTask,
    Event,
    JournalEntry,
    JournalKind,
)
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.offline import JournalReplayer
from valveflow_ros.monitoring.rows import Corrector
from valveflow_ros.parameters import Settings
from valveflow_ros.records import Readings
from valveflow_ros.ros.decoding import Decoder, Row, journal_entry
from valveflow_ros.ros.node import given_files
from valveflow_ros.ros.node.recording import PARAMETERS, TOPICS
from valveflow_ros.ros.outputs import OUTPUTS, Output, Outputs
from valveflow_ros.ros.worker import DiagnosisWorker
from valveflow_ros.signals.align import Aligner

# Small, so that what is said before a decision that cannot be repeated is compared first.
_BLOCK = 500
_LOOK_S = 0.05
Progress = Callable[[float], None]


@dataclass(slots=True)
class Verification:
    """What a comparison gave.

    Attributes
    ----------
    inputs, rows : int
        Messages fed and rows of the sample table made of them.
    compared : dict of str to int
        Messages that were equal byte for byte, by output.
    difference : str
        The first difference as a sentence; empty if there was none.
    warnings : tuple of str
        What the reader had to say about the file.
    """

    inputs: int = 0
    rows: int = 0
    compared: dict[str, int] = field(default_factory=dict)
    difference: str = ''
    warnings: tuple[str, ...] = ()

    @property
    def identical(self) -> bool:
        """Tell whether everything was equal."""
        return not self.difference


class _DifferenceError(Exception):
    """The first difference was found."""


def verify(path: str | Path, progress: Progress = lambda _: None) -> Verification:
    """Compare a recording with its replay.

    Parameters
    ----------
    path : str or Path
        A recording of the monitor.
    progress : callable
        Is told from time to time which share of the inputs was fed.

    Raises
    ------
    RecordingError
        The file cannot be read, or is no recording of the monitor.
    """
    log = open_log(path)
    settings, inputs, outputs = _attached(log)
    result = Verification(warnings=log.warnings)
    recorded = _messages(log, outputs)
    replay = _replayed(log, settings, inputs, outputs, result, progress)
    try:
        for output in replay:
            _compare(output, next(recorded, None), outputs, result)
        extra = next(recorded, None)
        if extra is not None:
            name = outputs[extra.topic]
            raise _DifferenceError(f'The recording goes on with {name} where the replay ends.')
    except _DifferenceError as error:
        result.difference = str(error)
    return result


def _attached(log: LogContents) -> tuple[Settings, dict[str, str], dict[str, str]]:
    """Return the settings, and the inputs and outputs by their topics."""
    try:
        settings = Settings(json.loads(log.attachments[PARAMETERS]))
        topics: dict[str, Any] = json.loads(log.attachments[TOPICS])
        inputs = {str(topic): str(name) for name, topic in topics['inputs'].items()}
        outputs = {str(t): str(n) for n, t in topics['outputs'].items() if n in OUTPUTS}
    except KeyError as error:
        problem = f'is no recording of the monitor (the attachment {error} is missing)'
        raise RecordingError(log.path, problem) from None
    except (ValueError, TypeError, AttributeError, ValveflowError) as error:
        problem = f'holds attachments that cannot be used ({str(error).rstrip(".")})'
        raise RecordingError(log.path, problem) from None
    return settings, inputs, outputs


def _replayed(
    log: LogContents,
    settings: Settings,
    inputs: dict[str, str],
    outputs: dict[str, str],
    result: Verification,
    progress: Progress,
) -> Iterator[Output]:
    """Yield what the engine says to the recorded inputs and decisions."""
    outputs_of_replay = Outputs(settings.text('unit_tag'))
    # A recording of an earlier version has no topics that came later.
    kept = set(outputs.values())
    journal = list(_journal(log, outputs))
    if journal and _began_elsewhere(log, journal[0], inputs, outputs):
        problem = 'goes on from an earlier recording and cannot be verified without it'
        raise RecordingError(log.path, problem)
    yield from (output for output in outputs_of_replay.latched() if output.name in kept)
    monitor = Monitor(settings, corrector_of_run(log, settings))
    replayer = JournalReplayer(monitor, journal, diagnose_in_process)
    aligner, decoder = Aligner(settings), Decoder(settings)
    messages = _messages(log, inputs)
    total = sum(log.topics[topic].count for topic in inputs if topic in log.topics)
    while block := list(islice(messages, _BLOCK)):
        result.inputs += len(block)
        rows = [
            row for m in block
            for row in decoder.recorded(inputs[m.topic], m.data, m.publish_time_ns)
        ]  # fmt: skip
        # Restarts of the clock stand in the journal, so the rows alone are enough here.
        said = outputs_of_replay.of(_fed(replayer, aligner, rows))
        yield from (output for output in said if output.name in kept)
        result.rows = monitor.rows
        progress(result.inputs / max(1, total))


def corrector_of_run(log: LogContents, settings: Settings) -> Corrector | None:
    """Return what took causes out of the rows in the run.

    Raises
    ------
    RecordingError
        The model is not in the recording, or cannot be used.
    """
    if not settings.text(given_files.MODEL_FILE):
        return None
    try:
        given = result.model_from_json(json.loads(log.attachments[given_files.ATTACHMENT]))
        return given_files.corrector_for(given, settings)
    except KeyError:
        problem = f"lacks the attachment '{given_files.ATTACHMENT}' that its run was made with"
        raise RecordingError(log.path, problem) from None
    except (ValueError, ValveflowError) as error:
        problem = f'holds an extended model that cannot be used ({str(error).rstrip(".")})'
        raise RecordingError(log.path, problem) from None


def diagnose_in_process(task: DiagnosisTask) -> str:
    """Compute a diagnosis in a process like the one of the run, on which its last bits depend.

    Raises
    ------
    DataError
        It gave no result.
    """
    worker = DiagnosisWorker(task.settings.real('diagnosis_timeout'))
    worker.submit(task)
    try:
        while not (outcomes := worker.poll()):
            time.sleep(_LOOK_S)
    finally:
        worker.close()
    result = outcomes[0].result
    if not isinstance(result, DiagnosisContent):
        raise DataError(f'A diagnosis cannot be repeated. {result}')
    return result.text


def _messages(log: LogContents, topics: Iterable[str]) -> Iterator[LoggedMessage]:
    """Return the messages of those topics that are there."""
    there = [topic for topic in topics if topic in log.topics]
    return log.iter_messages(there) if there else iter(())


def _journal(log: LogContents, outputs: dict[str, str]) -> Iterator[JournalEntry]:
    topics = [topic for topic, name in outputs.items() if name == 'journal']
    for message in _messages(log, topics):
        try:
            yield journal_entry(message.data)
        except ValueError as error:
            problem = f'holds a line of the journal that cannot be read ({error})'
            raise RecordingError(log.path, problem) from error


def _began_elsewhere(
    log: LogContents, first: JournalEntry, inputs: dict[str, str], outputs: dict[str, str]
) -> bool:
    """Tell whether the rows before the first decision, which is to go on, are not here."""
    if first.kind != JournalKind.RESUMED or first.rows == 0:
        return False
    lines = _messages(log, [topic for topic, name in outputs.items() if name == 'journal'])
    decided_ns = next(lines).log_time_ns
    rows = next(_messages(log, inputs), None)
    return rows is None or rows.log_time_ns > decided_ns


def _fed(replayer: JournalReplayer, aligner: Aligner, rows: list[Row]) -> list[Event]:
    try:
        return replayer.feed_aligned(aligner.feed(Readings.of(rows)))
    except (KeyError, ValveflowError) as error:
        raise _DifferenceError(
            f'The replay cannot follow the journal: {str(error).rstrip(".")}.'
        ) from None


def _compare(
    output: Output, then: LoggedMessage | None, outputs: dict[str, str], result: Verification
) -> None:
    """Raise `_DifferenceError` unless both are the same message."""
    number = result.compared.get(output.name, 0) + 1
    what = f'{output.name} number {number}'
    if then is None:
        raise _DifferenceError(
            f'The recording ends before {what}, after {counted(result.rows, "row")}.'
        )
    if outputs[then.topic] != output.name:
        raise _DifferenceError(
            f'The replay gives {what} where the recording has {outputs[then.topic]}.'
        )
    if then.publish_time_ns != (output.time_ns or then.log_time_ns):
        raise _DifferenceError(f'{what.capitalize()} belongs to another time in the recording.')
    if then.data != output.data:
        kind = OUTPUTS[output.name].message_type
        raise _DifferenceError(
            f'{what.capitalize()} differs: {_first_field(kind, then.data, output.data)}.'
        )
    result.compared[output.name] = number


def _first_field(kind: type, then: bytes, now: bytes) -> str:
    """Name the first field that differs."""
    try:
        old, new = deserialize_message(then, kind), deserialize_message(now, kind)
    except Exception as error:  # noqa: BLE001 - see `_journal`
        return f'it cannot be read ({error})'
    for name in old.get_fields_and_field_types():
        before, after = getattr(old, name), getattr(new, name)
        if repr(before) != repr(after):
            return f'{name} was {before!r} and is {after!r}'
    return 'its padding'
