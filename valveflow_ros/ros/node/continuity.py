"""Ties a run of the monitor to the one before it and to the one after it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from valveflow_ros.config import Settings
from valveflow_ros.errors import ValveflowError
from valveflow_ros.monitoring.alarms import AlarmState
from valveflow_ros.monitoring.events import Event
from valveflow_ros.ros.chronicle import line_of
from valveflow_ros.ros.diagnostics import Item, Level
from valveflow_ros.ros.node.keeper import Keeper
from valveflow_ros.ros.node.leftovers import Leftovers
from valveflow_ros.ros.node.live import LiveEngine
from valveflow_ros.ros.node.recording import Recording, tag_of
from valveflow_ros.ros.node.resuming import REASON, Earlier, earlier_run, retrace
from valveflow_ros.ros.outputs import Output, Outputs

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
