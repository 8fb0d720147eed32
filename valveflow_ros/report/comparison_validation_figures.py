"""Where and when measured and predicted power differ."""

from __future__ import annotations

import math

import numpy as np

from valveflow_ros.baselines.validation import Validation
from valveflow_ros.records import SegmentKind
from valveflow_ros.report.figure import Figure, Spec, packed, rounded, token
from valveflow_ros.report.words import input_axis


def _markers(v: Validation, by_time: bool) -> list[Spec]:
    traces: list[Spec] = []
    looks = ((SegmentKind.STEADY, 'steady', 'steady state'),
             (SegmentKind.SLOPE, 'slope', 'slope response'))  # fmt: skip
    at = '%{x|%d %b %H:%M}' if by_time else 'u %{x:.0f}'
    for kind, colour, name in looks:
        mine = v.judgement.kinds(kind)
        if by_time:
            x: object = packed(np.array([0.5 * (s.start_ns + s.end_ns) / 1e6 for s in mine]))
        else:
            x = rounded(np.array([v.trial.u[s.rows].mean() for s in mine]), 6)
        means = np.array([s.scores[v.judged_by].samples.mean for s in mine])
        traces.append(
            {
                'type': 'scatter', 'mode': 'markers', 'name': name, 'x': x,
                'y': rounded(means, 4),
                'marker': {'color': token(colour), 'size': 6, 'opacity': 0.75},
                'hovertemplate': f'{at}<br>%{{y:+.2f}} MW<extra>{name}</extra>',
            }
        )  # fmt: skip
    return traces


def _tolerance(v: Validation) -> list[Spec]:
    return [
        {
            'type': 'rect', 'xref': 'paper', 'yref': 'y', 'x0': 0, 'x1': 1, 'layer': 'below',
            'y0': -v.tolerance_mw, 'y1': v.tolerance_mw, 'line': {'width': 0},
            'fillcolor': token('density-0'), 'opacity': 0.6,
        }
    ]  # fmt: skip


def input_figure(v: Validation) -> Figure:
    """Return the mean difference of each segment over its input."""
    checks = [c for c in v.pieces if c.segments]
    x, y = [], []
    for c in checks:
        x += [c.u_from, c.u_to, math.nan]
        y += [c.test.mean, c.test.mean, math.nan]
    traces: list[Spec] = [
        *_markers(v, by_time=False),
        {
            'type': 'scatter', 'mode': 'lines', 'name': 'mean of each piece', 'x': rounded(
                np.array(x), 6
            ), 'y': rounded(np.array(y), 4), 'line': {'color': token('curve'), 'width': 2.4},
            'hovertemplate': '%{y:+.2f} MW<extra>mean of the piece</extra>',
        },
    ]  # fmt: skip
    layout = {
        'xaxis': {'title': input_axis(v.characteristic.pressure_exponent)},
        'yaxis': {'title': {'text': 'measured − predicted (MW)'}},
        'shapes': _tolerance(v), 'showlegend': True,
    }  # fmt: skip
    caption = (
        '<b>The points should scatter about zero at every u.</b> Each is the mean of a special '
        f'segment; the band is ± {v.tolerance_mw:.3g} MW.'
    )
    return Figure('by-input', caption, 'Mean difference by input.', traces, layout, 400)


def time_figure(v: Validation) -> Figure:
    """Return the mean difference of each segment over time."""
    layout = {
        'xaxis': {'type': 'date', 'title': {'text': 'time (UTC)'}},
        'yaxis': {'title': {'text': 'measured − predicted (MW)'}},
        'shapes': _tolerance(v), 'showlegend': True,
    }  # fmt: skip
    caption = '<b>A step or a drift here is a change of the plant.</b> The same points over time.'
    return Figure(
        'by-time', caption, 'Mean difference over time.', _markers(v, by_time=True), layout, 340
    )
