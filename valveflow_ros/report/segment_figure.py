"""What the curve leaves of each special segment: over u, and over time."""

from __future__ import annotations

import numpy as np

from valveflow_ros.curve.segment_residual import SegmentResiduals, segment_residuals
from valveflow_ros.report.figure import Figure, Spec, packed, rounded, token
from valveflow_ros.report.identified import Identified
from valveflow_ros.report.numbers import counted, plain
from valveflow_ros.report.words import input_unit

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
