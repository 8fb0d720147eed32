# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The report of a diagnosis: errors, causes, the extended model, the evidence."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from valveflow_ros.diagnosis.cause import Estimate, dates, told
from valveflow_ros.diagnosis.evidence import SegmentGain
from valveflow_ros.diagnosis.result import NAMED, NOTHING, Diagnosis
from valveflow_ros.diagnosis.signature import Answer, ResidualMap, Signature
from valveflow_ros.errors import listed
from valveflow_ros.records import FloatArray
from valveflow_ros.report import figure as plot
from valveflow_ros.report import page as html
from valveflow_ros.report import words as say
from valveflow_ros.report.figure import DAY_HOUR, Figure, Spec
from valveflow_ros.report.history import History, history_sections
from valveflow_ros.report.page import Page, Section
from valveflow_ros.report.words import UNKNOWN

_HOW = (
    'Means of bins with equally many minutes. A correct model stays in the band, here and '
    'below: chance alone leaves the band in one of a hundred records.'
)


@dataclass(frozen=True, slots=True)
class Diagnosed:
    """The data of the page."""

    source: str
    start_ns: int
    end_ns: int
    diagnosis: Diagnosis
    signatures: tuple[Signature, ...]
    answers: tuple[Answer, ...]
    maps: tuple[ResidualMap, ...] = ()
    history: History | None = None
    exponent: float = math.nan
    output_unit: str = 'MW'


def diagnosis_page(data: Diagnosed) -> Page:
    """Return the report: the result and its figure first, then the four steps."""
    agree = 'Simulation and measurement agree'
    if _drifts(data.diagnosis):
        agree = 'No cause found, but the power varies slowly'
    title = {NAMED: 'Why simulation and measurement disagree', NOTHING: agree}.get(
        data.diagnosis.verdict, 'Simulation and measurement disagree'
    )
    ranked = sorted(data.signatures, key=lambda s: -(s.share_before / max(s.share_chance, 1e-9)))
    sections = [
        _answer(data, ranked), _wrong(data, ranked), _why(data), _model(data), _proof(data),
        *history_sections(data.history),
    ]  # fmt: skip
    end_of_page = html.foot(
        'The same numbers without rounding are in diagnosis.json and extended_model.json beside '
        'this page.'
    )
    lead = html.where(data.source, say.period(data.start_ns, data.end_ns))
    return Page(title, lead, sections, end_of_page, 'diagnose')


def _drifts(d: Diagnosis) -> bool:
    """Return True if the power drifts over hours and days, so that the model does not agree."""
    return d.disturbance is not None and d.disturbance.drift_mw is not None


def _answer(data: Diagnosed, ranked: Sequence[Signature]) -> Section:
    d, said = data.diagnosis, html.text(data.diagnosis.sentence)
    good = d.verdict == NOTHING and not _drifts(d)
    apart = (
        f'What would tell {html.text(listed((c.name, *c.not_told_apart)))} apart: '
        f'{html.text(c.experiment)}'
        for c in d.causes
        if c.not_told_apart
    )
    advice = (
        f'<b>{html.text(c.name)}</b>{f": {html.text(c.meaning)}" if c.meaning else "."} '
        f'<b>What to do:</b> {html.text(c.to_do)}'
        for c in d.causes
        if c.to_do
    )
    proof = (
        'On held-out data, the simulation differs from the measured power by '
        f'{say.level(d.rmse_simulation, 2)} MW (root mean square), the extended model by '
        f'{say.level(d.rmse_extended, 2)} MW. {say.floor_words(d.disturbance is not None)} '
        f'would give about {say.level(d.rmse_noise_floor, 2)} MW.'
    )
    return html.section(
        'The answer', html.paragraph(said, 'good') if good else html.notice(said),
        *map(html.notice, apart), *map(html.paragraph, (*advice, proof)),
        signature_figure(ranked[0], data, _HOW) if ranked else None,
    )  # fmt: skip


def _wrong(data: Diagnosed, ranked: Sequence[Signature]) -> Section:
    rows = [
        [html.text(_variable(s.variable, data.exponent).removeprefix('the ')),
         *(say.percent(share) for share in (s.share_before, s.share_after, s.share_chance))]
        for s in ranked
    ]  # fmt: skip
    return html.section(
        '1. What is wrong',
        html.paragraph(
            'The simulation (curve and regional dynamics) was run on the measured opening and '
            'pressure. How much of the difference to the measured power depends on each variable:'
        ),
        html.table(['variable', 'simulation', 'extended model', 'by chance (99 %)'], rows),
        *(signature_figure(s, data) for s in ranked[1:]),
        answer_figure(data.answers) if data.answers else None,
        *(map_figure(m, data) for m in data.maps if m.shown_before or m.shown_after),
    )


def _why(data: Diagnosed) -> Section:
    d = data.diagnosis
    parts = [html.paragraph(html.text(c.sentence)) for c in d.causes]
    for c in d.causes:
        if c.switches_s:
            spans = times_in_effect(c.switches_s, data.start_ns, data.end_ns)
            parts.append(html.paragraph(f'{html.text(c.name)} was in effect: {html.text(spans)}.'))
        if c.not_told_apart:
            parts.append(html.notice(
                f'{html.text(c.name)} cannot be told from '
                f'{html.text(", ".join(c.not_told_apart))} with these data. What would tell '
                f'them apart: {html.text(c.experiment)}'
            ))  # fmt: skip
    others = (
        f'<b>{html.text(", ".join(names))}</b>: {html.text(why)}'
        for why, names in by_reason(d.rejected).items()
    )
    # With another verdict, or a drift, the answer says it.
    beside = d.disturbance if d.verdict == NAMED and not _drifts(d) else None
    return html.section(
        '2. Why', *parts,
        html.paragraph(html.text(beside.sentence)) if beside else None,
        html.paragraph('Causes that are not named, and why:') + html.bullets(others)
        if d.rejected else None,
        *(html.paragraph(html.text(note)) for note in d.notes),
    )  # fmt: skip


def by_reason(rejected: Sequence[tuple[str, str]]) -> dict[str, list[str]]:
    """Return the names of the causes for each reason."""
    found: dict[str, list[str]] = {}
    for name, why in rejected:
        found.setdefault(why, []).append(name)
    return found


def _model(data: Diagnosed) -> Section:
    d = data.diagnosis
    names = f', and {", ".join(html.text(n) for n in d.final.names)}.' if d.final.names else '.'
    words = (
        f'A curve of {say.counted(d.final.base.pieces, "piece")}, '
        f'{say.counted(d.final.base.regions, "region")} of dynamics{names}'
    )
    rows = [
        [html.text(c.name), html.text(key), *(html.text(cell) for cell in cells(e, data.exponent))]
        for c in d.causes
        for key, e in c.parameters.items()
    ]
    head = ['cause', 'parameter', 'value', '95 % interval']
    values = html.table(head, rows, sentences=True) if rows else ''
    return html.section('3. The extended model', html.paragraph(words), values)


def _proof(data: Diagnosed) -> Section:
    d = data.diagnosis
    errors = [
        ['simulation', say.level(d.rmse_simulation, 3)],
        ['extended model', say.level(d.rmse_extended, 3)],
        [f'{say.floor_words(d.disturbance is not None)} (estimate)',
         say.level(d.rmse_noise_floor, 3)],
    ]  # fmt: skip
    gains = [
        [html.text(c.name), say.level(c.gain.rmse_before, 3), say.level(c.gain.rmse_after, 3),
         say.percent(c.gain.reduction), say.plain(c.gain.p_value, 2)]
        for c in d.causes if math.isfinite(c.gain.p_value)
    ]  # fmt: skip
    told = html.paragraph(
        'What each cause gains there; p is the probability of such a gain by chance, '
        'corrected for the number of causes tested:'
    ) + html.table(['cause', 'before (MW)', 'after (MW)', 'smaller by', 'p'], gains)
    return html.section(
        '4. Check on held-out data',
        html.paragraph(
            'Every fifth block of the record was held out: nothing was fitted to it. Root mean '
            'square difference there, of means over '
            f'{say.duration(d.mean_s)}:'
        ),
        html.table(['model', 'MW'], errors), told if gains else None,
        segments_figure(d.segments) if d.segments else None,
    )  # fmt: skip


# Presentation of a diagnosis: names of variables, parameters, times as dates.

# For each variable: its name in a sentence, its axis title, a short axis title, and the likely
# cause if the line leaves the band.
_VARIABLES = {
    'u': (
        'the integrated input u', 'integrated input u ({unit})', '',
        'A bend or a step here points to the shape of the curve.',
    ),
    'pressure given u': (
        'the steam pressure given u', 'pressure above its usual at that u (MPa)',
        'pressure above usual (MPa)',
        'A tilt here points to the pressure exponent or to a flow that is choked.',
    ),
    'temperature': (
        'the steam temperature', 'main steam temperature (°C)', 'steam temperature (°C)',
        'A tilt here points to steam temperature or reheating.',
    ),
    'time': (
        'time', 'time (UTC)', '',
        'A step points to something that happened then, a slope to wear or drift.',
    ),
    'time of day': (
        'the time of day', 'time of day (h UTC)', '',
        'A wave here points to cooling water or ambient temperature.',
    ),
    'ramp': (
        'the ramp rate', 'change of u in 3 min ({unit})', '',
        'A tilt here points to lag and delay, or to a valve that is slower than its command.',
    ),
    'direction': (
        'the direction of motion', 'last motion (−1 closing, +1 opening)',
        'last motion (−1 to +1)',
        'A difference between the two ends points to backlash or stiction.',
    ),
}  # fmt: skip
_MOST_SPANS = 20


def _variable(name: str, exponent: float) -> str:
    return _of_opening(_VARIABLES[name][0], exponent) if name in _VARIABLES else name


def _of_opening(words: str, exponent: float) -> str:
    """Return words on u for a curve whose u is the opening: then its exponent is 0."""
    if exponent:
        return words
    return re.sub(r'\bu\b', 'opening', words.replace('integrated input u', 'valve opening'))


def axis_titles(name: str, exponent: float) -> dict[str, str]:
    """Return the title of an axis and a short one, as HTML; the exponent is that of u."""
    if name not in _VARIABLES:
        return {'text': name}
    _, long, short, _ = _VARIABLES[name]
    long = _of_opening(long, exponent).replace('{unit}', say.input_unit(exponent))
    return {'text': long, 'short': short} if short else {'text': long}


def points_to(name: str) -> str:
    """Return the likely cause if the line leaves the band; '' if unknown."""
    return _VARIABLES[name][3] if name in _VARIABLES else ''


def cells(estimate: Estimate, exponent: float) -> tuple[str, str]:
    """Return a parameter with its unit, and its 95 % interval; times are given as dates."""
    if estimate.origin_ns is not None:
        at, between = dates(estimate)
        return at, between or UNKNOWN
    unit = estimate.unit.replace(say.input_unit_plain(math.nan), say.input_unit_plain(exponent))
    number = say.count(round(estimate.value)) if unit == 'rows' else say.plain(estimate.value)
    value = f'{number} {unit}'.strip()
    return value, say.interval(estimate.low, estimate.high)


def times_in_effect(switches_s: Sequence[float], start_ns: int, end_ns: int) -> str:
    """Return the dates when a cause that is switched on and off was in effect.

    Parameters
    ----------
    switches_s : sequence of float
        On, off, on, ...: seconds after the first row.
    start_ns, end_ns : int
        Times of the first and last row.
    """
    moments = [told(start_ns, s) for s in switches_s]
    if len(moments) % 2:
        moments.append(told(end_ns, 0.0))
    spans = [f'{a} to {b}' for a, b in zip(moments[::2], moments[1::2], strict=True)]
    shown = '; '.join(spans[:_MOST_SPANS])
    more = len(spans) - _MOST_SPANS
    return f'{shown}; and {more} times more' if more > 0 else shown


_BOTH = (('simulation', 'raw', 'dash'), ('extended model', 'curve', 'solid'))


def _moments(start_ns: int, time_s: FloatArray) -> list[float | None]:
    return plot.moments(start_ns / 1e6 + 1e3 * np.asarray(time_s))


def _marked(
    x: list[float | None], y: FloatArray, name: str, colour: str, dash: str, hover: str
) -> Spec:
    look: Spec = {'dash': dash, 'mode': 'lines+markers', 'marker': {'size': 5}}
    return plot.line(x, plot.rounded(y, 4), name, colour, hover, **look)


def signature_figure(s: Signature, data: Diagnosed, how: str = '') -> Figure:
    """Return the mean residual over one variable, of the simulation and the extended model.

    ``how`` explains how to read such a figure.
    """
    titles = axis_titles(s.variable, data.exponent)
    across, x = plot.axis(titles), plot.rounded(s.middle, 6)
    hover = f'{titles["text"]}: %{{x:.4~g}}<br>%{{y:+.2f}} MW'
    if s.variable == 'time':
        across, x, hover = plot.time_axis(), _moments(data.start_ns, s.middle), (
            f'{DAY_HOUR}%{{y:+.2f}} MW'
        )  # fmt: skip
    elif s.variable == 'time of day':
        x = plot.rounded(s.middle / 3600.0, 6)
    chance = plot.rounded(np.concatenate([s.chance, -s.chance[::-1]]), 4)
    traces = [plot.area([*x, *x[::-1]], chance, 'by chance (99 %)',
                   line={'width': 0, 'color': plot.token('band')})]  # fmt: skip
    traces += [
        _marked(x, values, *look, hover)
        for values, look in zip((s.before, s.after), _BOTH, strict=True)
    ]
    ends = [say.plain(float(v), 2) for v in (s.before.min(), s.before.max(), s.after.min(),
                                         s.after.max())]  # fmt: skip
    variable = _variable(s.variable, data.exponent)
    return Figure(
        f'residual-{s.variable.replace(" ", "-")}',
        f'<b>Measured minus simulated power against {html.text(variable)}.</b> '
        f'{points_to(s.variable)} {how}',
        f'Mean residual against {variable}, from {ends[0]} to {ends[1]} MW before '
        f'and {ends[2]} to {ends[3]} MW after.',
        traces, {'xaxis': across, 'yaxis': plot.axis('mean residual (MW)')}, height=300,
    )  # fmt: skip


def answer_figure(answers: Sequence[Answer]) -> Figure:
    """Return the mean residual around fast moves, separately for opening and closing."""
    traces = []
    for a in answers:
        way = 'opening' if a.up else 'closing'
        for (name, _, dash), values in zip(_BOTH, (a.before, a.after), strict=True):
            traces.append(_marked(
                plot.rounded(a.time_s, 6), values, f'{name}, {way}', 'steady' if a.up else 'slope',
                dash, '%{x:.0f} s<br>%{y:+.3~g} MW',
            ))  # fmt: skip
    chance = max(a.chance for a in answers)
    moves = ' and '.join(f'{a.moves} {"opening" if a.up else "closing"}' for a in answers)
    return Figure(
        'fast-moves',
        f'<b>Mean residual around fast moves of the valve</b> ({moves}). Only this picture shows '
        'whether the unit answers late or early. By chance a point lies within '
        f'±{say.plain(chance, 2)} MW.',
        'Mean residual from a minute before to five minutes after fast moves.', traces,
        {'xaxis': plot.axis('time after the move (s)'), 'yaxis': plot.axis('mean residual (MW)')},
        height=340,
    )  # fmt: skip


def segments_figure(segments: Sequence[SegmentGain]) -> Figure:
    """Return the error in every special segment of the sealed (test) blocks, for both models."""
    better = sum(s.rmse_after < s.rmse_before for s in segments)
    at = plot.moments([s.start_ns / 1e6 for s in segments])
    errors = [s.rmse_before for s in segments], [s.rmse_after for s in segments]
    traces = [
        plot.points(at, plot.rounded(values, 4), name, colour, f'{DAY_HOUR}%{{y:.2f}} MW',
               marker={'symbol': sign})
        for values, (name, colour, _), sign in zip(
            errors, _BOTH, ('circle-open', 'circle'), strict=True
        )
    ]  # fmt: skip
    return Figure(
        'segments',
        f'<b>Special segments in the held-out blocks.</b> {better} of {len(segments)} are '
        'predicted better by the extended model.',
        f'{say.counted(len(segments), "segment")}, {better} of them predicted better.', traces,
        {'xaxis': plot.time_axis(), 'yaxis': plot.axis('RMSE (MW)')}, height=340,
    )  # fmt: skip


def map_figure(m: ResidualMap, data: Diagnosed) -> Figure:
    """Return the errors of the simulation and of the extended model over two variables."""
    across, over = plot.rounded(m.across_edges, 6), Spec()
    below = axis_titles(m.across, data.exponent)['text']
    if m.across == 'time':
        across, below = _moments(data.start_ns, m.across_edges), 'day of the month (UTC)'
        over = {'type': 'date', 'nticks': 4, 'tickangle': 0, 'tickformat': '%-d'}
    largest = max(
        (float(np.nanmax(np.abs(x))) for x in (m.before, m.after) if np.isfinite(x).any()),
        default=1.0,
    )
    traces: list[Spec] = [
        {
            'type': 'heatmap', 'name': name, 'x': across, 'y': plot.rounded(m.up_edges, 4),
            'z': [plot.rounded(row, 3) for row in residual], 'zmin': -largest, 'zmax': largest,
            'zmid': 0.0, 'colorscale': 'RdBu', 'showscale': bool(side),
            'colorbar': {'title': {'text': 'MW'}}, 'xaxis': f'x{side}', 'yaxis': f'y{side}',
            'hovertemplate': '%{z} MW<extra></extra>',
        }
        for name, residual, side in (
            ('simulation', m.before, ''), ('extended model', m.after, '2'),
        )
    ]  # fmt: skip
    layout = {
        'xaxis': {**over, 'domain': [0.0, 0.46]},
        'xaxis2': {**over, 'domain': [0.54, 1.0], 'anchor': 'y2'},
        'yaxis': plot.axis(axis_titles(m.up, data.exponent)['text']),
        # One title for both axes: two titles side by side do not fit on a phone.
        'annotations': [
            {'text': below, 'showarrow': False, 'xref': 'paper', 'x': 0.5, 'xanchor': 'center',
             'yref': 'paper', 'y': 0.0, 'yshift': -56}
        ],
        'margin': {'l': 56, 'r': 12, 't': 34, 'b': 70},
        'yaxis2': {'anchor': 'x2', 'matches': 'y', 'showticklabels': False},
    }  # fmt: skip
    names = [_variable(name, data.exponent) for name in (m.across, m.up)]
    return Figure(
        f'map-{m.across.replace(" ", "-")}',
        f'<b>Residual over {html.text(names[0])} and {html.text(names[1])}</b>, simulation left, '
        'extended model right. Only cells outside the 99 % band of random noise are filled: '
        f'{m.shown_before} of {m.cells} for the simulation, {m.shown_after} for the extended '
        f'model; chance alone fills about {say.plain(0.01 * m.cells, 1)}.',
        f'{m.shown_before} of {m.cells} cells are outside it before, {m.shown_after} after.',
        traces, layout, height=380,
    )  # fmt: skip
