"""From a window of rows to a flow characteristic: a pure function of its input."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from valveflow_ros.config import Settings
from valveflow_ros.core.characteristic import (
    Characteristic,
    Choice,
    Piece,
    RegionDynamics,
    ResidualStatistics,
    Source,
)
from valveflow_ros.core.model import RegionalModel
from valveflow_ros.core.partition import Partition, partition
from valveflow_ros.core.problem import Samples
from valveflow_ros.core.refine import Refined, refine
from valveflow_ros.core.selection import Selection, select
from valveflow_ros.core.whitening import inflation
from valveflow_ros.core.window import WindowContents
from valveflow_ros.errors import DataError, TooFewSamplesError
from valveflow_ros.records import ByteArray, FloatArray, SegmentKind

_EXPLAINED_LEAST = 0.5  # share of the power's variance a curve must explain to be one
_REFINE_LEAST_ROWS = 3600  # scored rows below which the dynamics are not asked for
_Z95 = 1.959963984540054
_MAD_TO_SD = 1.4826022185056018

Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class FitTask:
    """Everything a fit depends on.

    Attributes
    ----------
    request_ns : int
        Time of the row after which the fit was asked for; its name.
    contents : WindowContents
    settings : Settings
    input_noise, power_noise_mw : float
        The segmenter's noise levels at that moment.
    """

    request_ns: int
    contents: WindowContents
    settings: Settings
    input_noise: float
    power_noise_mw: float


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
    selection = select(part, rule='paper', correlation_inflation=growth)
    chosen = tuple(
        Piece(p.u_from, p.u_to, p.slope, p.intercept, p.slope_stderr * math.sqrt(growth),
              p.intercept_stderr * math.sqrt(growth), p.samples)
        for p in part.pieces(selection.pieces)
    )  # fmt: skip
    _carries_a_curve(chosen, u, power)
    source = _source(task, rows)
    choice = Choice(
        selection.rule, dict(selection.cost), dict(selection.turning_angle), _note(selection)
    )
    static = Characteristic(
        pressure_exponent=settings.real('pressure_exponent'),
        pieces=chosen,
        breakpoint_intervals=_no_intervals(chosen),
        choice=choice,
        source=source,
        residuals=_static_residuals(task, chosen, rows),
        partition_pieces=chosen,
    )
    if not settings.flag('refine'):
        return static.with_id()
    return _refined(task, static, u, progress).with_id()


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


def _carries_a_curve(pieces: tuple[Piece, ...], u: FloatArray, power: FloatArray) -> None:
    """Refuse a relation so loose that a curve through it would mislead."""
    rest = power - _evaluate(pieces, u)
    total = float(np.var(power))
    explained = 1.0 - float(np.mean(rest**2)) / total if total > 0.0 else 0.0
    if explained < _EXPLAINED_LEAST:
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
    most = part.pieces(len(part.cost))
    pieces = tuple(
        Piece(p.u_from, p.u_to, p.slope, p.intercept, 0.0, 0.0, p.samples) for p in most
    )
    series: list[FloatArray] = []
    for a, b, _ in contents.spans:
        series += [contents.power_mw[a:b] - _evaluate(pieces, contents.u[a:b]), np.zeros(1)]
    weight = np.concatenate(
        [np.append(np.ones(b - a, dtype=np.uint8), np.uint8(0)) for a, b, _ in contents.spans]
    )
    residual = np.concatenate(series)
    lengths = contents.spans[:, 1] - contents.spans[:, 0]
    longest = int(min(300, max(1, np.median(lengths) // 2)))
    return inflation(residual, weight, longest)


def _note(selection: Selection) -> str:
    return str(selection.guard_reason)


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


def _static_residuals(
    task: FitTask, pieces: tuple[Piece, ...], rows: np.ndarray
) -> ResidualStatistics:
    """Calibrate on the special segments alone."""
    c = task.contents
    rest = c.power_mw[rows] - _evaluate(pieces, c.u[rows])
    weight = np.ones(len(rest), dtype=np.uint8)
    return _statistics(task, rest, weight, task.settings.real('sample_period'))


def _statistics(
    task: FitTask, residual: FloatArray, weight: ByteArray, step_s: float
) -> ResidualStatistics:
    """Return rmse, and the sd that the running mean of the alarm has on these residuals."""
    average_s = task.settings.real('alarm_average')
    keep = weight > 0
    rest = residual[keep]
    forget = math.exp(-step_s / average_s)
    run, mean = np.empty(len(rest)), 0.0
    for k, value in enumerate(rest):
        mean = forget * mean + (1.0 - forget) * value
        run[k] = mean
    settled = run[min(len(run) // 4, int(3.0 * average_s / step_s)) :]
    sd = _MAD_TO_SD * float(np.median(np.abs(settled - np.median(settled))))
    return ResidualStatistics(
        rmse_mw=float(np.sqrt(np.mean(rest**2))),
        average_sd_mw=max(sd, 1e-9),
        average_s=average_s,
        input_noise=task.input_noise,
        power_noise_mw=task.power_noise_mw,
    )


def _refined(
    task: FitTask, static: Characteristic, u_special: FloatArray, progress: Progress
) -> Characteristic:
    """Refine on all rows; where that is not possible the partition's curve stands, and says so."""
    c, settings = task.contents, task.settings
    usable = (np.isfinite(c.u) & np.isfinite(c.power_mw)).astype(np.uint8)
    step = settings.real('sample_period')
    # A jump in time is a gap even where no row stands in it.
    usable[1:][np.diff(c.time_ns) > 1.5e9 * step] = 0
    if int(usable.sum()) < _REFINE_LEAST_ROWS:
        return replace(static, notes=('Too few rows to estimate dynamics; curve not refined.',))
    progress('curve and dynamics together')
    samples = Samples(
        u=np.where(usable > 0, c.u, 0.0),
        power_mw=np.where(usable > 0, c.power_mw, 0.0),
        usable=usable,
        step_s=step,
        settle_s=settings.settle_s,
        group=max(1, round(settings.real('block') / step)),
    )
    by_paper = settings.text('selection_rule') == 'paper'
    most = None if by_paper else settings.whole('max_pieces')
    try:
        result = refine(samples, static.model, most)
    except np.linalg.LinAlgError:
        return replace(static, notes=('The dynamics could not be estimated; curve not refined.',))
    return _from_refined(task, static, result, samples, u_special)


def _from_refined(
    task: FitTask, static: Characteristic, result: Refined, samples: Samples, u: FloatArray
) -> Characteristic:
    """Put a refined model into the form of the result, with its uncertainties."""
    m = result.model
    slopes, intercepts = m.slopes(), m.intercepts()
    slope_se, intercept_se = _line_errors(m, result.covariance)
    knots = m.knots.copy()
    counts = np.histogram(u, bins=np.concatenate([[-np.inf], knots[1:-1], [np.inf]]))[0]
    pieces = tuple(
        Piece(float(knots[k]), float(knots[k + 1]), float(slopes[k]), float(intercepts[k]),
              float(slope_se[k]), float(intercept_se[k]), int(counts[k]))
        for k in range(m.pieces)
    )  # fmt: skip
    j = m.pieces
    knot_se = np.sqrt(np.diag(result.covariance))[j + 1 : 2 * j]
    intervals = tuple(
        (float(b - _Z95 * s), float(b + _Z95 * s))
        for b, s in zip(knots[1:-1], knot_se, strict=True)
    )
    edges = [float(m.left[0]), *m.levels.tolist(), float(m.right[-1])]
    error = np.sqrt(np.diag(result.covariance))[3 * j - 1 :]
    dynamics = tuple(
        RegionDynamics(
            edges[i], edges[i + 1], float(m.time_constants[i]), float(m.delays[i]),
            float(m.time_constants[i] * error[i]), float(error[m.regions + i]),
        )
        for i in range(m.regions)
    )  # fmt: skip
    choice = static.choice
    if task.settings.text('selection_rule') != 'paper':
        note = f"The paper's rule (24) takes J = {len(static.pieces)}."
        choice = replace(choice, rule='prediction_error', note=f'{note} {choice.note}'.strip())
    return replace(
        static,
        choice=choice,
        pieces=pieces,
        breakpoint_intervals=intervals,
        dynamics=dynamics,
        residuals=_statistics(
            task, result.residual_mw, result.weight, samples.step_s * samples.group
        ),
    )


def _line_errors(m: RegionalModel, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return standard errors of slopes and intercepts by the delta method."""
    packed = m.pack()
    size = len(packed)
    slope_of, intercept_of = np.empty((m.pieces, size)), np.empty((m.pieces, size))
    for p in range(size):
        h = 1e-6 * max(1.0, abs(packed[p]))
        up, down = packed.copy(), packed.copy()
        up[p] += h
        down[p] -= h
        high, low = m.unpack(up), m.unpack(down)
        slope_of[:, p] = (high.slopes() - low.slopes()) / (2.0 * h)
        intercept_of[:, p] = (high.intercepts() - low.intercepts()) / (2.0 * h)

    def errors(gradient: FloatArray) -> FloatArray:
        variance = np.einsum('ip,pq,iq->i', gradient, covariance, gradient)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    return errors(slope_of), errors(intercept_of)
