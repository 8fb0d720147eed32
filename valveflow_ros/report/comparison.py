"""The report of a comparison: what came out first, then the evidence."""

from __future__ import annotations

from valveflow_ros import __version__
from valveflow_ros.baselines.library import NAMES
from valveflow_ros.report.choice import choice_figure
from valveflow_ros.report.comparison_data import Compared
from valveflow_ros.report.comparison_figures import curves_figure, truth_figure
from valveflow_ros.report.comparison_series import (
    linear_block_words,
    moves_figure,
    stretch_figure,
    stretches,
)
from valveflow_ros.report.comparison_tables import (
    errors_table,
    pairs_table,
    parameters_table,
    segments_table,
    totals_table,
)
from valveflow_ros.report.comparison_words import data_words, finding_words
from valveflow_ros.report.dynamics import dynamics_table
from valveflow_ros.report.figure import Figure
from valveflow_ros.report.numbers import counted, moment, plain
from valveflow_ros.report.page import Page, Section, folded, paragraph, table, text


def comparison_page(data: Compared) -> Page:
    """Return the report: what came out and the curves first, then the evidence."""
    c = data.result.characteristic
    lead = paragraph(text(data_words(data)), 'where') + paragraph(
        f'{moment(int(data.learnt.time_ns[0]))} to {moment(int(data.learnt.time_ns[-1]))}, and '
        f'{moment(int(data.judged.time_ns[0]))} to {moment(int(data.judged.time_ns[-1]))}',
        'where',
    )
    sections = [
        _finding(data),
        Section('The curves', [parameters_table(data)]),
        *_truth(data),
        _other_days(data),
        _dynamics(data),
        Section('Why this number of pieces', [choice_figure(c.choice, max(1, len(c.pieces)))]),
        _tuning(data),
    ]
    if data.notes:
        notes = '<ul>' + ''.join(f'<li>{text(n)}</li>' for n in data.notes) + '</ul>'
        sections.append(Section('How the data were read', [notes]))
    foot = (
        f'Made by valveflow {text(__version__)}. Curve <code>{text(c.model_id)}</code>; the same '
        'numbers, unrounded, stand in comparison.json and the tables beside this page.'
    )
    return Page('Three methods compared', lead, sections, foot, 'compare')


def _finding(data: Compared) -> Section:
    first, *rest = finding_words(data)
    return Section(
        'What came out',
        [
            paragraph(text(first), 'answer'),
            curves_figure(data),
            pairs_table(data.result.pairs),
            *(paragraph(text(sentence)) for sentence in rest),
        ],
    )


def _truth(data: Compared) -> list[Section]:
    if data.result.truth is None:
        return []
    return [Section('Against the truth', [errors_table(data), truth_figure(data)])]


def _other_days(data: Compared) -> Section:
    shown = stretches(data)
    parts: list[str | Figure] = [totals_table(data)]
    parts += [stretch_figure(data, s) for s in shown]
    segments = [s for stretch in shown for s in stretch.segments]
    if segments:
        parts.append(segments_table(data, segments))
    return Section('On data nobody has seen', parts)


def _dynamics(data: Compared) -> Section:
    c = data.result.characteristic
    parts: list[str | Figure] = []
    if c.dynamics:
        parts.append(dynamics_table(c.dynamics))
    parts.append(paragraph(text(linear_block_words(data))))
    figure = moves_figure(data)
    return Section('Dynamics by load', [*parts, figure] if figure else parts)


def _tuning(data: Compared) -> Section:
    """Tell what each baseline was chosen from; a baseline that was not tuned proves nothing."""
    h, s = data.result.hammerstein, data.result.sparse
    rows = [
        [f'Hammerstein, {_order(n_b, n_f)}', text(noise), plain(mse)]
        for n_b, n_f, noise, mse in h.tried
    ]
    if s is not None:
        rows += [
            [f'sparse, {text(kind)}, {window:g} s', f'{terms} functions', plain(mse)]
            for kind, window, terms, mse in s.mse_by_form
        ]
    words = (
        'Each was learnt from the first 70 % of the data learnt from and run freely over the '
        'rest; the one with the smallest error there was fitted again to everything (of the '
        'sparse ones the sparsest within 1 % of the best). The Hammerstein model has as many '
        f'pieces as the proposed curve, and began at several sets of knots. Chosen: '
        f'{h.noise}, {_order(len(h.model.b), len(h.model.denominator))}.'
    )
    head = ['candidate', '', 'mean squared error (MW²)']
    return Section(
        'How the other two were tuned',
        [
            paragraph(text(words)),
            paragraph(text(_sparse_words(data))),
            folded(f'The {counted(len(rows), "candidate")}', table(head, rows)),
        ],
    )


def _order(taps: int, poles: int) -> str:
    return f'{counted(taps, "tap")}, {counted(poles, "pole")}'


def _sparse_words(data: Compared) -> str:
    s = data.result.sparse
    if s is None:
        return data.result.failure
    terms = ' '.join(
        f'{"−" if x < 0.0 else "+"} {plain(abs(float(x)), 4)}{"" if name == "1" else f" {name}"}'
        for name, x in zip(NAMES, s.model.xi, strict=True)
        if x != 0.0
    )
    return (
        f'Sparse identification took the equations in the form "{s.form.kind}" over '
        f'{s.form.window_s:g} s and threshold {plain(s.threshold, 3)} on scaled columns. The '
        f'model, with y in MW: dy/dt = {terms.removeprefix("+ ") or "0"} (MW/s).'
    )
