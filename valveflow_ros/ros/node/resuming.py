"""Going on where an earlier run ended: its saved state, and what it recorded after that."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from rclpy.serialization import deserialize_message
from valveflow_msgs.msg import JournalEntry as JournalMessage

from valveflow_ros.config import Settings, parameter
from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.errors import DataError, RecordingError
from valveflow_ros.logs import LoggedMessage, messages_since, recover_leftovers
from valveflow_ros.monitoring.events import JournalEntry, JournalKind
from valveflow_ros.monitoring.offline import JournalReplayer
from valveflow_ros.records import Readings
from valveflow_ros.ros import conversions
from valveflow_ros.ros.inputs import Decoder
from valveflow_ros.ros.node.live import LiveEngine
from valveflow_ros.ros.outputs import Output, Outputs
from valveflow_ros.state import State

REASON = 'The monitor was started again; it goes on from its saved state.'
_BLOCK = 500
Curves = Callable[[str], Characteristic]


@dataclass(slots=True)
class Earlier:
    """An earlier run that this one goes on with.

    Attributes
    ----------
    settings : Settings
        Those its state was saved under.
    log_ns : int
        Log time of the newest message that its state or its recording holds.
    folder : Path or None
        Its recording, None if it made none or this run does not go on with it.
    tail : list of LoggedMessage
        What it recorded after its state was saved.
    sentence : str
        What could not be taken up; empty if nothing was lost.
    """

    settings: Settings
    log_ns: int
    folder: Path | None
    tail: list[LoggedMessage]
    sentence: str = ''


def engine_settings(saved: State, now: Settings) -> Settings:
    """Return the settings of now with those that may change while running as they were."""
    then = saved['settings']
    return now.changed({n: then[n] for n in now if parameter(n).live and n in then})


def earlier_run(
    saved: State, settings: Settings, topics: Mapping[str, str], curves: Curves
) -> Earlier:
    """Return what the earlier run left besides its state.

    Parameters
    ----------
    saved : State
        What `Keeper` found.
    settings : Settings
        Of this run.
    topics : mapping of str to str
        Full names of inputs and outputs in this run.
    curves : callable
        Returns an adopted curve by its name.
    """
    made = Earlier(engine_settings(saved, settings), int(saved['log_ns']), None, [])
    name = saved['recording']
    if name is None:
        return made
    folder = Path(name)
    try:
        recover_leftovers(folder)
        made.tail = list(messages_since(folder, made.log_ns))
        # With the same names on the topics it is one recording, and a replay finds all of it.
        goes_on = saved['topics'] == dict(topics) and not _lost(made.tail, topics, curves)
        made.folder = folder if goes_on else None
    except (RecordingError, DataError) as error:
        made.sentence = f'What was recorded after the state was saved is not there: {error}'
    if made.tail:
        made.log_ns = max(made.log_ns, made.tail[-1].log_time_ns)
    return made


def _said_at(message: LoggedMessage) -> int:
    """Return the time of the plant an output belongs to; 0 before the first row, see `Session`."""
    return 0 if message.publish_time_ns == message.log_time_ns else message.publish_time_ns


def retrace(
    engine: LiveEngine,
    speaker: Outputs,
    earlier: Earlier,
    inputs: Mapping[str, str],
    outputs: Mapping[str, str],
    curves: Curves,
    left: list[str],
) -> Iterator[Output]:
    """Feed what was recorded after the state was saved; yield what it had not recorded itself.

    Parameters
    ----------
    engine : LiveEngine
        Restored.
    speaker : Outputs
    earlier : Earlier
    inputs, outputs : mapping of str to str
        Names by topics.
    curves : callable
        Returns an adopted curve by its name.
    left : list of str
        Takes what could not be followed.

    Raises
    ------
    DataError
        The journal cannot be read.
    """
    told = Counter((outputs[m.topic], _said_at(m)) for m in earlier.tail if m.topic in outputs)
    # A diagnosis takes a minute, and is asked for again.
    journal = [
        e for e in _journal(earlier.tail, outputs) if e.kind != JournalKind.DIAGNOSED
    ]  # fmt: skip
    replayer = JournalReplayer(engine.monitor, journal, curves=curves, left=left)
    decoder = Decoder(earlier.settings)
    messages = [m for m in earlier.tail if m.topic in inputs]
    for k in range(0, len(messages) + 1, _BLOCK):
        block = messages[k : k + _BLOCK]
        rows = [
            row for m in block
            for row in decoder.recorded(inputs[m.topic], m.data, m.publish_time_ns)
        ]  # fmt: skip
        events = replayer.feed_aligned(engine.aligner.feed(Readings.of(rows)))
        for output in speaker.of(events):
            if told[output.name, output.time_ns]:
                told[output.name, output.time_ns] -= 1
            else:
                yield output
    if replayer.due:
        left.append(f'{replayer.due} of its decisions stand after rows that are not there.')


def _lost(tail: list[LoggedMessage], topics: Mapping[str, str], curves: Curves) -> bool:
    """Tell whether a result came that was not saved any more: then the recording ends there."""
    for entry in _journal(tail, {topics['journal']: 'journal'}):
        if entry.kind == JournalKind.DIAGNOSED:
            return True
        if entry.kind == JournalKind.FIT_ADOPTED:
            try:
                curves(entry.model_id)
            except DataError:
                return True
    return False


def _journal(tail: list[LoggedMessage], outputs: Mapping[str, str]) -> Iterator[JournalEntry]:
    for message in tail:
        if outputs.get(message.topic) == 'journal':
            try:
                entry = conversions.journal_entry(
                    deserialize_message(message.data, JournalMessage)
                )
            except Exception as error:
                # rclpy raises whatever the middleware's C++ gave it.
                raise DataError('A line of the recorded journal cannot be read.') from error
            yield entry
