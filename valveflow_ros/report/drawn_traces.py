"""One line, cloud, map or set of bars of a picture, drawn by matplotlib."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from valveflow_ros.records import FloatArray
from valveflow_ros.report.figure import Spec
from valveflow_ros.report.picture_data import column, numbers, plain_text

Palette = Mapping[str, str]
_DASHES = {'dash': '--', 'dot': ':', 'dashdot': '-.'}
_SIGNS = {
    'circle': 'o', 'circle-open': 'o', 'square': 's', 'diamond': 'D', 'triangle-up': '^',
    'x': 'X', 'cross': 'P', 'star': '*', 'line-ns-open': '|',
}  # fmt: skip
_POINTS = 72.0 / 96.0  # of a pixel
_MAPS = {'RdBu': 'RdBu_r'}  # plotly's runs the other way round


def colour_of(name: str, colours: Palette) -> Any:
    """Return a colour as matplotlib takes it; ``token:steady`` is looked up."""
    value = colours[name[6:]] if name.startswith('token:') else name
    if match := re.fullmatch(r'rgba\((\d+), (\d+), (\d+), ([\d.]+)\)', value):
        red, green, blue, alpha = (float(v) for v in match.groups())
        return red / 255.0, green / 255.0, blue / 255.0, alpha
    return value


def hours(ms: Sequence[Any] | FloatArray) -> FloatArray:
    """Return ms since 1970 as matplotlib's days."""
    return np.asarray(ms, dtype=np.float64) / 86400e3


def draw_trace(pane: Any, trace: Spec, colours: Palette, date: bool) -> None:
    """Draw one trace into a pane; ``date`` tells that x are ms since 1970."""
    kind = trace['type']
    if kind == 'heatmap':
        _heat(pane, trace, colours, date)
    elif kind == 'bar':
        _bars(pane, trace, colours)
    else:
        _scatter(pane, trace, colours, date)


def _label(trace: Spec) -> str:
    shown = trace.get('showlegend', True) and trace.get('name')
    return plain_text(str(trace['name'])) if shown else '_'


def _x(trace: Spec, date: bool) -> FloatArray:
    return hours(numbers(trace, 'x')) if date else numbers(trace, 'x')


def _y(trace: Spec) -> Any:
    values = column(trace, 'y')
    if any(isinstance(v, str) for v in values):
        # matplotlib wants words throughout; a gap of x breaks the line all the same.
        words = [v for v in values if isinstance(v, str)]
        return [v if isinstance(v, str) else words[0] for v in values]
    return np.array(values, dtype=np.float64)


def _scatter(pane: Any, trace: Spec, colours: Palette, date: bool) -> None:
    x, y = _x(trace, date), _y(trace)
    if trace.get('fill') == 'toself':
        pane.fill(
            x, y, facecolor=colour_of(trace['fillcolor'], colours), linewidth=0,
            label=_label(trace),
        )  # fmt: skip
        return
    mode, line = trace.get('mode', 'lines'), trace.get('line', {})
    look: dict[str, Any] = {'linestyle': 'none', 'label': _label(trace)}
    if 'lines' in mode:
        look['linestyle'] = _DASHES.get(line.get('dash', ''), '-')
        look['color'] = colour_of(line['color'], colours)
        look['linewidth'] = line.get('width', 2) * _POINTS
        look['solid_capstyle'] = 'butt'
        if line.get('shape') == 'hv':
            look['drawstyle'] = 'steps-post'
    if 'markers' not in mode:
        pane.plot(x, y, **look)
        return
    _marked(pane, trace, colours, x, y, look)


def _marked(
    pane: Any, trace: Spec, colours: Palette, x: FloatArray, y: Any, look: dict[str, Any]
) -> None:
    marker = trace.get('marker', {})
    sign = str(marker.get('symbol', 'circle'))
    given = marker.get('color', look.get('color', 'token:curve'))
    if isinstance(given, list) or isinstance(marker.get('size'), list):
        _one_by_one(pane, marker, colours, x, y, look)
        return
    colour = colour_of(given, colours) if isinstance(given, str) else given
    edge = marker.get('line', {}).get('color')
    look |= {
        'marker': _SIGNS.get(sign, 'o'), 'markersize': marker.get('size', 6) * _POINTS,
        'markerfacecolor': 'none' if sign == 'circle-open' else colour,
        'markeredgecolor': colour_of(edge, colours) if edge else colour,
        'alpha': marker.get('opacity'),
    }  # fmt: skip
    look.setdefault('color', colour)
    pane.plot(x, y, **look)
    for letter in 'xy':
        if bars := trace.get(f'error_{letter}'):
            ends = np.array([bars['arrayminus'], bars['array']], dtype=np.float64)
            pane.errorbar(
                x, y, fmt='none', capsize=3, ecolor=colour_of(bars['color'], colours),
                **{f'{letter}err': np.abs(ends)},
            )  # fmt: skip


def _one_by_one(
    pane: Any, marker: Spec, colours: Palette, x: FloatArray, y: Any, look: dict[str, Any]
) -> None:
    """Draw points that differ in colour or size over their line."""
    pane.plot(x, y, **look)
    size, colour = marker.get('size', 6), marker['color']
    sizes = size if isinstance(size, list) else [size] * len(x)
    shades = colour if isinstance(colour, list) else [colour] * len(x)
    pane.scatter(
        x, y, s=[(v * _POINTS) ** 2 for v in sizes],
        c=[colour_of(c, colours) for c in shades], zorder=3,
    )  # fmt: skip


def _edges(places: FloatArray, count: int) -> FloatArray:
    """Return the edges of cells that are given by their middles or by their edges."""
    if len(places) == count + 1:
        return places
    half = 0.5 * (places[1] - places[0]) if count > 1 else 0.5
    return np.append(places - half, places[-1] + half)


def _heat(pane: Any, trace: Spec, colours: Palette, date: bool) -> None:
    from matplotlib.colors import LinearSegmentedColormap

    cells = np.array([[np.nan if v is None else v for v in row] for row in trace['z']])
    rows, across = cells.shape
    given = column(trace, 'y')
    words = bool(given) and isinstance(given[0], str)
    up = np.arange(rows) if words else np.array(given, dtype=np.float64)
    scale = trace['colorscale']
    if isinstance(scale, str):
        shades: Any = _MAPS.get(scale, scale)
    else:
        places = [(place, colour_of(name, colours)) for place, name in scale]
        shades = LinearSegmentedColormap.from_list('own', places)
    drawn = pane.pcolormesh(
        _edges(_x(trace, date), across), _edges(np.asarray(up, dtype=np.float64), rows), cells,
        vmin=trace.get('zmin'), vmax=trace.get('zmax'), cmap=shades, rasterized=True,
    )  # fmt: skip
    if trace.get('showscale', True):
        title = trace.get('colorbar', {}).get('title', {}).get('text', '')
        pane.figure.colorbar(drawn, ax=pane, label=title)


def _bars(pane: Any, trace: Spec, colours: Palette) -> None:
    """Draw bars on top of those that stand there already, as the page stacks them."""
    x, y = numbers(trace, 'x'), numbers(trace, 'y')
    below = getattr(pane, 'stacked', np.zeros_like(y))
    width = float(x[1] - x[0]) if len(x) > 1 else 1.0
    given = trace['marker']['color']
    shades = [given] if isinstance(given, str) else given
    colour = [colour_of(c, colours) for c in shades]
    width *= 0.8 if len(shades) > 1 else 1.0
    pane.bar(x, y, width=width, bottom=below, color=colour, label=_label(trace))
    pane.stacked = below + y
