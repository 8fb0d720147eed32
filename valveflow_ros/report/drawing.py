"""Pictures of the report as PNG and SVG files, drawn by matplotlib from the same data."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from typing import Any

import numpy as np

from valveflow_ros.errors import InputError
from valveflow_ros.records import FloatArray
from valveflow_ros.report.figure import Figure, Spec, axis_of, column, is_date, numbers, plain_text
from valveflow_ros.report.page import read_text

# One line, cloud, map or set of bars of a picture, drawn by matplotlib.

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


FORMATS = ('png', 'svg')
_WIDTH, _INCH = 9.6, 96.0  # of a picture in inches; the page's pixels in an inch
_DPI = 150
_LONG = 26  # signs of a legend's entry; longer ones stand in two columns


def check_drawing() -> None:
    """Refuse early where pictures cannot be drawn.

    Raises
    ------
    InputError
        matplotlib is not installed.
    """
    if find_spec('matplotlib') is None:
        raise InputError(
            "--figures needs the Python package 'matplotlib', which is not installed: pip install "
            'matplotlib. The same pictures stand in report.html, which needs nothing.'
        )


def palette() -> Palette:
    """Return the colours of the page's light look by name."""
    light = read_text('style.css').split('@media', 1)[0]
    return dict(re.findall(r'--([a-z0-9-]+):\s*([^;]+);', light))


def figure_files(figure: Figure) -> dict[str, bytes]:
    """Return a picture as files by name: ``curve.png`` and ``curve.svg``.

    Raises
    ------
    InputError
        matplotlib is not installed.
    """
    check_drawing()
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Sheet

    colours = palette()
    about = plain_text(figure.caption)
    files = {}
    # The same log gives the same files: no date, no names by chance.
    with rc_context({'svg.hashsalt': figure.name, 'font.size': 10, 'svg.fonttype': 'path'}):
        sheet = Sheet(figsize=(_WIDTH, figure.height / _INCH), layout='constrained')
        FigureCanvasAgg(sheet)
        _fill(sheet, figure, colours)
        for kind in FORMATS:
            out = io.BytesIO()
            told: dict[str, Any] = {'Title': figure.name, 'Description': about}
            if kind == 'svg':
                told['Date'] = None
            with warnings.catch_warnings():
                # A sign no font has is drawn as a box; that is no reason to speak.
                warnings.simplefilter('ignore', UserWarning)
                sheet.savefig(out, format=kind, dpi=_DPI, metadata=told)
            files[f'{figure.name}.{kind}'] = out.getvalue()
    return files


def _fill(sheet: Any, figure: Figure, colours: Palette) -> None:
    places = _grid(figure.layout)
    heights = [h for _, h in sorted(places['rows'].items())]
    grid = sheet.add_gridspec(
        len(heights), len(places['columns']), height_ratios=heights
    )  # fmt: skip
    panes: dict[tuple[str, str], Any] = {}
    for trace in figure.traces:
        key = str(trace.get('xaxis', 'x')), str(trace.get('yaxis', 'y'))
        if key not in panes:
            row, column = places['row'].get(key[1], 0), places['column'].get(key[0], 0)
            same = next((p for (x, _), p in panes.items() if x == key[0]), None)
            place = sheet.add_subplot(grid[row, column], sharex=same)
            panes[key] = _pane(place, figure, trace, colours)
        draw_trace(panes[key], trace, colours, is_date(axis_of(figure, trace, 'x')))
    for (x, y), pane in panes.items():
        _marks(pane, figure, x, y, colours)
        _limits(pane, figure, x, y)
        lowest = max(places['row'].get(b, 0) for a, b in panes if a == x)
        if places['row'].get(y, 0) < lowest:
            # The axis stands below the last of the panes that share it, as on the page.
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


def _grid(layout: Spec) -> dict[str, Any]:
    """Return row and column of each axis, from the shares of the page it takes."""
    shares: dict[str, dict[str, tuple[float, float]]] = {'x': {}, 'y': {}}
    for key, axis in layout.items():
        if match := re.fullmatch(r'([xy])axis(\d*)', key):
            low, high = axis.get('domain', (0.0, 1.0))
            shares[match[1]][match[1] + match[2]] = (low, high)
    # A second axis of one row lies on the first: side by side, not one below the other.
    rows = sorted(set(shares['y'].values()) or {(0.0, 1.0)}, reverse=True)
    columns = sorted(set(shares['x'].values()) or {(0.0, 1.0)})
    return {
        'row': {name: rows.index(share) for name, share in shares['y'].items()},
        'column': {name: columns.index(share) for name, share in shares['x'].items()},
        'rows': {k: high - low for k, (low, high) in enumerate(rows)},
        'columns': columns,
    }


def _pane(pane: Any, figure: Figure, trace: Spec, colours: Palette) -> Any:
    """Give a pane its titles and its axes' kinds."""
    from matplotlib import dates, ticker

    across, up = axis_of(figure, trace, 'x'), axis_of(figure, trace, 'y')
    pane.set_xlabel(_words(across))
    pane.set_ylabel(_words(up))
    pane.grid(color=colours['grid'], linewidth=0.8)
    pane.set_axisbelow(True)
    pane.spines[['top', 'right']].set_visible(False)
    if is_date(across):
        places = dates.AutoDateLocator()  # type: ignore[no-untyped-call]
        pane.xaxis.set_major_locator(places)
        form = dates.ConciseDateFormatter(places)  # type: ignore[no-untyped-call]
        pane.xaxis.set_major_formatter(form)
    if step := across.get('dtick'):
        pane.xaxis.set_major_locator(ticker.MultipleLocator(step))
    if up.get('type') == 'log':
        pane.set_yscale('log')
    if up.get('type') == 'category':
        # The rows from top to bottom, as the page has them.
        order = list(reversed(up.get('categoryarray', [])))
        pane.plot([], [])
        pane.yaxis.update_units(order or trace['y'])
        pane.invert_yaxis()
    return pane


def _words(axis: Spec) -> str:
    html = str(axis.get('title', {}).get('text', ''))
    html = re.sub('<br>', '\n', html)
    html = re.sub(r'<sup>(.*?)</sup>', r'$^{\1}$', html.replace('$', r'\$'))
    return re.sub(r'<[^>]+>', '', html)


def _marks(pane: Any, figure: Figure, x: str, y: str, colours: Palette) -> None:
    date = is_date(figure.layout.get(f'xaxis{x[1:]}', {}))
    for shape in figure.layout.get('shapes', []):
        axes = shape.get('xref', 'x'), shape.get('yref', 'y')
        if axes[0] not in (x, 'paper') or axes[1] not in (y, 'paper'):
            continue
        if shape['type'] == 'rect' and axes[0] == 'paper':
            fill, opacity = _colour(shape['fillcolor'], colours), shape.get('opacity', 1.0)
            pane.axhspan(shape['y0'], shape['y1'], facecolor=fill, alpha=opacity, zorder=0.5)
        elif shape['type'] == 'rect':
            ends = hours([shape['x0'], shape['x1']]) if date else [shape['x0'], shape['x1']]
            fill, opacity = _colour(shape['fillcolor'], colours), shape.get('opacity', 1.0)
            pane.axvspan(*ends, facecolor=fill, alpha=opacity, zorder=0.5, linewidth=0)
        elif shape.get('xref') == 'paper':
            pane.axhline(shape['y0'], color=_colour(shape['line']['color'], colours), linewidth=1)
        else:
            at = hours([shape['x0']])[0] if date else shape['x0']
            style = ':' if shape['line'].get('dash') else '-'
            pane.axvline(at, color=_colour(shape['line']['color'], colours), linestyle=style)


def _colour(name: str, colours: Palette) -> Any:

    return colour_of(name, colours)


def _limits(pane: Any, figure: Figure, x: str, y: str) -> None:
    pane.margins(x=0.01)
    if figure.layout.get(f'yaxis{y[1:]}', {}).get('rangemode') == 'tozero':
        pane.set_ylim(bottom=0.0)
