"""The report of a comparison: what came out first, then the evidence."""

from __future__ import annotations

import math

from valveflow_ros import __version__
from valveflow_ros.baselines.library import NAMES
from valveflow_ros.baselines.verdict import BASELINES, Finding, Outcome, Pair, Terms, finding_of
from valveflow_ros.records import SegmentKind
from valveflow_ros.report.answer import choice_figure, dynamics_table
from valveflow_ros.report.comparison_figures import (
    curves_figure,
    linear_block_words,
    moves_figure,
    stretch_figure,
    stretches,
    truth_figure,
)
from valveflow_ros.report.comparison_tables import (
    LABELS,
    Compared,
    errors_table,
    pairs_table,
    parameters_table,
    segments_table,
    totals_table,
)
from valveflow_ros.report.figure import Figure
from valveflow_ros.report.page import Page, Section, folded, paragraph, table, text
from valveflow_ros.report.words import counted, duration, moment, plain

# What came out of a comparison, in sentences.

_FINDING = {
    Finding.CONFIRMED: 'In this run that comes out.',
    Finding.CONTRADICTED: 'This run contradicts it.',
    Finding.OPEN: 'This run neither confirms nor contradicts it.',
}
_TERMS = {
    Terms.STATIC: 'Curve against curve, in steady-state segments,',
    Terms.DYNAMIC: 'Simulation against simulation, in all special segments,',
    Terms.ALL_ROWS: 'Simulation against simulation, over all rows,',
}

_HEADLINE = {
    Outcome.BETTER: 'better than', Outcome.WORSE: 'worse than',
    Outcome.OPEN: 'and cannot be told apart from',
}  # fmt: skip
_ABOUT = {
    Terms.ALL_ROWS: 'simulates the power of all rows',
    Terms.DYNAMIC: 'simulates the power of special segments',
    Terms.STATIC: 'predicts the power of steady-state segments',
    Terms.AS_PAPER: 'predicts the power of special segments',
}


def finding_words(data: Compared) -> list[str]:
    """Return what the run says of the paper's finding, and what holds on equal terms."""
    r = data.result
    told = [_headline(r.pairs)] if r.pairs else []
    told += [words for terms in _TERMS if (words := _on_terms(terms, r.pairs))]
    told += [
        "The paper finds that a curve from special segments predicts other days' special segments "
        'better than the simulations of a Hammerstein and of a sparse model. '
        + _FINDING[finding_of(r.pairs)]
        + _as_paper(data)
    ]
    if r.failure:
        told.append(r.failure + ' So it is missing here.')
    if r.errors:
        told.append(_truth_words(data))
    told.append(_samples(data))
    return told


def _headline(pairs: tuple[Pair, ...]) -> str:
    """Say who predicts better, like against like, on the most that was judged."""
    terms = next(t for t in (Terms.ALL_ROWS, Terms.DYNAMIC, Terms.STATIC, Terms.AS_PAPER)
                 if _of(t, pairs))  # fmt: skip
    met = _of(terms, pairs)
    parts = [
        f'{words} {" and ".join(names)}'
        for outcome, words in _HEADLINE.items()
        if (names := [LABELS[p.baseline] for p in met if p.outcome is outcome])
    ]
    return f'On data that no method had seen, valveflow {_ABOUT[terms]} {"; ".join(parts)}.'


def _of(terms: Terms, pairs: tuple[Pair, ...]) -> list[Pair]:
    return [p for p in pairs if p.terms is terms]


def _as_paper(data: Compared) -> str:
    j = data.result.judgement
    pairs = _of(Terms.AS_PAPER, data.result.pairs)
    steady = len(j.kinds(SegmentKind.STEADY))
    slope = len(j.kinds(SegmentKind.SLOPE))
    told = (
        f' Over {counted(steady, "steady-state segment")} and '
        f'{counted(slope, "slope-response segment")} the mean squared error of the static curve '
        f'is {plain(pairs[0].mse_ours_mw2)} MW²; '
    )
    return told + ' and '.join(_against(p) for p in pairs) + '.'


def _against(pair: Pair) -> str:
    said = f'{LABELS[pair.baseline]} has {_mse(pair.mse_theirs_mw2)}'
    if pair.failed:
        what = 'half hour' if pair.terms is Terms.ALL_ROWS else 'segment'
        said += f', and gives no finite answer in {pair.failed} of {counted(pair.judged, what)}'
        return f'{said} (over the others {_tested(pair)})' if _is_tested(pair) else said
    return f'{said} ({_tested(pair)})'


def _is_tested(pair: Pair) -> bool:
    """Tell whether what is left without the failures says something of its own."""
    return math.isfinite(pair.test.p_value) and pair.test.zero_is_rejected()


def _mse(value: float) -> str:
    return f'{plain(value)} MW²' if math.isfinite(value) else 'no finite error'


def _tested(pair: Pair) -> str:
    """Say what the test over segments says of our error, and how sure."""
    words = {
        Outcome.BETTER: 'significantly more',
        Outcome.WORSE: 'significantly less',
        Outcome.OPEN: 'not told apart',
    }[pair.outcome]
    return f'{words}, {_p(pair.test.p_value)}'


def _p(value: float) -> str:
    if not math.isfinite(value):
        return 'not tested'
    return 'p < 0.0001' if value < 1e-4 else f'p = {plain(value, 2)}'


def _on_terms(terms: Terms, pairs: tuple[Pair, ...]) -> str:
    met = _of(terms, pairs)
    if not met:
        return ''
    return (
        f'{_TERMS[terms]} valveflow has {plain(met[0].mse_ours_mw2)} MW²; '
        + ' and '.join(_against(p) for p in met)
        + '.'
    )


def _truth_words(data: Compared) -> str:
    errors = data.result.errors
    rmse = ', '.join(f'{LABELS[m]} {plain(e.rmse_mw, 3)}' for m, e in errors.items())
    best = min(errors, key=lambda m: errors[m].rmse_mw)
    told = f'Against the true curve the root mean square errors are, in MW: {rmse}. '
    told += f'The nearest is {LABELS[best]}.'
    reference = errors['proposed'].rmse_mw
    for b in (b for b in BASELINES if b in errors):
        times = errors[b].rmse_mw / reference if reference > 0.0 else math.nan
        if math.isfinite(times):
            told += f' The error of {LABELS[b]} is {plain(times, 2)} times that of valveflow.'
    return told + _nearer(data)


def _nearer(data: Compared) -> str:
    """Say what becomes of the finding that the other two curves miss the truth."""
    errors = data.result.errors
    if 'paper' not in errors:
        return ''
    mine = errors['paper'].rmse_mw
    further = [LABELS[b] for b in BASELINES if b in errors and errors[b].rmse_mw > mine]
    nearer = [LABELS[b] for b in BASELINES if b in errors and errors[b].rmse_mw <= mine]
    told = (
        ' The paper finds the curves of the other two further from the truth than its own: here '
    )
    if not nearer:
        return told + 'that comes out.'
    if not further:
        return told + 'both are nearer.'
    return f'{told}{further[0]} is further from it, and {nearer[0]} is nearer.'


def _samples(data: Compared) -> str:
    r = data.result
    name = 'proposed.dynamic' if 'proposed.dynamic' in r.predictions else 'proposed.static'
    plain_ok, plain_all = r.judgement.passed(name, as_paper=True)
    eff_ok, eff_all = r.judgement.passed(name, as_paper=False)
    worth = duration(r.judgement.widening * r.trial.step_s)
    return (
        f'The paired t test of the paper, which counts each sample, lets a mean difference of '
        f'zero stand in {plain_ok} of {plain_all} segments for valveflow '
        f'({"simulated" if name.endswith("dynamic") else "curve"}). But the noise is correlated: '
        f'one independent value takes {worth}. Counted so, it stands in {eff_ok} of {eff_all}.'
    )


def data_words(data: Compared) -> str:
    """Say what was learnt from and judged on."""
    if data.held_out:
        return (
            f'Learnt from the first two thirds of {data.source}, judged on its last third, which '
            'no method has seen. No other log was named with --test.'
        )
    return f'Learnt from {data.source}, judged on {data.other}.'


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
