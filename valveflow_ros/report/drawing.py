"""Pictures of the report as PNG and SVG files, drawn by matplotlib from the same data."""

from __future__ import annotations

import io
import re
import warnings
from importlib.util import find_spec
from typing import Any

from valveflow_ros.errors import InputError
from valveflow_ros.report.drawn_traces import Palette, draw_trace, hours
from valveflow_ros.report.figure import Figure, Spec
from valveflow_ros.report.library import read_text
from valveflow_ros.report.picture_data import axis_of, is_date, plain_text

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
    from valveflow_ros.report.drawn_traces import colour_of

    return colour_of(name, colours)


def _limits(pane: Any, figure: Figure, x: str, y: str) -> None:
    pane.margins(x=0.01)
    if figure.layout.get(f'yaxis{y[1:]}', {}).get('rangemode') == 'tozero':
        pane.set_ylim(bottom=0.0)
