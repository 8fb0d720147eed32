# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A figure as plain data for plotly, with colours by name.

A colour is written ``token:steady``; the page looks it up in its style sheet
when it draws, so that the same figure suits the light, dark and print themes.
"""

from __future__ import annotations

import base64
import csv
import io
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone, tzinfo
from html import unescape
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.records import FloatArray, IntArray, finite

Spec = dict[str, Any]
DAY_HOUR = '%{x|%d %b %H:%M}<br>'  # the time in the first line of a hover text


@dataclass(frozen=True, slots=True)
class Figure:
    """One figure of the page."""

    name: str  # letters and dashes; the id of the HTML element
    caption: str  # HTML that says what the figure shows
    description: str  # plain text for screen readers
    traces: list[Spec]  # of plotly
    layout: Spec = field(default_factory=dict)  # differences from the base layout of the page
    height: int = 420  # pixels

    def to_json(self) -> str:
        """Return the figure for the script of the page; safe inside a script element."""
        content = {'data': self.traces, 'layout': {**self.layout, 'height': self.height}}
        text = json.dumps(finite(content), separators=(',', ':'), allow_nan=False)
        return text.replace('<', '\\u003c').replace('>', '\\u003e').replace('&', '\\u0026')


# Numbers for a figure.


def rounded(values: NDArray[Any] | Sequence[float], digits: int = 5) -> list[float | None]:
    """Return values rounded to significant digits of the largest; NaN is a gap."""
    values = np.asarray(values, dtype=np.float64)
    good = np.isfinite(values)
    largest = float(np.abs(values[good]).max()) if good.any() else 0.0
    places = digits - 1 - math.floor(math.log10(largest)) if largest > 0.0 else 0
    return [
        round(v, places) if ok else None
        for v, ok in zip(values.tolist(), good.tolist(), strict=True)
    ]


def moments(time_ms: NDArray[Any] | Sequence[float]) -> list[float | None]:
    """Return times in ms since 1970, rounded to ms, in the format of a date axis."""
    return rounded(time_ms, 13)


def packed(values: NDArray[Any]) -> Spec:
    """Return an array in plotly's binary form, exact and compact; NaN stays a gap."""
    data = np.ascontiguousarray(values, dtype='<f8')
    return {'dtype': 'f8', 'bdata': base64.b64encode(data.tobytes()).decode()}


def in_zone(figure: Figure, zone: tzinfo) -> Figure:
    """Return a figure with the times on its axes in a time zone."""
    dates = [k for k, v in figure.layout.items() if isinstance(v, Mapping) and is_date(dict(v))]
    if not dates:
        return figure
    layout = {k: v for k, v in figure.layout.items() if k not in ('shapes', 'annotations')}
    for key in dates:
        changed = dict(layout[key])
        title = dict(changed.get('title', {}))
        changed['title'] = {k: str(v).replace('UTC', str(zone)) for k, v in title.items()}
        if 'range' in changed:
            changed['range'] = [local_ms(v, zone) for v in changed['range']]
        layout[key] = changed
    for key in ('shapes', 'annotations'):
        if key in figure.layout:
            layout[key] = [_moved(mark, dates, zone) for mark in figure.layout[key]]
    traces = []
    for trace in figure.traces:
        new = dict(trace)
        for letter in 'xy':
            if is_date(axis_of(figure, trace, letter)):
                new[letter] = [local_ms(v, zone) for v in column(trace, letter)]
                new.pop(f'{letter}0', None), new.pop(f'd{letter}', None)
        traces.append(new)
    return replace(figure, traces=traces, layout=layout)


def _moved(mark: Spec, dates: Sequence[str], zone: tzinfo) -> Spec:
    """Return a shape or an annotation with its positions on time axes in a zone."""
    new = dict(mark)
    for letter in 'xy':
        ref = str(mark.get(f'{letter}ref', letter))
        if ref[0] == letter and f'{letter}axis{ref[1:]}' in dates:
            for key in (letter, f'{letter}0', f'{letter}1'):
                if isinstance(new.get(key), int | float):
                    new[key] = local_ms(new[key], zone)
    if 'text' in new:
        new['text'] = str(new['text']).replace('(UTC)', f'({zone})')
    return new


def local_ms(ms: Any, zone: tzinfo) -> Any:
    """Return ms since 1970 as local time of a zone; gaps and strings stay."""
    if not isinstance(ms, int | float) or not math.isfinite(ms):
        return None if isinstance(ms, float) else ms
    offset = datetime.fromtimestamp(ms / 1000.0, timezone.utc).astimezone(zone).utcoffset()
    return ms + (offset.total_seconds() * 1000.0 if offset else 0.0)


def envelope(
    time_ns: IntArray, values: FloatArray, stretches: int, period_ns: int
) -> tuple[int, float, FloatArray]:
    """Reduce a signal to at most ``2 * stretches`` points, keeping every peak.

    A short signal keeps each of its values at its own grid position. Returns the time of the first
    point, the step, and the lowest and highest value of each interval in the order in which they
    occur, float64 (2 k,), NaN if nothing was measured.
    """
    if not len(time_ns):
        return 0, 1.0, np.empty(0)
    span = int(time_ns[-1] - time_ns[0]) + period_ns
    k = max(1, min(stretches, span // (2 * period_ns)))
    width = span / k
    place = np.minimum(((time_ns - time_ns[0]) / width).astype(np.int64), k - 1)
    good = np.isfinite(values)
    place, value = place[good], values[good]
    out = np.full((k, 2), np.nan)
    if len(value):
        first = np.flatnonzero(np.diff(place, prepend=-1))
        low = np.minimum.reduceat(value, first)
        high = np.maximum.reduceat(value, first)
        rising = value[first] <= value[np.append(first[1:], len(value)) - 1]
        out[place[first], 0] = np.where(rising, low, high)
        out[place[first], 1] = np.where(rising, high, low)
    return int(time_ns[0]), width / 2.0, out.ravel()


# Traces, axes and marks. Keyword arguments are plotly's and take precedence.


def token(name: str) -> str:
    """Return a colour by its name in the style sheet."""
    return f'token:{name}'


def _hover(template: str) -> Spec:
    return {'hovertemplate': template} if template else {'hoverinfo': 'skip'}


def line(
    x: Any, y: Any, name: str, colour: str, hover: str = '', *, width: float = 2,
    dash: str = '', shape: str = '', **more: Any,
) -> Spec:  # fmt: skip
    """Return a line; without a hover text it does not react to the pointer."""
    look: Spec = {'color': token(colour), 'width': width}
    look |= {k: v for k, v in (('dash', dash), ('shape', shape)) if v}
    return {'type': 'scatter', 'mode': 'lines', 'name': name, 'x': x, 'y': y, 'line': look,
            **_hover(hover), **more}  # fmt: skip


def points(
    x: Any, y: Any, name: str, colour: str, hover: str = '', *, size: float = 6,
    marker: Mapping[str, Any] | None = None, **more: Any,
) -> Spec:  # fmt: skip
    """Return a cloud of points; ``marker`` adds to their style."""
    look = {'color': token(colour), 'size': size, **(marker or {})}
    return {'type': 'scatter', 'mode': 'markers', 'name': name, 'x': x, 'y': y, 'marker': look,
            **_hover(hover), **more}  # fmt: skip


def area(x: Any, y: Any, name: str, **more: Any) -> Spec:
    """Return the area inside a closed line, in the colour of a band."""
    return {'type': 'scatter', 'mode': 'lines', 'fill': 'toself', 'hoverinfo': 'skip', 'x': x,
            'y': y, 'fillcolor': token('band'), 'line': {'width': 0}, 'name': name,
            **more}  # fmt: skip


def error_bars(low: FloatArray, middle: FloatArray, high: FloatArray, **more: Any) -> Spec:
    """Return the bars from ``low`` to ``high``; of length zero if an end is unknown."""
    known = np.isfinite(low) & np.isfinite(high)
    return {'type': 'data', 'symmetric': False,
            'array': rounded(np.where(known, high - middle, 0.0)),
            'arrayminus': rounded(np.where(known, middle - low, 0.0)), **more}  # fmt: skip


def axis(title: str | Mapping[str, str], **more: Any) -> Spec:
    """Return an axis; a title with a short form for narrow windows is a mapping."""
    return {'title': {'text': title} if isinstance(title, str) else dict(title), **more}


def time_axis(**more: Any) -> Spec:
    """Return an axis of times in ms since 1970."""
    return axis('time (UTC)', type='date', **more)


def stripe(x0: float, x1: float, colour: str, **more: Any) -> Spec:
    """Return a coloured background between two positions on the x axis."""
    return {'type': 'rect', 'layer': 'below', 'yref': 'paper', 'y0': 0, 'y1': 1, 'x0': x0,
            'x1': x1, 'fillcolor': token(colour), 'line': {'width': 0}, **more}  # fmt: skip


def upright(x: float, colour: str, width: float, **look: Any) -> Spec:
    """Return a vertical line at one position on the x axis."""
    return {'type': 'line', 'yref': 'paper', 'y0': 0, 'y1': 1, 'x0': x, 'x1': x,
            'line': {'color': token(colour), 'width': width, **look}}  # fmt: skip


def zero_line(x0: float = 0, x1: float = 1, **more: Any) -> Spec:
    """Return a line at y = 0, by default across the whole figure."""
    return {'type': 'line', 'xref': 'paper', 'x0': x0, 'x1': x1, 'y0': 0, 'y1': 0,
            'line': {'color': token('muted'), 'width': 1}, **more}  # fmt: skip


# Reading back the numbers of a figure, in any of the formats of plotly.


def without_tags(html: str) -> str:
    """Return HTML without tags, exponents with a caret: ``MPa^(9/8)``; entities stay escaped."""
    html = re.sub(r'<sup>([^<]*/[^<]*)</sup>', r'^(\1)', html)
    html = re.sub(r'<sup>([^<]*)</sup>', r'^\1', html)
    return re.sub(r'<[^>]+>', '', html)


def plain_text(html: str) -> str:
    """Return HTML as one line of plain text."""
    return unescape(without_tags(html.replace('<br>', ' '))).strip()


def column(trace: Spec, axis: str) -> list[Any]:
    """Return the positions of a trace on ``x`` or ``y``: numbers (NaN for a gap) or strings."""
    given = trace.get(axis)
    if isinstance(given, dict):
        return list(np.frombuffer(base64.b64decode(given['bdata']), dtype=given['dtype']).tolist())
    if given is None:
        other = trace['z'] if 'z' in trace else trace['y']
        count = len(other[0]) if 'z' in trace and axis == 'x' else len(other)
        start, step = float(trace[f'{axis}0']), float(trace[f'd{axis}'])
        return [start + step * k for k in range(count)]
    return [math.nan if v is None else v for v in given]


def numbers(trace: Spec, axis: str) -> FloatArray:
    """Return the same as float64 (n,)."""
    return np.array(column(trace, axis), dtype=np.float64)


def axis_of(figure: Figure, trace: Spec, letter: str) -> Spec:
    """Return the layout of the axis of a trace."""
    name = str(trace.get(f'{letter}axis', letter))
    return dict(figure.layout.get(f'{letter}axis{name[1:]}', {}))


def is_date(axis: Spec) -> bool:
    """Return True if an axis shows ms since 1970."""
    return axis.get('type') == 'date'


def csv_text(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table as CSV; a number that is not finite becomes an empty cell."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator='\n')
    writer.writerow(head)
    for row in rows:
        writer.writerow(['' if isinstance(v, float) and not math.isfinite(v) else v for v in row])
    return out.getvalue()


def figure_csv(figure: Figure) -> str:
    """Return the data of a figure as CSV: one row per point, with the name of its line.

    Times are written in UTC. A row is missing where a line has a gap. The values are the drawn
    ones, reduced in number and rounded; the JSON of the result has them unrounded.
    """
    rows = []
    for number, trace in enumerate(figure.traces):
        name = plain_text(str(trace.get('name', f'line {number + 1}')))
        across, up = axis_of(figure, trace, 'x'), axis_of(figure, trace, 'y')
        titles = [plain_text(str(a.get('title', {}).get('text', ''))) for a in (across, up)]
        for x, y, *values in _points(trace):
            cells = [_cell(x, is_date(across)), _cell(y, is_date(up)), *map(_cell, values)]
            if cells[0] and (cells[1] or cells[2]):
                rows.append([name, *cells, *titles])
    head = ['line', 'x', 'y', 'value', 'y_low', 'y_high', 'x_axis', 'y_axis']
    return csv_text(head, rows)


def _cell(value: Any, date: bool = False) -> str:
    if isinstance(value, str) or value is None:
        return value or ''
    if not math.isfinite(value):
        return ''
    return f'{np.datetime64(round(value), "ms")}Z' if date else repr(value)


def _points(trace: Spec) -> Iterator[tuple[Any, Any, Any, Any, Any]]:
    x, y = column(trace, 'x'), column(trace, 'y')
    if trace['type'] == 'heatmap':
        across = _centres(x, len(trace['z'][0]))
        for place, row in zip(_centres(y, len(trace['z'])), trace['z'], strict=True):
            for at, value in zip(across, row, strict=True):
                if value is not None:
                    yield at, place, value, None, None
        return
    bars = trace.get('error_y')
    for k, (at, place) in enumerate(zip(x, y, strict=True)):
        if bars is None or not isinstance(place, float | int):
            yield at, place, None, None, None
        else:
            yield at, place, None, place - bars['arrayminus'][k], place + bars['array'][k]


def _centres(places: list[Any], count: int) -> list[Any]:
    if len(places) == count:
        return places
    return [0.5 * (a + b) for a, b in pairwise(places)]
