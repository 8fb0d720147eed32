"""The pictures of a diagnosis: the residual by variable, around fast moves, by segment."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from valveflow_ros.diagnosis.gain import SegmentGain
from valveflow_ros.diagnosis.signature import Answer, Signature
from valveflow_ros.records import FloatArray
from valveflow_ros.report.diagnosis_words import axis_title, axis_titles, points_to, variable
from valveflow_ros.report.figure import Figure, Spec, rounded, token
from valveflow_ros.report.numbers import counted, plain
from valveflow_ros.report.page import text

_MS = 13  # digits of a time in ms since 1970
TIME_AXIS: Spec = {'type': 'date', 'title': {'text': 'time (UTC)'}}


def moments(start_ns: int, time_s: FloatArray) -> list[float | None]:
    """Return times since the first row as a date axis wants them: ms since 1970."""
    return rounded(start_ns / 1e6 + 1e3 * np.asarray(time_s), _MS)


def _line(
    x: list[float | None], y: FloatArray, name: str, colour: str, dash: str = 'solid'
) -> Spec:
    return {
        'type': 'scatter', 'mode': 'lines+markers', 'name': name, 'x': x,
        'y': rounded(y, 4), 'line': {'color': token(colour), 'width': 2, 'dash': dash},
        'marker': {'size': 5},
    }  # fmt: skip


def _band(x: list[float | None], width: FloatArray) -> Spec:
    """Return the band round zero that chance fills."""
    return {
        'type': 'scatter', 'mode': 'lines', 'name': 'by chance (99 %)', 'fill': 'toself',
        'x': [*x, *x[::-1]],
        'y': rounded(np.concatenate([width, -width[::-1]]), 4),
        'line': {'width': 0, 'color': token('band')}, 'fillcolor': token('band'),
        'hoverinfo': 'skip',
    }  # fmt: skip


def hover(variable_name: str, exponent: float) -> str:
    """Return what a point of a mean residual says when pointed at."""
    if variable_name == 'time':
        return '%{x|%d %b %H:%M}<br>%{y:+.2f} MW'
    return f'{axis_title(variable_name, exponent)}: %{{x:.4~g}}<br>%{{y:+.2f}} MW'


def signature_figure(
    s: Signature, start_ns: int, how: str = '', exponent: float = math.nan
) -> Figure:
    """Return the mean residual against one variable, before and after extending.

    ``how`` says how such a picture is read, ``exponent`` is that of u.
    """
    over: Spec = {'title': axis_titles(s.variable, exponent)}
    x = rounded(s.middle, 6)
    if s.variable == 'time':
        over, x = TIME_AXIS, moments(start_ns, s.middle)
    elif s.variable == 'time of day':
        x = rounded(s.middle / 3600.0, 6)
    return Figure(
        f'residual-{s.variable.replace(" ", "-")}',
        f'<b>Measured minus simulated power against {text(variable(s.variable))}.</b> '
        f'{points_to(s.variable)} {how}',
        f'Mean residual against {variable(s.variable)}, from {plain(float(s.before.min()), 2)} to '
        f'{plain(float(s.before.max()), 2)} MW before and {plain(float(s.after.min()), 2)} to '
        f'{plain(float(s.after.max()), 2)} MW after.',
        [_band(x, s.chance),
         *({**_line(x, values, name, colour, dash), 'hovertemplate': hover(s.variable, exponent)}
           for values, name, colour, dash in (
               (s.before, 'simulation', 'raw', 'dash'),
               (s.after, 'extended model', 'curve', 'solid')))],
        {'xaxis': over,
         'yaxis': {'title': {'text': 'mean residual (MW)'}}},
        height=300,
    )  # fmt: skip


def answer_figure(answers: Sequence[Answer]) -> Figure:
    """Return the mean residual around fast moves, opening and closing apart."""
    traces = []
    for a in answers:
        time_s = rounded(a.time_s, 6)
        way = f'{"opening" if a.up else "closing"}, {counted(a.moves, "move")}'
        colour = 'steady' if a.up else 'slope'
        for name, values, dash in (
            ('simulation', a.before, 'dash'), ('extended model', a.after, 'solid'),
        ):  # fmt: skip
            line = _line(time_s, values, f'{name}, {way}', colour, dash)
            traces.append({**line, 'hovertemplate': '%{x:.0f} s<br>%{y:+.2f} MW'})
    chance = max(a.chance for a in answers)
    return Figure(
        'fast-moves',
        '<b>Mean residual around fast moves of the valve.</b> A slow or early answer shows here '
        f'only. By chance a point lies within ±{plain(chance, 2)} MW.',
        'Mean residual from a minute before to five minutes after fast moves.',
        traces,
        {'xaxis': {'title': {'text': 'time after the move (s)'}},
         'yaxis': {'title': {'text': 'mean residual (MW)'}}},
        height=340,
    )  # fmt: skip


def segments_figure(segments: Sequence[SegmentGain]) -> Figure:
    """Return the error in every special segment of the sealed blocks, before and after."""
    better = sum(s.rmse_after < s.rmse_before for s in segments)
    at = rounded(np.array([s.start_ns / 1e6 for s in segments]), _MS)
    traces = [
        {
            'type': 'scatter', 'mode': 'markers', 'name': name, 'x': at,
            'y': rounded(np.array(values), 4),
            'marker': {'color': token(colour), 'size': 6, 'symbol': symbol},
            'hovertemplate': '%{x|%d %b %H:%M}<br>%{y:.2f} MW',
        }
        for name, values, colour, symbol in (
            ('simulation', [s.rmse_before for s in segments], 'raw', 'circle-open'),
            ('extended model', [s.rmse_after for s in segments], 'curve', 'circle'),
        )
    ]  # fmt: skip
    return Figure(
        'segments',
        f'<b>Special segments inside the sealed blocks.</b> {better} of {len(segments)} are '
        'predicted better by the extended model.',
        f'{counted(len(segments), "segment")}, {better} of them predicted better.',
        traces,
        {'xaxis': TIME_AXIS,
         'yaxis': {'title': {'text': 'RMSE (MW)'}}},
        height=340,
    )  # fmt: skip
