"""The curve over the samples it was found in, with what is known of its error."""

from __future__ import annotations

import math

import numpy as np

from valveflow_ros.curve.characteristic import Piece
from valveflow_ros.curve.segment_residual import SegmentResiduals, segment_residuals
from valveflow_ros.curve.shift import PieceShift, Shift
from valveflow_ros.records import FloatArray
from valveflow_ros.report.figure import Density, Figure, Spec, density, packed, rounded, token
from valveflow_ros.report.identified import Identified
from valveflow_ros.report.page import Section, notice, paragraph, table, text
from valveflow_ros.report.words import (
    counted,
    decimals,
    input_axis,
    input_unit,
    moment,
    plain,
    with_error,
)

_Z95 = 1.959963984540054
_SHADES = 5
_COLUMNS, _ROWS = 150, 100
_DAY_NS = 86400 * 10**9
_LONGER = 1.5  # of a log in days, for its last day to be worth marking


def band(piece: Piece, u_samples: FloatArray, u: FloatArray) -> FloatArray:
    """Return the standard error of one piece's line at ``u`` in MW, NaN if not known.

    For a straight line through samples with mean m and variance s of u, the
    error is ``slope_stderr * sqrt((u - m)^2 + s)``: smallest where the samples
    are, and growing away from them. Taking it from the slope's error alone
    avoids the difference of two large numbers that slope and intercept give.
    """
    inside = u_samples[(u_samples >= piece.u_from) & (u_samples <= piece.u_to)]
    if not math.isfinite(piece.slope_stderr) or len(inside) < 3:
        return np.full(len(u), np.nan)
    return np.asarray(piece.slope_stderr * np.sqrt((u - inside.mean()) ** 2 + inside.var()))


def _line(piece: Piece, u: FloatArray) -> FloatArray:
    return np.asarray(piece.slope * u + piece.intercept)


def _lines(pieces: tuple[Piece, ...]) -> tuple[FloatArray, FloatArray]:
    """Return end points of all pieces, a gap between two."""
    x, y = [], []
    for piece in pieces:
        ends = np.array([piece.u_from, piece.u_to])
        x += [*ends, np.nan]
        y += [*_line(piece, ends), np.nan]
    return np.array(x), np.array(y)


def _shades(most: int) -> list[list[float | str]]:
    """Return a colour scale whose steps follow the logarithm of the count."""
    places = np.linspace(0.0, 1.0, _SHADES)
    if most > 1:
        places = (most**places - 1.0) / (most - 1.0)
    return [[float(p), token(f'density-{k}')] for k, p in enumerate(places)]


def _heat(cells: Density) -> Spec:
    most = max(1, int(cells.counts.max(initial=0)))
    return {
        'type': 'heatmap', 'name': 'special samples', 'showscale': False,
        'x0': cells.x_from, 'dx': cells.x_step, 'y0': cells.y_from, 'dy': cells.y_step,
        'z': [[c or None for c in row] for row in cells.counts.tolist()],
        'zmin': 1, 'zmax': max(2, most), 'colorscale': _shades(most), 'hoverongaps': False,
        'hovertemplate': 'u %{x:.0f}<br>%{y:.1f} MW<br>%{z} samples<extra></extra>',
    }  # fmt: skip


def _bands(data: Identified, u_samples: FloatArray) -> list[Spec]:
    traces: list[Spec] = []
    for piece in data.characteristic.pieces:
        u = np.linspace(piece.u_from, piece.u_to, 25)
        error = _Z95 * band(piece, u_samples, u)
        if not np.all(np.isfinite(error)):
            continue
        line = _line(piece, u)
        traces.append(
            {
                'type': 'scatter', 'mode': 'lines', 'fill': 'toself', 'hoverinfo': 'skip',
                'x': rounded(np.append(u, u[::-1]), 6),
                'y': rounded(np.append(line + error, (line - error)[::-1]), 6),
                'fillcolor': token('band'), 'line': {'width': 0}, 'legendgroup': 'band',
                'name': '95 % band', 'showlegend': not traces,
            }
        )  # fmt: skip
    return traces


def _breakpoints(data: Identified) -> Spec:
    c = data.characteristic
    u, x = c.breakpoints[1:-1], c.values()[1:-1]
    low = np.array([lo for lo, _ in c.breakpoint_intervals])
    high = np.array([hi for _, hi in c.breakpoint_intervals])
    known = np.isfinite(low) & np.isfinite(high)
    hover = [
        f'breakpoint at u {plain(float(b), 5)}'
        + (f'<br>95 %: {plain(float(lo), 5)} to {plain(float(hi), 5)}' if ok else '')
        for b, lo, hi, ok in zip(u, low, high, known, strict=True)
    ]
    return {
        'type': 'scatter', 'mode': 'markers', 'name': 'breakpoints, 95 %',
        'x': rounded(u, 7), 'y': rounded(x, 7), 'hovertext': hover, 'hoverinfo': 'text',
        'marker': {
            'color': token('paper'), 'size': 9, 'line': {'color': token('curve'), 'width': 2},
        },
        'error_x': {
            'type': 'data', 'symmetric': False, 'thickness': 2, 'width': 5,
            'color': token('curve'),
            'array': rounded(np.where(known, high - u, 0.0)),
            'arrayminus': rounded(np.where(known, u - low, 0.0)),
        },
    }  # fmt: skip


def last_range(data: Identified) -> tuple[float, float] | None:
    """Return between which u the unit ran in the last day of the log, but for 1 % of the time.

    None where the log is hardly longer than that, or u is not known then.
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


def _last_day(data: Identified) -> Spec:
    """Return the marks of the last day's range, as part of the layout."""
    span = last_range(data)
    if span is None:
        return {}
    return {
        'shapes': [
            {
                'type': 'rect', 'layer': 'below', 'yref': 'paper', 'y0': 0, 'y1': 1,
                'x0': span[0], 'x1': span[1], 'fillcolor': token('today'), 'line': {'width': 0},
            }
        ],
        'annotations': [
            {
                'text': 'last day', 'showarrow': False, 'x': span[1], 'xanchor': 'right',
                'yref': 'paper', 'y': 0.01, 'yanchor': 'bottom', 'font': {'color': token('muted')},
            }
        ],
    }  # fmt: skip


def _reference(data: Identified) -> list[Spec]:
    if data.reference is None:
        return []
    x, y = _lines(data.reference.pieces)
    return [
        {
            'type': 'scatter', 'mode': 'lines', 'name': 'reference',
            'x': rounded(x, 7), 'y': rounded(y, 7),
            'line': {'color': token('chosen'), 'width': 2, 'dash': 'dot'},
            'hovertemplate': 'u %{x:.0f}<br>%{y:.1f} MW<extra>reference</extra>',
        }
    ]  # fmt: skip


def curve_figure(data: Identified) -> Figure:
    """Return the picture of the characteristic."""
    c = data.characteristic
    special = data.special
    u, power = data.u[special], data.power[special]
    x, y = _lines(c.pieces)
    raw_x, raw_y = _lines(c.partition_pieces)
    traces: list[Spec] = [
        _heat(density(u, power, _COLUMNS, _ROWS)),
        *_bands(data, u),
        {
            'type': 'scatter', 'mode': 'lines', 'name': 'before refining',
            'x': rounded(raw_x, 7), 'y': rounded(raw_y, 7), 'hoverinfo': 'skip',
            'line': {'color': token('raw'), 'width': 1.2, 'dash': 'dash'},
        },
        {
            'type': 'scatter', 'mode': 'lines', 'name': 'flow characteristic',
            'x': rounded(x, 7), 'y': rounded(y, 7),
            'line': {'color': token('curve'), 'width': 2.6},
            'hovertemplate': 'u %{x:.0f}<br>%{y:.1f} MW<extra>flow characteristic</extra>',
        },
    ]  # fmt: skip
    if c.pieces == c.partition_pieces:
        del traces[-2]
    traces[-1:-1] = _reference(data)
    if len(c.pieces) > 1:
        traces.append(_breakpoints(data))
    layout = {
        'xaxis': {'title': input_axis(c.pressure_exponent)},
        'yaxis': {'title': {'text': 'generated power (MW)'}},
        **_last_day(data),
    }
    return Figure('curve', _caption(data), _description(data), traces, layout, height=500)


def _caption(data: Identified) -> str:
    c = data.characteristic
    parts = [
        '<b>The curve should run through the middle of the cloud.</b> Colour: samples in '
        'special segments, the stronger the more there are.'
    ]
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
    if (span := last_range(data)) is not None:
        parts.append(
            f'The tinted background is where the unit ran in the last day, u {span[0]:.0f} to '
            f'{span[1]:.0f}.'
        )
    if c.pieces != c.partition_pieces:
        parts.append(
            'The dashed <span class="key raw">line</span> is the exact partition before the '
            'dynamics were fitted with it; where it leaves the curve, ramps had bent it.'
        )
    return ' '.join(parts)


def _description(data: Identified) -> str:
    c = data.characteristic
    ends, values = c.breakpoints, c.values()
    return (
        f'Flow characteristic of {counted(len(c.pieces), "piece")} from u {plain(float(ends[0]))} '
        f'({plain(float(values[0]))} MW) to u {plain(float(ends[-1]))} '
        f'({plain(float(values[-1]))} MW), over the density of special samples.'
    )


# What the curve leaves of each special segment: over u, and over time.

_LEAST = 3  # segments that are worth a picture


def segments_figure(data: Identified) -> Figure | None:
    """Return the mean residual of each segment; None where there are hardly any."""
    c = data.characteristic
    found = segment_residuals(c, data.segments)
    if len(found) < _LEAST:
        return None
    unit = input_unit(c.pressure_exponent)
    zero: Spec = {'color': token('muted'), 'width': 1}
    layout: Spec = {
        'xaxis': {'domain': [0.0, 0.47], 'anchor': 'y', 'title': {'text': f'u ({unit})'}},
        'xaxis2': {
            'domain': [0.53, 1.0], 'anchor': 'y2', 'type': 'date', 'nticks': 4,
            'title': {'text': 'time (UTC)'},
        },
        'yaxis': {'title': {'text': 'measured less curve (MW)'}},
        'yaxis2': {'anchor': 'x2', 'matches': 'y', 'showticklabels': False},
        'shapes': [
            {
                'type': 'line', 'xref': 'paper', 'yref': axis, 'x0': x0, 'x1': x1, 'y0': 0,
                'y1': 0, 'line': zero,
            }
            for axis, x0, x1 in (('y', 0.0, 0.47), ('y2', 0.53, 1.0))
        ],
        'showlegend': False,
    }  # fmt: skip
    caption = (
        '<b>The points should scatter about zero, at every u and at every time.</b> Each is a '
        'special segment. A bend on the left: the curve lacks a piece. A step or a slope on the '
        'right: the unit changed while the data were taken, and diagnose may say why.'
    )
    spread = float(np.std(found.residual_mw))
    words = (
        f'Mean residual of {counted(len(found), "segment")} over u and over time; they spread '
        f'by {plain(spread, 2)} MW.'
    )
    return Figure('residuals', caption, words, _dots(found, unit), layout, height=340)


def _dots(found: SegmentResiduals, unit: str) -> list[Spec]:
    shared: Spec = {
        'type': 'scatter', 'mode': 'markers', 'y': rounded(found.residual_mw, 5),
        'marker': {'color': token('chosen'), 'size': 6, 'opacity': 0.75},
    }  # fmt: skip
    return [
        {
            **shared, 'name': 'over u', 'x': rounded(found.u, 6),
            'hovertemplate': f'u %{{x:.0f}} {unit}<br>%{{y:+.2f}} MW<extra></extra>',
        },
        {
            **shared, 'name': 'over time', 'x': packed(found.time_ns / 1e6), 'xaxis': 'x2',
            'yaxis': 'y2', 'hovertemplate': '%{x|%d %b %H:%M}<br>%{y:+.2f} MW<extra></extra>',
        },
    ]  # fmt: skip


# The curve against its reference: the judgement, its numbers, and the segments over time.


# One colour a piece, over and over; moved pieces are told apart by being strong.
_STRONG, _SOFT = 'steady', 'data'
_SURE = 0.9999


def shift_section(data: Identified) -> Section | None:
    """Return the part of the page; None where there was no reference."""
    shift = data.shift
    if shift is None or data.reference is None:
        return None
    told = text(shift.sentence)
    lead = notice(told) if shift.moved else paragraph(told)
    found = segment_residuals(data.reference, data.segments)
    parts: list[str | Figure] = [lead, _table(shift)]
    if len(found):
        parts.append(_figure(shift, found))
    return Section('Against the reference', parts)


def _table(shift: Shift) -> str:
    rows = [_row(k, piece) for k, piece in enumerate(shift.pieces)]
    head = [
        'piece', 'u', 'moved', 'now (MW)', '% of flow', 'curves differ in the middle by (MW)',
        'along the piece (MW)', 'confidence', 'smallest shift seen (MW)',
    ]  # fmt: skip
    return table(head, rows)


def _row(k: int, p: PieceShift) -> list[str]:
    if not math.isfinite(p.u_from):
        return [str(k + 1), 'not in the reference', *[''] * 7]
    sure = f'> {100.0 * _SURE:g} %' if p.confidence > _SURE else f'{100.0 * p.confidence:.1f} %'
    return [
        str(k + 1),
        f'{decimals(p.u_from, 0)} to {decimals(p.u_to, 0)}',
        '<b>yes</b>' if p.moved else 'no',
        with_error(p.now_mw, p.now_error_mw) if math.isfinite(p.now_mw) else '–',
        decimals(p.percent, 2) if p.moved else '–',
        with_error(p.middle_mw, p.error_mw),
        f'{decimals(p.low_mw, 2)} to {decimals(p.high_mw, 2)}',
        sure,
        plain(p.smallest_mw, 2),
    ]


def _figure(shift: Shift, found: SegmentResiduals) -> Figure:
    """Return each segment's difference from the reference over time."""
    moved = np.zeros(len(found), dtype=bool)
    for p in shift.pieces:
        if p.moved:
            moved |= (found.u >= p.u_from) & (found.u < p.u_to)
    traces = [
        trace
        for keep, name, colour in (
            (~moved, 'pieces that did not move', _SOFT), (moved, 'pieces that moved', _STRONG)
        )
        if keep.any()
        for trace in _trace(found.part(keep), name, colour)
    ]  # fmt: skip
    layout: Spec = {
        'xaxis': {'type': 'date', 'title': {'text': 'time (UTC)'}},
        'yaxis': {'title': {'text': 'measured less reference (MW)'}},
        'shapes': _marks(shift),
        'hovermode': 'closest',
    }
    caption = (
        '<b>Without a shift the points scatter about zero.</b> Each is a special segment, '
        'measured less what the reference gives.'
    )
    if shift.since_ns:
        caption += (
            f' The line marks the change, {moment(shift.since_ns)}; shaded, where it lies with '
            '95 % confidence.'
        )
    about = 'Difference of each special segment from the reference curve over time.'
    return Figure('shift', caption, about, traces, layout, height=380)


def _trace(found: SegmentResiduals, name: str, colour: str) -> list[Spec]:
    return [
        {
            'type': 'scatter', 'mode': 'markers', 'name': name,
            'x': packed(found.time_ns / 1e6), 'y': rounded(found.residual_mw, 5),
            'customdata': rounded(found.u, 5),
            'marker': {'color': token(colour), 'size': 6},
            'hovertemplate': '%{x|%d %b %H:%M}<br>u %{customdata:.0f}<br>%{y:+.2f} MW'
            f'<extra>{name}</extra>',
        }
    ]  # fmt: skip


def _marks(shift: Shift) -> list[Spec]:
    zero: Spec = {
        'type': 'line', 'xref': 'paper', 'x0': 0, 'x1': 1, 'y0': 0, 'y1': 0,
        'line': {'color': token('muted'), 'width': 1},
    }  # fmt: skip
    if not shift.since_ns:
        return [zero]
    span = {'yref': 'paper', 'y0': 0, 'y1': 1}
    return [
        zero,
        {
            'type': 'rect', **span, 'x0': shift.since_low_ns / 1e6,
            'x1': shift.since_high_ns / 1e6, 'fillcolor': token('band'), 'line': {'width': 0},
            'layer': 'below',
        },
        {
            'type': 'line', **span, 'x0': shift.since_ns / 1e6, 'x1': shift.since_ns / 1e6,
            'line': {'color': token('chosen'), 'width': 2},
        },
    ]  # fmt: skip
