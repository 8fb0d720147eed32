# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The result in words and tables: the curve, its number of pieces, its dynamics."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from valveflow_ros.curve.characteristic import Characteristic, Choice, RegionDynamics, piece_of
from valveflow_ros.fit.model_form import Misfit
from valveflow_ros.fit.result import forms_apart, is_borrowed, lends, wrong_form
from valveflow_ros.fit.static_test import STATIC_RULE
from valveflow_ros.fit.step_test import RULE
from valveflow_ros.records import FLOW_UNITS, FloatArray, Signal
from valveflow_ros.report import figure as plot
from valveflow_ros.report import page as html
from valveflow_ros.report import words as say
from valveflow_ros.report.figure import Figure, Spec
from valveflow_ros.report.identified import Identified
from valveflow_ros.report.page import Cells
from valveflow_ros.report.words import NOT_KNOWN, Z95
from valveflow_ros.signals.static_form import LEAST_PRESSURE_RANGE, OPENING, pressure_range

# Below this explained fraction of the power, it depends on something else, or a signal is wrong.
_LITTLE = 0.8
_WELL_KNOWN = 0.1  # 95 % error of every slope, as a fraction of the steepest
_NO_EFFECT = 0.1  # of the range of the power, for the whole range of the opening
_FLAT = 0.2  # slope relative to the steepest piece, below which a piece is reported as flat


def explained(data: Identified) -> float:
    """Return the fraction of the power variance in special segments that the curve explains."""
    rows = data.special
    if not len(rows):
        return math.nan
    power = data.power[rows]
    # Outside the identified range the outer pieces are extrapolated.
    rest = power - data.static_mw[rows]
    total = float(np.var(power))
    return 1.0 - float(np.mean(rest**2)) / total if total > 0.0 else math.nan


def doubt(data: Identified) -> str:
    """Return a warning if the curve is unreliable; empty otherwise."""
    share, misfit = explained(data), data.misfit
    if share < _LITTLE and not _slope_error(data) <= _WELL_KNOWN:
        return (
            f'Do not rely on this curve: it explains only {say.percent(share)} of the variance of '
            'the power. Look whether a signal is constant, taken for another one, or in another '
            'unit.'
        )
    told = [words] if (words := _no_effect(data)) else []
    if share < _LITTLE:
        told.append(
            f'The curve explains only {say.percent(share)} of the variance of the power: the unit '
            'moved little, or something that was not logged moves the power. The slopes are known '
            'within 10 %.'
        )
    if misfit is not None:
        told.append(f'Do not rely on this curve: it is wrong by {misfit_words(misfit)}.')
        if not data.mixture:
            told.append(
                'The power depends on opening and pressure in another way, or on something that '
                'was not logged.'
            )
    if form := wrong_form(data.characteristic):
        told.append(form)
    return ' '.join(told)


def _slope_error(data: Identified) -> float:
    """Return the largest 95 % error of a slope, as a fraction of the steepest slope."""
    slope, error = np.array([(p.slope, p.slope_stderr) for p in data.characteristic.pieces]).T
    return float(1.96 * np.max(error) / max(float(np.max(np.abs(slope))), 1e-300))


def _no_effect(data: Identified) -> str:
    there = [(load, float(np.median(v)), float(np.median(p))) for load, v, p in _at_loads(data)]
    if not there:
        return ''
    loads, openings, pressures = np.array(there).T
    opening = data.table.column(Signal.VALVE_OPENING)
    reach = float(np.ptp(np.nanquantile(opening, (0.01, 0.99))))
    effect = float(np.abs(_gains(data.characteristic, openings, pressures)[0]).max()) * reach
    if effect > _NO_EFFECT * float(np.ptp(loads)):
        return ''
    return (
        'Do not rely on this curve: the power follows the pressure alone, and the whole range of '
        f'the opening makes at most {say.plain(max(effect, 0.1), 2)} MW. Is this the pressure '
        'before the valve, or one behind it?'
    )


def misfit_words(misfit: Misfit) -> str:
    """Return the size of a systematic error of the curve and where it is largest, in words."""
    opening, pressure, most = misfit.worst
    return (
        f'{say.plain(misfit.rms_mw, 2)} MW (root mean square) at the openings and pressures of '
        f'these data, most at {say.decimals(opening, 0)} % and {say.decimals(pressure, 1)} MPa, '
        f'where the measured power differs by {say.plain(most, 2)} MW'
    )


def form_words(data: Identified) -> str:
    """Return the form of the power and its evidence; empty for the paper's form if confirmed."""
    c, form = data.characteristic, data.characteristic.form
    if data.one_pressure and c.choice.rule not in (RULE, STATIC_RULE):  # they have a note
        return 'The pressure is the same in all rows: the curve holds at that pressure only.'
    mine = c.static_form.words
    if form is None and c.choice.rule not in (RULE, STATIC_RULE):
        pressure = data.table.column(Signal.MAIN_STEAM_PRESSURE)[data.special]
        if not len(pressure) or pressure_range(pressure) < LEAST_PRESSURE_RANGE:
            return ''
        other = 'F(V p^m)' if c.axis == OPENING else 'p^m F(V) + c'
        return (
            f'Whether the power follows {mine}, as this curve does, or {other} could not be '
            'tried: the special segments are too few. At another pressure than is usual for an '
            'opening the curve may be wrong by several MW. A longer log would help.'
        )
    if form is None or form.contradicted:
        return ''
    if not form.told:
        return (
            f'Whether the power follows {mine}, as this curve does, or {form.other} cannot be '
            f'decided from these data: {forms_apart(form)}. Where the pressure leaves the range '
            'of these data the curve may be wrong.'
        )
    if c.axis != OPENING:
        return ''
    return (
        f'The breakpoints of this valve are at fixed openings: the power follows {mine}. On '
        f'held-out data the error of this form is {say.plain(form.rmse_mw, 2)} MW, that of '
        f'{form.other} {say.plain(form.rmse_other_mw, 2)} MW.'
    )


_LOADS = 50.0, 20.0, 10.0, 5.0  # steps of the table by load, MW
_NEAR = 0.02  # of the range of the power: rows at a load
_LEAST_ROWS = 20
_LARGEST = 0.99  # quantile of the power that is called the largest load
_SMALL_MPA = 2.0  # below it, as of a pressure difference, one decimal would hide the change
_PRESSURES = 41  # between the ends of the pressures at a load


class LoadGain(NamedTuple):
    """The effect of the opening at a load, over the pressures that the unit had there.

    A unit that slides and at times holds a reserve has two usual pressures at one load: their
    median may be either, or lie between them. So the ends tell more than the middle.
    """

    load: float  # MW
    pressure: float  # median of the rows at the load, MPa
    pressure_low: float  # ends of nine of ten of these rows
    pressure_high: float
    opening: float  # that gives the load at the median pressure, %
    gain: float  # there, MW per % of opening
    error: float  # its 95 % error
    low: float  # its range over these pressures
    high: float


def _at_loads(data: Identified) -> Iterator[tuple[float, FloatArray, FloatArray]]:
    """Yield round loads with the openings and pressures of the rows near each."""
    wanted = [Signal.GENERATED_POWER, Signal.VALVE_OPENING, Signal.MAIN_STEAM_PRESSURE]
    rows = data.table.values[:, wanted]
    power, opening, pressure = rows[np.isfinite(rows).all(axis=1)].T
    low, high = np.quantile(power, (0.01, _LARGEST)).tolist() if len(power) else (0.0, 0.0)
    if not high > low:
        return
    step = next((s for s in _LOADS if high - low > 8.0 * s), (high - low) / 8.0)
    for load in (np.arange(math.ceil(low / step), math.floor(high / step) + 1) * step).tolist():
        near = np.abs(power - load) < _NEAR * (high - low)
        if near.sum() >= _LEAST_ROWS:
            yield load, opening[near], pressure[near]


def _gains(
    c: Characteristic, opening: FloatArray, pressure: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return MW per % of opening and its standard error."""
    scale = pressure ** (c.pressure_exponent + c.pressure_scale_exponent)
    piece = piece_of(c, opening * pressure**c.pressure_exponent)
    slopes = np.array([(p.slope, p.slope_stderr) for p in c.pieces])
    return scale * slopes[piece, 0], scale * slopes[piece, 1]


def gain_by_load(data: Identified) -> list[LoadGain]:
    """Return the effect of the opening at each load that the curve reaches."""
    c, found = data.characteristic, []
    for load, _, pressures in _at_loads(data):
        low, middle, high = np.quantile(pressures, (0.05, 0.5, 0.95)).tolist()
        p = np.append(np.linspace(low, high, _PRESSURES), middle)
        v = c.opening(load, p)
        gains, errors = _gains(c, v, p)
        known = gains[np.isfinite(v)]
        if math.isfinite(v[-1]):
            found.append(LoadGain(
                load, middle, low, high, float(v[-1]), float(gains[-1]),
                Z95 * float(errors[-1]), float(known.min()), float(known.max()),
            ))  # fmt: skip
    return found


def _load(gain: LoadGain) -> str:
    return say.decimals(gain.load, 0 if gain.load % 1.0 == 0.0 else 1)


def _load_head(data: Identified) -> str:
    unit = data.characteristic.output_unit
    return f'{"flow" if unit in FLOW_UNITS else "load"} ({unit})'


def gain_cells(data: Identified) -> Cells:
    """Return head and cells of the table of MW per % of opening by load."""
    unit, gains = data.characteristic.output_unit, gain_by_load(data)
    digits = 1 if all(g.pressure_high > _SMALL_MPA for g in gains) else 3
    head = [_load_head(data), 'median pressure (MPa)', 'usual range (MPa)', 'opening (%)',
            f'{unit} per 1 % of opening', '95 % interval', 'over the usual range']  # fmt: skip
    cells = [
        [
            _load(g),
            say.decimals(g.pressure, digits),
            f'{say.decimals(g.pressure_low, digits)} to {say.decimals(g.pressure_high, digits)}',
            say.decimals(g.opening, 1), say.plain(g.gain, 3),
            f'{say.plain(g.gain - g.error, 3)} to {say.plain(g.gain + g.error, 3)}'
            if g.error > 0.0 else '-',
            f'{say.plain(g.low, 3)} to {say.plain(g.high, 3)}',
        ]
        for g in gains
    ]  # fmt: skip
    if data.one_pressure:  # then there is no range of pressures
        head, *cells = ([row[0], *row[3:6]] for row in (head, *cells))
    return head, cells


def gain_table(data: Identified) -> str:
    """Return the table of MW per % of opening by load; empty without data for it."""
    head, cells = gain_cells(data)
    caption = 'MW per 1 % of opening at each load.'
    if not data.one_pressure:
        caption += (
            ' The opening is the one that gives the load at the median pressure. The usual range '
            'of the pressure holds for nine tenths of the time at this load.'
        )
    return html.table(head, cells, caption=caption)


def reference_cells(data: Identified) -> Cells:
    """Return head and cells of the curve against the reference by load, the largest load last.

    Both curves are read at the same opening and pressure; there are no cells without a reference.
    """
    c, r, shift = data.characteristic, data.reference, data.shift
    head = [
        _load_head(data),
        'MW per 1 % of opening',
        'in the reference, at the same opening',
        'change of the power (MW)',
    ]
    if r is None or shift is None:
        return head, []
    at = np.array([(g.opening, g.pressure) for g in gain_by_load(data)]).reshape(-1, 2)
    rows = data.table.values[:, [Signal.VALVE_OPENING, Signal.MAIN_STEAM_PRESSURE]]
    powers = c.power(*rows.T)
    powers[~np.isfinite(r.power(*rows.T))] = np.nan
    if np.isfinite(powers).any():
        largest = np.nanquantile(powers, _LARGEST, method='nearest')
        at = np.append(at, rows[powers == largest][:1], axis=0)
    opening, pressure = at.T
    now, then = c.power(opening, pressure), r.power(opening, pressure)
    gains = [_gains(curve, opening, pressure)[0] for curve in (c, r)]
    piece = piece_of(c, opening * pressure**c.pressure_exponent)
    cells = [
        [
            say.decimals(float(now[k]), 0), *(say.plain(float(gain[k]), 3) for gain in gains),
            say.with_error(float(now[k] - then[k]), shift.pieces[piece[k]].error_mw),
        ]
        for k in np.argsort(now) if np.isfinite(now[k] - then[k])
    ]  # fmt: skip
    return head, cells


def reference_table(data: Identified) -> str:
    """Return the table of the curve against the reference by load; empty without common loads."""
    head, cells = reference_cells(data)
    caption = (
        'Both curves at the same opening and pressure. The last row is the largest load at which '
        'both are known.'
    )
    return html.table(head, cells, caption=caption)


def answer_words(data: Identified) -> str:
    """Return a summary paragraph for an engineer, with the risks of the result."""
    c = data.shown
    words = (
        f'The flow characteristic has <b>{say.counted(len(c.pieces), "piece")}</b>. '
        f'{range_words(data)}{_bends(data)} It explains '
        f'{say.percent(explained(data))} of the variance of the power in '
        f'{say.counted(c.source.steady, "steady-state segment")} and '
        f'{say.counted(c.source.slope_response, "slope-response segment")} '
        f'({say.counted(c.source.samples, "sample")}). The typical difference between curve and '
        f'samples is {say.plain(c.residuals.rmse_mw, 2)} MW. {pieces_doubt(c)}'
    )
    told = []
    if c.source.temperature_flag:
        limit = say.plain(data.settings.real('temperature_spread_limit'))
        told.append(
            'The main steam temperature spread over '
            f'{say.plain(c.source.temperature_spread_k, 3)} K in the special segments (limit '
            f'{limit} K). The method assumes a constant one: part of what the curve shows may '
            'come from the temperature.'
        )
    if any(p.slope <= 0.0 for p in c.pieces):
        told.append(
            'On one piece the power does not rise with '
            f'{say.input_name(c.pressure_exponent)}, so the curve has no inverse there and cannot '
            'be compensated. A flat upper end is normal; a falling piece elsewhere is not.'
        )
    told += [html.text(n) for n in (say.held_words(c.held), *c.notes)]
    form = form_words(data)
    doubts = doubt(data)
    said = html.notice(html.text(doubts)) if doubts else ''
    said += html.paragraph(words, 'answer') + (html.paragraph(html.text(form)) if form else '')
    return said + ''.join(html.notice(n) for n in told if n)


def range_words(data: Identified) -> str:
    """Return the ends of the curve in a sentence: openings if the pressure was nearly constant."""
    c, unit = data.shown, data.characteristic.output_unit
    ends, m = c.breakpoints[[0, -1]], c.pressure_exponent
    power = f'{say.span(*c.values()[[0, -1]])} {unit}'
    pressure = data.table.column(Signal.MAIN_STEAM_PRESSURE)[data.special]
    over_u = '' if m == 0.0 else f'u from {say.span(*ends)} {say.input_unit_plain(m)}'
    if m == 0.0:
        opening, at = ends, '' if data.one_pressure else data.at_pressure
    elif len(pressure) and pressure_range(pressure) < LEAST_PRESSURE_RANGE:
        usual = float(np.median(pressure))
        opening, at = ends / usual**m, f' at {usual:.3g} MPa'
    else:
        return f'The curve is known from {power} ({over_u}).'
    known = f'The curve is known from {say.decimals(float(opening[0]), 1)} % to '
    known += f'{say.decimals(float(opening[1]), 1)} % opening{at}: from {power}'
    return f'{known} ({over_u}).' if over_u else f'{known}.'


def _bends(data: Identified) -> str:
    """Return where one per cent of opening gives least and most, and where the curve is flat."""
    c, unit = data.shown, data.characteristic.output_unit
    if len(c.pieces) == 1:
        return ' It is straight.'
    gains, said = sorted(gain_by_load(data), key=lambda g: g.gain), ''
    if len(gains) > 1:
        least, most = (
            f'{say.plain(g.gain, 2)} {unit} at {_load(g)} {unit}' for g in (gains[0], gains[-1])
        )
        said = f' One per cent of opening gives from {least} to {most}.'
    flat, *_, steep = sorted(c.pieces, key=lambda p: p.slope)
    there = c.place_words(flat.u_from, flat.u_to)
    if flat.slope <= 0.0:
        return f'{said} At {there} opening further <b>does not raise the power</b>.'
    if flat.slope < _FLAT * steep.slope:
        said += f' At {there} the valve hardly changes the power.'
    return said


def pieces_cells(data: Identified) -> Cells:
    """Return head and cells with one row per piece."""
    c = data.shown
    m, u = c.pressure_exponent, say.input_name(c.pressure_exponent)
    rows = []
    for k, piece in enumerate(c.pieces):
        low, high = (piece.slope * u + piece.intercept for u in (piece.u_from, piece.u_to))
        rows.append([
            str(k + 1), say.span(piece.u_from, piece.u_to, 1), say.span(low, high, 1),
            say.with_error(piece.slope, piece.slope_stderr),
            say.with_error(piece.intercept, piece.intercept_stderr), say.count(piece.samples),
        ])  # fmt: skip
    head = [
        'piece', f'{u} ({say.input_unit_plain(m)})', f'power{data.at_pressure} (MW)',
        f'slope, 95 % ({say.per_input(m)})', 'intercept, 95 % (MW)', 'samples',
    ]  # fmt: skip
    return head, rows


def pieces_table(data: Identified) -> str:
    """Return the table of the pieces, with what each rests on."""
    c, (head, rows) = data.shown, pieces_cells(data)
    if not c.support:
        return html.table(head, rows)
    return html.table([*head, 'rests on'], [[*row, _rests(c, k)] for k, row in enumerate(rows)])


def _rests(c: Characteristic, k: int) -> str:
    found = c.support[k]
    said = (
        f'{say.counted(found.steady, "steady state")} at '
        f'{say.counted(len(found.levels), "level")}, '
        f'{say.counted(found.slope_response, "slope response")}'
    )
    if found.identifiable:
        return said
    if is_borrowed(c.pieces[k]):
        return f'{said}; the slope follows from {lends(c)}'
    return f'<b>slope uncertain</b>: {said}'


def breakpoints_cells(c: Characteristic) -> Cells:
    """Return head and cells with one row per breakpoint; no rows for a straight curve."""
    rows = [
        [str(k), say.level(piece.u_to, 1), say.interval(low, high), say.level(float(value), 1)]
        for k, (piece, (low, high), value) in enumerate(
            zip(c.pieces[:-1], c.breakpoint_intervals, c.values()[1:-1], strict=True), 1
        )
    ]
    m = c.pressure_exponent
    u = f'{say.input_name(m)} ({say.input_unit_plain(m)})'
    return ['breakpoint', u, '95 % interval', 'power (MW)'], rows


def temperature_words(data: Identified) -> str:
    """Return the temperature during the special segments in words."""
    source = data.characteristic.source
    if not math.isfinite(source.temperature_spread_k):
        return 'The main steam temperature is not known.'
    mean = f'{say.decimals(source.temperature_mean_degc, 1)} °C'
    if source.temperature_spread_k == 0.0:
        return f'Main steam temperature: {mean} throughout.'
    limit = say.plain(data.settings.real('temperature_spread_limit'))
    return (
        f'Main steam temperature in the special segments: mean {mean}, 95 % of it within '
        f'{say.plain(source.temperature_spread_k, 3)} K, '
        f'{"more than" if source.temperature_flag else "within"} the limit of {limit} K.'
    )


def window_words(c: Characteristic) -> str:
    """Return the length of the window."""
    return say.duration((c.source.window_end_ns - c.source.window_start_ns) / 1e9)


_LOOKS = (('chosen', 'solid'), ('steady', 'dash'), ('slope', 'dot'))


def dynamics_cells(dynamics: tuple[RegionDynamics, ...]) -> Cells:
    """Return time constant and delay by region of power; 'not known' if below its error."""
    rows = [
        [
            f'{say.span(d.power_from, d.power_to)} MW',
            say.time_with_error(d.time_constant_s, d.time_constant_stderr_s),
            say.time_with_error(d.delay_s, d.delay_stderr_s),
            say.decimals(d.delay_s + 3.0 * d.time_constant_s, 0) if _told(d) else NOT_KNOWN,
        ]
        for d in dynamics
    ]
    head = ['power', 'time constant T, 95 % (s)', 'delay τ, 95 % (s)',
            '95 % done after τ + 3 T (s)']  # fmt: skip
    return head, rows


def _told(region: RegionDynamics) -> bool:
    return say.is_known(region.time_constant_s, region.time_constant_stderr_s)


def dynamics_figure(dynamics: tuple[RegionDynamics, ...]) -> Figure | None:
    """Return the response of the power to a step of the steam flow in each region.

    None if no time constant is known.
    """
    dynamics = tuple(d for d in dynamics if _told(d))
    if not dynamics:
        return None
    ends = [d.delay_s + 4.0 * d.time_constant_s for d in dynamics]
    # A slow region must not compress the others at the edge of the axis.
    t = np.linspace(0.0, min(max(ends), 8.0 * min(ends)), 160)
    traces = []
    for k, d in enumerate(dynamics):
        colour, dash = _LOOKS[k % 3]
        moved = 100.0 * (1.0 - np.exp(-np.maximum(t - d.delay_s, 0.0) / d.time_constant_s))
        traces.append(plot.line(
            plot.rounded(t), plot.rounded(moved, 4), f'{say.span(d.power_from, d.power_to)} MW',
            colour, '%{x:.0f} s: %{y:.0f} %', width=2.2, dash=dash,
        ))  # fmt: skip
    title = {'text': 'seconds after a step of the steam flow', 'short': 'seconds after a step'}
    layout = {'xaxis': plot.axis(title), 'yaxis': plot.axis('power has moved (%)'),
              'showlegend': True}  # fmt: skip
    caption = (
        '<b>The further right a line rises, the slower the unit answers there.</b> '
        'Each line is the identified first-order answer of one range of power.'
    )
    return Figure('dynamics', caption, 'Step responses by range of power.', traces, layout, 320)


# Choice of the number of pieces: cost and turning angle over the number (Fig. 6 of the paper).

_KEPT = {
    'prediction_error': 'the number kept is the one that predicts all samples best once the '
    'dynamics are known'
}
_LEAST_SHOWN = 0.005  # smaller probabilities of a number of pieces are not listed
_DOUBTFUL = 0.05  # probability of another number of pieces that makes the chosen one uncertain
# Mantissas of the ticks, from coarse to fine.
_STEPS = (
    [1.0, 2.0, 5.0],
    [1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0],
    [0.1 * k for k in range(10, 100)],
)


def choice_figure(choice: Choice, chosen: int) -> Figure:
    """Return Omega(J) on a log axis above Lambda(J), with the confidence if there is one."""

    def colours(numbers: list[int]) -> list[str]:
        return [plot.token('chosen' if k == chosen else 'data') for k in numbers]

    def values_of(values: dict[int, float], up: str, name: str, hover: str) -> Spec:
        j = sorted(values)
        sizes = [13 if k == chosen else 7 for k in j]
        return plot.line(
            j, plot.rounded([values[k] for k in j], 8), name, 'data', f'J = %{{x}}<br>{hover}',
            width=1.5, mode='lines+markers', yaxis=up, showlegend=False,
            marker={'size': sizes, 'color': colours(j)},
        )  # fmt: skip

    traces = [
        values_of(choice.cost, 'y', 'cost', 'Ω = %{y:.4s} MW²<extra></extra>'),
        values_of(choice.turning_angle, 'y2', 'turning angle', 'Λ = %{y:.3f}<extra></extra>'),
    ]
    sure = bool(choice.confidence)
    first, second = ([0.7, 1.0], [0.34, 0.64]) if sure else ([0.56, 1.0], [0.0, 0.44])
    layout = {
        'xaxis': plot.axis('number of pieces J', dtick=1, anchor='y3' if sure else 'y2'),
        'yaxis': plot.axis('cost Ω(J)<br>(MW²)', domain=first, type='log',
                           **_ticks(np.array(list(choice.cost.values())))),
        'yaxis2': plot.axis('turning<br>angle Λ(J)', domain=second, rangemode='tozero'),
        'hovermode': 'closest',
    }  # fmt: skip
    if sure:
        j = sorted(choice.confidence)
        traces.append({
            'type': 'bar', 'name': 'confidence', 'yaxis': 'y3', 'showlegend': False, 'x': j,
            'y': [100.0 * choice.confidence[k] for k in j], 'marker': {'color': colours(j)},
            'hovertemplate': 'J = %{x}<br>%{y:.1f} %<extra></extra>',
        })  # fmt: skip
        layout['yaxis3'] = plot.axis('confidence<br>(%)', domain=[0.0, 0.28], rangemode='tozero')
    costs = ', '.join(f'{j}: {say.plain(v, 3)}' for j, v in sorted(choice.cost.items()))
    return Figure(
        'choice', _choice_caption(choice, chosen),
        f'Cost by number of pieces ({costs}); chosen is {chosen}.', traces, layout,
        height=560 if sure else 420,
    )  # fmt: skip


def _choice_caption(choice: Choice, chosen: int) -> str:
    words = (
        '<b>Look for the sharpest bend.</b> Above, the squared error of the best curve of J '
        'pieces '
        '(on a logarithmic axis); each point is the exact optimum. Below, how sharply that line '
        'turns at J, eq. (24) of the paper: after the sharpest turn another piece gains little. '
    )
    sharpest = max(choice.turning_angle, key=lambda j: choice.turning_angle[j], default=chosen)
    if choice.rule != 'paper' and sharpest != chosen:
        kept = _KEPT.get(choice.rule, 'another number was kept')
        words += f'It turns most sharply at J = {sharpest}; {kept}. '
    words += f'<b>Chosen: J = {chosen}.</b>'
    if choice.confidence:
        words += ' At the bottom, how probable each J is.'
    if choice.note:
        words += f' {html.text(choice.note).removesuffix(".")}.'
    return words


def _ticks(costs: FloatArray) -> Spec:
    """Return round ticks for a logarithmic axis, at least three if possible."""
    costs = costs[costs > 0.0]
    if not len(costs):
        return {}
    low, high = float(costs.min()), float(costs.max())
    decades = 10.0 ** np.arange(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    ticks = decades
    for steps in _STEPS:
        ticks = np.outer(decades, steps).ravel()
        ticks = ticks[(ticks >= 0.98 * low) & (ticks <= 1.02 * high)]
        if len(ticks) >= 3:
            break
    told = [_power(t) for t in ticks]
    return {'tickmode': 'array', 'tickvals': ticks.tolist(), 'ticktext': told}


def _power(value: float) -> str:
    exponent = math.floor(math.log10(value) + 1e-9)
    if -2 <= exponent <= 4:
        return f'{value:g}'
    lead = f'{value / 10.0**exponent:.3g}'
    return ('' if lead == '1' else f'{lead}·') + f'10<sup>{exponent}</sup>'


def confidence_table(choice: Choice) -> str:
    """Return the probability of each number of pieces; empty if the rule gives none."""
    likely = {j: p for j, p in sorted(choice.confidence.items()) if p >= _LEAST_SHOWN}
    if not likely:
        return ''
    rest = sum(p for p in choice.confidence.values() if p < _LEAST_SHOWN)
    words = html.paragraph(
        'How probable each number of pieces is, given these data and their noise; all others '
        f'together {_percent(rest)}.'
    )
    rows = [[str(j), _percent(p)] for j, p in likely.items()]
    return words + html.table(['number of pieces J', 'probability'], rows)


def pieces_doubt(c: Characteristic) -> str:
    """Say which numbers of pieces are nearly as probable as the chosen one; empty if none is."""
    likely = {j: p for j, p in c.choice.confidence.items() if p >= _DOUBTFUL}
    likely.pop(len(c.pieces), None)
    if not likely:
        return ''
    chosen = _percent(c.choice.confidence[len(c.pieces)])
    others = ', '.join(f'{j} of {_percent(p)}' for j, p in likely.items())
    right = ' The 95 % intervals of the breakpoints are valid only for the right number.'
    of_breakpoints = right if len(c.pieces) > 1 else ''
    return (
        f'The number of pieces is not certain: {len(c.pieces)} has a probability of {chosen}, '
        f'{others}.{of_breakpoints}'
    )


def _percent(share: float) -> str:
    if share > 0.9995:
        return 'more than 99.9 %'
    return 'less than 0.1 %' if share < 0.0005 else f'{100.0 * share:.1f} %'
