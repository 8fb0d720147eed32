"""The numbers of a picture as arrays and as a table, whichever way plotly was given them."""

from __future__ import annotations

import base64
import csv
import io
import math
from collections.abc import Iterator
from html import unescape
from itertools import pairwise
from typing import Any

import numpy as np

from valveflow_ros.records import FloatArray
from valveflow_ros.report.figure import Figure, Spec, without_tags


def plain_text(html: str) -> str:
    """Return HTML as one line of plain text."""
    return unescape(without_tags(html.replace('<br>', ' '))).strip()


def column(trace: Spec, axis: str) -> list[Any]:
    """Return the places of a trace along ``x`` or ``y``: numbers (NaN for a gap) or words."""
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
    """Return the layout of the axis a trace is drawn on."""
    name = str(trace.get(f'{letter}axis', letter))
    return dict(figure.layout.get(f'{letter}axis{name[1:]}', {}))


def is_date(axis: Spec) -> bool:
    """Tell whether an axis shows ms since 1970."""
    return axis.get('type') == 'date'


def _cell(value: Any, date: bool) -> str:
    if isinstance(value, str) or value is None:
        return value or ''
    if not math.isfinite(value):
        return ''
    if not date:
        return repr(value)
    return f'{np.datetime64(round(value), "ms")}Z'


def figure_csv(figure: Figure) -> str:
    """Return what a picture shows as CSV: one row a point, with the name of its line.

    Times are written in UTC. Lines are broken where a row is missing. The values are those that
    are drawn, thinned out and rounded for the eye; the result's JSON has them unrounded.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator='\n')
    writer.writerow(['line', 'x', 'y', 'value', 'y_low', 'y_high', 'x_axis', 'y_axis'])
    for number, trace in enumerate(figure.traces):
        name = plain_text(str(trace.get('name', f'line {number + 1}')))
        across, up = axis_of(figure, trace, 'x'), axis_of(figure, trace, 'y')
        titles = [plain_text(str(a.get('title', {}).get('text', ''))) for a in (across, up)]
        for x, y, value, low, high in _points(trace):
            cells = [_cell(x, is_date(across)), _cell(y, is_date(up))]
            ends = [_cell(v, False) for v in (value, low, high)]
            if cells[0] and (cells[1] or ends[0]):
                writer.writerow([name, *cells, *ends, *titles])
    return out.getvalue()


def _points(trace: Spec) -> Iterator[tuple[Any, Any, Any, Any, Any]]:
    x, y = column(trace, 'x'), column(trace, 'y')
    if trace['type'] == 'heatmap':
        across = _centres(x, len(trace['z'][0]))
        up = _centres(y, len(trace['z']))
        for place, row in zip(up, trace['z'], strict=True):
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
    """Return the middles of cells that are given by their edges."""
    if len(places) == count:
        return places
    return [0.5 * (a + b) for a, b in pairwise(places)]
