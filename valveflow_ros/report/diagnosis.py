"""The report of a diagnosis: what is wrong, why, the extended model, the proof."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from valveflow_ros import __version__
from valveflow_ros.diagnosis.residual_map import ResidualMap
from valveflow_ros.diagnosis.result import NAMED, NOTHING, Diagnosis, NamedCause
from valveflow_ros.diagnosis.signature import Answer, Signature
from valveflow_ros.report.diagnosis_map import map_figure
from valveflow_ros.report.figure import Figure, Spec, rounded, token
from valveflow_ros.report.numbers import decimals, interval, moment, percent, plain
from valveflow_ros.report.page import Section, notice, page, paragraph, table, text

_DAY_S = 86_400.0


@dataclass(frozen=True, slots=True)
class Diagnosed:
    """What the page is made from."""

    source: str
    start_ns: int
    end_ns: int
    diagnosis: Diagnosis
    signatures: tuple[Signature, ...]
    answers: tuple[Answer, ...]
    maps: tuple[ResidualMap, ...] = ()


def diagnosis_report(data: Diagnosed) -> str:
    """Return ``report.html``: one self-contained page in four steps."""
    d = data.diagnosis
    title = {
        NAMED: 'Why simulation and measurement disagree',
        NOTHING: 'Simulation and measurement agree',
    }.get(d.verdict, 'Simulation and measurement disagree')
    lead = paragraph(text(data.source))
    lead += paragraph(f'{moment(data.start_ns)} to {moment(data.end_ns)}')
    lead += notice(text(d.sentence))
    sections = [_wrong(data), _why(d), _model(d), _proof(data)]
    foot = (
        f'Made by valveflow {text(__version__)}. The same numbers, unrounded, stand in '
        'diagnosis.json and extended_model.json beside this page.'
    )
    return page(title, lead, sections, foot)


def _wrong(data: Diagnosed) -> Section:
    worst = sorted(data.signatures, key=lambda s: -(s.share_before / max(s.share_chance, 1e-9)))
    rows = [
        [
            text(s.variable), percent(s.share_before), percent(s.share_after),
            percent(s.share_chance),
        ]
        for s in worst
    ]  # fmt: skip
    told = paragraph(
        'The simulation (curve and regional dynamics) was run on the measured opening and '
        'pressure. How much of the difference to the measured power depends on each variable:'
    )
    parts: list[str | Figure] = [
        told,
        table(['variable', 'simulation', 'extended model', 'by chance (99 %)'], rows),
    ]
    parts += [_signature_figure(s) for s in worst]
    if data.answers:
        parts.append(_answer_figure(data.answers))
    parts += [map_figure(m) for m in data.maps]
    return Section('1. What is wrong', parts)


def _line(x: np.ndarray, y: np.ndarray, name: str, colour: str, dash: str = 'solid') -> Spec:
    return {
        'type': 'scatter', 'mode': 'lines+markers', 'name': name, 'x': rounded(x, 6),
        'y': rounded(y, 4), 'line': {'color': token(colour), 'width': 2, 'dash': dash},
        'marker': {'size': 5},
    }  # fmt: skip


def _band(x: np.ndarray, width: np.ndarray) -> Spec:
    """Return the band round zero that chance fills."""
    return {
        'type': 'scatter', 'mode': 'lines', 'name': 'by chance (99 %)', 'fill': 'toself',
        'x': rounded(np.concatenate([x, x[::-1]]), 6),
        'y': rounded(np.concatenate([width, -width[::-1]]), 4),
        'line': {'width': 0, 'color': token('band')}, 'fillcolor': token('band'),
        'hoverinfo': 'skip',
    }  # fmt: skip


def _signature_figure(s: Signature) -> Figure:
    x, unit = s.middle, s.unit
    if s.variable == 'time':
        x, unit = x / _DAY_S, 'days'
    elif s.variable == 'time of day':
        x, unit = x / 3600.0, 'h UTC'
    name = s.variable.replace(' ', '-')
    return Figure(
        f'residual-{name}',
        f'<b>Measured minus simulated power against {text(s.variable)}.</b> Means of bins '
        'with equally many minutes. A model that is right stays in the band, which is what chance '
        'reaches in one of a hundred records.',
        f'Mean residual against {s.variable}, from {plain(float(s.before.min()), 2)} to '
        f'{plain(float(s.before.max()), 2)} MW before and {plain(float(s.after.min()), 2)} to '
        f'{plain(float(s.after.max()), 2)} MW after.',
        [_band(x, s.chance),
         _line(x, s.before, 'simulation', 'raw', 'dash'),
         _line(x, s.after, 'extended model', 'curve')],
        {'xaxis': {'title': {'text': f'{s.variable} ({unit})'}},
         'yaxis': {'title': {'text': 'mean residual (MW)'}}},
        height=300,
    )  # fmt: skip


def _answer_figure(answers: Sequence[Answer]) -> Figure:
    traces = []
    for a in answers:
        way = f'{"opening" if a.up else "closing"}, {a.moves} moves'
        colour = 'steady' if a.up else 'slope'
        traces.append(_line(a.time_s, a.before, f'simulation, {way}', colour, 'dash'))
        traces.append(_line(a.time_s, a.after, f'extended model, {way}', colour))
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


def _why(d: Diagnosis) -> Section:
    parts: list[str | Figure] = [paragraph(text(c.sentence)) for c in d.causes]
    if not d.causes:
        parts.append(paragraph(text(d.sentence)))
    for c in d.causes:
        if c.not_told_apart:
            parts.append(
                notice(
                    f'{text(c.name)} cannot be told from {text(", ".join(c.not_told_apart))} '
                    f'with these data. What would: {text(c.experiment)}'
                )
            )
    if d.unexplained_by:
        parts.append(notice(f'Unexplained: depends on {text(" and ".join(d.unexplained_by))}.'))
    if d.disturbance:
        hours = d.disturbance.time_scale_s / 3600.0
        parts.append(
            paragraph(
                f'The power wanders slowly by {plain(d.disturbance.rms_mw, 2)} MW over about '
                f'{plain(hours, 2)} h; that is a disturbance and no cause.'
            )
        )
    if d.rejected:
        rows = [[text(name), text(reason)] for name, reason in d.rejected]
        parts += [paragraph(f'Put away ({len(rows)}):'), table(['cause', 'why not'], rows)]
    parts += [paragraph(text(note)) for note in d.notes]
    return Section('2. Why', parts)


def _parameters(causes: Sequence[NamedCause]) -> list[list[str]]:
    return [
        [text(c.name), text(key), f'{plain(e.value)} {text(e.unit)}', interval(e.low, e.high)]
        for c in causes
        for key, e in c.parameters.items()
    ]


def _model(d: Diagnosis) -> Section:
    rows = _parameters(d.causes)
    m = d.final.base
    told = paragraph(
        f'A curve of {m.pieces} pieces, {m.regions} regions of dynamics'
        + (f', and {", ".join(text(n) for n in d.final.names)}.' if d.final.names else '.')
    )
    parts: list[str | Figure] = [told]
    if rows:
        parts.append(table(['cause', 'parameter', 'value', '95 % interval'], rows))
    return Section('3. The extended model', parts)


def _proof(data: Diagnosed) -> Section:
    d = data.diagnosis
    rows = [
        ['simulation', decimals(d.rmse_simulation, 3)],
        ['extended model', decimals(d.rmse_extended, 3)],
        ['noise alone (estimate)', decimals(d.rmse_noise_floor, 3)],
    ]
    parts: list[str | Figure] = [
        paragraph(
            'Every fifth block of the record was sealed: nothing was fitted to it, and it was '
            'opened once. Root mean square difference there, means of ten seconds:'
        ),
        table(['model', 'MW'], rows),
    ]
    modelled = [c for c in d.causes if math.isfinite(c.gain.p_value)]
    if modelled:
        parts.append(
            table(
                ['cause', 'before (MW)', 'after (MW)', 'smaller by', 'chance of it'],
                [
                    [
                        text(c.name), decimals(c.gain.rmse_before, 3),
                        decimals(c.gain.rmse_after, 3), percent(c.gain.reduction),
                        plain(c.gain.p_value, 2),
                    ]
                    for c in modelled
                ],
            )
        )  # fmt: skip
    if d.segments:
        parts.append(_segments_figure(data))
    return Section('4. The proof', parts)


def _segments_figure(data: Diagnosed) -> Figure:
    segments = data.diagnosis.segments
    better = sum(s.rmse_after < s.rmse_before for s in segments)
    days = np.array([(s.start_ns - data.start_ns) / 1e9 / _DAY_S for s in segments])
    traces = [
        {
            'type': 'scatter', 'mode': 'markers', 'name': name, 'x': rounded(days, 6),
            'y': rounded(np.array(values), 4),
            'marker': {'color': token(colour), 'size': 6, 'symbol': symbol},
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
        f'{len(segments)} segments, {better} of them predicted better.',
        traces,
        {'xaxis': {'title': {'text': 'days after the beginning'}},
         'yaxis': {'title': {'text': 'RMSE (MW)'}}},
        height=340,
    )  # fmt: skip
