"""Run everything once on made-up rows, so that no sample of the plant waits for a compiler."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from valveflow_ros.curve.characteristic import (
    Characteristic,
    Choice,
    Piece,
    RegionDynamics,
    ResidualStatistics,
    Source,
)
from valveflow_ros.fit.residual_chart import ChartDesign
from valveflow_ros.fit.task import FitTask
from valveflow_ros.monitoring.alarms import ResidualAlarm
from valveflow_ros.monitoring.mismatch import Mismatch
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.prediction import Predictor
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S, SampleTable, SegmentKind, Signal, table_to_readings
from valveflow_ros.report.first_run import must_compile_to_fit
from valveflow_ros.ros.worker.worker import FitWorker
from valveflow_ros.segments.window import WindowContents
from valveflow_ros.signals.align import Aligner

_LONGEST_S = 300.0
_ROWS = 6000
_STRETCH = 600
_FEW = 32
_PRESSURE_MPA = 16.0


def made_up_task(settings: Settings) -> FitTask:
    """Return a small fit: a plant that stands and moves in turn, on a curve with one knee."""
    period_s = settings.real('sample_period')
    row = np.arange(_ROWS)
    stretch = row // _STRETCH
    # Even stretches stand still, odd ones go up to the next level.
    moved = (stretch + 1) // 2 + np.where(stretch % 2, row % _STRETCH, 0) / _STRETCH
    level = 900.0 + 150.0 * moved
    chance = np.random.default_rng(1)
    u = level + 0.5 * chance.standard_normal(_ROWS)
    power = 0.2 * level - 0.1 * np.maximum(level - 1200.0, 0.0) + chance.standard_normal(_ROWS)
    steady = np.arange(0, _ROWS, 2 * _STRETCH)
    spans = np.column_stack([steady, steady + _STRETCH, np.full(len(steady), SegmentKind.STEADY)])
    time_ns = (row * round(period_s * NS_PER_S)).astype(np.int64)
    contents = WindowContents(time_ns, u, power, np.full(_ROWS, 540.0), spans.astype(np.int64))
    return FitTask(0, contents, settings.changed({'min_fit_samples': 10}), 0.5, 1.0)


def made_up_curve(settings: Settings) -> Characteristic:
    """Return the curve of that plant, with dynamics."""
    pieces = (
        Piece(900.0, 1200.0, 0.2, 0.0, 0.0, 0.0, 1),
        Piece(1200.0, 1650.0, 0.1, 120.0, 0.0, 0.0, 1),
    )
    return Characteristic(
        pressure_exponent=settings.real('pressure_exponent'),
        pieces=pieces,
        breakpoint_intervals=((1190.0, 1210.0),),
        choice=Choice('', {}, {}),
        source=Source(0, 0, 0, 0, 0, 540.0, 0.0, False),
        residuals=ResidualStatistics(
            1.0,
            1.0,
            settings.real('alarm_average'),
            0.5,
            1.0,
            2.0,
            ChartDesign(settings.real('alarm_block'), 0.5, 1.0, (0.25, 1.0), (17.0, 5.0), 30.0),
        ),
        dynamics=(RegionDynamics(180.0, 285.0, 30.0, 5.0, 1.0, 1.0),),
    )


def warm_up(settings: Settings, worker: FitWorker, stop: Callable[[], bool], wait: bool) -> None:
    """Compile, or load what was compiled before.

    The worker does its share meanwhile. If it fails, that shows at the first
    real fit, with a sentence; nothing is lost by going on.

    Parameters
    ----------
    settings : Settings
    worker : FitWorker
    stop : callable
        Tells whether to give up waiting.
    wait : bool
        Wait for the worker too, if it has to compile: without a curve nothing can be said before
        its first fit. Who has a curve goes on at once.
    """
    wait = wait and must_compile_to_fit()
    begun = time.monotonic()
    task = made_up_task(settings)
    worker.rehearse(task)
    c = task.contents
    table = SampleTable.from_columns(
        c.time_ns[:_FEW] + NS_PER_S,
        {
            Signal.VALVE_OPENING: c.u[:_FEW] / _PRESSURE_MPA,
            Signal.MAIN_STEAM_PRESSURE: np.full(_FEW, _PRESSURE_MPA),
            Signal.MAIN_STEAM_TEMPERATURE: c.temperature_degc[:_FEW],
            Signal.GENERATED_POWER: c.power_mw[:_FEW],
        },
    )
    aligner = Aligner(settings)
    Monitor(settings).feed(aligner.feed(table_to_readings(table)).table)
    _predict(settings, made_up_curve(settings), c)
    while wait and worker.rehearsing and not stop() and time.monotonic() - begun < _LONGEST_S:
        time.sleep(0.02)
        worker.poll()


def _predict(settings: Settings, curve: Characteristic, c: WindowContents) -> None:
    """Let a throw-away curve predict a few rows, and a throw-away alarm judge them."""
    predictor = Predictor(
        curve, settings.real('sample_period'), settings.settle_s, settings.real('alarm_average')
    )
    few = slice(0, _FEW)
    kinds = np.ones(_FEW, dtype=np.uint8)
    block = predictor.predict(c.time_ns[few], c.u[few], c.power_mw[few], kinds)
    watch = Mismatch(settings.real('sample_period'))
    watch.feed(block, c.temperature_degc[few], curve.model)
    ResidualAlarm(settings).feed(block.time_ns, block.evidence, block.shift_mw, curve.model_id)
