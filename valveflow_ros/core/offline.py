"""Drive the engine without a plant: fits in place, or where a journal says."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from valveflow_ros.core.align import Aligned, Aligner
from valveflow_ros.core.events import Event, FitRequested, JournalEntry, JournalKind
from valveflow_ros.core.fit import FitTask, fit
from valveflow_ros.core.monitor import Monitor
from valveflow_ros.errors import DataError
from valveflow_ros.records import Readings, SampleTable

Progress = Callable[[float, str], None]
CLOCK_BACK = 'The clock went back; rows before that were let go.'


def _quiet(_share: float, _what: str) -> None:
    """Show no progress."""


@dataclass(frozen=True, slots=True)
class _Outcome:
    task: FitTask
    due_row: int | None


def outcome_of(monitor: Monitor, task: FitTask) -> list[Event]:
    """Compute a fit here and now, and hand it to the engine."""
    try:
        return monitor.adopt(task.request_ns, fit(task))
    except DataError as error:
        return monitor.refuse(task.request_ns, str(error))


def align_all(aligner: Aligner, readings: Readings) -> Iterator[Aligned]:
    """Yield all rows of a finished list of readings."""
    yield aligner.feed(readings)
    yield aligner.finish()


def feed_rows(monitor: Monitor, table: SampleTable) -> list[Event]:
    """Feed rows, computing every fit in place."""
    events: list[Event] = []
    done = 0
    while done < len(table):
        fed = monitor.feed(table.part(done, len(table)))
        done += fed.rows
        events += fed.events
        for event in fed.events:
            if isinstance(event, FitRequested):
                events += outcome_of(monitor, event.task)
    return events


def feed_aligned(monitor: Monitor, aligned: Aligned) -> list[Event]:
    """Feed rows with restarts of the clock among them, computing every fit in place."""
    events: list[Event] = []
    start = 0
    for reset in aligned.resets.tolist():
        events += feed_rows(monitor, aligned.table.part(start, reset))
        events += monitor.restart(CLOCK_BACK)
        start = reset
    return events + feed_rows(monitor, aligned.table.part(start, len(aligned.table)))


class JournalReplayer:
    """Feed rows and repeat a live run's decisions at the boundaries its journal names.

    Parameters
    ----------
    monitor : Monitor
        Fresh, with the settings of the live run.
    journal : sequence of JournalEntry
        In the order written. Requests the engine makes by itself come anew
        and are not repeated; outcomes, acknowledgements and requests by hand are.
    """

    def __init__(self, monitor: Monitor, journal: Sequence[JournalEntry]) -> None:
        self._monitor = monitor
        self._due = list(journal)
        self._tasks: dict[int, FitTask] = {}

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
            events += fed.events
            self._keep(fed.events)

    def _keep(self, events: list[Event]) -> None:
        for event in events:
            if isinstance(event, FitRequested):
                self._tasks[event.task.request_ns] = event.task
                self._strike(JournalKind.FIT_REQUESTED, event.task.request_ns)

    def _strike(self, kind: JournalKind, request_ns: int) -> None:
        """Take an entry off the list that the engine has made by itself."""
        for k, entry in enumerate(self._due):
            if entry.kind == kind and entry.request_ns == request_ns:
                del self._due[k]
                return

    def _repeat_due(self) -> list[Event]:
        events: list[Event] = []
        while self._due and self._due[0].rows <= self._monitor.rows:
            events += self._repeat(self._due.pop(0))
        return events

    def _repeat(self, entry: JournalEntry) -> list[Event]:
        monitor = self._monitor
        if entry.kind == JournalKind.FIT_REQUESTED:
            events = monitor.request_fit()
            self._tasks.update(
                (e.task.request_ns, e.task) for e in events if isinstance(e, FitRequested)
            )
            return events
        if entry.kind == JournalKind.FIT_ADOPTED:
            return monitor.adopt(entry.request_ns, fit(self._tasks.pop(entry.request_ns)))
        if entry.kind == JournalKind.FIT_REFUSED:
            self._tasks.pop(entry.request_ns, None)
            return monitor.refuse(entry.request_ns, entry.text)
        if entry.kind == JournalKind.ACKNOWLEDGE:
            return monitor.acknowledge()
        if entry.kind == JournalKind.RESET:
            return monitor.restart(entry.text)
        return []
