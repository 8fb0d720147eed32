"""The pictures of a comparison: Figs. 7 and 11 of the paper."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timezone

import numpy as np

from valveflow_ros.baselines.judged import JudgedSegment
from valveflow_ros.records import NS_PER_S, FloatArray, IntArray, SegmentKind
from valveflow_ros.report.comparison_tables import LEGEND, METHODS, Compared, curves_of
from valveflow_ros.report.figure import Figure, Spec, rounded, thin, token
from valveflow_ros.report.words import counted, input_axis, plain
from valveflow_ros.segments.window import WindowContents

_DOTS = 5000
# Colour, dash and width of each method's line, everywhere on the page.
LOOK = {
    'paper': ('raw', 'dash', 1.6),
    'proposed': ('curve', 'solid', 2.4),
    'hammerstein': ('slope', 'dashdot', 2.0),
    'sparse': ('chosen', 'dot', 2.0),
}


def line_of(method: str, axis: str = 'y', shown: bool = True) -> Spec:
    """Return what all lines of a method have in common."""
    colour, dash, width = LOOK[method]
    return {
        'type': 'scatter', 'mode': 'lines', 'name': LEGEND[method], 'yaxis': axis,
        'line': {'color': token(colour), 'dash': dash, 'width': width},
        'legendgroup': method, 'showlegend': shown,
    }  # fmt: skip


def _dots(contents: WindowContents, special: bool) -> tuple[FloatArray, FloatArray]:
    """Return some of the measured points, of special segments or of all rows."""
    rows = contents.special_rows() if special else np.arange(len(contents.u))
    rows = rows[np.isfinite(contents.u[rows]) & np.isfinite(contents.power_mw[rows])]
    rows = rows[thin(len(rows), _DOTS)]
    return contents.u[rows], contents.power_mw[rows]


def _cloud(contents: WindowContents, special: bool) -> Spec:
    u, power = _dots(contents, special)
    return {
        'type': 'scatter', 'mode': 'markers', 'hoverinfo': 'skip',
        'name': 'special samples' if special else 'all samples',
        'x': rounded(u), 'y': rounded(power, 4),
        'marker': {'color': token('data-soft'), 'size': 2.5, 'opacity': 0.5},
    }  # fmt: skip


def _curves(data: Compared, axis: str = 'y') -> list[Spec]:
    curves = curves_of(data)
    traces: list[Spec] = []
    if 'truth' in curves:
        traces.append(
            {
                'type': 'scatter', 'mode': 'lines', 'name': 'truth', 'yaxis': axis,
                'x': rounded(curves['u'], 6), 'y': rounded(curves['truth'], 6),
                'line': {'color': token('density-2'), 'width': 6},
                'hovertemplate': 'u %{x:.0f}<br>%{y:.1f} MW',
            }
        )  # fmt: skip
    for method in METHODS:
        if method in curves:
            traces.append(
                {
                    **line_of(method, axis), 'x': rounded(curves['u'], 6),
                    'y': rounded(curves[method], 6),
                    'hovertemplate': 'u %{x:.0f}<br>%{y:.1f} MW',
                }
            )  # fmt: skip
    return traces


def curves_figure(data: Compared) -> Figure:
    """Return the curves over the special samples they are judged by (Fig. 7)."""
    layout = {
        'xaxis': {'title': input_axis(data.result.characteristic.pressure_exponent)},
        'yaxis': {'title': {'text': 'generated power (MW)'}},
        'showlegend': True,
    }
    caption = (
        '<b>Every line should run through the cloud.</b> Grey: samples of special segments of '
        'the data learnt from. The curve of the sparse model is where its equation rests.'
    )
    traces = [_cloud(data.learnt, special=True), *_curves(data)]
    words = 'Flow characteristics of all methods over the special samples.'
    return Figure('curves', caption, words, traces, layout, height=480)


def truth_figure(data: Compared) -> Figure:
    """Return the curves over all samples, and how far each is from the true one (Fig. 11)."""
    curves = curves_of(data)
    traces = [_cloud(data.learnt, special=False), *_curves(data)]
    for method in METHODS:
        if method in curves:
            off = curves[method] - curves['truth']
            traces.append(
                {
                    **line_of(method, 'y2', shown=False), 'x': rounded(curves['u'], 6),
                    'y': rounded(off, 4), 'hovertemplate': 'u %{x:.0f}<br>%{y:.2f} MW',
                }
            )  # fmt: skip
    layout = {
        'xaxis': {
            'title': input_axis(data.result.characteristic.pressure_exponent),
            'anchor': 'y2',
        },
        'yaxis': {'domain': [0.44, 1.0], 'title': {'text': 'power (MW)'}},
        'yaxis2': {'domain': [0.0, 0.38], 'title': {'text': 'curve − truth (MW)'}},
        'showlegend': True,
    }
    caption = (
        '<b>Below, a perfect curve would lie at zero.</b> Above, the same curves over all '
        'samples; the wide line is the truth.'
    )
    words = 'Curves of all methods and their errors against the true curve.'
    return Figure('truth', caption, words, traces, layout, height=620)


# Stretches of the data to judge by, measured and simulated: Figs. 9 and 10 of the paper.

_LENGTH_S = 7200.0
_MOVE_S = 900.0
_POINTS = 600
_HOVER = '%{x|%d %b %H:%M:%S}<br>%{y:.1f} MW'
_COLOUR = {SegmentKind.STEADY: 'steady', SegmentKind.SLOPE: 'slope'}


@dataclass(frozen=True, slots=True)
class Stretch:
    """Rows [first, end) to be shown, and the segments within."""

    name: str
    first: int
    end: int
    segments: tuple[JudgedSegment, ...]


def stretches(data: Compared) -> list[Stretch]:
    """Return two hours at low and two at high power, those with most special segments."""
    trial, segments = data.result.trial, data.result.judgement.segments
    rows = round(_LENGTH_S / trial.step_s)
    middle = float(np.median([s.power_mw for s in segments]))
    chosen = []
    for name, low in (('low', True), ('high', False)):
        best: Stretch | None = None
        for s in segments:
            first = max(0, int(s.rows[0]) - round(300.0 / trial.step_s))
            end = min(first + rows, len(trial.u))
            inside = tuple(
                t for t in segments if first <= t.rows[0] and t.rows[-1] < end
            )  # fmt: skip
            fits = inside and all((t.power_mw <= middle) is low for t in inside)
            if fits and (best is None or _worth(inside) > _worth(best.segments)):
                best = Stretch(name, first, end, inside)
        if best is not None:
            chosen.append(best)
    return chosen


def _worth(segments: tuple[JudgedSegment, ...]) -> tuple[int, int]:
    kinds = {s.kind for s in segments}
    return len(kinds), len(segments)


def _means(values: FloatArray, first: int, end: int) -> FloatArray:
    """Return means over short blocks, so that lines stay readable."""
    block = max(1, (end - first) // _POINTS)
    usable = (end - first) // block * block
    with np.errstate(invalid='ignore'):
        return np.asarray(values[first : first + usable].reshape(-1, block).mean(axis=1))


def _times(time_ns: IntArray, first: int, end: int) -> list[float | None]:
    return rounded(_means(time_ns[first:end] / 1e6, 0, end - first), 14)


def _measured(data: Compared, first: int, end: int, axis: str) -> Spec:
    trial = data.result.trial
    power = np.where(np.isfinite(data.judged.power_mw), data.judged.power_mw, np.nan)
    return {
        'type': 'scatter', 'mode': 'lines', 'name': 'measured', 'yaxis': axis,
        'x': _times(trial.time_ns, first, end), 'y': rounded(_means(power, first, end), 5),
        'line': {'color': token('data-soft'), 'width': 1.2}, 'legendgroup': 'measured',
        'hovertemplate': _HOVER,
        'showlegend': axis == 'y',
    }  # fmt: skip


def _predicted(
    data: Compared, prediction: str, first: int, end: int, axis: str, **changes: object
) -> Spec:
    values = data.result.predictions[prediction]
    spec = line_of(prediction.partition('.')[0], axis)
    return {
        **spec, 'x': _times(data.result.trial.time_ns, first, end),
        'y': rounded(_means(np.where(np.isfinite(values), values, np.nan), first, end), 5),
        'hovertemplate': _HOVER, **changes,
    }  # fmt: skip


def stretch_figure(data: Compared, stretch: Stretch) -> Figure:
    """Return measured and predicted power with special segments marked (Fig. 9)."""
    first, end = stretch.first, stretch.end
    there = data.result.predictions
    traces = [_measured(data, first, end, 'y'), _measured(data, first, end, 'y2')]
    for name in ('paper.static', 'proposed.dynamic'):
        if name in there:
            traces.append(_predicted(data, name, first, end, 'y'))
    for name in ('hammerstein.dynamic', 'sparse.dynamic'):
        if name in there:
            traces.append(_predicted(data, name, first, end, 'y2'))
    shapes = [
        {
            'type': 'rect', 'xref': 'x', 'yref': 'paper', 'y0': 0, 'y1': 1, 'layer': 'below',
            'x0': s.start_ns / 1e6, 'x1': s.end_ns / 1e6, 'opacity': 0.14,
            'fillcolor': token(_COLOUR[s.kind]), 'line': {'width': 0},
        }
        for s in stretch.segments
    ]  # fmt: skip
    layout = {
        # Labels that may turn and turn back would never let the margins rest.
        'xaxis': {
            'type': 'date', 'anchor': 'y2', 'title': {'text': 'time (UTC)'}, 'tickangle': 0,
            'nticks': 8,
        },
        'yaxis': {'domain': [0.53, 1.0], 'title': {'text': 'power (MW)'}},
        'yaxis2': {'domain': [0.0, 0.47], 'title': {'text': 'power (MW)'}, 'matches': 'y'},
        'shapes': shapes, 'showlegend': True,
    }  # fmt: skip
    caption = (
        f'<b>At {stretch.name} power: each line should cover the grey one.</b> Above the '
        "paper's static curve and valveflow's simulation, below the simulations of the other two. "
        'Shaded: <span class="key steady">steady-state</span> and '
        '<span class="key slope">slope-response</span> segments.'
    )
    words = f'Measured and predicted power over two hours at {stretch.name} power.'
    return Figure(f'stretch-{stretch.name}', caption, words, traces, layout, height=560)


def _fastest(data: Compared, low: bool) -> tuple[int, int] | None:
    """Return rows around the flow's largest move in five minutes, at low or at high power."""
    trial = data.result.trial
    flow = np.where(trial.good, data.result.predictions['proposed.static'], np.nan)
    rows = max(1, round(300.0 / trial.step_s))
    if len(flow) <= 2 * rows:
        return None
    moved = np.abs(flow[rows:] - flow[:-rows])
    middle = np.nanmedian(flow)
    same = (flow[rows:] < middle) & (flow[:-rows] < middle)
    if not low:
        same = (flow[rows:] >= middle) & (flow[:-rows] >= middle)
    moved = np.where(same & np.isfinite(moved), moved, -1.0)
    at = int(np.argmax(moved))
    if moved[at] <= 0.0:
        return None
    half = round(0.5 * _MOVE_S / trial.step_s)
    return max(0, at + rows // 2 - half), min(len(flow), at + rows // 2 + half)


def moves_figure(data: Compared) -> Figure | None:
    """Return how the power follows the flow at low and at high power (Fig. 10)."""
    spans = [_fastest(data, low) for low in (True, False)]
    if None in spans:
        return None
    traces: list[Spec] = []
    layout: Spec = {'showlegend': True}
    there = data.result.predictions
    for k, span in enumerate(spans):
        assert span is not None
        x, y = ('x', 'y') if k == 0 else ('x2', 'y2')
        mine = [_measured(data, *span, 'y')]
        mine.append(
            _predicted(data, 'proposed.static', *span, 'y', name='steam flow F(u)',
                       line={'color': token('chosen'), 'width': 1.4})
        )  # fmt: skip
        for name in ('proposed.dynamic', 'hammerstein.dynamic'):
            if name in there:
                mine.append(_predicted(data, name, *span, 'y'))
        for trace in mine:
            trace |= {'xaxis': x, 'yaxis': y, 'showlegend': k == 0}
        traces += mine
        left, right = (0.0, 0.44) if k == 0 else (0.56, 1.0)
        load, day = f'{"low" if k == 0 else "high"} power', _day(data, span[0])
        layout[f'xaxis{x[1:]}'] = {
            'type': 'date', 'domain': [left, right], 'anchor': y, 'nticks': 3,
            'title': {
                'text': f'{load}<br>{day:%d %b %Y} (UTC)', 'short': f'{load}<br>{day:%d %b}',
            },
            'tickformat': '%H:%M', 'tickangle': 0,
        }  # fmt: skip
        layout[f'yaxis{y[1:]}'] = {'anchor': x, 'title': {'text': 'power (MW)' if k == 0 else ''}}
    caption = (
        '<b>How long the power lags behind the flow.</b> Where one block for all loads answers '
        'too slowly on the left or too quickly on the right, the dynamics differ between loads.'
    )
    words = 'Steam flow and power in a large move at low and at high power.'
    return Figure('moves', caption, words, traces, layout, height=380)


def _day(data: Compared, row: int) -> datetime:
    second = int(data.result.trial.time_ns[row]) // NS_PER_S
    return datetime.fromtimestamp(second, tz=timezone.utc)


def linear_block_words(data: Compared) -> str:
    """Say what linear block the Hammerstein model has."""
    m = data.result.hammerstein.model
    times = ', '.join(f'{plain(float(t), 3)} s' for t in m.time_constants_s)
    return (
        f'The Hammerstein model has one linear block for all loads: {counted(len(m.b), "tap")}, '
        f'{counted(len(m.denominator), "pole")} (time constants {times or "none"}), delay '
        f'{plain(m.delay * m.step_s, 3)} s.'
    )
