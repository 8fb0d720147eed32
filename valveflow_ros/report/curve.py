# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The curve with its samples and error; its residual; its reference."""

from __future__ import annotations

import math

import numpy as np

from valveflow_ros.curve.characteristic import Piece
from valveflow_ros.curve.segment_residual import SegmentResiduals, segment_residuals
from valveflow_ros.curve.shift import PieceShift, Shift
from valveflow_ros.records import FloatArray, IntArray, Signal
from valveflow_ros.report import figure as plot
from valveflow_ros.report import page as html
from valveflow_ros.report import words as say
from valveflow_ros.report.answer import reference_table
from valveflow_ros.report.figure import DAY_HOUR, Figure, Spec
from valveflow_ros.report.identified import Identified
from valveflow_ros.report.page import Section
from valveflow_ros.report.words import Z95
from valveflow_ros.signals.static_form import LEAST_PRESSURE_RANGE, OPENING, pressure_range

_SHADES = 5
_COLUMNS, _ROWS = 150, 100
_DAY_NS = 86400 * 10**9
_LONGER = 1.5  # length of a log in days, above which its last day is marked
_LEAST = 3  # fewer segments are not drawn
_SURE = 0.9999
_SAME_PRESSURE = 0.02
_OPENINGS = 121
_CONTOURS = 10


def band(piece: Piece, u_samples: FloatArray, u: FloatArray) -> FloatArray:
    """Return the standard error of the line of a piece at ``u`` in MW, NaN if unknown.

    For a straight line through samples with mean m and variance s of u, the
    error is ``slope_stderr * sqrt((u - m)^2 + s)``: smallest near the mean of the
    samples, and growing away from it. Computing it from the slope's error alone
    avoids the difference of two large numbers, slope and intercept.
    """
    inside = u_samples[(u_samples >= piece.u_from) & (u_samples <= piece.u_to)]
    if not math.isfinite(piece.slope_stderr) or len(inside) < 3:
        return np.full(len(u), np.nan)
    return np.asarray(piece.slope_stderr * np.sqrt((u - inside.mean()) ** 2 + inside.var()))


def _unrefined(data: Identified) -> bool:
    """Return True if the partition before the refinement can be drawn beside the curve.

    That of p^e F(V) + c has the e and c of its own, which the refinement changed.
    """
    c = data.characteristic
    return c.axis != OPENING and c.pieces != c.partition_pieces


def curve_figure(data: Identified) -> Figure:
    """Return the figure of the characteristic."""
    c = data.shown
    name, u = say.input_name(c.pressure_exponent), data.u[data.special]
    hover = f'{name} %{{x:.4~g}}<br>%{{y:.4~g}} MW'
    traces = [_heat(u, data.power_shown[data.special], hover), *_bands(data, u)]
    if _unrefined(data):
        traces.append(_line(c.partition_pieces, 'before refining', 'raw', 1.2, 'dash'))
    if data.reference is not None:
        there = data.reference.at_pressure(c.reference_pressure_mpa)
        if data.one_pressure:
            there = data.reference.over_opening(data.median_pressure)
        traces.append(_line(there.pieces, 'reference', 'chosen', 2, 'dot', hover))
    traces.append(_line(c.pieces, 'flow characteristic', 'curve', 2.6, hover=hover))
    if len(c.pieces) > 1:
        traces.append(_breakpoints(data))
    layout: Spec = {
        'xaxis': plot.axis(say.input_axis(c.pressure_exponent)),
        'yaxis': plot.axis(f'generated power{data.at_pressure} (MW)'),
    }  # fmt: skip
    if (day := last_range(data)) is not None:
        layout['shapes'] = [plot.stripe(*day, 'today')]
        layout['annotations'] = [{
            'text': 'last day', 'showarrow': False, 'x': day[1], 'xanchor': 'right',
            'yref': 'paper', 'y': 0.01, 'yanchor': 'bottom',
            'font': {'color': plot.token('muted')},
        }]  # fmt: skip
    ends, values = c.breakpoints, c.values()
    words = (
        f'Flow characteristic of {say.counted(len(c.pieces), "piece")} from {name} '
        f'{say.plain(float(ends[0]))} ({say.plain(float(values[0]))} MW) to {name} '
        f'{say.plain(float(ends[-1]))} ({say.plain(float(values[-1]))} MW), over the density of '
        'special samples.'
    )
    return Figure('curve', _caption(data), words, traces, layout, height=500)


def opening_figure(data: Identified) -> Figure | None:
    """Return the power over the opening at typical pressures.

    None if the pressure is unknown, or if the curve is already over the opening.
    """
    wanted = [Signal.VALVE_OPENING, Signal.MAIN_STEAM_PRESSURE]
    opening, pressure = data.table.values[data.special][:, wanted].T
    known = np.isfinite(opening) & (pressure > 0.0)
    if not known.any() or data.one_pressure:
        return None
    opening, pressure = opening[known], pressure[known]
    low, middle, high = np.quantile(pressure, (0.05, 0.5, 0.95), method='nearest').tolist()
    wide = high - low > _SAME_PRESSURE * middle
    traces = [
        plot.line(
            plot.rounded(v), plot.rounded(data.characteristic.power(v, p)), f'at {p:.3g} MPa',
            colour, 'opening %{x:.3~g} %<br>%{y:.4~g} MW', width=2.6 if p == middle else 1.6,
            dash=dash,
        )
        for p, colour, dash in (
            (high, 'chosen', 'dot'), (middle, 'curve', ''), (low, 'raw', 'dash')
        )
        if p == middle or wide
        for seen in (opening[np.abs(pressure - p) <= _SAME_PRESSURE * p],)
        for v in (np.linspace(float(seen.min()), float(seen.max()), _OPENINGS),)
    ]  # fmt: skip
    caption = (
        '<b>Power against opening.</b> The same curve against the opening of '
        f'the valve, at the median pressure of the special segments, {middle:.3g} MPa'
        + (', and at its 5 % and 95 % quantiles.' if wide else '.')
        + ' Each line ends with the openings seen at its pressure, within 2 %.'
    )
    words = f'Power against the valve opening at {middle:.3g} MPa.'
    layout = {'xaxis': plot.axis('valve opening (%)'), 'yaxis': plot.axis('generated power (MW)')}
    return Figure('opening', caption, words, traces, layout, height=360)


def surface_figure(data: Identified) -> Figure | None:
    """Return the power over opening and pressure with the residuals of the special segments.

    None if the pressure hardly moves, or there are too few segments.
    """
    c = data.characteristic
    found = segment_residuals(c, data.segments)
    middles = {(s.start_ns + s.end_ns) // 2: s for s in data.segments}
    chosen = [middles[t] for t in found.time_ns.tolist()]
    opening = np.array([0.5 * (s.opening_start_percent + s.opening_end_percent) for s in chosen])
    pressure = np.array([0.5 * (s.pressure_start_mpa + s.pressure_end_mpa) for s in chosen])
    known = np.isfinite(opening) & np.isfinite(pressure)
    opening, pressure, residual = opening[known], pressure[known], found.residual_mw[known]
    if len(residual) < _LEAST:
        return None
    if pressure_range(pressure) < LEAST_PRESSURE_RANGE:
        return None
    p = np.linspace(float(pressure.min()), float(pressure.max()), _OPENINGS)
    widest = float(opening.min()), float(opening.max())
    traces, names = [], []
    for power in _round_levels(c.power(opening, pressure)):
        v = c.opening(power, p)
        v[(v < widest[0]) | (v > widest[1])] = np.nan
        if np.isfinite(v).sum() < 2:
            continue
        name = f'{power:g} MW'
        at = int(np.flatnonzero(np.isfinite(v))[-1])
        traces.append(
            plot.line(plot.rounded(v), plot.rounded(p), name, 'muted', width=1.2, showlegend=False)
        )
        names.append({
            'text': name, 'x': float(v[at]), 'y': float(p[at]), 'showarrow': False,
            'xanchor': 'left', 'yshift': 9, 'font': {'color': plot.token('muted')},
        })  # fmt: skip
    largest = max(float(np.quantile(np.abs(residual), 0.98)), 1e-3)
    traces.append(plot.points(
        plot.rounded(opening), plot.rounded(pressure), 'special segments', 'data',
        'opening %{x:.3~g} %<br>%{y:.3~g} MPa<br>%{marker.color:+.3~g} MW<extra></extra>',
        size=7, showlegend=False,
        marker={
            'color': plot.rounded(residual, 3), 'cmin': -largest, 'cmax': largest,
            'colorscale': [[0.0, plot.token('chosen')], [0.5, plot.token('grid')],
                           [1.0, plot.token('steady')]],
            'colorbar': {'title': {'text': 'MW'}},
            'line': {'color': plot.token('data'), 'width': 0.5},
        },
    ))  # fmt: skip
    layout: Spec = {
        'xaxis': plot.axis('valve opening (%)'), 'yaxis': plot.axis('main steam pressure (MPa)'),
        'annotations': names,
    }  # fmt: skip
    caption = (
        '<b>Both colours should be mixed everywhere.</b> The lines are the power of the curve '
        'over opening and pressure. Each dot is a special segment; its colour is measured less '
        'curve. A region of one colour: there the curve, or its form, is off.'
    )
    words = (
        f'Power over opening and pressure, and the residuals of '
        f'{say.counted(len(residual), "segment")}; they spread by '
        f'{say.plain(float(np.std(residual)), 2)} MW.'
    )
    return Figure('surface', caption, words, traces, layout, height=440)


def _round_levels(power: FloatArray) -> list[float]:
    """Return at most about ten round numbers in the range of a power."""
    low, high = float(np.nanmin(power)), float(np.nanmax(power))
    step = 10.0 ** math.floor(math.log10(max(high - low, 1e-6) / _CONTOURS))
    step *= next(k for k in (1.0, 2.0, 5.0, 10.0) if (high - low) / (k * step) <= _CONTOURS)
    return [float(v) for v in step * np.arange(math.ceil(low / step), math.floor(high / step) + 1)]


def _caption(data: Identified) -> str:
    c, name = data.shown, say.input_name(data.shown.pressure_exponent)
    parts = [
        '<b>The curve should run through the middle of the samples.</b> Colour: density of the '
        'samples in special segments.'
    ]
    if data.at_pressure:
        parts.append(
            'The breakpoints of this valve are at fixed openings; the power is '
            f'shown{data.at_pressure}, at other pressures p the part without the constant c is '
            f'proportional to p^{data.characteristic.pressure_scale_exponent:.3g}.'
        )
    if len(c.pieces) > 1:
        parts.append(
            'Circles are the breakpoints; a bar through one is the range in which it lies with '
            '95 % confidence.'
        )
    parts.append(
        'The shaded band, often thinner than the line itself, is the 95 % range of the curve.'
    )
    if data.reference is not None:
        parts.append('The dotted <span class="key reference">line</span> is the reference.')
    if (day := last_range(data)) is not None:
        parts.append(
            f'The tinted background is where the unit ran in the last day, {name} {day[0]:.0f} to '
            f'{day[1]:.0f}.'
        )
    if _unrefined(data):
        parts.append(
            'The dashed <span class="key raw">line</span> is the curve before it was corrected '
            'for the delay and lag of the unit on ramps.'
        )
    return ' '.join(parts)


def _line(
    pieces: tuple[Piece, ...], name: str, colour: str, width: float, dash: str = '',
    hover: str = '',
) -> Spec:  # fmt: skip
    x = [v for p in pieces for v in (p.u_from, p.u_to, math.nan)]
    y = [
        v for p in pieces
        for v in (p.slope * p.u_from + p.intercept, p.slope * p.u_to + p.intercept, math.nan)
    ]  # fmt: skip
    told = f'{hover}<extra>{name}</extra>' if hover else ''
    return plot.line(
        plot.rounded(x, 7), plot.rounded(y, 7), name, colour, told, width=width, dash=dash
    )


def density(
    x: FloatArray, y: FloatArray, columns: int, rows: int
) -> tuple[tuple[float, float], tuple[float, float], IntArray]:
    """Count points in a grid that covers their range.

    Returns
    -------
    across, up : tuple of float
        Centre of the first cell and distance between cells.
    counts : int64 (rows, columns)
    """
    (x_low, x_high), (y_low, y_high) = _span(x), _span(y)
    counts, _, _ = np.histogram2d(
        y, x, bins=(rows, columns), range=((y_low, y_high), (x_low, x_high))
    )
    x_step, y_step = (x_high - x_low) / columns, (y_high - y_low) / rows
    across, up = (x_low + 0.5 * x_step, x_step), (y_low + 0.5 * y_step, y_step)
    return across, up, counts.astype(np.int64)


def _span(values: FloatArray) -> tuple[float, float]:
    """Return the ends of the range of values, not identical even if all values are equal."""
    if not len(values):
        return 0.0, 1.0
    low, high = float(values.min()), float(values.max())
    pad = max(1e-9, 1e-6 * abs(low)) if high <= low else 0.0
    return low - pad, high + pad


def _heat(u: FloatArray, power: FloatArray, hover: str) -> Spec:
    (x0, dx), (y0, dy), counts = density(u, power, _COLUMNS, _ROWS)
    most = max(1, int(counts.max(initial=0)))
    # The colour scale is logarithmic in the count.
    places = np.linspace(0.0, 1.0, _SHADES)
    if most > 1:
        places = (most**places - 1.0) / (most - 1.0)
    return {
        'type': 'heatmap', 'name': 'special samples', 'showscale': False,
        'x0': x0, 'dx': dx, 'y0': y0, 'dy': dy,
        'z': [[c or None for c in row] for row in counts.tolist()],
        'zmin': 1, 'zmax': max(2, most), 'hoverongaps': False,
        'colorscale': [[float(p), plot.token(f'density-{k}')] for k, p in enumerate(places)],
        'hovertemplate': f'{hover}<br>%{{z}} samples<extra></extra>',
    }  # fmt: skip


def _bands(data: Identified, u_samples: FloatArray) -> list[Spec]:
    traces: list[Spec] = []
    for piece in data.shown.pieces:
        u = np.linspace(piece.u_from, piece.u_to, 25)
        error = Z95 * band(piece, u_samples, u)
        if np.all(np.isfinite(error)):
            middle = piece.slope * u + piece.intercept
            edge = np.append(middle + error, (middle - error)[::-1])
            traces.append(plot.area(
                plot.rounded(np.append(u, u[::-1]), 6), plot.rounded(edge, 6), '95 % band',
                legendgroup='band', showlegend=not traces,
            ))  # fmt: skip
    return traces


def _breakpoints(data: Identified) -> Spec:
    c = data.shown
    u, x = c.breakpoints[1:-1], c.values()[1:-1]
    low, high = np.array(c.breakpoint_intervals, dtype=np.float64).reshape(-1, 2).T
    hover = [
        f'breakpoint at {say.input_name(c.pressure_exponent)} {say.plain(float(b), 5)}'
        + (f'<br>95 %: {say.plain(float(lo), 5)} to {say.plain(float(hi), 5)}'
           if math.isfinite(lo) and math.isfinite(hi) else '')
        for b, lo, hi in zip(u, low, high, strict=True)
    ]  # fmt: skip
    return plot.points(
        plot.rounded(u, 7), plot.rounded(x, 7), 'breakpoints, 95 %', 'paper', size=9,
        marker={'line': {'color': plot.token('curve'), 'width': 2}}, hovertext=hover,
        hoverinfo='text',
        error_x=plot.error_bars(low, u, high, thickness=2, width=5, color=plot.token('curve')),
    )  # fmt: skip


def last_range(data: Identified) -> tuple[float, float] | None:
    """Return the central 99 % range of u in the last day of the log.

    None if the log is not much longer than a day, or if u is unknown in the last day.
    """
    time_ns = data.table.time_ns
    if not len(time_ns) or time_ns[-1] - time_ns[0] < _LONGER * _DAY_NS:
        return None
    u = data.u[np.searchsorted(time_ns, time_ns[-1] - _DAY_NS) :]
    u = u[np.isfinite(u)]
    if not len(u):
        return None
    low, high = np.quantile(u, (0.005, 0.995))
    return float(low), float(high)


def segments_figure(data: Identified) -> Figure | None:
    """Return the mean residual of each segment; None if there are too few segments."""
    c = data.characteristic
    found = segment_residuals(c, data.segments)
    if len(found) < _LEAST:
        return None
    unit = say.input_unit(data.shown.pressure_exponent)
    name = say.input_name(data.shown.pressure_exponent)
    y, marker = plot.rounded(found.residual_mw), {'opacity': 0.75}
    traces = [
        plot.points(plot.rounded(found.u / data.u_per_percent, 6), y, f'over {name}', 'chosen',
               f'{name} %{{x:.4~g}} {unit}<br>%{{y:+.3~g}} MW<extra></extra>', marker=marker),
        plot.points(plot.packed(found.time_ns / 1e6), y, 'over time', 'chosen',
               f'{DAY_HOUR}%{{y:+.3~g}} MW<extra></extra>', marker=marker, xaxis='x2', yaxis='y2'),
    ]  # fmt: skip
    layout: Spec = {
        'xaxis': plot.axis(f'{name} ({unit})', domain=[0.0, 0.47], anchor='y'),
        'xaxis2': plot.time_axis(domain=[0.53, 1.0], anchor='y2', nticks=4),
        'yaxis': plot.axis('measured less curve (MW)'),
        'yaxis2': {'anchor': 'x2', 'matches': 'y', 'showticklabels': False},
        'shapes': [plot.zero_line(0.0, 0.47, yref='y'), plot.zero_line(0.53, 1.0, yref='y2')],
        'showlegend': False,
    }
    caption = (
        f'<b>The points should scatter about zero, at every {name} and at every time.</b> Each '
        'is a special segment. A bend on the left: the curve lacks a piece. A step or a slope on '
        'the right: the unit changed while the data were taken, and diagnose may say why.'
    )
    words = (
        f'Mean residual of {say.counted(len(found), "segment")} over {name} and over time; they '
        f'spread by {say.plain(float(np.std(found.residual_mw)), 2)} MW.'
    )
    return Figure('residuals', caption, words, traces, layout, height=340)


def shift_section(data: Identified) -> Section | None:
    """Return the judgement against the reference; None without a reference."""
    shift = data.shift
    if shift is None or data.reference is None:
        return None
    told = html.text(shift.sentence)
    name, scale = say.input_name(data.shown.pressure_exponent), data.u_per_percent
    head = [
        'piece', name, 'moved', 'now (MW)', '% of flow', 'difference in the middle (MW)',
        'along the piece (MW)', 'confidence that it moved', 'smallest visible move (MW)',
    ]  # fmt: skip
    parts: list[str | Figure] = [
        html.notice(told) if shift.moved else html.paragraph(told),
        reference_table(data),
        html.table(head, [_row(k, piece, scale) for k, piece in enumerate(shift.pieces, 1)]),
    ]
    found = segment_residuals(data.reference, data.segments)
    if len(found):
        parts.append(_shift_figure(shift, found, name, scale))
    return Section('Against the reference', parts)


def _row(number: int, p: PieceShift, scale: float) -> list[str]:
    if not math.isfinite(p.u_from):
        return [str(number), 'not in the reference', *[''] * 7]
    sure = f'> {100.0 * _SURE:g} %' if p.confidence > _SURE else f'{100.0 * p.confidence:.1f} %'
    return [
        str(number), say.span(p.u_from / scale, p.u_to / scale), '<b>yes</b>' if p.moved else 'no',
        say.with_error(p.now_mw, p.now_error_mw) if math.isfinite(p.now_mw) else '–',
        say.decimals(p.percent, 2) if p.moved else '–', say.with_error(p.middle_mw, p.error_mw),
        say.span(p.low_mw, p.high_mw, 2), sure, say.plain(p.smallest_mw, 2),
    ]  # fmt: skip


def _shift_figure(shift: Shift, found: SegmentResiduals, u: str, scale: float) -> Figure:
    moved = np.zeros(len(found), dtype=bool)
    for p in shift.pieces:
        if p.moved:
            moved |= (found.u >= p.u_from) & (found.u < p.u_to)
    looks = ((~moved, 'pieces that did not move', 'data'), (moved, 'pieces that moved', 'steady'))
    traces = [
        plot.points(
            plot.packed(part.time_ns / 1e6), plot.rounded(part.residual_mw), name, colour,
            f'{DAY_HOUR}{u} %{{customdata:.4~g}}<br>%{{y:+.3~g}} MW<extra>{name}</extra>',
            customdata=plot.rounded(part.u / scale),
        )
        for keep, name, colour in looks if keep.any() for part in (found.part(keep),)
    ]  # fmt: skip
    caption = (
        '<b>Without a shift the points scatter about zero.</b> Each is a special segment, '
        'measured less what the reference gives.'
    )
    shapes = [plot.zero_line()]
    if shift.since_ns:
        caption += (
            f' The line marks the change, {say.moment(shift.since_ns)}; shaded, where it lies '
            'with 95 % confidence.'
        )
        shapes += [
            plot.stripe(shift.since_low_ns / 1e6, shift.since_high_ns / 1e6, 'band'),
            plot.upright(shift.since_ns / 1e6, 'chosen', 2),
        ]
    about = 'Difference of each special segment from the reference curve over time.'
    layout = {'xaxis': plot.time_axis(), 'yaxis': plot.axis('measured less reference (MW)'),
              'shapes': shapes, 'hovermode': 'closest'}  # fmt: skip
    return Figure('shift', caption, about, traces, layout, height=380)
