"""The pictures of a comparison: Figs. 7 and 11 of the paper."""

from __future__ import annotations

import numpy as np

from valveflow_ros.records import FloatArray
from valveflow_ros.report.comparison_csv import curves_of
from valveflow_ros.report.comparison_data import LEGEND, METHODS, Compared
from valveflow_ros.report.downsample import thin
from valveflow_ros.report.figure import Figure, Spec, rounded, token
from valveflow_ros.report.words import input_axis
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
