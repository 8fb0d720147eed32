# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Fit a flow characteristic to a window of rows: a pure function of its input."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from valveflow_ros.curve.characteristic import (
    Characteristic,
    Choice,
    FittedData,
    FormEvidence,
    Piece,
    ResidualStatistics,
)
from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.errors import DataError, TooFewSamplesError
from valveflow_ros.fit.model_form import FoundForm, find_form
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
from valveflow_ros.records import ByteArray, FloatArray, IntArray, SegmentKind
from valveflow_ros.segments.window import WindowContents
from valveflow_ros.signals.static_form import INTEGRATED_INPUT, StaticForm, pressure_of

_RICHER = 3  # additional pieces beyond the paper's rule, before pruning


Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class _Formed:
    """A task whose ``contents.u`` is the argument of the curve, and the other parts of the form.

    ``scale`` (n,) is p^e; without it the power is F(u). ``pressure`` (n,) is p in MPa.
    ``held``: the exponent of the pressure is kept fixed.
    """

    task: FitTask
    form: StaticForm
    offset_mw: float = 0.0
    scale: FloatArray | None = None
    evidence: FormEvidence | None = None
    pressure: FloatArray | None = None
    held: bool = False

    @property
    def exponents(self) -> tuple[float | None, float | None]:
        """Return the exponent if it may be fitted, and the one kept unless data exclude it."""
        usual = None if self.form.scaled else self.task.settings.real('pressure_exponent')
        return None if self.held else self.form.exponent, usual

    @property
    def contents(self) -> WindowContents:
        """Return the rows."""
        return self.task.contents

    def scales(self, rows: IntArray | slice) -> FloatArray | float:
        """Return p^e of rows."""
        return 1.0 if self.scale is None else self.scale[rows]

    def static(self, pieces: tuple[Piece, ...], rows: IntArray | slice) -> FloatArray:
        """Return the power of a curve at rows, MW."""
        return self.scales(rows) * evaluate(pieces, self.contents.u[rows]) + self.offset_mw


# The residuals of the static curve are computed only if it is the result: that takes as long as a
# tenth of a fit.
_UNJUDGED = ResidualStatistics(math.nan, math.nan, math.nan, math.nan, math.nan)


@dataclass(frozen=True, slots=True)
class _Begun:
    """The exact partition of the special segments, and its static curve without residuals."""

    formed: _Formed
    static: Characteristic
    part: Partition
    u_special: FloatArray


def fit(task: FitTask, progress: Progress = lambda _: None) -> Characteristic:
    """Fit the characteristic.

    Raises `DataError` if the data determine no curve; the message says why and what would help.
    """
    begun = _begin(task, progress)
    if task.settings.flag('refine'):
        found, contents = _refined(task, begun, progress)
    else:
        found, contents = _judged(begun), begun.formed.contents
    found = with_support(found, contents, begun.formed.task.input_noise)
    return found.measured_in(task.settings.output_unit)


def form_of_data(task: FitTask) -> StaticForm:
    """Return the form that the rows of a task require; the paper's if they do not decide."""
    try:
        return _formed(task).form
    except DataError:
        return StaticForm(exponent=task.settings.real('pressure_exponent'))


def form_contradicted(task: FitTask, given: StaticForm) -> bool:
    """Return True if the rows of a task show that the static power has another form."""
    found = _formed(replace(task, form=given)).evidence
    return found is not None and found.contradicted


def outline(
    task: FitTask, progress: Progress = lambda _: None
) -> tuple[RegionalModel, StaticForm]:
    """Find curve and dynamics without the last fit on single rows and without errors.

    This is a start for a caller with a fit of its own, in two thirds of the time of `fit`. The
    form is that of the task, or the one that the data require. Raises `DataError` if the data
    determine no curve or no dynamics; the message says why.
    """
    begun = _begin(task, progress)
    progress('curve and dynamics together')
    try:
        formed = begun.formed
        model, moved = search(_samples(formed), *_refinement(begun), *formed.exponents)
        return model, replace(formed.form, exponent=formed.form.exponent + moved)
    except np.linalg.LinAlgError as error:
        raise DataError(f'Curve and dynamics could not be found together: {error}.') from None


def _begin(task: FitTask, progress: Progress) -> _Begun:
    """Partition the special segments and choose the number of pieces."""
    settings = task.settings
    rows = task.contents.special_rows()
    enough_samples(task, len(rows))
    valve_moved(task, rows[np.isfinite(task.contents.u[rows])])
    progress('exact partition')
    formed = _formed(task)
    contents = formed.contents
    rows = rows[np.isfinite(contents.u[rows])]
    u, scale = contents.u[rows], formed.scales(rows)
    input_moved(formed.task, u)
    least = max(2, math.ceil(settings.real('min_piece_share') * len(np.unique(u))))
    part = partition(
        u, (contents.power_mw[rows] - formed.offset_mw) / scale, settings.whole('max_pieces'),
        least, weight=None if formed.scale is None else np.asarray(scale**2),
    )  # fmt: skip
    growth = _inflation(formed, part)
    selection = select(part, growth)
    chosen = _pieces_of(part, selection.pieces, growth)
    carries_a_curve(formed.task, rows, len(chosen), formed.static(chosen, rows))
    choice = Choice('paper', selection.cost, selection.turning_angle, selection.note)
    static = Characteristic(
        pressure_exponent=formed.form.input_exponent,
        pieces=chosen,
        breakpoint_intervals=_no_intervals(chosen),
        choice=choice,
        source=_source(task, rows),
        residuals=_UNJUDGED,
        partition_pieces=chosen,
        held=task.held,
        axis=formed.form.axis,
        pressure_scale_exponent=formed.form.scale_exponent,
        offset_mw=formed.offset_mw,
        reference_pressure_mpa=_pressure(task, rows),
        form=formed.evidence,
    )
    return _Begun(formed, static, part, u)


def _formed(task: FitTask) -> _Formed:
    """Choose the form, unless the task or a parameter gives it, and convert the rows to it."""
    contents, exponent = task.contents, task.settings.real('pressure_exponent')
    paper = _Formed(task, StaticForm(INTEGRATED_INPUT, exponent), held=True)
    if not len(contents.opening_percent):
        return paper
    pressure = pressure_of(contents.u, contents.opening_percent, exponent)
    rows = contents.opening_percent, pressure, contents.power_mw
    period, axis = task.settings.real('sample_period'), task.settings.text('axis')
    special = contents.spans[:, :2]
    found = find_form(*rows, special, period, exponent, axis, task.form, task.known)
    if found is None:
        return paper
    free = axis == 'auto' and task.form is None and task.known is None
    if free:
        found = _found_in_all_rows(found, contents, pressure, period, exponent)
    u, scale = found.form.of_rows(contents.opening_percent, pressure)
    if found.form == paper.form:
        return replace(paper, evidence=found.evidence, pressure=pressure, held=found.exponent_held)
    # The noise of u must be in the unit of the axis.
    at = contents.special_rows()
    with np.errstate(invalid='ignore', divide='ignore'):
        ratio = float(np.nanmedian(u[at] / contents.u[at]))
    formed = replace(
        task, contents=replace(contents, u=u), input_noise=task.input_noise * abs(ratio)
    )
    return _Formed(
        formed,
        found.form,
        found.offset_mw,
        scale,
        found.evidence,
        pressure,
        found.exponent_held,
    )


def _found_in_all_rows(
    found: FoundForm,
    contents: WindowContents,
    pressure: FloatArray,
    period_s: float,
    exponent: float,
) -> FoundForm:
    """Return the form that all rows require if it is not the one found in special segments.

    Special segments may be too few in the part of the range where the forms differ. Means over
    a minute of all rows carry some dynamics too, which are alike in both forms: they are used to
    choose the form, but neither for the exponent of the paper's form nor for c.
    """
    rows = contents.opening_percent, pressure, contents.power_mw
    breaks = np.flatnonzero(np.diff(contents.time_ns) > 1.5e9 * period_s) + 1
    stretches = np.column_stack([np.append(0, breaks), np.append(breaks, len(pressure))])
    decided = find_form(*rows, stretches, period_s, exponent)
    if decided is None or decided.evidence is None:
        return found
    same = decided.form.axis == found.form.axis
    known = found.evidence is not None and found.evidence.told
    # If neither is sure, the form over V is taken that all rows make likelier.
    if known and (same or not decided.evidence.told):
        return found
    if not decided.evidence.told and (same or not decided.form.scaled):
        return found
    form = decided.form if decided.form.scaled else StaticForm(INTEGRATED_INPUT, exponent)
    held = find_form(*rows, contents.spans[:, :2], period_s, exponent, held=form)
    assert held is not None  # a form that is given always has an answer
    return replace(held, evidence=decided.evidence, exponent_held=decided.exponent_held)


def _pressure(task: FitTask, rows: IntArray) -> float:
    """Return the median pressure of rows, NaN if unknown."""
    if not len(task.contents.opening_percent):
        return math.nan
    c = task.contents
    exponent = task.settings.real('pressure_exponent')
    known = pressure_of(c.u[rows], c.opening_percent[rows], exponent)
    known = known[np.isfinite(known)]
    return float(np.median(known)) if len(known) else math.nan


def _pieces_of(part: Partition, pieces: int, inflation: float = 1.0) -> tuple[Piece, ...]:
    """Return a partition's pieces; their errors are widened for correlation in time."""
    wider = math.sqrt(inflation)
    return tuple(
        Piece(p.u_from, p.u_to, p.slope, p.intercept, p.slope_stderr * wider,
              p.intercept_stderr * wider, p.samples)
        for p in part.pieces(pieces)
    )  # fmt: skip


def _inflation(formed: _Formed, part: Partition) -> float:
    """Return the factor by which correlation in time increases the variances of this fit.

    It is estimated within segments from the residual of the partition with the most
    pieces, so that a missing piece is not taken for correlation.
    """
    residual, weight = _special_residual(formed, _pieces_of(part, len(part.cost)))
    spans = formed.contents.spans
    lengths = spans[:, 1] - spans[:, 0]
    longest = int(min(300, max(1, np.median(lengths) // 2)))
    return inflation(residual, weight, longest)


def _special_residual(formed: _Formed, pieces: tuple[Piece, ...]) -> tuple[FloatArray, ByteArray]:
    """Return the residuals of the segments in one series, separated by rows of weight 0."""
    series: list[FloatArray] = []
    weights: list[ByteArray] = []
    power = formed.contents.power_mw
    for a, b, _ in formed.contents.spans:
        rest = power[a:b] - formed.static(pieces, slice(a, b))
        known = np.isfinite(rest)
        series += [np.where(known, rest, 0.0), np.zeros(1)]
        weights.append(np.append(known.astype(np.uint8), np.uint8(0)))
    return np.concatenate(series), np.concatenate(weights)


def _no_intervals(pieces: tuple[Piece, ...]) -> tuple[tuple[float, float], ...]:
    return tuple((math.nan, math.nan) for _ in pieces[1:])


def _source(task: FitTask, rows: np.ndarray) -> FittedData:
    """Return the description of the fitted data."""
    c = task.contents
    return FittedData.of(
        c.time_ns, c.count(SegmentKind.STEADY), c.count(SegmentKind.SLOPE),
        c.temperature_degc[rows], task.settings.real('temperature_spread_limit'),
    )  # fmt: skip


def _static_residuals(formed: _Formed, pieces: tuple[Piece, ...]) -> ResidualStatistics:
    """Return the residual statistics of the special segments only."""
    task = formed.task
    rest, weight = _special_residual(formed, pieces)
    rows = rest[weight > 0]
    # The error of a static curve is unknown here: use the error of its mean, a lower bound.
    sd = float(np.std(rows))
    return residual_statistics(
        task, rest, weight, task.settings.real('sample_period'), sd, sd / math.sqrt(len(rows))
    )


def _judged(begun: _Begun) -> Characteristic:
    """Return the static curve with its residuals."""
    static = begun.static
    return replace(static, residuals=_static_residuals(begun.formed, static.pieces))


def _only_straight(begun: _Begun, why: str) -> Characteristic:
    """Return one straight piece if the dynamics could not be estimated.

    Few samples form a few clusters, and the slope within a cluster is mostly noise
    of the valve: several pieces would be far wrong between the clusters.
    """
    notes = (f'{NOT_REFINED}one straight piece, without dynamics. {why}',)
    pieces = _pieces_of(begun.part, 1, _inflation(begun.formed, begun.part))
    return replace(
        begun.static,
        pieces=pieces,
        choice=replace(begun.static.choice, confidence={}),
        breakpoint_intervals=(),
        residuals=_static_residuals(begun.formed, pieces),
        notes=notes,
    )


def _rich(part: Partition, pieces: int) -> tuple[Piece, ...]:
    """Return the exact partition with some pieces more than chosen, to be pruned."""
    return _pieces_of(part, min(len(part.cost), pieces + _RICHER))


def _samples(formed: _Formed) -> Samples:
    """Return all rows of the window."""
    task, c = formed.task, formed.contents
    step = task.settings.real('sample_period')
    usable = (np.isfinite(c.u) & np.isfinite(c.power_mw)).astype(np.uint8)
    # A jump in time is a gap even without rows in it.
    usable[1:][np.diff(c.time_ns) > 1.5e9 * step] = 0
    pressure = formed.pressure
    return Samples(
        u=np.where(usable > 0, c.u, 0.0),
        power_mw=np.where(usable > 0, c.power_mw, 0.0),
        usable=usable,
        step_s=step,
        settle_s=task.settings.settle_s,
        group=max(1, round(task.settings.real('block') / step)),
        scale=None if formed.scale is None else np.where(usable > 0, formed.scale, 1.0),
        pressure_mpa=None if pressure is None else np.where(usable > 0, pressure, 1.0),
    )


def _refinement(begun: _Begun) -> tuple[RegionalModel, int | None]:
    """Return the initial curve and the maximum number of pieces (None: keep its number)."""
    task, static = begun.formed.task, begun.static
    if task.settings.text('selection_rule') != 'prediction_error':
        return static.model, None
    rich = replace(static, pieces=_rich(begun.part, len(static.pieces)))
    return rich.model, task.settings.whole('max_pieces')


def _refined(
    task: FitTask, begun: _Begun, progress: Progress
) -> tuple[Characteristic, WindowContents]:
    """Refine on all rows; if that is impossible return the partition's curve with a note.

    The rows that are returned have the u of the curve.
    """
    progress('curve and dynamics together')
    formed = begun.formed
    samples = _samples(formed)
    try:
        result = refine(samples, *_refinement(begun), *formed.exponents)
    except (np.linalg.LinAlgError, TooFewSamplesError) as error:
        return _only_straight(begun, str(error)), formed.contents
    if result.exponent_moved and not formed.form.scaled:
        # The exact partition of another u.
        form = replace(formed.form, exponent=formed.form.exponent + result.exponent_moved)
        begun = _begin(replace(task, form=form), progress)
        begun = replace(begun, static=replace(begun.static, form=formed.evidence))
        samples = _samples(begun.formed)
    found = from_refined(begun.formed.task, begun.static, result, samples, begun.u_special)
    return found, begun.formed.contents
