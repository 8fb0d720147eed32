# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Figures of the report as PNG and SVG files, drawn by matplotlib from the same data."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np

from valveflow_ros.errors import InputError
from valveflow_ros.records import FloatArray
from valveflow_ros.report.figure import Figure, Spec, axis_of, column, is_date, numbers, plain_text
from valveflow_ros.report.page import read_text

FORMATS = ('png', 'svg')
_WIDTH, _INCH = 9.6, 96.0  # figure width in inches; page pixels per inch
_DPI = 150
_LONG = 26  # characters of a legend entry; longer ones are set in two columns
_DASHES = {'dash': '--', 'dot': ':', 'dashdot': '-.'}
_SIGNS = {
    'circle': 'o', 'circle-open': 'o', 'square': 's', 'diamond': 'D', 'triangle-up': '^',
    'x': 'X', 'cross': 'P', 'star': '*', 'line-ns-open': '|',
}  # fmt: skip
_POINTS = 72.0 / 96.0  # points per pixel
_MAPS = {'RdBu': 'RdBu_r'}  # the colour scale of plotly has the opposite direction
_DAY_MS = 86400e3  # matplotlib uses days
_RGBA = re.compile(r'rgba\((\d+), (\d+), (\d+), ([\d.]+)\)')
_NUMBERS = ('x', 'y', 'z', 'customdata', 'hovertext')  # numeric entries of a trace


def check_drawing() -> None:
    """Raise early if figures cannot be drawn.

    Raises `InputError` if matplotlib is not installed, or cannot be loaded.
    """
    same = 'report.html has the same pictures and needs no library.'
    if find_spec('matplotlib') is None:
        raise InputError(
            "--figures needs the Python package 'matplotlib', which is not installed: pip install "
            f'matplotlib. {same}'
        )
    try:
        # A library that is missing or of another version shows only when it is loaded.
        import_module('matplotlib.backends.backend_agg')
    except Exception as error:
        raise InputError(
            "--figures needs the Python package 'matplotlib', which is installed but cannot be "
            f'loaded ({error}): pip install --force-reinstall matplotlib. {same}'
        ) from error


def palette() -> Mapping[str, str]:
    """Return the colours of the light theme of the page by name."""
    light = read_text('style.css').split('@media', 1)[0]
    return dict(re.findall(r'--([a-z0-9-]+):\s*([^;]+);', light))


def figure_files(figure: Figure) -> dict[str, bytes]:
    """Return a figure as files by name: ``curve.png`` and ``curve.svg``.

    Raises `InputError` if matplotlib is not installed.
    """
    check_drawing()
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Sheet

    colours = palette()
    files = {}
    # The same log must give identical files: no date, no random names.
    with rc_context({'svg.hashsalt': figure.name, 'font.size': 10, 'svg.fonttype': 'path'}):
        sheet = Sheet(figsize=(_WIDTH, figure.height / _INCH), layout='constrained')
        FigureCanvasAgg(sheet)
        _fill(sheet, replace(
            figure, traces=_painted(figure.traces, colours),
            layout=_painted(figure.layout, colours),
        ), colours['grid'])  # fmt: skip
        for kind in FORMATS:
            out = io.BytesIO()
            told = {'Title': figure.name, 'Description': plain_text(figure.caption)}
            date = {'Date': None} if kind == 'svg' else {}
            with warnings.catch_warnings():
                # A character missing in the font is drawn as a box; no warning is needed.
                warnings.simplefilter('ignore', UserWarning)
                sheet.savefig(out, format=kind, dpi=_DPI, metadata={**told, **date})
            files[f'{figure.name}.{kind}'] = out.getvalue()
    return files


def _painted(value: Any, colours: Mapping[str, str]) -> Any:
    if isinstance(value, dict):
        return {k: v if k in _NUMBERS else _painted(v, colours) for k, v in value.items()}
    if isinstance(value, list):
        return [_painted(v, colours) for v in value]
    if not isinstance(value, str):
        return value
    value = colours[value[6:]] if value.startswith('token:') else value
    if match := _RGBA.fullmatch(value):
        red, green, blue, alpha = (float(v) for v in match.groups())
        return red / 255.0, green / 255.0, blue / 255.0, alpha
    return value


def _fill(sheet: Any, figure: Figure, grid_colour: Any) -> None:
    columns, column_of = _places(figure.layout, 'x')
    rows, row_of = _places(figure.layout, 'y')
    # The pane with the highest domain is in the first row.
    row_of = {name: len(rows) - 1 - k for name, k in row_of.items()}
    heights = [high - low for low, high in reversed(rows)]
    grid = sheet.add_gridspec(len(rows), len(columns), height_ratios=heights)
    panes: dict[tuple[str, str], Any] = {}
    for trace in figure.traces:
        key = str(trace.get('xaxis', 'x')), str(trace.get('yaxis', 'y'))
        if key not in panes:
            same = next((p for (x, _), p in panes.items() if x == key[0]), None)
            place = grid[row_of.get(key[1], 0), column_of.get(key[0], 0)]
            panes[key] = sheet.add_subplot(place, sharex=same)
            _prepare(panes[key], figure, trace, grid_colour)
        _draw(panes[key], trace, is_date(axis_of(figure, trace, 'x')))
    for (x, y), pane in panes.items():
        _marks(pane, figure.layout, x, y)
        pane.margins(x=0.01)
        if figure.layout.get(f'yaxis{y[1:]}', {}).get('rangemode') == 'tozero':
            pane.set_ylim(bottom=0.0)
        if row_of.get(y, 0) < max(row_of.get(b, 0) for a, b in panes if a == x):
            # The axis is drawn below the last of the panes that share it, as on the page.
            pane.set_xlabel('')
            pane.tick_params(labelbottom=False)
            pane.xaxis.get_offset_text().set_visible(False)
    shown = [p.get_legend_handles_labels() for p in panes.values()]
    pairs = {name: h for handles, names in shown for h, name in zip(handles, names, strict=True)}
    if figure.layout.get('showlegend', len(pairs) > 1) and pairs:
        sheet.legend(
            pairs.values(), pairs.keys(), loc='outside upper left',
            ncols=4 if max(map(len, pairs)) < _LONG else 2, frameon=False,
        )  # fmt: skip


def _places(layout: Spec, letter: str) -> tuple[list[tuple[float, float]], dict[str, int]]:
    """Return the domains of the axes in order, and the index of the domain of each axis."""
    shares = {
        key.replace('axis', ''): tuple(axis.get('domain', (0.0, 1.0)))
        for key, axis in layout.items()
        if key.startswith(f'{letter}axis')
    }
    order = sorted(set(shares.values()) or {(0.0, 1.0)})
    return order, {name: order.index(share) for name, share in shares.items()}


def _prepare(pane: Any, figure: Figure, trace: Spec, grid_colour: Any) -> None:
    from matplotlib import dates, ticker

    across, up = axis_of(figure, trace, 'x'), axis_of(figure, trace, 'y')
    pane.set_xlabel(_words(across))
    pane.set_ylabel(_words(up))
    pane.grid(color=grid_colour, linewidth=0.8)
    pane.set_axisbelow(True)
    pane.spines[['top', 'right']].set_visible(False)
    if is_date(across):
        # Half a figure has room for half the times.
        some = {'minticks': 2, 'maxticks': across['nticks'] + 1} if 'nticks' in across else {}
        places = dates.AutoDateLocator(**some)  # type: ignore[no-untyped-call]
        pane.xaxis.set_major_locator(places)
        form = dates.ConciseDateFormatter(places)  # type: ignore[no-untyped-call]
        pane.xaxis.set_major_formatter(form)
    if step := across.get('dtick'):
        pane.xaxis.set_major_locator(ticker.MultipleLocator(step))
    if up.get('type') == 'log':
        pane.set_yscale('log')
    if up.get('type') == 'category':
        # The rows from top to bottom, as on the page.
        order = list(reversed(up.get('categoryarray', [])))
        pane.plot([], [])
        pane.yaxis.update_units(order or trace['y'])
        pane.invert_yaxis()


def _words(axis: Spec) -> str:
    html = str(axis.get('title', {}).get('text', ''))
    html = re.sub('<br>', '\n', html)
    html = re.sub(r'<sup>(.*?)</sup>', r'$^{\1}$', html.replace('$', r'\$'))
    return re.sub(r'<[^>]+>', '', html)


def _marks(pane: Any, layout: Spec, x: str, y: str) -> None:
    unit = _DAY_MS if is_date(layout.get(f'xaxis{x[1:]}', {})) else 1.0
    for shape in layout.get('shapes', []):
        across, up = shape.get('xref', 'x'), shape.get('yref', 'y')
        if across not in (x, 'paper') or up not in (y, 'paper'):
            continue
        if shape['type'] == 'rect':
            look = {'facecolor': shape['fillcolor'], 'alpha': shape.get('opacity', 1.0),
                    'zorder': 0.5}  # fmt: skip
            if across == 'paper':
                pane.axhspan(shape['y0'], shape['y1'], **look)
            else:
                pane.axvspan(shape['x0'] / unit, shape['x1'] / unit, linewidth=0, **look)
        elif across == 'paper':
            pane.axhline(shape['y0'], color=shape['line']['color'], linewidth=1)
        else:
            style = ':' if shape['line'].get('dash') else '-'
            pane.axvline(shape['x0'] / unit, color=shape['line']['color'], linestyle=style)
    for note in layout.get('annotations', []):
        if (note.get('xref', 'x'), note.get('yref', 'y')) == (x, y):
            pane.annotate(
                plain_text(note['text']), (note['x'] / unit, note['y']),
                ha=note.get('xanchor', 'center'), va='center',
                xytext=(0, note.get('yshift', 0) * _POINTS), textcoords='offset points',
                color=note.get('font', {}).get('color'), size='small',
            )  # fmt: skip


def _draw(pane: Any, trace: Spec, date: bool) -> None:
    """Draw one trace into a pane; ``date`` is True if x are ms since 1970."""
    x = numbers(trace, 'x') / (_DAY_MS if date else 1.0)
    shown = trace.get('showlegend', True) and trace.get('name')
    label = plain_text(str(trace['name'])) if shown else '_'
    if trace['type'] == 'heatmap':
        _heat(pane, trace, x)
    elif trace['type'] == 'bar':
        _bars(pane, trace, x, label)
    elif trace.get('fill') == 'toself':
        pane.fill(x, _heights(trace), facecolor=trace['fillcolor'], linewidth=0, label=label)
    else:
        _scatter(pane, trace, x, _heights(trace), label)


def _heights(trace: Spec) -> Any:
    values = column(trace, 'y')
    if any(isinstance(v, str) for v in values):
        # matplotlib needs strings only; a gap in x interrupts the line anyway.
        words = [v for v in values if isinstance(v, str)]
        return [v if isinstance(v, str) else words[0] for v in values]
    return np.array(values, dtype=np.float64)


def _scatter(pane: Any, trace: Spec, x: FloatArray, y: Any, label: str) -> None:
    mode, line, marker = trace.get('mode', 'lines'), trace.get('line', {}), trace.get('marker', {})
    look: dict[str, Any] = {'linestyle': 'none', 'label': label}
    if 'lines' in mode:
        look |= {
            'linestyle': _DASHES.get(line.get('dash', ''), '-'), 'color': line['color'],
            'linewidth': line.get('width', 2) * _POINTS, 'solid_capstyle': 'butt',
        }  # fmt: skip
        if line.get('shape') == 'hv':
            look['drawstyle'] = 'steps-post'
    if 'markers' not in mode:
        pane.plot(x, y, **look)
        return
    sign, size = str(marker.get('symbol', 'circle')), marker.get('size', 6)
    colour = marker.get('color', look.get('color'))
    if isinstance(colour, list) or isinstance(size, list):
        # Points with individual colours or sizes are drawn over their line.
        pane.plot(x, y, **look)
        sizes = size if isinstance(size, list) else [size] * len(x)
        shades = colour if isinstance(colour, list) else [colour] * len(x)
        more: dict[str, Any] = {}
        if scale := marker.get('colorscale'):
            more = {'vmin': marker['cmin'], 'vmax': marker['cmax'], 'cmap': _shades(scale)}
        dots = [(v * _POINTS) ** 2 for v in sizes]
        drawn = pane.scatter(x, y, s=dots, c=shades, zorder=3, **more)
        if more:
            pane.figure.colorbar(drawn, ax=pane, label=marker['colorbar']['title']['text'])
        return
    look |= {
        'marker': _SIGNS.get(sign, 'o'), 'markersize': size * _POINTS,
        'markerfacecolor': 'none' if sign == 'circle-open' else colour,
        'markeredgecolor': marker.get('line', {}).get('color') or colour,
        'alpha': marker.get('opacity'),
    }  # fmt: skip
    look.setdefault('color', colour)
    pane.plot(x, y, **look)
    for letter in 'xy':
        if bars := trace.get(f'error_{letter}'):
            ends = np.abs(np.array([bars['arrayminus'], bars['array']], dtype=np.float64))
            pane.errorbar(
                x, y, fmt='none', capsize=3, ecolor=bars['color'], **{f'{letter}err': ends}
            )


def _heat(pane: Any, trace: Spec, x: FloatArray) -> None:
    cells = np.array([[np.nan if v is None else v for v in row] for row in trace['z']])
    rows, across = cells.shape
    given = column(trace, 'y')
    words = bool(given) and isinstance(given[0], str)
    up = np.asarray(np.arange(rows) if words else given, dtype=np.float64)
    drawn = pane.pcolormesh(
        _edges(x, across), _edges(up, rows), cells, vmin=trace.get('zmin'),
        vmax=trace.get('zmax'), cmap=_shades(trace['colorscale']), rasterized=True,
    )  # fmt: skip
    if trace.get('showscale', True):
        title = trace.get('colorbar', {}).get('title', {}).get('text', '')
        pane.figure.colorbar(drawn, ax=pane, label=title)


def _shades(scale: Any) -> Any:
    """Return the colours of a scale, given by its name or by its steps."""
    from matplotlib.colors import LinearSegmentedColormap

    if isinstance(scale, str):
        return _MAPS.get(scale, scale)
    return LinearSegmentedColormap.from_list('own', [tuple(step) for step in scale])


def _edges(places: FloatArray, count: int) -> FloatArray:
    """Return the edges of cells given by their centres or by their edges."""
    if len(places) == count + 1:
        return places
    half = 0.5 * (places[1] - places[0]) if count > 1 else 0.5
    return np.append(places - half, places[-1] + half)


def _bars(pane: Any, trace: Spec, x: FloatArray, label: str) -> None:
    y, colour = numbers(trace, 'y'), trace['marker']['color']
    below = getattr(pane, 'stacked', np.zeros_like(y))
    width = float(x[1] - x[0]) if len(x) > 1 else 1.0
    width *= 0.8 if isinstance(colour, list) and len(colour) > 1 else 1.0
    pane.bar(x, y, width=width, bottom=below, color=colour, label=label)
    pane.stacked = below + y
