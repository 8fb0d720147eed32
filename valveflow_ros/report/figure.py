"""A picture as plain data: what plotly draws, with colours by name.

A colour is written ``token:steady``; the page looks it up in its style sheet
when it draws, so that the same picture suits light, dark and paper.
"""

from __future__ import annotations

import base64
import csv
import io
import json
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from html import unescape
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.records import FloatArray, IntArray, SpecialSegment

Spec = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Figure:
    """One picture of the page.

    Attributes
    ----------
    name : str
        Letters and dashes; the element's id.
    caption : str
        HTML that says what to look for.
    description : str
        Plain text for those who cannot see the picture.
    traces : list
        plotly traces.
    layout : dict
        What differs from the page's base layout.
    height : int
        In pixels.
    """

    name: str
    caption: str
    description: str
    traces: list[Spec]
    layout: Spec = field(default_factory=dict)
    height: int = 420

    def to_json(self) -> str:
        """Return the picture for the page's script; safe inside a script element."""
        content = {'data': self.traces, 'layout': {**self.layout, 'height': self.height}}
        text = json.dumps(_clean(content), separators=(',', ':'), allow_nan=False)
        return text.replace('<', '\\u003c').replace('>', '\\u003e').replace('&', '\\u0026')


def without_tags(html: str) -> str:
    """Return HTML without its tags, powers with a caret: ``MPa^(9/8)``; signs stay escaped."""
    html = re.sub(r'<sup>([^<]*/[^<]*)</sup>', r'^(\1)', html)
    html = re.sub(r'<sup>([^<]*)</sup>', r'^\1', html)
    return re.sub(r'<[^>]+>', '', html)


def token(name: str) -> str:
    """Return a colour by its name in the style sheet."""
    return f'token:{name}'


def rounded(values: NDArray[Any], digits: int = 5) -> list[float | None]:
    """Return values for the eye: so many significant digits of the largest; NaN is a gap."""
    values = np.asarray(values, dtype=np.float64)
    good = np.isfinite(values)
    largest = float(np.abs(values[good]).max()) if good.any() else 0.0
    places = digits - 1 - math.floor(math.log10(largest)) if largest > 0.0 else 0
    return [
        round(v, places) if ok else None
        for v, ok in zip(values.tolist(), good.tolist(), strict=True)
    ]


def packed(values: NDArray[Any]) -> Spec:
    """Return an array in plotly's binary form, exact and compact; NaN stays a gap."""
    data = np.ascontiguousarray(values, dtype='<f8')
    return {'dtype': 'f8', 'bdata': base64.b64encode(data.tobytes()).decode()}


def _clean(value: Any) -> Any:
    """Turn numpy scalars into Python's and what is not finite into null."""
    if isinstance(value, Mapping):
        return {str(k): _clean(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_clean(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


# The numbers of a picture as arrays and as a table, whichever way plotly was given them.


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


# Fewer points for the eye; the numbers of the report never come from here.


@dataclass(frozen=True, slots=True)
class Envelope:
    """A signal as its lowest and highest value in each of many equal stretches of time.

    Attributes
    ----------
    start_ns, step_ns : int
        Time of the first point and from one point to the next.
    values : float64 (2 k,)
        Two points a stretch, in the order in which they occur; NaN where nothing was measured.
    """

    start_ns: int
    step_ns: float
    values: FloatArray


def envelope(time_ns: IntArray, values: FloatArray, stretches: int, period_ns: int) -> Envelope:
    """Reduce a signal to at most ``2 * stretches`` points that keep every peak.

    A short signal comes back with each of its values on its own grid place.
    """
    if not len(time_ns):
        return Envelope(0, 1.0, np.empty(0))
    span = int(time_ns[-1] - time_ns[0]) + period_ns
    k = max(1, min(stretches, span // (2 * period_ns)))
    width = span / k
    place = np.minimum(((time_ns - time_ns[0]) / width).astype(np.int64), k - 1)
    good = np.isfinite(values)
    place, value = place[good], values[good]
    out = np.full((k, 2), np.nan)
    if len(value):
        first = np.flatnonzero(np.diff(place, prepend=-1))
        where = place[first]
        low = np.minimum.reduceat(value, first)
        high = np.maximum.reduceat(value, first)
        rising = value[first] <= value[np.append(first[1:], len(value)) - 1]
        out[where, 0] = np.where(rising, low, high)
        out[where, 1] = np.where(rising, high, low)
    return Envelope(int(time_ns[0]), width / 2.0, out.ravel())


@dataclass(frozen=True, slots=True)
class Density:
    """How many samples fall into each cell of a grid.

    Attributes
    ----------
    x_from, x_step, y_from, y_step : float
        Centre of the first cell and distance of cells.
    counts : int64 (rows, columns)
    """

    x_from: float
    x_step: float
    y_from: float
    y_step: float
    counts: IntArray


def density(x: FloatArray, y: FloatArray, columns: int, rows: int) -> Density:
    """Count points in a grid that spans them."""
    x_low, x_high = _span(x)
    y_low, y_high = _span(y)
    counts, _, _ = np.histogram2d(
        y, x, bins=(rows, columns), range=((y_low, y_high), (x_low, x_high))
    )
    x_step, y_step = (x_high - x_low) / columns, (y_high - y_low) / rows
    return Density(
        x_low + 0.5 * x_step, x_step, y_low + 0.5 * y_step, y_step, counts.astype(np.int64)
    )


def _span(values: FloatArray) -> tuple[float, float]:
    """Return the ends of the values, a little apart even where all are equal."""
    if not len(values):
        return 0.0, 1.0
    low, high = float(values.min()), float(values.max())
    pad = max(1e-9, 1e-6 * abs(low)) if high <= low else 0.0
    return low - pad, high + pad


def thin(number: int, most: int) -> IntArray:
    """Return at most ``most`` of ``number`` places, evenly spread, both ends kept."""
    if number <= most:
        return np.arange(number, dtype=np.int64)
    return np.unique(np.linspace(0, number - 1, most).round().astype(np.int64))


def segment_rows(time_ns: IntArray, segments: list[SpecialSegment]) -> IntArray:
    """Return (first row, end row) of each segment within ``time_ns``, shape (k, 2)."""
    starts = np.array([s.start_ns for s in segments], dtype=np.int64)
    ends = np.array([s.end_ns for s in segments], dtype=np.int64)
    return np.column_stack(
        [
            np.searchsorted(time_ns, starts, side='left'),
            np.searchsorted(time_ns, ends, side='right'),
        ]
    ).astype(np.int64)


def segment_path(
    time_ns: IntArray, values: FloatArray, rows: IntArray, points: int
) -> tuple[FloatArray, FloatArray]:
    """Return times in ms and block means along segments, NaN between two segments.

    Parameters
    ----------
    rows : int64 (k, 2)
        First and end row of each segment.
    points : int
        About how many points all segments together may have.
    """
    total = int((rows[:, 1] - rows[:, 0]).sum()) if len(rows) else 0
    block = max(1, -(-total // max(1, points)))
    times, means = [], []
    for first, end in rows.tolist():
        edges = np.arange(first, end, block)
        if not len(edges):
            continue
        sizes = np.diff(np.append(edges, end))
        means += [np.add.reduceat(values[first:end], edges - first) / sizes, np.array([np.nan])]
        middle = np.minimum(edges + sizes // 2, end - 1)
        times += [time_ns[middle] / 1e6, np.array([np.nan])]
    if not times:
        return np.empty(0), np.empty(0)
    return np.concatenate(times), np.concatenate(means)
