"""Two maps of the residual side by side: simulation and extended model."""

from __future__ import annotations

import math

import numpy as np

from valveflow_ros.diagnosis.residual_map import ResidualMap
from valveflow_ros.report.diagnosis_figures import moments
from valveflow_ros.report.diagnosis_words import axis_title, variable
from valveflow_ros.report.figure import Figure, Spec, rounded
from valveflow_ros.report.numbers import plain
from valveflow_ros.report.page import text


def map_figure(m: ResidualMap, start_ns: int, exponent: float = math.nan) -> Figure:
    """Return where the simulation is wrong over two variables, and where the extended model is."""
    across, over = rounded(m.across_edges, 6), Spec()
    if m.across == 'time':
        across = moments(start_ns, m.across_edges)
        over = {'type': 'date', 'nticks': 4, 'tickangle': 0, 'tickformat': '%-d'}
    largest = max(
        (float(np.nanmax(np.abs(x))) for x in (m.before, m.after) if np.isfinite(x).any()),
        default=1.0,
    )
    name = m.across.replace(' ', '-')
    return Figure(
        f'map-{name}',
        f'<b>Residual over {text(variable(m.across))} and {text(variable(m.up))}</b>, '
        'simulation left, extended model right. Only cells beyond chance are filled: '
        f'{m.shown_before} of {m.cells} for the simulation, {m.shown_after} for the extended '
        f'model; chance alone fills about {plain(0.01 * m.cells, 1)}.',
        f'{m.shown_before} of {m.cells} cells are beyond chance before, {m.shown_after} after.',
        [_half(m.before, across, m.up_edges, largest, ''),
         _half(m.after, across, m.up_edges, largest, '2')],
        {
            'xaxis': {**over, 'domain': [0.0, 0.46]},
            'xaxis2': {**over, 'domain': [0.54, 1.0], 'anchor': 'y2'},
            'yaxis': {'title': {'text': axis_title(m.up, exponent)}},
            # One title for both axes: side by side there is no room for two on a telephone.
            'annotations': [
                {'text': _below(m.across, exponent), 'showarrow': False, 'xref': 'paper', 'x': 0.5,
                 'xanchor': 'center', 'yref': 'paper', 'y': 0.0, 'yshift': -56}
            ],
            'margin': {'l': 56, 'r': 12, 't': 34, 'b': 70},
            'yaxis2': {'anchor': 'x2', 'matches': 'y', 'showticklabels': False},
        },
        height=380,
    )  # fmt: skip


def _below(name: str, exponent: float) -> str:
    return 'day of the month (UTC)' if name == 'time' else axis_title(name, exponent)


def _half(
    cells: np.ndarray, across: list[float | None], up: np.ndarray, largest: float, axis: str
) -> Spec:
    return {
        'type': 'heatmap', 'name': 'extended model' if axis else 'simulation',
        'x': across, 'y': rounded(up, 4),
        'z': [rounded(row, 3) for row in cells], 'zmin': -largest, 'zmax': largest, 'zmid': 0.0,
        'colorscale': 'RdBu', 'showscale': axis == '2',
        'colorbar': {'title': {'text': 'MW'}}, 'xaxis': f'x{axis}', 'yaxis': f'y{axis}',
        'hovertemplate': '%{z} MW<extra></extra>',
    }  # fmt: skip
