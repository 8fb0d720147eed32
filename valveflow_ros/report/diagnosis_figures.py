"""The pictures of a diagnosis: the residual by variable, around fast moves, by segment."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from valveflow_ros.diagnosis.cause import Estimate, dates, told
from valveflow_ros.diagnosis.evidence import SegmentGain
from valveflow_ros.diagnosis.signature import Answer, ResidualMap, Signature
from valveflow_ros.records import FloatArray
from valveflow_ros.report.figure import Figure, Spec, rounded, token
from valveflow_ros.report.page import text
from valveflow_ros.report.words import (
    UNKNOWN,
    counted,
    input_unit,
    input_unit_plain,
    interval,
    plain,
)

# How a diagnosis is put for people: its variables, its parameters, times as dates.


# What the residual is held against: in a sentence, at an axis, at a narrow one, and what a
# line that leaves the band there points to.
_VARIABLES = {
    'u': (
        'the integrated input u', 'integrated input u ({unit})', '',
        'A bend or a step here points to the shape of the curve.',
    ),
    'pressure given u': (
        'the steam pressure given u', 'pressure above its usual at that u (MPa)',
        'pressure above usual (MPa)',
        'A tilt here points to the pressure exponent or to a flow that is choked.',
    ),
    'temperature': (
        'the steam temperature', 'main steam temperature (°C)', 'steam temperature (°C)',
        'A tilt here points to steam temperature or reheating.',
    ),
    'time': (
        'time', 'time (UTC)', '',
        'A step points to something that happened then, a slope to wear or drift.',
    ),
    'time of day': (
        'the time of day', 'time of day (h UTC)', '',
        'A wave here points to cooling water or ambient temperature.',
    ),
    'ramp': (
        'the ramp rate', 'change of u in 3 min ({unit})', '',
        'A tilt here points to lag and delay, or to a valve that is slower than its command.',
    ),
    'direction': (
        'the direction of motion', 'last motion (−1 closing, +1 opening)',
        'last motion (−1 to +1)',
        'A difference between the two ends points to backlash or stiction.',
    ),
}  # fmt: skip
_MOST_SPANS = 20


def variable(name: str) -> str:
    """Return a variable as it stands in a sentence."""
    return _VARIABLES[name][0] if name in _VARIABLES else name


def axis_title(name: str, exponent: float) -> str:
    """Return what stands at the axis of a variable, as HTML; the exponent is that of u."""
    if name not in _VARIABLES:
        return name
    return _VARIABLES[name][1].replace('{unit}', input_unit(exponent))


def axis_titles(name: str, exponent: float) -> dict[str, str]:
    """Return what stands at an axis, and at a narrow one, as HTML."""
    short = _VARIABLES[name][2] if name in _VARIABLES else ''
    return {'text': axis_title(name, exponent), **({'short': short} if short else {})}


def points_to(name: str) -> str:
    """Return what a line that leaves the band points to; '' where nothing is known."""
    return _VARIABLES[name][3] if name in _VARIABLES else ''


def cells(estimate: Estimate, exponent: float) -> tuple[str, str]:
    """Return a parameter with its unit, and its 95 % interval; a time and its own as dates."""
    if estimate.origin_ns is not None:
        at, between = dates(estimate)
        return at, between or UNKNOWN
    unit = estimate.unit.replace(input_unit_plain(math.nan), input_unit_plain(exponent))
    value = f'{plain(estimate.value)} {unit}'.strip()
    return value, interval(estimate.low, estimate.high)


def times_in_effect(switches_s: Sequence[float], start_ns: int, end_ns: int) -> str:
    """Return when a cause was in effect that is switched in and out, as dates.

    Parameters
    ----------
    switches_s : sequence of float
        In, out, in, ...: seconds after the first row.
    start_ns, end_ns : int
        First and last row.
    """
    moments = [told(start_ns, s) for s in switches_s]
    if len(moments) % 2:
        moments.append(told(end_ns, 0.0))
    spans = [f'{a} to {b}' for a, b in zip(moments[::2], moments[1::2], strict=True)]
    shown = '; '.join(spans[:_MOST_SPANS])
    more = len(spans) - _MOST_SPANS
    return f'{shown}; and {more} times more' if more > 0 else shown


_MS = 13  # digits of a time in ms since 1970
TIME_AXIS: Spec = {'type': 'date', 'title': {'text': 'time (UTC)'}}


def moments(start_ns: int, time_s: FloatArray) -> list[float | None]:
    """Return times since the first row as a date axis wants them: ms since 1970."""
    return rounded(start_ns / 1e6 + 1e3 * np.asarray(time_s), _MS)


def _line(
    x: list[float | None], y: FloatArray, name: str, colour: str, dash: str = 'solid'
) -> Spec:
    return {
        'type': 'scatter', 'mode': 'lines+markers', 'name': name, 'x': x,
        'y': rounded(y, 4), 'line': {'color': token(colour), 'width': 2, 'dash': dash},
        'marker': {'size': 5},
    }  # fmt: skip


def _band(x: list[float | None], width: FloatArray) -> Spec:
    """Return the band round zero that chance fills."""
    return {
        'type': 'scatter', 'mode': 'lines', 'name': 'by chance (99 %)', 'fill': 'toself',
        'x': [*x, *x[::-1]],
        'y': rounded(np.concatenate([width, -width[::-1]]), 4),
        'line': {'width': 0, 'color': token('band')}, 'fillcolor': token('band'),
        'hoverinfo': 'skip',
    }  # fmt: skip


def hover(variable_name: str, exponent: float) -> str:
    """Return what a point of a mean residual says when pointed at."""
    if variable_name == 'time':
        return '%{x|%d %b %H:%M}<br>%{y:+.2f} MW'
    return f'{axis_title(variable_name, exponent)}: %{{x:.4~g}}<br>%{{y:+.2f}} MW'


def signature_figure(
    s: Signature, start_ns: int, how: str = '', exponent: float = math.nan
) -> Figure:
    """Return the mean residual against one variable, before and after extending.

    ``how`` says how such a picture is read, ``exponent`` is that of u.
    """
    over: Spec = {'title': axis_titles(s.variable, exponent)}
    x = rounded(s.middle, 6)
    if s.variable == 'time':
        over, x = TIME_AXIS, moments(start_ns, s.middle)
    elif s.variable == 'time of day':
        x = rounded(s.middle / 3600.0, 6)
    return Figure(
        f'residual-{s.variable.replace(" ", "-")}',
        f'<b>Measured minus simulated power against {text(variable(s.variable))}.</b> '
        f'{points_to(s.variable)} {how}',
        f'Mean residual against {variable(s.variable)}, from {plain(float(s.before.min()), 2)} to '
        f'{plain(float(s.before.max()), 2)} MW before and {plain(float(s.after.min()), 2)} to '
        f'{plain(float(s.after.max()), 2)} MW after.',
        [_band(x, s.chance),
         *({**_line(x, values, name, colour, dash), 'hovertemplate': hover(s.variable, exponent)}
           for values, name, colour, dash in (
               (s.before, 'simulation', 'raw', 'dash'),
               (s.after, 'extended model', 'curve', 'solid')))],
        {'xaxis': over,
         'yaxis': {'title': {'text': 'mean residual (MW)'}}},
        height=300,
    )  # fmt: skip


def answer_figure(answers: Sequence[Answer]) -> Figure:
    """Return the mean residual around fast moves, opening and closing apart."""
    traces = []
    for a in answers:
        time_s = rounded(a.time_s, 6)
        way = f'{"opening" if a.up else "closing"}, {counted(a.moves, "move")}'
        colour = 'steady' if a.up else 'slope'
        for name, values, dash in (
            ('simulation', a.before, 'dash'), ('extended model', a.after, 'solid'),
        ):  # fmt: skip
            line = _line(time_s, values, f'{name}, {way}', colour, dash)
            traces.append({**line, 'hovertemplate': '%{x:.0f} s<br>%{y:+.2f} MW'})
    chance = max(a.chance for a in answers)
    return Figure(
        'fast-moves',
        '<b>Mean residual around fast moves of the valve.</b> A slow or early answer shows here '
        f'only. By chance a point lies within ±{plain(chance, 2)} MW.',
        'Mean residual from a minute before to five minutes after fast moves.',
        traces,
        {'xaxis': {'title': {'text': 'time after the move (s)'}},
         'yaxis': {'title': {'text': 'mean residual (MW)'}}},
        height=340,
    )  # fmt: skip


def segments_figure(segments: Sequence[SegmentGain]) -> Figure:
    """Return the error in every special segment of the sealed blocks, before and after."""
    better = sum(s.rmse_after < s.rmse_before for s in segments)
    at = rounded(np.array([s.start_ns / 1e6 for s in segments]), _MS)
    traces = [
        {
            'type': 'scatter', 'mode': 'markers', 'name': name, 'x': at,
            'y': rounded(np.array(values), 4),
            'marker': {'color': token(colour), 'size': 6, 'symbol': symbol},
            'hovertemplate': '%{x|%d %b %H:%M}<br>%{y:.2f} MW',
        }
        for name, values, colour, symbol in (
            ('simulation', [s.rmse_before for s in segments], 'raw', 'circle-open'),
            ('extended model', [s.rmse_after for s in segments], 'curve', 'circle'),
        )
    ]  # fmt: skip
    return Figure(
        'segments',
        f'<b>Special segments inside the sealed blocks.</b> {better} of {len(segments)} are '
        'predicted better by the extended model.',
        f'{counted(len(segments), "segment")}, {better} of them predicted better.',
        traces,
        {'xaxis': TIME_AXIS,
         'yaxis': {'title': {'text': 'RMSE (MW)'}}},
        height=340,
    )  # fmt: skip


# Two maps of the residual side by side: simulation and extended model.


def map_figure(m: ResidualMap, start_ns: int, exponent: float = math.nan) -> Figure:
    """Return where the simulation is wrong over two variables, and where the extended model is."""
    across, over = rounded(m.across_edges, 6), Spec()
    if m.across == 'time':
        across = moments(start_ns, m.across_edges)
        over = {'type': 'date', 'nticks': 4, 'tickangle': 0, 'tickformat': '%-d'}
    largest = max(
        (float(np.nanmax(np.abs(x))) for x in (m.before, m.after) if np.isfinite(x).any()),
        default=1.0,
    )
    name = m.across.replace(' ', '-')
    return Figure(
        f'map-{name}',
        f'<b>Residual over {text(variable(m.across))} and {text(variable(m.up))}</b>, '
        'simulation left, extended model right. Only cells beyond chance are filled: '
        f'{m.shown_before} of {m.cells} for the simulation, {m.shown_after} for the extended '
        f'model; chance alone fills about {plain(0.01 * m.cells, 1)}.',
        f'{m.shown_before} of {m.cells} cells are beyond chance before, {m.shown_after} after.',
        [_half(m.before, across, m.up_edges, largest, ''),
         _half(m.after, across, m.up_edges, largest, '2')],
        {
            'xaxis': {**over, 'domain': [0.0, 0.46]},
            'xaxis2': {**over, 'domain': [0.54, 1.0], 'anchor': 'y2'},
            'yaxis': {'title': {'text': axis_title(m.up, exponent)}},
            # One title for both axes: side by side there is no room for two on a telephone.
            'annotations': [
                {'text': _below(m.across, exponent), 'showarrow': False, 'xref': 'paper', 'x': 0.5,
                 'xanchor': 'center', 'yref': 'paper', 'y': 0.0, 'yshift': -56}
            ],
            'margin': {'l': 56, 'r': 12, 't': 34, 'b': 70},
            'yaxis2': {'anchor': 'x2', 'matches': 'y', 'showticklabels': False},
        },
        height=380,
    )  # fmt: skip


def _below(name: str, exponent: float) -> str:
    return 'day of the month (UTC)' if name == 'time' else axis_title(name, exponent)


def _half(
    cells: np.ndarray, across: list[float | None], up: np.ndarray, largest: float, axis: str
) -> Spec:
    return {
        'type': 'heatmap', 'name': 'extended model' if axis else 'simulation',
        'x': across, 'y': rounded(up, 4),
        'z': [rounded(row, 3) for row in cells], 'zmin': -largest, 'zmax': largest, 'zmid': 0.0,
        'colorscale': 'RdBu', 'showscale': axis == '2',
        'colorbar': {'title': {'text': 'MW'}}, 'xaxis': f'x{axis}', 'yaxis': f'y{axis}',
        'hovertemplate': '%{z} MW<extra></extra>',
    }  # fmt: skip
