"""Time constant and delay by region of power."""

from __future__ import annotations

import numpy as np

from valveflow_ros.curve.characteristic import RegionDynamics
from valveflow_ros.report.figure import Figure, Spec, rounded, token
from valveflow_ros.report.numbers import decimals, with_error
from valveflow_ros.report.page import table

_COLOURS = ('chosen', 'steady', 'slope')
_DASHES = ('solid', 'dash', 'dot')


def dynamics_table(dynamics: tuple[RegionDynamics, ...]) -> str:
    """Return the table of regions."""
    rows = [
        [
            f'{decimals(d.power_from, 0)} to {decimals(d.power_to, 0)} MW',
            with_error(d.time_constant_s, d.time_constant_stderr_s),
            with_error(d.delay_s, d.delay_stderr_s),
            decimals(d.delay_s + 3.0 * d.time_constant_s, 0),
        ]
        for d in dynamics
    ]
    head = ['power', 'time constant T (s)', 'delay τ (s)', '95 % done after τ + 3 T (s)']
    return table(head, rows)


def dynamics_figure(dynamics: tuple[RegionDynamics, ...]) -> Figure:
    """Return how the power follows a sudden step of the steam flow in each region."""
    ends = [d.delay_s + 4.0 * d.time_constant_s for d in dynamics]
    # One slow region must not press the others against the edge.
    t = np.linspace(0.0, min(max(ends), 8.0 * min(ends)), 160)
    traces: list[Spec] = []
    for k, d in enumerate(dynamics):
        late = np.maximum(t - d.delay_s, 0.0)
        moved = 100.0 * (1.0 - np.exp(-late / d.time_constant_s))
        traces.append(
            {
                'type': 'scatter', 'mode': 'lines',
                'name': f'{decimals(d.power_from, 0)} to {decimals(d.power_to, 0)} MW',
                'x': rounded(t), 'y': rounded(moved, 4),
                'line': {
                    'color': token(_COLOURS[k % 3]), 'dash': _DASHES[k % 3], 'width': 2.2,
                },
                'hovertemplate': '%{x:.0f} s: %{y:.0f} %',
            }
        )  # fmt: skip
    layout = {
        'xaxis': {
            'title': {
                'text': 'seconds after a step of the steam flow',
                'short': 'seconds after a step',
            }
        },
        'yaxis': {'title': {'text': 'power has moved (%)'}},
        'showlegend': True,
    }
    caption = (
        '<b>The further right a line rises, the slower the unit answers there.</b> '
        'Each line is the identified first-order answer of one range of power.'
    )
    return Figure('dynamics', caption, 'Step responses by range of power.', traces, layout, 320)
