"""From a window of rows to a flow characteristic: a pure function of its input."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from valveflow_ros.core.characteristic import (
    Characteristic,
    Choice,
    Piece,
    ResidualStatistics,
    Source,
)
from valveflow_ros.core.fit_result import from_refined, residual_statistics
from valveflow_ros.core.fit_task import FitTask
from valveflow_ros.core.identifiability import NOT_REFINED, with_support
from valveflow_ros.core.partition import Partition, partition
from valveflow_ros.core.problem import Samples
from valveflow_ros.core.refine import refine
from valveflow_ros.core.selection import select
from valveflow_ros.core.selection_series import Series
from valveflow_ros.core.whitening import inflation
from valveflow_ros.core.window import WindowContents
from valveflow_ros.errors import DataError, TooFewSamplesError
from valveflow_ros.records import ByteArray, FloatArray, IntArray, SegmentKind

_EXPLAINED_LEAST = 0.5  # share of the power's variance a curve must explain to be one
_ONE_LEVEL_PERCENT = 2.0  # of opening: less than this is one load with its jitter
_LEAST_SPREAD = 10.0  # noise sd that the openings must spread over
_RICHER = 3  # pieces more than the paper's rule takes, before pruning


Progress = Callable[[str], None]


def fit(task: FitTask, progress: Progress = lambda _: None) -> Characteristic:
    """Fit the characteristic.

    Raises
    ------
    DataError
        The data do not carry a curve; the sentence says why and what would help.
    """
    settings, contents = task.settings, task.contents
    rows = contents.special_rows()
    _enough(task, len(rows))
    u, power = contents.u[rows], contents.power_mw[rows]
    progress('exact partition')
    least = max(2, math.ceil(settings.real('min_piece_share') * len(np.unique(u))))
    part = partition(u, power, settings.whole('max_pieces'), least)
    growth = _inflation(contents, part)
    selection = select(
        part,
        rule='evidence' if settings.text('selection_rule') == 'evidence' else 'paper',
        correlation_inflation=growth,
        series=Series.of_spans(contents.u, contents.power_mw, contents.spans),
    )
    _moved(task, u)
    _valve_moved(task, rows)
    chosen = _pieces_of(part, selection.pieces, growth)
    _carries_a_curve(task, rows, chosen)
    source = _source(task, rows)
    choice = Choice(
        selection.rule, dict(selection.cost), dict(selection.turning_angle), selection.note,
        dict(selection.confidence),
    )  # fmt: skip
    static = Characteristic(
        pressure_exponent=settings.real('pressure_exponent'),
        pieces=chosen,
        breakpoint_intervals=_no_intervals(chosen),
        choice=choice,
        source=source,
        residuals=_static_residuals(task, chosen),
        partition_pieces=chosen,
    )
    if not settings.flag('refine'):
        return with_support(static, contents, task.input_noise).with_id()
    refined = _refined(task, static, part, u, progress)
    return with_support(refined, contents, task.input_noise).with_id()


def _pieces_of(part: Partition, pieces: int, inflation: float = 1.0) -> tuple[Piece, ...]:
    """Return a partition's pieces, their errors widened for correlation in time."""
    wider = math.sqrt(inflation)
    return tuple(
        Piece(p.u_from, p.u_to, p.slope, p.intercept, p.slope_stderr * wider,
              p.intercept_stderr * wider, p.samples)
        for p in part.pieces(pieces)
    )  # fmt: skip


def _enough(task: FitTask, samples: int) -> None:
    """Refuse a window that cannot carry a fit, and say what would help."""
    c = task.contents
    usable = np.isfinite(c.u) & np.isfinite(c.power_mw)
    if not usable.any():
        raise DataError('There is no row with opening, pressure and power together.')
    if np.ptp(c.u[usable]) == 0.0:
        raise DataError(
            'The integrated input never changes: a curve needs the valve at several openings.'
        )
    need = task.settings.whole('min_fit_samples')
    if samples < need:
        raise TooFewSamplesError(
            'Samples in steady-state and slope-response segments', samples, need,
            'Longer data, or calmer operation at several loads, would help.',
        )  # fmt: skip


def _moved(task: FitTask, u: FloatArray) -> None:
    """Refuse samples that lie at one opening: their scatter has no slope to tell."""
    low, high = np.quantile(u, (0.01, 0.99))
    if high - low < _LEAST_SPREAD * task.input_noise:
        raise DataError(
            f'The unit stood at one opening: in the special segments u lies between {low:.4g} and '
            f'{high:.4g}, hardly more than its noise of {task.input_noise:.2g}. A curve needs '
            'several loads.'
        )


def _valve_moved(task: FitTask, rows: IntArray) -> None:
    """Refuse samples whose u was moved by the pressure alone.

    They may follow a curve well, since power follows the pressure; but it is no
    characteristic of the valve, and a dead transmitter gives the same.
    """
    if not len(task.contents.opening_percent):
        return
    opening, u = task.contents.opening_percent[rows], task.contents.u[rows]
    known = np.isfinite(opening)
    if not known.any() or not np.median(opening[known]) > 0.0:
        return
    low, high = np.quantile(opening[known], (0.01, 0.99))
    moved_u = (high - low) * float(np.median(u[known]) / np.median(opening[known]))
    if moved_u < _LEAST_SPREAD * task.input_noise:
        raise DataError(
            f'The valve did not move: in the special segments its opening lies between {low:.4g} '
            f'and {high:.4g} %, and u follows the pressure alone. Hours at several openings are '
            'needed; if the valve did move, the transmitter of its opening is dead.'
        )


def _carries_a_curve(task: FitTask, rows: IntArray, pieces: tuple[Piece, ...]) -> None:
    """Refuse a relation so loose that a curve through it would mislead."""
    u, power = task.contents.u[rows], task.contents.power_mw[rows]
    rest = power - _evaluate(pieces, u)
    total = float(np.var(power))
    explained = 1.0 - float(np.mean(rest**2)) / total if total > 0.0 else 0.0
    if explained >= _EXPLAINED_LEAST:
        return
    opening = task.contents.opening_percent[rows] if len(task.contents.opening_percent) else u[:0]
    known = opening[np.isfinite(opening)]
    if len(known) and np.ptp(np.quantile(known, (0.01, 0.99))) < _ONE_LEVEL_PERCENT:
        raise DataError(
            f'The unit stood at one opening, {np.median(known):.4g} %, in all special segments. '
            'A curve needs several loads: hours at other openings would help.'
        )
    raise DataError(
        f'The power hardly follows the valve: the best curve of {len(pieces)} '
        f'piece{"s" if len(pieces) > 1 else ""} explains {100.0 * explained:.0f} % of its '
        f'variance (at least {100.0 * _EXPLAINED_LEAST:.0f} % needed). An input that is not '
        'measured moves it, or a signal is mapped wrongly.'
    )


def _evaluate(pieces: tuple[Piece, ...], u: FloatArray) -> FloatArray:
    inner = np.array([p.u_to for p in pieces[:-1]])
    k = np.searchsorted(inner, u, side='right')
    slopes = np.array([p.slope for p in pieces])
    return np.asarray(slopes[k] * u + np.array([p.intercept for p in pieces])[k])


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
        series += [contents.power_mw[a:b] - _evaluate(pieces, contents.u[a:b]), np.zeros(1)]
        weights.append(np.append(np.ones(b - a, dtype=np.uint8), np.uint8(0)))
    return np.concatenate(series), np.concatenate(weights)


def _no_intervals(pieces: tuple[Piece, ...]) -> tuple[tuple[float, float], ...]:
    return tuple((math.nan, math.nan) for _ in pieces[1:])


def _source(task: FitTask, rows: np.ndarray) -> Source:
    """Describe the window, and watch the paper's condition of an unchanged temperature."""
    c = task.contents
    temperature = c.temperature_degc[rows]
    temperature = temperature[np.isfinite(temperature)]
    mean = spread = math.nan
    if len(temperature):
        low, high = np.quantile(temperature, (0.025, 0.975))
        mean, spread = float(temperature.mean()), float(high - low)
    return Source(
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


def _refined(
    task: FitTask,
    static: Characteristic,
    part: Partition,
    u_special: FloatArray,
    progress: Progress,
) -> Characteristic:
    """Refine on all rows; where that is not possible the partition's curve stands, and says so."""
    c, settings = task.contents, task.settings
    usable = (np.isfinite(c.u) & np.isfinite(c.power_mw)).astype(np.uint8)
    step = settings.real('sample_period')
    # A jump in time is a gap even where no row stands in it.
    usable[1:][np.diff(c.time_ns) > 1.5e9 * step] = 0
    progress('curve and dynamics together')
    samples = Samples(
        u=np.where(usable > 0, c.u, 0.0),
        power_mw=np.where(usable > 0, c.power_mw, 0.0),
        usable=usable,
        step_s=step,
        settle_s=settings.settle_s,
        group=max(1, round(settings.real('block') / step)),
    )
    most, start = None, static.model
    if settings.text('selection_rule') == 'prediction_error':
        most = settings.whole('max_pieces')
        start = replace(static, pieces=_rich(part, len(static.pieces))).model
    try:
        result = refine(samples, start, most)
    except (np.linalg.LinAlgError, TooFewSamplesError) as error:
        return _only_straight(task, static, part, str(error))
    return from_refined(task, static, result, samples, u_special)
