"""The engine as the node runs it: rows as they come, long work elsewhere. Nothing knows ROS."""

from __future__ import annotations

from typing import Any, Protocol

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.monitoring.events import (
    DiagnosisContent,
    DiagnosisRequested,
    Event,
    FitRequested,
)
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.offline import CLOCK_BACK
from valveflow_ros.monitoring.rows import Corrector
from valveflow_ros.parameters import Settings
from valveflow_ros.records import Readings, SampleTable
from valveflow_ros.ros.inputs import Row
from valveflow_ros.ros.worker.worker import Outcome
from valveflow_ros.signals.align import Aligner
from valveflow_ros.state import State


class Worker(Protocol):
    """Whoever computes fits or diagnoses."""

    def submit(self, task: Any) -> None:
        """Take a task; its outcome comes with a later `poll`."""

    def poll(self) -> list[Outcome]:
        """Return the outcomes there are, without waiting."""


class LiveEngine:
    """Readings in, events out; each call ends at a row's boundary.

    Parameters
    ----------
    settings : Settings
    worker : Worker
        For fits.
    diagnosis_worker : Worker, optional
        For diagnoses; without one none is ever finished.
    corrector : Corrector, optional
        Takes known causes out of the rows.
    """

    def __init__(
        self,
        settings: Settings,
        worker: Worker,
        diagnosis_worker: Worker | None = None,
        corrector: Corrector | None = None,
    ) -> None:
        self.aligner = Aligner(settings)
        self.monitor = Monitor(settings, corrector)
        self.last_fit_s: float | None = None
        self.last_diagnosis_s: float | None = None
        self._worker = worker
        self._diagnosis_worker = diagnosis_worker

    def feed(self, rows: list[Row]) -> list[Event]:
        """Take readings in their order of arrival."""
        if not rows:
            return []
        aligned = self.aligner.feed(Readings.of(rows))
        events: list[Event] = []
        start = 0
        for reset in aligned.resets.tolist():
            events += self._feed_rows(aligned.table.part(start, reset))
            events += self.monitor.restart(CLOCK_BACK)
            start = reset
        return events + self._feed_rows(aligned.table.part(start, len(aligned.table)))

    def poll(self) -> list[Event]:
        """Adopt or refuse what the worker has finished."""
        events: list[Event] = []
        for outcome in self._worker.poll():
            self.last_fit_s = outcome.seconds
            if isinstance(outcome.result, Characteristic):
                events += self.monitor.adopt(outcome.request_ns, outcome.result)
            else:
                events += self.monitor.refuse(outcome.request_ns, str(outcome.result))
        return events + self._poll_diagnosis()

    def _poll_diagnosis(self) -> list[Event]:
        events: list[Event] = []
        diagnosing = self.monitor.diagnosing
        for outcome in self._diagnosis_worker.poll() if self._diagnosis_worker else ():
            self.last_diagnosis_s = outcome.seconds
            if isinstance(outcome.result, DiagnosisContent):
                events += diagnosing.adopt(outcome.request_ns, outcome.result.text)
            else:
                events += diagnosing.refuse(outcome.request_ns, str(outcome.result))
        return events

    def request_diagnosis(self) -> list[Event]:
        """Ask for a diagnosis now; raises `DataError` where that makes no sense."""
        self.monitor.check_clock()
        return self._pass_on(self.monitor.request_diagnosis())

    def request_fit(self) -> list[Event]:
        """Ask for a fit now; raises `DataError` where that makes no sense."""
        self.monitor.check_clock()
        return self._pass_on(self.monitor.request_fit())

    def acknowledge(self) -> list[Event]:
        """Acknowledge the alarms; raises `DataError` if there is none."""
        return self.monitor.acknowledge()

    def shelve(self) -> list[Event]:
        """Put the alarms that stand aside for a time; raises `DataError` if there is none."""
        return self.monitor.shelve()

    def unshelve(self) -> list[Event]:
        """Take the alarms from the shelf; raises `DataError` if none is there."""
        return self.monitor.unshelve()

    def set_reference(self, given: Characteristic | None = None) -> list[Event]:
        """Judge later curves against the running one, or one given; raises `DataError`."""
        return self.monitor.set_reference(given)

    def reconfigure(self, settings: Settings) -> list[Event]:
        """Take settings of which only live ones differ."""
        return self.monitor.reconfigure(settings)

    def snapshot(self) -> State:
        """Return what is remembered."""
        return {'aligner': self.aligner.snapshot(), 'monitor': self.monitor.snapshot()}

    def restore(self, saved: State) -> None:
        """Go on from a snapshot; raises `DataError` if it does not fit."""
        self.aligner.restore(saved['aligner'])
        self.monitor.restore(saved['monitor'])

    def _feed_rows(self, table: SampleTable) -> list[Event]:
        events: list[Event] = []
        done = 0
        while done < len(table):
            fed = self.monitor.feed(table.part(done, len(table)))
            done += fed.rows
            events += self._pass_on(fed.events)
        return events

    def _pass_on(self, events: list[Event]) -> list[Event]:
        for event in events:
            if isinstance(event, FitRequested):
                self._worker.submit(event.task)
            elif isinstance(event, DiagnosisRequested) and self._diagnosis_worker:
                self._diagnosis_worker.submit(event.task)
        return events
