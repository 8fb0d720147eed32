"""The report of a diagnosis: what is wrong, why, the extended model, the proof."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from valveflow_ros import __version__
from valveflow_ros.diagnosis.result import NAMED, NOTHING, Diagnosis, NamedCause
from valveflow_ros.diagnosis.signature import Answer, ResidualMap, Signature
from valveflow_ros.report.diagnosis_figures import (
    answer_figure,
    cells,
    map_figure,
    segments_figure,
    signature_figure,
    times_in_effect,
    variable,
)
from valveflow_ros.report.figure import Figure
from valveflow_ros.report.history import History, history_sections
from valveflow_ros.report.page import Page, Section, notice, paragraph, table, text
from valveflow_ros.report.words import counted, decimals, moment, percent, plain

_HOW = (
    'Means of bins with equally many minutes. A model that is right stays in the band, here and '
    'below: that is how far chance reaches in one of a hundred records.'
)


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
    history: History | None = None
    exponent: float = math.nan


def diagnosis_report(data: Diagnosed) -> str:
    """Return ``report.html``: one self-contained page in four steps."""
    return diagnosis_page(data).to_html()


def diagnosis_page(data: Diagnosed) -> Page:
    """Return the report: the answer and its picture first, then the four steps."""
    d = data.diagnosis
    title = {
        NAMED: 'Why simulation and measurement disagree',
        NOTHING: 'Simulation and measurement agree',
    }.get(d.verdict, 'Simulation and measurement disagree')
    lead = paragraph(text(data.source), 'where')
    lead += paragraph(f'{moment(data.start_ns)} to {moment(data.end_ns)}', 'where')
    ranked = sorted(data.signatures, key=lambda s: -(s.share_before / max(s.share_chance, 1e-9)))
    sections = [
        _answer(data, ranked), _wrong(data, ranked), _why(data), _model(data), _proof(data),
        *history_sections(data.history),
    ]  # fmt: skip
    foot = (
        f'Made by valveflow {text(__version__)}. The same numbers, unrounded, stand in '
        'diagnosis.json and extended_model.json beside this page.'
    )
    return Page(title, lead, sections, foot, 'diagnose')


def _answer(data: Diagnosed, ranked: Sequence[Signature]) -> Section:
    """Return the verdict with its doubts, what it is worth, and the one telling picture."""
    d = data.diagnosis
    told = text(d.sentence)
    parts: list[str | Figure] = [
        paragraph(told, 'good') if d.verdict == NOTHING else notice(told),
        *(notice(words) for words in _doubts(d)),
        paragraph(
            'On blocks of time that nothing was fitted to, the simulation misses the measured '
            f'power by {decimals(d.rmse_simulation, 2)} MW, the extended model by '
            f'{decimals(d.rmse_extended, 2)} MW; noise alone makes about '
            f'{decimals(d.rmse_noise_floor, 2)} MW.'
        ),
    ]
    if ranked:
        parts.append(signature_figure(ranked[0], data.start_ns, _HOW, data.exponent))
    return Section('The answer', parts)


def _doubts(d: Diagnosis) -> list[str]:
    """Return what the verdict cannot tell apart, and what would; HTML."""
    if not d.not_told_apart:
        return []
    names = ' and '.join(text(n) for n in d.not_told_apart)
    told = f'These data do not tell apart: {names}.'
    if d.experiments:
        told += ' What would tell them apart: ' + ' '.join(text(e) for e in d.experiments)
    return [told]


def _wrong(data: Diagnosed, ranked: Sequence[Signature]) -> Section:
    rows = [
        [
            text(variable(s.variable).removeprefix('the ')), percent(s.share_before),
            percent(s.share_after), percent(s.share_chance),
        ]
        for s in ranked
    ]  # fmt: skip
    told = paragraph(
        'The simulation (curve and regional dynamics) was run on the measured opening and '
        'pressure. How much of the difference to the measured power depends on each variable:'
    )
    parts: list[str | Figure] = [
        told,
        table(['variable', 'simulation', 'extended model', 'by chance (99 %)'], rows),
    ]
    parts += [signature_figure(s, data.start_ns, exponent=data.exponent) for s in ranked[1:]]
    if data.answers:
        parts.append(answer_figure(data.answers))
    parts += [map_figure(m, data.start_ns, data.exponent) for m in data.maps]
    return Section('1. What is wrong', parts)


def _why(data: Diagnosed) -> Section:
    d = data.diagnosis
    parts: list[str | Figure] = [paragraph(text(c.sentence)) for c in d.causes]
    if not d.causes:
        parts.append(paragraph(text(d.sentence)))
    for c in d.causes:
        if c.switches_s:
            spans = times_in_effect(c.switches_s, data.start_ns, data.end_ns)
            parts.append(paragraph(f'{text(c.name)} was in effect: {text(spans)}.'))
        if c.not_told_apart:
            parts.append(
                notice(
                    f'{text(c.name)} cannot be told from {text(", ".join(c.not_told_apart))} '
                    f'with these data. What would tell them apart: {text(c.experiment)}'
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
        told = 'Other causes that were tried or could not be, and why they are not named:'
        items = ''.join(f'<li><b>{text(n)}</b>: {text(reason)}</li>' for n, reason in d.rejected)
        parts.append(f'{paragraph(told)}<ul>{items}</ul>')
    parts += [paragraph(text(note)) for note in d.notes]
    return Section('2. Why', parts)


def _parameters(causes: Sequence[NamedCause], exponent: float) -> list[list[str]]:
    return [
        [text(c.name), text(key), *(text(cell) for cell in cells(e, exponent))]
        for c in causes
        for key, e in c.parameters.items()
    ]


def _model(data: Diagnosed) -> Section:
    d = data.diagnosis
    rows = _parameters(d.causes, data.exponent)
    m = d.final.base
    told = paragraph(
        f'A curve of {counted(m.pieces, "piece")}, {counted(m.regions, "region")} of dynamics'
        + (f', and {", ".join(text(n) for n in d.final.names)}.' if d.final.names else '.')
    )
    parts: list[str | Figure] = [told]
    if rows:
        head = ['cause', 'parameter', 'value', '95 % interval']
        parts.append(table(head, rows, sentences=True))
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
            paragraph(
                'What each cause is worth there; p is the chance of such a gain if the cause were '
                'absent, with the number of causes tried in it:'
            )
        )
        parts.append(
            table(
                ['cause', 'before (MW)', 'after (MW)', 'smaller by', 'p'],
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
        parts.append(segments_figure(d.segments))
    return Section('4. The proof', parts)
