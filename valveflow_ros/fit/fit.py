"""From a window of rows to a flow characteristic: a pure function of its input."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from valveflow_ros.curve.characteristic import (
    Characteristic,
    Choice,
    FittedData,
    Piece,
    ResidualStatistics,
)
from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.errors import DataError, TooFewSamplesError
from valveflow_ros.fit.problem import Samples
from valveflow_ros.fit.refine import refine, search
from valveflow_ros.fit.result import NOT_REFINED, from_refined, residual_statistics, with_support
from valveflow_ros.fit.task import (
    FitTask,
    carries_a_curve,
    enough_samples,
    evaluate,
    input_moved,
    valve_moved,
)
from valveflow_ros.fit.whitening import inflation
from valveflow_ros.partition.paper_rule import select
from valveflow_ros.partition.partition import Partition, partition
from valveflow_ros.records import ByteArray, FloatArray, SegmentKind
from valveflow_ros.segments.window import WindowContents

_RICHER = 3  # pieces more than the paper's rule takes, before pruning


Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class _Begun:
    """The exact partition of the special segments, and the static curve taken from it."""

    static: Characteristic
    part: Partition
    u_special: FloatArray


def fit(task: FitTask, progress: Progress = lambda _: None) -> Characteristic:
    """Fit the characteristic.

    Raises
    ------
    DataError
        The data do not carry a curve; the sentence says why and what would help.
    """
    begun = _begin(task, progress)
    if not task.settings.flag('refine'):
        return with_support(begun.static, task.contents, task.input_noise).with_id()
    refined = _refined(task, begun, progress)
    return with_support(refined, task.contents, task.input_noise).with_id()


def outline(task: FitTask, progress: Progress = lambda _: None) -> RegionalModel:
    """Find curve and dynamics without the last fit on single rows and without errors.

    A start for those who fit everything themselves, in two thirds of the time of `fit`.

    Raises
    ------
    DataError
        The data do not carry a curve, or no dynamics; the sentence says why.
    """
    begun = _begin(task, progress)
    progress('curve and dynamics together')
    try:
        return search(_samples(task), *_refinement(task, begun))
    except np.linalg.LinAlgError as error:
        raise DataError(f'Curve and dynamics could not be found together: {error}.') from None


def _begin(task: FitTask, progress: Progress) -> _Begun:
    """Partition the special segments and choose the number of pieces."""
    settings, contents = task.settings, task.contents
    rows = contents.special_rows()
    enough_samples(task, len(rows))
    u, power = contents.u[rows], contents.power_mw[rows]
    progress('exact partition')
    least = max(2, math.ceil(settings.real('min_piece_share') * len(np.unique(u))))
    part = partition(u, power, settings.whole('max_pieces'), least)
    growth = _inflation(contents, part)
    selection = select(part, growth)
    input_moved(task, u)
    valve_moved(task, rows)
    chosen = _pieces_of(part, selection.pieces, growth)
    carries_a_curve(task, rows, chosen)
    choice = Choice('paper', selection.cost, selection.turning_angle, selection.note)
    static = Characteristic(
        pressure_exponent=settings.real('pressure_exponent'),
        pieces=chosen,
        breakpoint_intervals=_no_intervals(chosen),
        choice=choice,
        source=_source(task, rows),
        residuals=_static_residuals(task, chosen),
        partition_pieces=chosen,
        held=task.held,
    )
    return _Begun(static, part, u)


def _pieces_of(part: Partition, pieces: int, inflation: float = 1.0) -> tuple[Piece, ...]:
    """Return a partition's pieces, their errors widened for correlation in time."""
    wider = math.sqrt(inflation)
    return tuple(
        Piece(p.u_from, p.u_to, p.slope, p.intercept, p.slope_stderr * wider,
              p.intercept_stderr * wider, p.samples)
        for p in part.pieces(pieces)
    )  # fmt: skip


def _inflation(contents: WindowContents, part: Partition) -> float:
    """Return how much correlation in time widens the errors of this fit.

    Judged on the residual of the richest partition, so that a missing piece is
    not taken for correlation, within segments only.
    """
    residual, weight = _special_residual(contents, _pieces_of(part, len(part.cost)))
    lengths = contents.spans[:, 1] - contents.spans[:, 0]
    longest = int(min(300, max(1, np.median(lengths) // 2)))
    return inflation(residual, weight, longest)


def _special_residual(
    contents: WindowContents, pieces: tuple[Piece, ...]
) -> tuple[FloatArray, ByteArray]:
    """Return the residual of the segments one after the other, a row of weight 0 in between."""
    series: list[FloatArray] = []
    weights: list[ByteArray] = []
    for a, b, _ in contents.spans:
        series += [contents.power_mw[a:b] - evaluate(pieces, contents.u[a:b]), np.zeros(1)]
        weights.append(np.append(np.ones(b - a, dtype=np.uint8), np.uint8(0)))
    return np.concatenate(series), np.concatenate(weights)


def _no_intervals(pieces: tuple[Piece, ...]) -> tuple[tuple[float, float], ...]:
    return tuple((math.nan, math.nan) for _ in pieces[1:])


def _source(task: FitTask, rows: np.ndarray) -> FittedData:
    """Describe the window, and watch the paper's condition of an unchanged temperature."""
    c = task.contents
    temperature = c.temperature_degc[rows]
    temperature = temperature[np.isfinite(temperature)]
    mean = spread = math.nan
    if len(temperature):
        low, high = np.quantile(temperature, (0.025, 0.975))
        mean, spread = float(temperature.mean()), float(high - low)
    return FittedData(
        window_start_ns=int(c.time_ns[0]),
        window_end_ns=int(c.time_ns[-1]),
        steady=c.count(SegmentKind.STEADY),
        slope_response=c.count(SegmentKind.SLOPE),
        samples=len(rows),
        temperature_mean_degc=mean,
        temperature_spread_k=spread,
        temperature_flag=bool(spread > task.settings.real('temperature_spread_limit')),
    )


def _static_residuals(task: FitTask, pieces: tuple[Piece, ...]) -> ResidualStatistics:
    """Calibrate on the special segments alone."""
    rest, weight = _special_residual(task.contents, pieces)
    rows = rest[weight > 0]
    # A static curve has no error of its own that is known here: that of its mean is the least.
    sd = float(np.std(rows))
    return residual_statistics(
        task, rest, weight, task.settings.real('sample_period'), sd, sd / math.sqrt(len(rows))
    )


def _only_straight(
    task: FitTask, static: Characteristic, part: Partition, why: str
) -> Characteristic:
    """Return one straight piece where the dynamics could not be estimated.

    Few samples lie in a few clusters, and each cluster's own slope is mostly noise
    of the valve: pieces of their own would run far off between the clusters.
    """
    notes = (f'{NOT_REFINED}one straight piece, without dynamics. {why}',)
    pieces = _pieces_of(part, 1, _inflation(task.contents, part))
    return replace(
        static,
        pieces=pieces,
        choice=replace(static.choice, confidence={}),
        breakpoint_intervals=(),
        residuals=_static_residuals(task, pieces),
        notes=notes,
    )


def _rich(part: Partition, pieces: int) -> tuple[Piece, ...]:
    """Return the exact partition with some pieces more than chosen, to be pruned."""
    return _pieces_of(part, min(len(part.cost), pieces + _RICHER))


def _samples(task: FitTask) -> Samples:
    """Return all rows of the window."""
    c, step = task.contents, task.settings.real('sample_period')
    usable = (np.isfinite(c.u) & np.isfinite(c.power_mw)).astype(np.uint8)
    # A jump in time is a gap even where no row stands in it.
    usable[1:][np.diff(c.time_ns) > 1.5e9 * step] = 0
    return Samples(
        u=np.where(usable > 0, c.u, 0.0),
        power_mw=np.where(usable > 0, c.power_mw, 0.0),
        usable=usable,
        step_s=step,
        settle_s=task.settings.settle_s,
        group=max(1, round(task.settings.real('block') / step)),
    )


def _refinement(task: FitTask, begun: _Begun) -> tuple[RegionalModel, int | None]:
    """Return the curve to begin with, and how many pieces it may get (None: those it has)."""
    static = begun.static
    if task.settings.text('selection_rule') != 'prediction_error':
        return static.model, None
    rich = replace(static, pieces=_rich(begun.part, len(static.pieces)))
    return rich.model, task.settings.whole('max_pieces')


def _refined(task: FitTask, begun: _Begun, progress: Progress) -> Characteristic:
    """Refine on all rows; where that is not possible the partition's curve stands, and says so."""
    progress('curve and dynamics together')
    samples = _samples(task)
    try:
        result = refine(samples, *_refinement(task, begun))
    except (np.linalg.LinAlgError, TooFewSamplesError) as error:
        return _only_straight(task, begun.static, begun.part, str(error))
    return from_refined(task, begun.static, result, samples, begun.u_special)
