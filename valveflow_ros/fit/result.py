# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Convert a refined model into the result, with its uncertainties."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from valveflow_ros.curve.characteristic import (
    Characteristic,
    FormEvidence,
    Piece,
    RegionDynamics,
    ResidualStatistics,
    Support,
    level_error_mw,
)
from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.errors import counted, listed, short
from valveflow_ros.fit.piece_selection import evidence_words
from valveflow_ros.fit.problem import Samples
from valveflow_ros.fit.refine import Refined
from valveflow_ros.fit.residual_chart import design_chart, slow_wander
from valveflow_ros.fit.task import FitTask
from valveflow_ros.numerics import running_average
from valveflow_ros.records import COARSE_STEP_S, NS_PER_S, ByteArray, FloatArray, SegmentKind
from valveflow_ros.segments.window import WindowContents
from valveflow_ros.signals.static_form import OPENING, exponents_near

_Z95 = 1.959963984540054
_MAD_TO_SD = 1.4826022185056018
_AT_END = 0.5e-3  # an exponent this close to the end of its range did not end by itself


def residual_statistics(
    task: FitTask,
    residual: FloatArray,
    weight: ByteArray,
    step_s: float,
    row_sd_mw: float,
    curve_error_mw: float,
) -> ResidualStatistics:
    """Return the statistics of clean residuals, and the chart that detects a shift.

    Parameters
    ----------
    residual, weight : (m,)
        Of rows or of means over rows, with the step ``step_s``.
    row_sd_mw : float
        sd of single rows.
    curve_error_mw : float
        Standard error of the prediction.
    """
    settings = task.settings
    average_s = settings.real('alarm_average')
    rest = residual[weight > 0]
    forget = math.exp(-step_s / average_s)
    run = running_average(rest, forget)
    settled = run[min(len(run) // 4, int(3.0 * average_s / step_s)) :]
    sd = _MAD_TO_SD * float(np.median(np.abs(settled - np.median(settled))))
    floor_mw = settings.real('alarm_floor')
    wander_mw = slow_wander(residual, weight, step_s, floor_mw)
    # The level of the curve is the mean over its days, which has an error of its own.
    level_mw = level_error_mw(wander_mw, 0, round(len(residual) * step_s * NS_PER_S))
    return ResidualStatistics(
        rmse_mw=float(np.sqrt(np.mean(rest**2))),
        average_sd_mw=max(sd, 1e-9),
        average_s=average_s,
        input_noise=task.input_noise,
        power_noise_mw=task.power_noise_mw,
        width_mw=_Z95 * math.hypot(row_sd_mw, curve_error_mw),
        chart=design_chart(
            residual, weight, step_s,
            block_s=settings.real('alarm_block'),
            run_length_days=settings.real('alarm_run_length'),
            floor_mw=floor_mw,
            curve_error_mw=curve_error_mw,
            wander_mw=math.hypot(wander_mw, level_mw),
        ),
        wander_mw=wander_mw,
    )  # fmt: skip


def from_refined(
    task: FitTask, static: Characteristic, result: Refined, samples: Samples, u: FloatArray
) -> Characteristic:
    """Convert a refined model into the result, with its uncertainties."""
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
    error = np.sqrt(np.maximum(np.diag(result.covariance), 0.0))
    knot_se = error[j + 1 : 2 * j]
    intervals = tuple(
        (float(b - _Z95 * s), float(b + _Z95 * s))
        for b, s in zip(knots[1:-1], knot_se, strict=True)
    )
    # The curve at the usual pressure may reach loads that the unit never had.
    measured = samples.power_mw[samples.usable > 0]
    flow = np.clip(_flow_at_ends(m, samples), measured.min(), measured.max())
    ends = np.concatenate([flow, m.levels])
    edges = [float(ends.min()), *m.levels.tolist(), float(ends.max())]
    error = error[3 * j - 1 :]
    level_errors = np.append(result.level_stderr, math.nan)
    step_s = task.settings.real('sample_period')
    times, delays = m.time_constants.tolist(), m.delays.tolist()
    dynamics = tuple(
        RegionDynamics(
            edges[i], edges[i + 1], times[i], delays[i],
            _time_error(times[i], float(times[i] * error[i]), step_s),
            _time_error(delays[i], float(error[m.regions + i]), step_s),
            float(level_errors[i]),
        )
        for i in range(m.regions)
        if edges[i] < edges[i + 1]  # a level beyond the curve's ends leaves a region empty
    )  # fmt: skip
    choice = static.choice
    if task.settings.text('selection_rule') == 'prediction_error':
        note = evidence_words(result.model.pieces, result.confidence)
        note += f" The paper's rule (24) takes J = {len(static.pieces)}."
        choice = replace(
            choice, rule='prediction_error', note=f'{note} {choice.note}'.strip(),
            confidence=dict(result.confidence),
        )  # fmt: skip
    elif m.pieces != len(static.pieces):
        note = (
            f'The rule took {counted(len(static.pieces), "piece")}; the refined curve has '
            f'{m.pieces}, since pieces too narrow to be moved were joined with others.'
        )
        choice = replace(choice, note=f'{note} {choice.note}'.strip(), confidence={})
    return replace(
        static,
        choice=choice,
        pieces=pieces,
        breakpoint_intervals=intervals,
        dynamics=dynamics,
        offset_mw=m.offset,
        notes=(
            *static.notes,
            *_form_errors(static, result, exponents_near(task.settings.real('pressure_exponent'))),
            *_long_means(result, step_s),
        ),
        pressure_scale_exponent=static.pressure_scale_exponent
        + (result.exponent_moved if static.axis == OPENING else 0.0),
        residuals=residual_statistics(
            task,
            result.residual_mw,
            result.weight,
            samples.step_s * samples.group,
            result.row_sd_mw,
            result.prediction_mw,
        ),
    )


# How the notes on a fitted exponent begin.
EXPONENT_NOTES = 'The exponent m of the pressure was fitted:', 'This is an end of the range'


def _form_errors(
    static: Characteristic, result: Refined, within: tuple[float, float]
) -> tuple[str, ...]:
    """Return notes on the fitted exponent and c, with 95 % intervals; none if they were given.

    ``within`` is the range in which the exponent was searched.
    """
    if math.isnan(result.exponent_stderr):
        return ()
    m = static.static_form.exponent + (result.exponent_moved if static.axis == OPENING else 0.0)
    said = f'{EXPONENT_NOTES[0]} {m:.3f}'
    at_end = min(abs(m - limit) for limit in within) < _AT_END
    if not at_end:
        said += f' ± {_Z95 * result.exponent_stderr:.3f}'
    if static.axis == OPENING:
        error = _Z95 * math.sqrt(max(float(result.covariance[-1, -1]), 0.0))
        said += f'; the constant c is {result.model.offset:.1f} ± {error:.1f} MW'
    if not at_end:
        return (f'{said}.',)
    return (
        f'{said}.',
        f'{EXPONENT_NOTES[1]} {within[0]:.3g} to {within[1]:.3g} in which m is searched, '
        'and the data ask for one beyond it: check the zero and the range of the pressure '
        'transmitter, and whether the curve fits over opening and pressure.',
    )


def _long_means(result: Refined, step_s: float) -> tuple[str, ...]:
    """Return a note if the curve was fitted to long means."""
    if not result.long_s:
        return ()
    why = 'the valve moves within the time between two rows.'
    if step_s < COARSE_STEP_S:
        why = (
            'fast movements would give another curve, because one lag does not describe them well '
            'enough.'
        )
    return (f'The curve was fitted to means over {result.long_s / 60.0:.3g} min: {why}',)


def _time_error(time_s: float, error_s: float, step_s: float) -> float:
    """Return the standard error of a time constant or a delay.

    Rows far apart hide shorter times than their step, and of a longer one they do not tell which
    part of a step is lag and which is delay: an even distribution over one step.
    """
    if step_s < COARSE_STEP_S:
        return error_s
    return max(error_s, step_s) if time_s < step_s else math.hypot(error_s, step_s / 12.0**0.5)


def _flow_at_ends(m: RegionalModel, samples: Samples) -> FloatArray:
    """Return the smallest and largest flow in MW; without a scale the flow at all piece ends."""
    if samples.scale is None:
        return np.concatenate([m.left, m.right])
    used = samples.usable > 0
    flow = m.static(samples.u[used], samples.scale[used])
    return np.array([flow.min(), flow.max()])


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

    # The dynamics of a region without rows are unknown, but no line depends on them.
    dead = np.isnan(np.diag(covariance))
    known = np.nan_to_num(covariance)

    def errors(gradient: FloatArray) -> FloatArray:
        variance = np.einsum('ip,pq,iq->i', gradient, known, gradient)
        touched = np.any(gradient[:, dead] != 0.0, axis=1)
        return np.where(touched, np.nan, np.sqrt(np.maximum(variance, 0.0)))

    return errors(slope_of), errors(intercept_of)


# Test if each piece has data of its own: the condition after Proposition 2 of the paper.
#
# Slope and intercept of a piece are determined by the special segments inside it when these
# are linearly independent: two steady states at different levels, or a slope response that
# crosses different levels. Otherwise they follow from the neighbouring pieces through the joins,
# or from the rows between segments, and a note reports this.

NOT_REFINED = 'The curve is not refined: '  # beginning of a note on that
_SMALL = 0.05  # half of a small 95 % interval, relative to the slope
_MOST_PERCENT = 100.0  # an opening beyond it is no advice
_LEAST_ROWS = 30  # minimum rows of a segment inside a piece to be counted
_SAME_MW = 0.01  # a smaller difference of two forms is not given in numbers
_APART = 10.0  # minimum difference of two distinct levels, in noise sd of u


def with_support(
    c: Characteristic, contents: WindowContents, input_noise: float
) -> Characteristic:
    """Return the characteristic with the support of each piece, and notes on unsupported pieces.

    Parameters
    ----------
    c : Characteristic
    contents : WindowContents
        The rows and special segments to which it was fitted.
    input_noise : float
        Noise sd of block means of u.
    """
    support = tuple(
        support_of(piece, contents, input_noise, last=k == len(c.pieces) - 1)
        for k, piece in enumerate(c.pieces)
    )
    return replace(c, support=support, notes=(*c.notes, *_support_notes(c, support)))


def wrong_form(c: Characteristic, why: str = 'was given') -> str:
    """Return a sentence if the form was given and is wrong; otherwise an empty text."""
    form = c.form
    if form is None or not form.contradicted:
        return ''
    return (
        f'The form of this curve, {c.static_form.words}, {why} and is the wrong one: on '
        f'stretches held out the power follows {form.other} to {form.rmse_other_mw:.2g} MW and '
        f'this form to {form.rmse_mw:.2g} MW; {forms_apart(form)}.'
    )


def forms_apart(form: FormEvidence) -> str:
    """Return a phrase on how much the two forms differ, and where most."""
    opening, pressure, most = form.worst
    if abs(most) < _SAME_MW:
        return 'both give the same power at the pressures of these data'
    return (
        f'the two differ by {form.apart_mw:.2g} MW (root mean square), at {opening:.0f} % and '
        f'{pressure:.1f} MPa by {most:.2g} MW'
    )


def weaknesses(c: Characteristic) -> tuple[str, ...]:
    """Return the doubts about a curve: its form, and the notes that report a weakness."""
    form = [wrong_form(c)] if wrong_form(c) else []
    return (*form, *(n for n in c.notes if n.startswith((NOT_REFINED, 'Piece ', 'Pieces '))))


def support_of(
    piece: Piece, contents: WindowContents, input_noise: float, last: bool = True
) -> Support:
    """Count the special segments inside a piece, and test if they determine its line.

    A segment is counted if 30 of its rows or half of them lie inside. The upper end
    belongs to the piece only if it is the ``last``.
    """
    steady = slope = samples = 0
    levels: list[float] = []
    crossing = False
    apart = _APART * input_noise
    for first, end, kind in contents.spans.tolist():
        u = contents.u[first:end]
        below = u <= piece.u_to if last else u < piece.u_to
        inside = u[(u >= piece.u_from) & below]
        samples += len(inside)
        if len(inside) < min(_LEAST_ROWS, (end - first + 1) // 2):
            continue
        if kind == SegmentKind.STEADY:
            steady += 1
            levels.append(float(np.median(inside)))
        else:
            slope += 1
            low, high = np.quantile(inside, (0.1, 0.9))
            crossing = crossing or bool(high - low > apart)
    distinct = _distinct(levels, apart)
    return Support(
        steady=steady,
        slope_response=slope,
        samples=samples,
        levels=tuple(distinct),
        identifiable=crossing or len(distinct) >= 2,
    )


def _distinct(levels: list[float], apart: float) -> list[float]:
    """Return the levels that are more than ``apart`` above the previous one."""
    found: list[float] = []
    for level in sorted(levels):
        if not found or level - found[-1] > apart:
            found.append(level)
    return found


def _support_notes(c: Characteristic, support: tuple[Support, ...]) -> list[str]:
    """Return a sentence for each kind of piece without enough data of its own."""
    groups: dict[tuple[str, bool], list[int]] = {}
    pieces = c.at_pressure().pieces
    for k, (piece, found) in enumerate(zip(pieces, support, strict=True)):
        if not found.identifiable:
            groups.setdefault((_rests(found), is_borrowed(piece)), []).append(k)
    return [
        _sentence(c, [(k + 1, pieces[k], support[k]) for k in group], rests, borrowed)
        for (rests, borrowed), group in groups.items()
    ]


_AT_ENDS = 'no special segment of its own'


def _rests(found: Support) -> str:
    if not found.samples:
        return 'no data in special segments'
    if not found.levels and not found.slope_response:
        return _AT_ENDS
    if not found.levels:
        return 'data only in slope responses that hardly move'
    return 'steady data at one load only'


def _sentence(
    c: Characteristic, weak: list[tuple[int, Piece, Support]], rests: str, borrowed: bool
) -> str:
    """Return a sentence on the data of pieces, and on the data that they need."""
    many = len(weak) > 1
    places = [(piece, u) for _, piece, found in weak for u in _missing(piece, found.levels)]
    loads = [_operation(c, piece, u, short_of=many) for piece, u in places]
    if many:
        name = f'Pieces {listed([str(number) for number, _, _ in weak])} have '
        name += rests.replace('its own', 'their own')
        if borrowed:
            return (
                f'{name}: their slopes follow from the pieces beside them, and their errors hold '
                'if each piece is straight. One hour of constant operation at each of about '
                f'{listed(loads)} MW would check them.'
            )
        return (
            f'{name}, so their slopes are uncertain. One hour of constant operation at each of '
            f'about {listed(loads)} MW would give them.'
        )
    ((number, piece, found),) = weak
    if rests == _AT_ENDS:
        rests += f', only {counted(found.samples, "sample")} at the ends of others'
    name = f'Piece {number} ({c.place_words(piece.u_from, piece.u_to)}) has {rests}'
    load = ' and one at '.join(loads)
    if borrowed:
        return (
            f'{name}: its slope follows from {lends(c)}, and its error holds if the '
            f'piece is straight. One hour of constant operation at about {load} would check it.'
        )
    return (
        f'{name}, so its slope is uncertain. One hour of constant operation at about {load} would '
        'give it.'
    )


def is_borrowed(piece: Piece) -> bool:
    """Return True if the error of a slope is small although the piece has too few data.

    The pieces meet, so that the data of its neighbours determine a piece too; a single piece
    is determined by the rows between its special segments.
    """
    return 0.0 < _Z95 * piece.slope_stderr < _SMALL * abs(piece.slope)


def lends(c: Characteristic) -> str:
    """Return what the slope of a piece follows from if `is_borrowed`, as a phrase."""
    if len(c.pieces) == 1:
        return 'the samples in which the valve moved'
    return 'the pieces beside it'


def _operation(c: Characteristic, piece: Piece, u: float, short_of: bool) -> str:
    """Return the operation at a u on a piece, at the usual pressure; in MW only, if short."""
    load = short(piece.slope * u + piece.intercept)
    if short_of:
        return load
    power, pressure = f'{load} MW', c.reference_pressure_mpa
    if not math.isfinite(pressure):
        return power
    opening = u / pressure**c.pressure_exponent
    if opening > _MOST_PERCENT:
        return power
    return f'{opening:.0f} % opening ({power} at {pressure:.1f} MPa)'


def _missing(piece: Piece, levels: tuple[float, ...]) -> list[float]:
    """Return where steady states are missing: two points, or the one farther from a level."""
    width = piece.u_to - piece.u_from
    places = [piece.u_from + share * width for share in (0.2, 0.8)]
    if not levels:
        return places
    return [max(places, key=lambda u: abs(u - levels[0]))]
