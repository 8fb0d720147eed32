# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Run the engine without a plant: compute fits at once, or repeat those of a journal."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.characteristic_json import from_json
from valveflow_ros.errors import DataError
from valveflow_ros.fit.fit import fit
from valveflow_ros.fit.task import FitTask
from valveflow_ros.monitoring.alarm_state import AlarmAction
from valveflow_ros.monitoring.diagnosis_requests import ASKED
from valveflow_ros.monitoring.events import (
    DiagnosisRequested,
    DiagnosisTask,
    Event,
    FitRequested,
    JournalEntry,
    JournalKind,
)
from valveflow_ros.monitoring.monitor import BY_HAND, OF_ITSELF, Monitor
from valveflow_ros.records import Readings, SampleTable
from valveflow_ros.signals.align import Aligned, Aligner

Diagnose = Callable[[DiagnosisTask], str]
# Called before a fit or a diagnosis with the time (ns) of the newest row and its name.
Tell = Callable[[int, str], None]
_ALARM_ACTIONS = {JournalKind[action.name]: action for action in AlarmAction}
CLOCK_BACK = 'The clock went back; the rows later than the new time are set aside.'


def _quiet(_time_ns: int, _what: str) -> None:
    """Show no progress."""


def outcome_of(monitor: Monitor, task: FitTask) -> list[Event]:
    """Compute a fit now, and pass the outcome to the engine."""
    try:
        return monitor.adopt(task.request_ns, fit(task))
    except DataError as error:
        return monitor.refuse(task.request_ns, str(error))


def align_all(aligner: Aligner, readings: Readings) -> Iterator[Aligned]:
    """Yield all rows of a complete list of readings."""
    yield aligner.feed(readings)
    yield aligner.finish()


def feed_rows(
    monitor: Monitor, table: SampleTable, diagnose: Diagnose | None = None, tell: Tell = _quiet
) -> list[Event]:
    """Feed rows and compute every fit at once; with ``diagnose`` also every diagnosis.

    ``diagnose`` returns the content of `diagnosis.json`, or raises `DataError`.
    """
    events: list[Event] = []
    done = 0
    while done < len(table):
        fed = monitor.feed(table.part(done, len(table)))
        done += fed.rows
        events += fed.events
        for event in fed.events:
            if isinstance(event, FitRequested):
                tell(monitor.last_ns, 'fit')
                events += outcome_of(monitor, event.task)
            elif isinstance(event, DiagnosisRequested) and diagnose is not None:
                request_ns = event.task.request_ns
                tell(monitor.last_ns, 'diagnosis')
                try:
                    events += monitor.diagnosing.adopt(request_ns, diagnose(event.task))
                except DataError as error:
                    events += monitor.diagnosing.refuse(request_ns, str(error))
    return events


def feed_aligned(
    monitor: Monitor, aligned: Aligned, diagnose: Diagnose | None = None, tell: Tell = _quiet
) -> list[Event]:
    """Feed rows that contain restarts of the clock, like `feed_rows`."""
    events: list[Event] = []
    start = 0
    for reset in aligned.resets.tolist():
        events += feed_rows(monitor, aligned.table.part(start, reset), diagnose, tell)
        events += monitor.restart(CLOCK_BACK)
        start = reset
    rest = aligned.table.part(start, len(aligned.table))
    return events + feed_rows(monitor, rest, diagnose, tell)


class JournalReplayer:
    """Feed rows and repeat the decisions of a live run at the rows given in its journal.

    Parameters
    ----------
    monitor : Monitor
        A new one, with the settings of the live run.
    journal : sequence of JournalEntry
        In the order written. Decisions that the engine makes from the rows alone are computed
        again; all others are repeated.
    diagnose : callable, optional
        Computes a diagnosis and returns its content; without it the diagnoses of the journal
        cannot be repeated.
    curves : callable, optional
        Returns the curve of a given name, if that is faster than computing it again.
    compute : callable
        Computes a fit if ``curves`` is not given.
    left : list of str, optional
        Receives the reasons why entries cannot be repeated; without it such an entry is an error.
    """

    def __init__(
        self,
        monitor: Monitor,
        journal: Sequence[JournalEntry],
        diagnose: Diagnose | None = None,
        curves: Callable[[str], Characteristic] | None = None,
        left: list[str] | None = None,
        compute: Callable[[FitTask], Characteristic] = fit,
    ) -> None:
        self._monitor = monitor
        self._curves, self._compute = curves, compute
        self._left = left
        self._due = [entry for entry in journal if _from_outside(entry)]
        self._tasks: dict[int, FitTask] = {}
        self._diagnose = diagnose
        self._diagnosis: DiagnosisTask | None = None
        self._reset_at = -1

    def feed(self, table: SampleTable) -> list[Event]:
        """Feed rows; return the events."""
        events: list[Event] = []
        done = 0
        while True:
            events += self._repeat_due()
            if done >= len(table):
                return events
            until = len(table)
            if self._due:
                until = min(until, done + self._due[0].rows - self._monitor.rows)
            fed = self._monitor.feed(table.part(done, until))
            done += fed.rows
            events += self._keep(fed.events)

    def feed_aligned(self, aligned: Aligned) -> list[Event]:
        """Feed rows that contain restarts of the clock; return the events.

        If a run was killed, its journal may lack the last restart.
        """
        events: list[Event] = []
        start = 0
        for reset in aligned.resets.tolist():
            events += self.feed(aligned.table.part(start, reset))
            if self._reset_at != self._monitor.rows:
                events += self._monitor.restart(CLOCK_BACK)
            start = reset
        return events + self.feed(aligned.table.part(start, len(aligned.table)))

    def _keep(self, events: list[Event]) -> list[Event]:
        """Keep the tasks of requests; return the events."""
        for event in events:
            if isinstance(event, DiagnosisRequested):
                self._diagnosis = event.task
            elif isinstance(event, FitRequested):
                self._tasks[event.task.request_ns] = event.task
        return events

    def _repeat_due(self) -> list[Event]:
        events: list[Event] = []
        while self._due and self._due[0].rows <= self._monitor.rows:
            try:
                events += self._repeat(self._due.pop(0))
            except DataError as error:
                if self._left is None:
                    raise
                self._left.append(str(error))
        return events

    @property
    def due(self) -> int:
        """Return how many journal entries belong to rows that have not arrived yet."""
        return len(self._due)

    def _repeat(self, entry: JournalEntry) -> list[Event]:
        monitor = self._monitor
        if entry.kind == JournalKind.FIT_REQUESTED:
            return self._keep(monitor.request_fit())
        if entry.kind == JournalKind.DIAGNOSE:
            return self._keep(monitor.request_diagnosis())
        if entry.kind == JournalKind.DIAGNOSED:
            return self._conclude(entry)
        if entry.kind == JournalKind.DIAGNOSIS_FAILED:
            return monitor.diagnosing.refuse(entry.request_ns, entry.text)
        if entry.kind == JournalKind.FIT_ADOPTED:
            return self._adopt(entry)
        if entry.kind == JournalKind.FIT_REFUSED:
            self._tasks.pop(entry.request_ns, None)
            return monitor.refuse(entry.request_ns, entry.text)
        if entry.kind in _ALARM_ACTIONS:
            return monitor.operate_alarms(_ALARM_ACTIONS[entry.kind], entry.text or None)
        if entry.kind == JournalKind.RESET:
            self._reset_at = monitor.rows
            return monitor.restart(entry.text)
        if entry.kind == JournalKind.RESUMED:
            return monitor.resume(entry.text)
        if entry.kind == JournalKind.SETTINGS:
            return monitor.reconfigure(monitor.settings.changed(_held(entry, 'parameters')))
        if entry.kind == JournalKind.SET_REFERENCE:
            given = from_json(_held(entry, 'reference')) if entry.text else None
            return monitor.set_reference(given)
        return []

    def _adopt(self, entry: JournalEntry) -> list[Event]:
        """Compute the fit that was adopted; its curve must have the same name."""
        if self._curves is not None:
            return self._monitor.adopt(entry.request_ns, self._curves(entry.model_id))
        task = self._tasks.pop(entry.request_ns, None)
        if task is None:
            raise DataError(
                f'The journal adopts curve {entry.model_id} for a request that never came: '
                'the readings before it are not complete.'
            )
        found = self._compute(task)
        if entry.model_id and found.model_id != entry.model_id:
            raise DataError(
                f'The fit gives curve {found.model_id} where the journal has {entry.model_id}: '
                'the readings, the settings or the program are not those of the run.'
            )
        return self._monitor.adopt(entry.request_ns, found)

    def _conclude(self, entry: JournalEntry) -> list[Event]:
        """Compute the published diagnosis; the journal entry shows whether it is the same."""
        task, self._diagnosis = self._diagnosis, None
        if task is None or task.request_ns != entry.request_ns:
            raise DataError('The journal has a diagnosis that was never asked for.')
        if self._diagnose is None:
            raise DataError('The journal has a diagnosis, which cannot be repeated here.')
        return self._monitor.diagnosing.adopt(entry.request_ns, self._diagnose(task))


def _from_outside(entry: JournalEntry) -> bool:
    """Return True if the engine would not make this decision from rows alone."""
    if entry.kind == JournalKind.SET_REFERENCE:
        return entry.text not in OF_ITSELF
    by_hand = {JournalKind.FIT_REQUESTED: BY_HAND, JournalKind.DIAGNOSE: ASKED}
    return entry.kind != JournalKind.MISMATCH and entry.text == by_hand.get(entry.kind, entry.text)


def _held(entry: JournalEntry, what: str) -> dict[str, object]:
    """Return the JSON object of a journal entry."""
    try:
        held = json.loads(entry.text)
    except ValueError:
        held = None
    if not isinstance(held, dict):
        raise DataError(f"The journal's change of {what} cannot be read: '{entry.text[:200]}'.")
    return held
