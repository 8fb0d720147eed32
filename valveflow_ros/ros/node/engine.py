# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The live engine: processes readings on arrival; fits and diagnoses run in other processes."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from valveflow_ros.curve.characteristic import (
    Characteristic,
    Choice,
    FittedData,
    Piece,
    RegionDynamics,
    ResidualStatistics,
)
from valveflow_ros.fit.residual_chart import ChartDesign
from valveflow_ros.fit.task import FitTask
from valveflow_ros.monitoring.alarms import ResidualAlarm
from valveflow_ros.monitoring.events import (
    DiagnosisContent,
    DiagnosisRequested,
    Event,
    FitRequested,
)
from valveflow_ros.monitoring.mismatch import Mismatch
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.offline import CLOCK_BACK
from valveflow_ros.monitoring.prediction import Predictor
from valveflow_ros.monitoring.rows import Corrector
from valveflow_ros.parameters import Settings
from valveflow_ros.records import (
    NS_PER_S,
    Readings,
    SampleTable,
    SegmentKind,
    Signal,
    table_to_readings,
)
from valveflow_ros.report.first_run import must_compile_to_fit
from valveflow_ros.ros.decoding import Row
from valveflow_ros.ros.node.worker import FitWorker, Worker
from valveflow_ros.segments.window import WindowContents
from valveflow_ros.signals.align import Aligner
from valveflow_ros.signals.covariates import entries_of
from valveflow_ros.state import State


class LiveEngine:
    """Turns readings into events; each call processes complete rows.

    Without a ``diagnosis_worker``, diagnoses are requested but never finished. The ``corrector``
    corrects the rows for known causes. `last_fit_s` and `last_diagnosis_s` are the durations of
    the last ones in s, None before the first.
    """

    def __init__(
        self,
        settings: Settings,
        fit_worker: Worker,
        diagnosis_worker: Worker | None = None,
        corrector: Corrector | None = None,
    ) -> None:
        covariates = entries_of(settings)
        self.aligner = Aligner(settings, covariates)
        self.monitor = Monitor(settings, corrector, covariates)
        self.last_fit_s: float | None = None
        self.last_diagnosis_s: float | None = None
        self._fit_worker = fit_worker
        self._diagnosis_worker = diagnosis_worker

    def feed(self, rows: list[Row]) -> list[Event]:
        """Process readings in their order of arrival; return the events."""
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
        """Adopt or refuse the finished results of the workers; return the events."""
        events: list[Event] = []
        for outcome in self._fit_worker.poll():
            self.last_fit_s = outcome.seconds
            if isinstance(outcome.result, Characteristic):
                events += self.monitor.adopt(outcome.request_ns, outcome.result)
            else:
                events += self.monitor.refuse(outcome.request_ns, str(outcome.result))
        for outcome in self._diagnosis_worker.poll() if self._diagnosis_worker else ():
            self.last_diagnosis_s = outcome.seconds
            if isinstance(outcome.result, DiagnosisContent):
                events += self.monitor.diagnosing.adopt(outcome.request_ns, outcome.result.text)
            else:
                events += self.monitor.diagnosing.refuse(outcome.request_ns, str(outcome.result))
        return events

    def request_diagnosis(self) -> list[Event]:
        """Request a diagnosis now; raises `DataError` if that is not possible."""
        self.monitor.check_clock()
        return self._submit(self.monitor.request_diagnosis())

    def request_fit(self) -> list[Event]:
        """Request a fit now; raises `DataError` if that is not possible."""
        self.monitor.check_clock()
        return self._submit(self.monitor.request_fit())

    def snapshot(self) -> State:
        """Return the state to save; see `valveflow_ros.state`."""
        return {'aligner': self.aligner.snapshot(), 'monitor': self.monitor.snapshot()}

    def restore(self, saved: State) -> None:
        """Continue from a snapshot; raises `DataError` if it does not fit."""
        self.aligner.restore(saved['aligner'])
        self.monitor.restore(saved['monitor'])

    def carry(self, saved: State, then: Settings) -> tuple[str, list[Event]]:
        """Continue from a snapshot with other settings; see `Monitor.carry`.

        Readings that were not yet part of a row are dropped.
        """
        return self.monitor.carry(saved['monitor'], then)

    def _feed_rows(self, table: SampleTable) -> list[Event]:
        events: list[Event] = []
        done = 0
        while done < len(table):
            fed = self.monitor.feed(table.part(done, len(table)))
            done += fed.rows
            events += self._submit(fed.events)
        return events

    def _submit(self, events: list[Event]) -> list[Event]:
        for event in events:
            if isinstance(event, FitRequested):
                self._fit_worker.submit(event.task)
            elif isinstance(event, DiagnosisRequested) and self._diagnosis_worker:
                self._diagnosis_worker.submit(event.task)
        return events


# Warm-up: run everything once on example rows, so that no sample waits for compilation.

_LONGEST_S = 300.0
_ROWS = 6000
_STRETCH = 600
_FEW = 32
_PRESSURE_MPA = 16.0


def example_task(settings: Settings) -> FitTask:
    """Return a small fit task: steady segments and ramps in turn, on a curve with a breakpoint."""
    row = np.arange(_ROWS)
    stretch = row // _STRETCH
    # Even segments are steady, odd ones are ramps up to the next level.
    moved = (stretch + 1) // 2 + np.where(stretch % 2, row % _STRETCH, 0) / _STRETCH
    level = 900.0 + 150.0 * moved
    chance = np.random.default_rng(1)
    u = level + 0.5 * chance.standard_normal(_ROWS)
    power = 0.2 * level - 0.1 * np.maximum(level - 1200.0, 0.0) + chance.standard_normal(_ROWS)
    steady = np.arange(0, _ROWS, 2 * _STRETCH)
    spans = np.column_stack([steady, steady + _STRETCH, np.full(len(steady), SegmentKind.STEADY)])
    time_ns = (row * round(settings.real('sample_period') * NS_PER_S)).astype(np.int64)
    contents = WindowContents(time_ns, u, power, np.full(_ROWS, 540.0), spans.astype(np.int64))
    return FitTask(0, contents, settings.changed({'min_fit_samples': 10}), 0.5, 1.0)


def example_curve(settings: Settings) -> Characteristic:
    """Return the curve of the plant in `example_task`, with dynamics."""
    chart = ChartDesign(settings.real('alarm_block'), 0.5, 1.0, (0.25, 1.0), (17.0, 5.0), 30.0)
    average_s = settings.real('alarm_average')
    return Characteristic(
        pressure_exponent=settings.real('pressure_exponent'),
        pieces=(
            Piece(900.0, 1200.0, 0.2, 0.0, 0.0, 0.0, 1),
            Piece(1200.0, 1650.0, 0.1, 120.0, 0.0, 0.0, 1),
        ),
        breakpoint_intervals=((1190.0, 1210.0),),
        choice=Choice('', {}, {}),
        source=FittedData(0, 0, 0, 0, 0, 540.0, 0.0, False),
        residuals=ResidualStatistics(1.0, 1.0, average_s, 0.5, 1.0, 2.0, chart),
        dynamics=(RegionDynamics(180.0, 285.0, 30.0, 5.0, 1.0, 1.0),),
    )


def warm_up(settings: Settings, worker: FitWorker, stop: Callable[[], bool], wait: bool) -> None:
    """Compile all functions, or load them from the cache.

    The worker does the same in its process. If it fails, the monitor continues, and the first
    real fit reports the failure.

    With ``wait``, wait for the worker, too, if it has to compile, unless ``stop`` returns True. A
    monitor without a curve waits, because it cannot predict before its first fit; one with a
    curve does not.
    """
    wait = wait and must_compile_to_fit()
    begun_s = time.monotonic()
    task = example_task(settings)
    worker.warm_up(task)
    c, few = task.contents, slice(0, _FEW)
    table = SampleTable.from_columns(
        c.time_ns[few] + NS_PER_S,
        {
            Signal.VALVE_OPENING: c.u[few] / _PRESSURE_MPA,
            Signal.MAIN_STEAM_PRESSURE: np.full(_FEW, _PRESSURE_MPA),
            Signal.MAIN_STEAM_TEMPERATURE: c.temperature_degc[few],
            Signal.GENERATED_POWER: c.power_mw[few],
        },
    )
    Monitor(settings).feed(Aligner(settings).feed(table_to_readings(table)).table)
    curve, period_s = example_curve(settings), settings.real('sample_period')
    predictor = Predictor(curve, period_s, settings.settle_s, settings.real('alarm_average'))
    kinds = np.ones(_FEW, dtype=np.uint8)
    block = predictor.predict(c.time_ns[few], c.u[few], c.power_mw[few], kinds)
    Mismatch(period_s).feed(block, c.temperature_degc[few], curve.model)
    ResidualAlarm(settings).feed(block.time_ns, block.evidence, block.shift_mw, curve.model_id)
    while wait and worker.warming_up and not stop() and time.monotonic() - begun_s < _LONGEST_S:
        time.sleep(0.02)
        worker.poll()
