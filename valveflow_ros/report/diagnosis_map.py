"""Two maps of the residual side by side: simulation and extended model."""

from __future__ import annotations

import numpy as np

from valveflow_ros.diagnosis.residual_map import ResidualMap
from valveflow_ros.diagnosis.signature import UNITS
from valveflow_ros.report.figure import Figure, Spec, rounded
from valveflow_ros.report.numbers import plain
from valveflow_ros.report.page import text

_DAY_S = 86_400.0


def map_figure(m: ResidualMap) -> Figure:
    """Return where the simulation is wrong over two variables, and where the extended model is."""
    across, unit = m.across_edges, UNITS[m.across]
    if m.across == 'time':
        across, unit = across / _DAY_S, 'days'
    largest = max(
        (float(np.nanmax(np.abs(x))) for x in (m.before, m.after) if np.isfinite(x).any()),
        default=1.0,
    )
    name = m.across.replace(' ', '-')
    return Figure(
        f'map-{name}',
        f'<b>Residual over {text(m.across)} and {text(m.up)}</b>, simulation left, extended model '
        f'right. Only cells beyond chance are filled: {m.shown_before} of {m.cells} for the '
        f'simulation, {m.shown_after} for the extended model; chance alone fills about '
        f'{plain(0.01 * m.cells, 1)}.',
        f'{m.shown_before} of {m.cells} cells are beyond chance before, {m.shown_after} after.',
        [_half(m.before, across, m.up_edges, largest, ''),
         _half(m.after, across, m.up_edges, largest, '2')],
        {
            'xaxis': {'domain': [0.0, 0.46], 'title': {'text': f'{m.across} ({unit})'}},
            'xaxis2': {'domain': [0.54, 1.0], 'title': {'text': f'{m.across} ({unit})'},
                       'anchor': 'y2'},
            'yaxis': {'title': {'text': f'{m.up} ({UNITS[m.up]})'}},
            'yaxis2': {'anchor': 'x2', 'matches': 'y', 'showticklabels': False},
        },
        height=380,
    )  # fmt: skip


def _half(
    cells: np.ndarray, across: np.ndarray, up: np.ndarray, largest: float, axis: str
) -> Spec:
    return {
        'type': 'heatmap', 'x': rounded(across, 6), 'y': rounded(up, 4),
        'z': [rounded(row, 3) for row in cells], 'zmin': -largest, 'zmax': largest, 'zmid': 0.0,
        'colorscale': 'RdBu', 'showscale': axis == '2',
        'colorbar': {'title': {'text': 'MW'}}, 'xaxis': f'x{axis}', 'yaxis': f'y{axis}',
        'hovertemplate': '%{z} MW<extra></extra>',
    }  # fmt: skip
