"""Ties a run of the monitor to the one before it and to the one after it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rclpy.serialization import deserialize_message
from valveflow_msgs.msg import JournalEntry as JournalMessage

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.errors import DataError, RecordingError, ValveflowError
from valveflow_ros.logs import LoggedMessage, messages_since, recover_leftovers
from valveflow_ros.monitoring.alarms import AlarmState
from valveflow_ros.monitoring.events import Event, JournalEntry, JournalKind
from valveflow_ros.monitoring.offline import JournalReplayer
from valveflow_ros.parameters import Settings, parameter
from valveflow_ros.records import Readings
from valveflow_ros.ros import conversions
from valveflow_ros.ros.diagnostics import Item, Level, line_of
from valveflow_ros.ros.inputs import Decoder
from valveflow_ros.ros.node.live import LiveEngine
from valveflow_ros.ros.node.recording import Leftovers, Recording, tag_of
from valveflow_ros.ros.node.state_store import Keeper
from valveflow_ros.ros.outputs import Output, Outputs
from valveflow_ros.state import State

# Going on where an earlier run ended: its saved state, and what it recorded after that.


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


Log = Callable[[Level, str], None]


class Continuity:
    """Finds what an earlier run left, and leaves the like for a later one.

    Parameters
    ----------
    settings : Settings
    inputs, outputs : mapping of str to str
        Full names of the topics.
    log : callable
        Takes how grave something is and a sentence.

    Raises
    ------
    InUseError
        Another monitor keeps its state in the same folder.
    """

    def __init__(
        self, settings: Settings, inputs: Mapping[str, str], outputs: Mapping[str, str], log: Log
    ) -> None:
        self._settings = settings
        self._inputs = {topic: name for name, topic in inputs.items()}
        self._outputs = {topic: name for name, topic in outputs.items()}
        self._topics = {**inputs, **outputs}
        self._log = log
        self._earlier: Earlier | None = None
        # Before the tail of an earlier run is fed, a state would leave it out for good.
        self._begun = False
        self._leftovers: Leftovers | None = None
        self._keeper = Keeper(settings)

    @property
    def goes_on(self) -> bool:
        """Tell whether an earlier run is gone on with."""
        return self._earlier is not None

    @property
    def log_ns(self) -> int:
        """Return the newest log time of the earlier run, 0 without one."""
        return 0 if self._earlier is None else self._earlier.log_ns

    @property
    def folder(self) -> Path | None:
        """Return the recording that is gone on with, None if a new one is to be begun."""
        return None if self._earlier is None else self._earlier.folder

    @property
    def began(self) -> Mapping[str, Any] | None:
        """Return the parameters that recording began with."""
        saved = self._keeper.saved
        return None if self.folder is None or saved is None else saved['began']

    def engine(self, make: Callable[[Settings], LiveEngine]) -> LiveEngine:
        """Return the engine, where it was left if there is a state that can be used."""
        saved = self._keeper.saved
        if saved is not None:
            try:
                earlier = earlier_run(saved, self._settings, self._topics, self._keeper.curve)
                engine = make(earlier.settings)
                engine.restore(saved['engine'])
            except (ValveflowError, LookupError, TypeError, ValueError, AttributeError) as error:
                known = isinstance(error, ValveflowError)
                self._keeper.drop(str(error) if known else 'It does not fit this program.')
            else:
                self._earlier = earlier
                return engine
        return make(self._settings)

    def begin(self, settings: Settings, engine: LiveEngine, speaker: Outputs) -> Iterator[Output]:
        """Yield what stands at the beginning: nothing yet, or where the earlier run ended."""
        for sentence in filter(None, (self._keeper.problem, self._keeper.sentence)):
            self._log(Level.WARN, sentence)
        earlier = self._earlier
        if earlier is None:
            yield from speaker.first()
            self._begun = True
            return
        if earlier.sentence:
            self._log(Level.WARN, earlier.sentence)
        left: list[str] = []
        try:
            yield from retrace(
                engine, speaker, earlier, self._inputs, self._outputs, self._keeper.curve, left
            )
        except ValveflowError as error:
            left.append(str(error))
        if left:
            what = ' '.join(dict.fromkeys(left))
            self._log(Level.WARN, f'Not all of the earlier recording could be followed: {what}')
        yield from speaker.of(engine.monitor.resume(REASON))
        yield from speaker.of(engine.reconfigure(settings))
        self._begun = True
        earlier.tail.clear()
        self._log(Level.OK, f'Going on after {engine.monitor.rows} rows of an earlier run.')
        for last in (engine.monitor.alarm.last, engine.monitor.reference.alarm.last):
            if last is not None and last.state != AlarmState.NORMAL and (line := line_of(last)):
                self._log(line[0], f'from before, {line[1]}')

    def look_after(self, recording: Recording) -> None:
        """Finish in the background what other runs left unfinished beside this recording."""
        if recording.folder is not None:
            self._leftovers = Leftovers(recording.folder, tag_of(self._settings))

    def note(self, events: Sequence[Event]) -> None:
        """Look for what must survive the end of the process."""
        self._keeper.note(events)

    def step(
        self, settings: Settings, engine: LiveEngine, log_ns: int, recording: Recording
    ) -> None:
        """Save the state if that is due; ``log_ns`` is of the newest message that went into it."""
        for level, sentence in self._leftovers.news() if self._leftovers else ():
            self._log(level, sentence)
        if self._keeper.due:
            self.save(settings, engine, log_ns, recording)

    def save(
        self, settings: Settings, engine: LiveEngine, log_ns: int, recording: Recording
    ) -> None:
        """Save the state now."""
        if self._keeper.on and self._begun:
            self._keeper.write(settings, engine.snapshot(), log_ns, recording, self._topics)

    def item(self) -> Item:
        """Return how saving goes."""
        keeper = self._keeper
        age_s = keeper.age_s
        values = {'Seconds since it was saved': '' if age_s is None else f'{age_s:.0f}'}
        if keeper.problem:
            return Item('state', Level.ERROR, keeper.problem, values)
        if not keeper.on:
            nothing = 'Nothing is kept (parameters keep_state, state_directory).'
            return Item('state', Level.OK, nothing)
        if keeper.lost:
            # Nobody would see it otherwise: what stood is not there to be shown. Until the next
            # start, which goes on from this run.
            return Item('state', Level.WARN, keeper.sentence, values)
        return Item('state', Level.OK, 'The state is saved in its time.', values)

    def close(self) -> None:
        """Let the next run in, once what is being saved is in place."""
        self._keeper.close()
