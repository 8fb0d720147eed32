"""Why so many pieces: cost and turning angle against their number (the paper's Fig. 6)."""

from __future__ import annotations

import math
from html import escape

import numpy as np

from valveflow_ros.curve.characteristic import Choice
from valveflow_ros.records import FloatArray
from valveflow_ros.report.figure import Figure, Spec, rounded, token
from valveflow_ros.report.numbers import plain
from valveflow_ros.report.page import paragraph, table

_KEPT = {
    'prediction_error': 'the number kept is the one that predicts all samples best once the '
    'dynamics are known',
    'evidence': 'the number kept is the one that makes the special samples most probable, their '
    'noise considered',
}
_LEAST_SHOWN = 0.005  # probability of a number of pieces worth a row
# Mantissas of the ticks, the coarsest first.
_STEPS = (
    [1.0, 2.0, 5.0],
    [1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0],
    [0.1 * k for k in range(10, 100)],
)


def _points(
    values: dict[int, float], axis: str, chosen: int, name: str, template: str
) -> list[Spec]:
    j = sorted(values)
    y = np.array([values[k] for k in j])
    size = [13 if k == chosen else 7 for k in j]
    colour = [token('chosen') if k == chosen else token('data') for k in j]
    return [
        {
            'type': 'scatter', 'mode': 'lines+markers', 'name': name, 'yaxis': axis,
            'x': j, 'y': rounded(y, 8), 'showlegend': False,
            'line': {'color': token('data'), 'width': 1.5},
            'marker': {'size': size, 'color': colour}, 'hovertemplate': template,
        }
    ]  # fmt: skip


def choice_figure(choice: Choice, chosen: int) -> Figure:
    """Return Omega(J) on a log axis above Lambda(J)."""
    traces = _points(
        choice.cost, 'y', chosen, 'cost', 'J = %{x}<br>Ω = %{y:.4s} MW²<extra></extra>'
    ) + _points(
        choice.turning_angle, 'y2', chosen, 'turning angle',
        'J = %{x}<br>Λ = %{y:.3f}<extra></extra>',
    )  # fmt: skip
    sure = bool(choice.confidence)
    first, second = ([0.7, 1.0], [0.34, 0.64]) if sure else ([0.56, 1.0], [0.0, 0.44])
    layout = {
        'xaxis': {
            'title': {'text': 'number of pieces J'}, 'dtick': 1, 'anchor': 'y3' if sure else 'y2',
        },
        'yaxis': {
            'domain': first, 'type': 'log', 'title': {'text': 'cost Ω(J)<br>(MW²)'},
            **_ticks(np.array(list(choice.cost.values()))),
        },
        'yaxis2': {
            'domain': second, 'rangemode': 'tozero', 'title': {'text': 'turning<br>angle Λ(J)'},
        },
        'hovermode': 'closest',
    }  # fmt: skip
    if sure:
        traces.append(_confidence(choice, chosen))
        layout['yaxis3'] = {
            'domain': [0.0, 0.28], 'rangemode': 'tozero', 'title': {'text': 'confidence<br>(%)'},
        }  # fmt: skip
    return Figure(
        'choice', _caption(choice, chosen), _description(choice, chosen), traces, layout,
        height=560 if sure else 420,
    )  # fmt: skip


def _confidence(choice: Choice, chosen: int) -> Spec:
    j = sorted(choice.confidence)
    return {
        'type': 'bar', 'name': 'confidence', 'yaxis': 'y3', 'showlegend': False, 'x': j,
        'y': [100.0 * choice.confidence[k] for k in j],
        'marker': {'color': [token('chosen') if k == chosen else token('data') for k in j]},
        'hovertemplate': 'J = %{x}<br>%{y:.1f} %<extra></extra>',
    }  # fmt: skip


def confidence_table(choice: Choice) -> str:
    """Return how probable each number of pieces is; empty where the rule has no confidence."""
    likely = {j: p for j, p in sorted(choice.confidence.items()) if p >= _LEAST_SHOWN}
    if not likely:
        return ''
    rows = [[str(j), _percent(p)] for j, p in likely.items()]
    rest = sum(p for p in choice.confidence.values() if p < _LEAST_SHOWN)
    words = paragraph(
        'How probable each number of pieces is, given these data and their noise; all others '
        f'together {_percent(rest)}.'
    )
    return words + table(['number of pieces J', 'probability'], rows)


def _percent(share: float) -> str:
    if share > 0.9995:
        return 'more than 99.9 %'
    return 'less than 0.1 %' if share < 0.0005 else f'{100.0 * share:.1f} %'


def _ticks(costs: FloatArray) -> Spec:
    """Return round ticks for a logarithmic axis, at least three where there is room."""
    costs = costs[costs > 0.0]
    if not len(costs):
        return {}
    low, high = float(costs.min()), float(costs.max())
    decades = 10.0 ** np.arange(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    ticks = decades
    for steps in _STEPS:
        ticks = np.outer(decades, steps).ravel()
        ticks = ticks[(ticks >= 0.98 * low) & (ticks <= 1.02 * high)]
        if len(ticks) >= 3:
            break
    return {
        'tickmode': 'array',
        'tickvals': ticks.tolist(),
        'ticktext': [_power(t) for t in ticks],
    }


def _power(value: float) -> str:
    exponent = math.floor(math.log10(value) + 1e-9)
    if -2 <= exponent <= 4:
        return f'{value:g}'
    lead = f'{value / 10.0**exponent:.3g}'
    return ('' if lead == '1' else f'{lead}·') + f'10<sup>{exponent}</sup>'


def _caption(choice: Choice, chosen: int) -> str:
    words = (
        '<b>Look for the elbow.</b> Above, what the best curve of J pieces leaves unexplained '
        '(on a logarithmic axis); each point is the exact optimum. Below, how sharply that line '
        'turns at J, eq. (24) of the paper: after the sharpest turn another piece gains little. '
    )
    sharpest = max(choice.turning_angle, key=lambda j: choice.turning_angle[j], default=chosen)
    if choice.rule != 'paper' and sharpest != chosen:
        kept = _KEPT.get(choice.rule, 'another number was kept')
        words += f'It turns most sharply at J = {sharpest}; {kept}. '
    words += f'<b>Chosen: J = {chosen}.</b>'
    if choice.confidence:
        words += ' At the bottom, how probable each J is.'
    if choice.note:
        words += f' {escape(choice.note)}'
        words += '' if choice.note.endswith('.') else '.'
    return words


def _description(choice: Choice, chosen: int) -> str:
    costs = ', '.join(f'{j}: {plain(v, 3)}' for j, v in sorted(choice.cost.items()))
    return f'Cost by number of pieces ({costs}); chosen is {chosen}.'
