"""Where the data are: over u, and over time."""

from __future__ import annotations

import numpy as np

from valveflow_ros.records import SIGNALS, FloatArray, SignalInfo
from valveflow_ros.report.figure import Figure, Spec, rounded, token
from valveflow_ros.report.identified import Identified
from valveflow_ros.report.numbers import percent, plain
from valveflow_ros.report.words import input_axis

_BINS = 60
_STRETCHES = 240
_WHOLE = 0.999  # a stretch of time with fewer of its values is drawn as incomplete
_MS = 13


def coverage_figure(data: Identified) -> Figure | None:
    """Return how long the unit ran at each u, and how much of it could be used."""
    known = data.u[np.isfinite(data.u) & np.isfinite(data.power)]
    if not len(known):
        return None
    edges = np.histogram_bin_edges(known, bins=_BINS)
    hours = data.period_ns / 3600e9
    every, _ = np.histogram(known, bins=edges)
    special, _ = np.histogram(data.u[data.special], bins=edges)
    middle = 0.5 * (edges[1:] + edges[:-1])
    traces = [
        _bars(middle, (every - special) * hours, 'other', 'data-soft'),
        _bars(middle, special * hours, 'special segments', 'density-3'),
    ]
    exponent = data.characteristic.pressure_exponent
    inner = data.characteristic.breakpoints[1:-1]
    layout: Spec = {
        'xaxis': {'title': input_axis(exponent)},
        'yaxis': {'title': {'text': 'time there (h)'}, 'rangemode': 'tozero'},
        'barmode': 'stack', 'bargap': 0, 'showlegend': True,
        'shapes': [
            {
                'type': 'line', 'yref': 'paper', 'y0': 0, 'y1': 1, 'x0': float(u),
                'x1': float(u), 'line': {'color': token('curve'), 'width': 1.5, 'dash': 'dot'},
            }
            for u in inner
        ],
    }  # fmt: skip
    share = len(data.special) / len(known)
    caption = (
        '<b>Every piece needs blue.</b> How long the unit ran at each u; blue, the part inside '
        f'special segments, {percent(share, 2)} of all. Dotted, the breakpoints. Where there is '
        'little blue the curve has little to stand on: more data at that load would help.'
    )
    words = (
        f'Hours by u from {plain(float(edges[0]))} to {plain(float(edges[-1]))}; '
        f'{percent(share, 2)} of the time lies in special segments.'
    )
    return Figure('coverage', caption, words, traces, layout, height=320)


def _bars(x: FloatArray, y: FloatArray, name: str, colour: str) -> Spec:
    return {
        'type': 'bar', 'name': name, 'x': rounded(x, 6), 'y': rounded(y, 4),
        'marker': {'color': token(colour)},
        'hovertemplate': f'u %{{x:.0f}}<br>%{{y:.2f}} h<extra>{name}</extra>',
    }  # fmt: skip


def presence(data: Identified, stretches: int = _STRETCHES) -> tuple[FloatArray, FloatArray]:
    """Return the share of expected rows that have a value, by signal and stretch of time.

    Returns
    -------
    edges_ns : float64 (k + 1,)
    share : float64 (signals, k)
        0 to 1; a missing row counts as one without a value.
    """
    time_ns = data.table.time_ns
    span = int(time_ns[-1] - time_ns[0]) + data.period_ns
    k = max(1, min(stretches, span // (20 * data.period_ns)))
    edges = np.linspace(0.0, float(span), k + 1)
    place = np.minimum(((time_ns - time_ns[0]) / (span / k)).astype(np.int64), k - 1)
    expected = np.maximum(np.diff(np.ceil(edges / data.period_ns)), 1.0)
    known = np.isfinite(data.table.values)
    sent = [i for i in SIGNALS if _sent(data, i)]
    counts = np.zeros((len(sent), k))
    for row, info in zip(counts, sent, strict=True):
        row[:] = np.bincount(place[known[:, info.signal]], minlength=k)
    return float(time_ns[0]) + edges, np.minimum(counts / expected, 1.0)


def _sent(data: Identified, info: SignalInfo) -> bool:
    return bool(np.isfinite(data.table.column(info.signal)).any())


def presence_figure(data: Identified) -> Figure | None:
    """Return when values are missing; None where none is."""
    if len(data.table) < 2:
        return None
    edges, share = presence(data)
    if not share.size or share.min() >= _WHOLE:
        return None
    names = [i.topic.replace('_', ' ') for i in SIGNALS if _sent(data, i)]
    traces: list[Spec] = [
        {
            'type': 'heatmap', 'x': rounded(edges / 1e6, _MS), 'y': names, 'ygap': 3,
            'z': [rounded(100.0 * row, 3) for row in share], 'zmin': 0, 'zmax': 100,
            'colorscale': [[0.0, token('steady')], [0.5, token('notice-rule')],
                           [0.999, token('notice')], [1.0, token('density-1')]],
            'showscale': False,
            'hovertemplate': '%{x|%d %b %H:%M}<br>%{y}: %{z:.0f} % there<extra></extra>',
        }
    ]  # fmt: skip
    layout: Spec = {
        'xaxis': {'type': 'date', 'title': {'text': 'time (UTC)'}},
        'yaxis': {'type': 'category', 'autorange': 'reversed'},
    }
    gone = float((1.0 - share).max())
    caption = (
        '<b>Blue: complete. Yellow to red: values are missing then.</b> Missing are times '
        'without any row and values that were refused; the table above counts them by reason.'
    )
    words = f'Share of values there by signal and time; at worst {percent(gone, 2)} are missing.'
    return Figure('presence', caption, words, traces, layout, height=110 + 34 * len(names))
