# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Continues an earlier run from its saved state and from what it recorded after that."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from valveflow_ros.errors import DataError, RecordingError, ValveflowError
from valveflow_ros.logs import LoggedMessage, messages_since, recover_leftovers
from valveflow_ros.logs.names import has_earlier_codes
from valveflow_ros.logs.part_file import PART_SUFFIX, is_held
from valveflow_ros.monitoring.alarms import AlarmState
from valveflow_ros.monitoring.events import Event, JournalEntry, JournalKind
from valveflow_ros.monitoring.offline import JournalReplayer
from valveflow_ros.parameters import Settings, parameter
from valveflow_ros.records import Readings
from valveflow_ros.report.words import duration
from valveflow_ros.ros.decoding import PLANT_SAMPLE, Decoder, journal_entry
from valveflow_ros.ros.node.diagnostics import Level, line_of
from valveflow_ros.ros.node.engine import LiveEngine
from valveflow_ros.ros.node.outputs import Output, Outputs
from valveflow_ros.ros.node.state_store import StateStore
from valveflow_ros.state import State

REASON = 'The monitor was started again; it goes on from its saved state.'
_BLOCK = 500
_DOES_NOT_FIT = (ValveflowError, LookupError, TypeError, ValueError, AttributeError)


class Restart:
    """The earlier run that this one continues, if there is one.

    ``inputs`` and ``outputs`` are the full topic names in this run by contract name; ``log`` is
    called with a level and a sentence.
    """

    def __init__(
        self,
        settings: Settings,
        store: StateStore,
        inputs: Mapping[str, str],
        outputs: Mapping[str, str],
        log: Callable[[Level, str], None],
    ) -> None:
        self._settings = settings
        self._store = store
        self._topics = {**inputs, **outputs}
        self._inputs = {topic: name for name, topic in inputs.items()}
        self._outputs = {topic: name for name, topic in outputs.items()}
        self._log = log
        self._tail: list[LoggedMessage] = []
        self._missing = self._sample = ''
        self.continues = False  # True if an earlier run is continued; valid after `engine`
        # Log time of the newest message in its state or its recording; 0 if there is none.
        self.log_ns = 0
        # Its recording if it is continued; None if a new one must be begun.
        self.folder: Path | None = None

    @property
    def began(self) -> Mapping[str, Any] | None:
        """Return the parameters that the continued recording began with."""
        saved = self._store.saved
        return None if self.folder is None or saved is None else saved['began']

    @property
    def begun_ns(self) -> int:
        """Return the start time of the first continued run; 0 without a saved state."""
        saved = self._store.saved
        return 0 if saved is None else int(saved.get('begun_ns', saved['log_ns']))

    @property
    def adopted(self) -> bool:
        """Return True if the earlier run adopted a curve after its state was saved."""
        try:
            return any(entry.kind == JournalKind.FIT_ADOPTED for entry in self._journal())
        except DataError:
            return False

    def engine(self, make: Callable[[Settings], LiveEngine]) -> LiveEngine:
        """Return the engine, restored from the saved state if it can be used."""
        saved, self._make = self._store.saved, make
        if saved is not None:
            try:
                self._find_recording(saved)
                engine = self._restored(saved['engine'], self._settings_then(saved))
            except _DOES_NOT_FIT as error:
                known = isinstance(error, ValveflowError)
                self._store.drop(str(error) if known else 'It does not fit this program.')
                self.log_ns, self.folder, self._tail = 0, None, []
            else:
                self.continues = True
                return engine
        return make(self._settings)

    def begin(self, settings: Settings, engine: LiveEngine, outputs: Outputs) -> Iterator[Output]:
        """Yield the first outputs, after continuing the earlier run if there is one."""
        missing = self._missing if self.continues else ''
        for sentence in filter(None, (self._store.problem, self._store.sentence, missing)):
            self._log(Level.WARN, sentence)
        if not self.continues:
            yield from outputs.latched()
            return
        problems: list[str] = []
        try:
            yield from self.feed_tail(engine, outputs, problems)
        except ValveflowError as error:
            problems.append(str(error))
        if problems:
            what = ' '.join(dict.fromkeys(problems))
            self._log(Level.WARN, f'Not all of the earlier recording could be followed: {what}')
        retuned = settings.retuned(engine.monitor.settings)
        events: list[Event] = []
        if retuned:
            made = self._make(settings)
            sentence, events = made.carry(engine.snapshot(), engine.monitor.settings)
            self._log(Level.OK, sentence)
            engine.aligner, engine.monitor = made.aligner, made.monitor
            outputs.restore(engine.monitor)
        monitor = engine.monitor
        yield from outputs.of(monitor.resume(REASON))
        yield from outputs.of(events if retuned else monitor.reconfigure(settings))
        self._tail.clear()
        rows, past_s = monitor.rows, monitor.rows * monitor.settings.real('sample_period')
        then = 'the recording continues in the same folder'
        if self.folder is None:
            then = 'a new recording is begun'
        self._log(
            Level.OK,
            f'The saved state was loaded, with {rows} rows ({duration(past_s)}); {then}.',
        )
        for last in (monitor.alarm.last, monitor.reference.alarm.last):
            if last is not None and last.state != AlarmState.NORMAL and (line := line_of(last)):
                self._log(line[0], f'from before, {line[1]}')

    def feed_tail(
        self, engine: LiveEngine, outputs: Outputs, problems: list[str]
    ) -> Iterator[Output]:
        """Process what was recorded after the state was saved; yield outputs not recorded then.

        Sentences about what could not be repeated are added to ``problems``. Raises `DataError` if
        the journal cannot be read.
        """
        # An output before the first row has its log time as publish time; see `Session.record`.
        told = Counter(
            (self._outputs[m.topic], m.publish_time_ns * (m.publish_time_ns != m.log_time_ns))
            for m in self._tail if m.topic in self._outputs
        )  # fmt: skip
        # Diagnoses are not repeated here: they take a minute and are requested again.
        journal = [e for e in self._journal() if e.kind != JournalKind.DIAGNOSED]
        curves = self._store.curve
        replayer = JournalReplayer(engine.monitor, journal, curves=curves, left=problems)
        decoder = Decoder(engine.monitor.settings, self._sample)
        messages = [m for m in self._tail if m.topic in self._inputs]
        for k in range(0, len(messages) + 1, _BLOCK):
            rows = [
                row for m in messages[k : k + _BLOCK]
                for row in decoder.recorded(self._inputs[m.topic], m.data, m.publish_time_ns)
            ]  # fmt: skip
            events = replayer.feed_aligned(engine.aligner.feed(Readings.of(rows)))
            for output in outputs.of(events):
                if told[output.name, output.time_ns]:
                    told[output.name, output.time_ns] -= 1
                else:
                    yield output
        if replayer.due:
            problems.append(f'{replayer.due} of its decisions belong to missing rows.')

    def _settings_then(self, saved: State) -> Settings:
        """Return the saved settings, with current values of those that the engine ignores."""
        now, then = self._settings, saved['settings']
        apart = (n for n in now if not (parameter(n).of_state or parameter(n).live))
        return Settings({**then, **{n: now[n] for n in apart}})

    def _restored(self, saved: State, then: Settings) -> LiveEngine:
        """Return an engine restored from a snapshot; one of another version is used in part."""
        engine = self._make(then)
        try:
            engine.restore(saved)
        except _DOES_NOT_FIT:
            engine = self._make(then)
            sentence, _ = engine.carry(saved, then)
            self._log(Level.WARN, f'The saved state is of another version. {sentence}')
            self.folder = None  # a replay would give another result
        return engine

    def _find_recording(self, saved: State) -> None:
        """Read what was recorded after the state was saved; decide if it is continued."""
        self.log_ns = int(saved['log_ns'])
        if saved['recording'] is None:
            return
        folder = Path(saved['recording'])
        try:
            recover_leftovers(folder)
            definitions: dict[str, str] = {}
            self._tail = list(messages_since(folder, self.log_ns, definitions))
            self._sample = definitions.get(self._topics.get(PLANT_SAMPLE, ''), '')
            if any(map(_written_now, folder.glob(f'*{PART_SUFFIX}'))):
                self._missing = f'Another process records into {folder}; a new recording is begun.'
            # For a replay, one recording needs the same parameters and topic names throughout.
            elif (
                saved['topics'] == self._topics
                and not self._settings.retuned(saved['settings'])
                and not self._result_lost()
                # Quality codes must have the same meaning in the whole folder.
                and not has_earlier_codes(self._sample)
            ):
                self.folder = folder
        except (RecordingError, DataError) as error:
            self._missing = f'What was recorded after the state was saved is not there: {error}'
        if self._tail:
            self.log_ns = max(self.log_ns, self._tail[-1].log_time_ns)

    def _result_lost(self) -> bool:
        """Return True if a recorded result was not saved; then the recording cannot continue."""
        for entry in self._journal():
            if entry.kind == JournalKind.DIAGNOSED:
                return True
            if entry.kind == JournalKind.FIT_ADOPTED:
                try:
                    self._store.curve(entry.model_id)
                except DataError:
                    return True
        return False

    def _journal(self) -> Iterator[JournalEntry]:
        for message in self._tail:
            if self._outputs.get(message.topic) == 'journal':
                try:
                    yield journal_entry(message.data)
                except ValueError as error:
                    raise DataError('A line of the recorded journal cannot be read.') from error


def _written_now(part: Path) -> bool:
    """Return True if a living process writes the file; False for a link or a removed file."""
    try:
        return is_held(part)
    except OSError:
        return False
