# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The report of a comparison: the result first, then the evidence."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import Any

import numpy as np

from valveflow_ros.baselines.comparison import (
    BASELINES,
    ErrorOrder,
    Finding,
    Pair,
    Terms,
    finding_of,
)
from valveflow_ros.baselines.judged import JudgedSegment
from valveflow_ros.baselines.sparse import NAMES
from valveflow_ros.records import NS_PER_S, FloatArray, SegmentKind
from valveflow_ros.report import figure as plot
from valveflow_ros.report import page as html
from valveflow_ros.report import words as say
from valveflow_ros.report.answer import choice_figure, dynamics_cells
from valveflow_ros.report.comparison_tables import (
    LABELS,
    METHODS,
    Compared,
    curves_of,
    errors_table,
    pairs_table,
    parameters_cells,
    segments_table,
    totals_cells,
)
from valveflow_ros.report.figure import Figure, Spec
from valveflow_ros.report.page import Page, Section
from valveflow_ros.segments.window import WindowContents

# The result of a comparison, in sentences.

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
# For the headline: what a method does, on the largest data set first; and the ranking.
_ABOUT = {
    Terms.ALL_ROWS: 'simulates the power of all rows',
    Terms.DYNAMIC: 'simulates the power of special segments',
    Terms.STATIC: 'predicts the power of steady-state segments',
    Terms.AS_PAPER: 'predicts the power of special segments',
}
_HEADLINE = {
    ErrorOrder.BETTER: 'better than', ErrorOrder.WORSE: 'worse than',
    ErrorOrder.OPEN: 'and cannot be told apart from',
}  # fmt: skip
_TESTED = {
    ErrorOrder.BETTER: 'significantly more', ErrorOrder.WORSE: 'significantly less',
    ErrorOrder.OPEN: 'not told apart',
}  # fmt: skip


def data_words(data: Compared) -> str:
    """Return which data were used for fitting and for testing."""
    if data.held_out:
        return (
            f'Learnt from the first two thirds of {data.source}, judged on its last third, which '
            'no method has seen. No other log was named with --test.'
        )
    return f'Learnt from {data.source}, judged on {data.other}.'


def finding_words(data: Compared) -> list[str]:
    """Return the result for the finding of the paper, and the result on equal terms."""
    r, j = data.result, data.result.judgement
    told = [_headline(r.pairs)] if r.pairs else []
    for terms, words in _TERMS.items():
        if met := _of(terms, r.pairs):
            told.append(
                f'{words} valveflow has {say.plain(met[0].mse_ours_mw2)} MW²; {_against(met)}'
            )
    met = _of(Terms.AS_PAPER, r.pairs)
    steady, slope = (len(j.kinds(kind)) for kind in (SegmentKind.STEADY, SegmentKind.SLOPE))
    told.append(
        "The paper finds that a curve from special segments predicts other days' special segments "
        f'better than the simulations of a Hammerstein and of a sparse model. '
        f'{_FINDING[finding_of(r.pairs)]} Over {say.counted(steady, "steady-state segment")} and '
        f'{say.counted(slope, "slope-response segment")} the mean squared error of the static '
        f'curve is {say.plain(met[0].mse_ours_mw2)} MW²; {_against(met)}'
    )
    if r.failure:
        told.append(r.failure + ' So it is missing here.')
    if r.errors:
        told.append(_truth_words(data))
    name = 'proposed.dynamic' if 'proposed.dynamic' in r.predictions else 'proposed.static'
    stands, tested = j.passed(name, as_paper=True)
    worth, of_worth = j.passed(name, as_paper=False)
    told.append(
        f'The paired t test of the paper, which counts each sample, does not reject a mean '
        f'difference of zero in {stands} of {tested} segments for valveflow '
        f'({"simulated" if name.endswith("dynamic") else "curve"}). But the noise is correlated: '
        f'one independent value takes {say.duration(j.widening * r.trial.step_s)}. Counted so, it '
        f'does not reject it in {worth} of {of_worth}.'
    )
    return told


def _of(terms: Terms, pairs: tuple[Pair, ...]) -> list[Pair]:
    return [p for p in pairs if p.terms is terms]


def _headline(pairs: tuple[Pair, ...]) -> str:
    terms = next(t for t in _ABOUT if _of(t, pairs))
    parts = [
        f'{words} {" and ".join(names)}'
        for outcome, words in _HEADLINE.items()
        if (names := [LABELS[p.baseline] for p in _of(terms, pairs) if p.outcome is outcome])
    ]
    return f'On data that no method had seen, valveflow {_ABOUT[terms]} {"; ".join(parts)}.'


def _against(pairs: list[Pair]) -> str:
    told = []
    for p in pairs:
        mse = p.mse_theirs_mw2
        said = f'{LABELS[p.baseline]} has ' + (
            f'{say.plain(mse)} MW²' if math.isfinite(mse) else 'no finite error'
        )
        tested = f'{_TESTED[p.outcome]}, {say.p_value(p.test.p_value)}'
        if not p.failed:
            told.append(f'{said} ({tested})')
            continue
        what = 'half hour' if p.terms is Terms.ALL_ROWS else 'segment'
        said += f', and gives no finite answer in {p.failed} of {say.counted(p.judged, what)}'
        # The result without failures is reported if it differs.
        told.append(f'{said} (over the others {tested})' if p.test.zero_is_rejected() else said)
    return ' and '.join(told) + '.'


def _truth_words(data: Compared) -> str:
    rmse = {method: error.rmse_mw for method, error in data.result.errors.items()}
    listed = ', '.join(f'{LABELS[m]} {say.plain(e, 3)}' for m, e in rmse.items())
    told = (
        f'Against the true curve the root mean square errors are, in MW: {listed}. '
        f'The nearest is {LABELS[min(rmse, key=lambda m: rmse[m])]}.'
    )
    others = [b for b in BASELINES if b in rmse]
    for b in others:
        times = rmse[b] / rmse['proposed'] if rmse['proposed'] > 0.0 else math.nan
        if math.isfinite(times):
            told += f' The error of {LABELS[b]} is {say.plain(times, 2)} times that of valveflow.'
    if 'paper' not in rmse:
        return told
    further = [LABELS[b] for b in others if rmse[b] > rmse['paper']]
    nearer = [LABELS[b] for b in others if rmse[b] <= rmse['paper']]
    told += (
        ' The paper finds the curves of the other two further from the truth than its own: here '
    )
    if not nearer:
        return told + 'that comes out.'
    if not further:
        return told + 'both are nearer.'
    return f'{told}{further[0]} is further from it, and {nearer[0]} is nearer.'


def comparison_page(data: Compared) -> Page:
    """Return the report: the result and the curves first, then the evidence."""
    c = data.result.characteristic
    first, *rest = finding_words(data)
    spans = [say.period(part.time_ns[0], part.time_ns[-1]) for part in (data.learnt, data.judged)]
    shown = stretches(data)
    segments = [s for stretch in shown for s in stretch.segments]
    sections = [
        html.section(
            'What came out', html.paragraph(html.text(first), 'answer'), curves_figure(data),
            pairs_table(data.result.pairs),
            *(html.paragraph(html.text(sentence)) for sentence in rest),
        ),
        html.section(
            'The curves',
            html.table(*parameters_cells(data), caption="As in the paper's Table II."),
        ),
        html.section('Against the truth', errors_table(data), truth_figure(data))
        if data.result.truth is not None else None,
        html.section(
            'On data nobody has seen',
            html.table(*totals_cells(data), caption='Mean squared errors on the test data.'),
            *(stretch_figure(data, s) for s in shown),
            segments_table(data, segments) if segments else None,
        ),
        html.section(
            'Dynamics by load', html.table(*dynamics_cells(c.dynamics)),
            html.paragraph(html.text(_linear_block_words(data))), moves_figure(data),
        ),
        html.section('Why this number of pieces', choice_figure(c.choice, max(1, len(c.pieces)))),
        _tuning(data),
        html.section('How the data were read', html.bullets(map(html.text, data.notes)))
        if data.notes else None,
    ]  # fmt: skip
    end = html.foot(
        f'Curve <code>{html.text(c.model_id)}</code>; the same numbers without rounding are in '
        'comparison.json and the tables beside this page.'
    )
    lead = html.where(data_words(data), ', and '.join(spans))
    return Page('Three methods compared', lead, [s for s in sections if s], end, 'compare')


def _linear_block_words(data: Compared) -> str:
    m = data.result.hammerstein.model
    times = ', '.join(f'{say.plain(float(t), 3)} s' for t in m.time_constants_s)
    return (
        f'The Hammerstein model has one linear block for all loads: '
        f'{_order(len(m.b), len(m.denominator))} (time constants {times or "none"}), delay '
        f'{say.plain(m.delay * m.step_s, 3)} s.'
    )


def _order(taps: int, poles: int) -> str:
    return f'{say.counted(taps, "tap")}, {say.counted(poles, "pole")}'


def _tuning(data: Compared) -> Section:
    """Return the candidates for each baseline; a baseline without tuning is no fair comparison."""
    h, s = data.result.hammerstein, data.result.sparse
    rows = [
        [f'Hammerstein, {_order(n_b, n_f)}', html.text(noise), say.plain(mse)]
        for n_b, n_f, noise, mse in h.tried
    ]
    sparse = data.result.failure
    if s is not None:
        rows += [
            [f'sparse, {html.text(kind)}, {window:g} s', f'{terms} functions', say.plain(mse)]
            for kind, window, terms, mse in s.mse_by_form
        ]
        equation = ' '.join(
            f'{"−" if x < 0.0 else "+"} {say.plain(abs(float(x)), 4)}{"" if n == "1" else f" {n}"}'
            for n, x in zip(NAMES, s.model.xi, strict=True)
            if x != 0.0
        )
        sparse = (
            f'Sparse identification took the equations in the form "{s.form.kind}" over '
            f'{s.form.window_s:g} s and threshold {say.plain(s.threshold, 3)} on scaled columns. '
            f'The model, with y in MW: dy/dt = {equation.removeprefix("+ ") or "0"} (MW/s).'
        )
    words = (
        'Each was learnt from the first 70 % of the data learnt from and run freely over the '
        'rest; the one with the smallest error there was fitted again to everything (of the '
        'sparse ones the sparsest within 1 % of the best). The Hammerstein model has as many '
        f'pieces as the proposed curve, and began at several sets of breakpoints. Chosen: '
        f'{h.noise}, {_order(len(h.model.b), len(h.model.denominator))}.'
    )
    candidates = html.table(['candidate', '', 'mean squared error (MW²)'], rows)
    return html.section(
        'How the other two were tuned', html.paragraph(html.text(words)),
        html.paragraph(html.text(sparse)),
        html.folded(f'The {say.counted(len(rows), "candidate")}', candidates),
    )  # fmt: skip


# Figs. 7 and 11 of the paper: the curves.

_DOTS = 5000
# Colour, dash and width of the line of each method, the same in all figures.
LOOK = {
    'paper': ('raw', 'dash', 1.6),
    'proposed': ('curve', 'solid', 2.4),
    'hammerstein': ('slope', 'dashdot', 2.0),
    'sparse': ('chosen', 'dot', 2.0),
}


def _method_line(method: str, x: Any, y: Any, hover: str, **more: Any) -> Spec:
    colour, dash, width = LOOK[method]
    # A legend has little space.
    name = "the paper's curve" if method == 'paper' else LABELS[method]
    shared = {'legendgroup': method, 'showlegend': True, 'yaxis': 'y', **more}
    return plot.line(x, y, name, colour, hover, dash=dash, width=width, **shared)


def _cloud(contents: WindowContents, special: bool) -> Spec:
    """Return a subset of the measured points, of special segments or of all rows."""
    rows = contents.special_rows() if special else np.arange(len(contents.u))
    rows = rows[np.isfinite(contents.u[rows]) & np.isfinite(contents.power_mw[rows])]
    if len(rows) > _DOTS:
        rows = rows[np.unique(np.linspace(0, len(rows) - 1, _DOTS).round().astype(np.int64))]
    return plot.points(
        plot.rounded(contents.u[rows]), plot.rounded(contents.power_mw[rows], 4),
        'special samples' if special else 'all samples', 'data-soft', size=2.5,
        marker={'opacity': 0.5},
    )  # fmt: skip


def _curves(data: Compared) -> list[Spec]:
    curves, hover = curves_of(data), 'u %{x:.0f}<br>%{y:.1f} MW'
    u = plot.rounded(curves['u'], 6)
    traces = []
    if 'truth' in curves:
        truth = plot.rounded(curves['truth'], 6)
        traces.append(plot.line(u, truth, 'truth', 'density-2', hover, width=6, yaxis='y'))
    return traces + [
        _method_line(m, u, plot.rounded(curves[m], 6), hover) for m in METHODS if m in curves
    ]


def curves_figure(data: Compared) -> Figure:
    """Return the curves over the special samples of the test data (Fig. 7)."""
    layout = {
        'xaxis': plot.axis(say.input_axis(data.result.characteristic.pressure_exponent)),
        'yaxis': plot.axis('generated power (MW)'), 'showlegend': True,
    }  # fmt: skip
    caption = (
        '<b>Every line should run through the cloud.</b> Grey: samples of special segments of '
        'the data learnt from. The curve of the sparse model is where its equation rests.'
    )
    traces = [_cloud(data.learnt, special=True), *_curves(data)]
    words = 'Flow characteristics of all methods over the special samples.'
    return Figure('curves', caption, words, traces, layout, height=480)


def truth_figure(data: Compared) -> Figure:
    """Return the curves over all samples, and their errors relative to the true one (Fig. 11)."""
    curves = curves_of(data)
    u = plot.rounded(curves['u'], 6)
    traces = [_cloud(data.learnt, special=False), *_curves(data)]
    traces += [
        _method_line(m, u, plot.rounded(curves[m] - curves['truth'], 4),
                     'u %{x:.0f}<br>%{y:.2f} MW', yaxis='y2', showlegend=False)
        for m in METHODS if m in curves
    ]  # fmt: skip
    m = data.result.characteristic.pressure_exponent
    layout = {
        'xaxis': plot.axis(say.input_axis(m), anchor='y2'),
        'yaxis': plot.axis('power (MW)', domain=[0.44, 1.0]),
        'yaxis2': plot.axis('curve − truth (MW)', domain=[0.0, 0.38]), 'showlegend': True,
    }  # fmt: skip
    caption = (
        '<b>Below, a perfect curve would lie at zero.</b> Above, the same curves over all '
        'samples; the wide line is the truth.'
    )
    words = 'Curves of all methods and their errors against the true curve.'
    return Figure('truth', caption, words, traces, layout, height=620)


# Figs. 9 and 10 of the paper: parts of the test data, measured and simulated.

_LENGTH_S = 7200.0
_MOVE_S = 900.0
_POINTS = 600
_COLOUR = {SegmentKind.STEADY: 'steady', SegmentKind.SLOPE: 'slope'}


@dataclass(frozen=True, slots=True)
class Stretch:
    """Rows [first, end) to be shown, and the segments in them."""

    name: str
    first: int
    end: int
    segments: tuple[JudgedSegment, ...]


def stretches(data: Compared) -> list[Stretch]:
    """Return two hours at low and two at high power, with most kinds and numbers of segments."""
    trial, segments = data.result.trial, data.result.judgement.segments
    rows = round(_LENGTH_S / trial.step_s)
    middle = float(np.median([s.power_mw for s in segments]))
    chosen = []
    for name, low in (('low', True), ('high', False)):
        found = []
        for s in segments:
            first = max(0, int(s.rows[0]) - round(300.0 / trial.step_s))
            end = min(first + rows, len(trial.u))
            inside = tuple(t for t in segments if first <= t.rows[0] and t.rows[-1] < end)
            if inside and all((t.power_mw <= middle) is low for t in inside):
                found.append(Stretch(name, first, end, inside))
        if found:
            chosen.append(
                max(found, key=lambda s: (len({t.kind for t in s.segments}), len(s.segments)))
            )
    return chosen


def _means(values: FloatArray, first: int, end: int) -> FloatArray:
    block = max(1, (end - first) // _POINTS)
    usable = (end - first) // block * block
    with np.errstate(invalid='ignore'):
        return np.asarray(values[first : first + usable].reshape(-1, block).mean(axis=1))


def _over_time(
    data: Compared, values: FloatArray, first: int, end: int
) -> tuple[list[float | None], list[float | None], str]:
    at = plot.rounded(_means(data.result.trial.time_ns[first:end] / 1e6, 0, end - first), 14)
    known = np.where(np.isfinite(values), values, np.nan)
    return at, plot.rounded(_means(known, first, end)), '%{x|%d %b %H:%M:%S}<br>%{y:.1f} MW'


def _measured(data: Compared, first: int, end: int, **more: Any) -> Spec:
    x, y, hover = _over_time(data, data.judged.power_mw, first, end)
    return plot.line(
        x, y, 'measured', 'data-soft', hover, width=1.2, legendgroup='measured', **more
    )


def _predicted(data: Compared, name: str, first: int, end: int, **more: Any) -> Spec:
    x, y, hover = _over_time(data, data.result.predictions[name], first, end)
    return _method_line(name.partition('.')[0], x, y, hover, **more)


def stretch_figure(data: Compared, stretch: Stretch) -> Figure:
    """Return measured and predicted power with special segments marked (Fig. 9)."""
    rows = stretch.first, stretch.end
    traces = [_measured(data, *rows, yaxis=y, showlegend=y == 'y') for y in ('y', 'y2')]
    traces += [
        _predicted(data, name, *rows, yaxis=y)
        for y, names in (
            ('y', ('paper.static', 'proposed.dynamic')),
            ('y2', ('hammerstein.dynamic', 'sparse.dynamic')),
        )
        for name in names if name in data.result.predictions
    ]  # fmt: skip
    layout = {
        # Tick labels that rotate automatically would make the margins unstable.
        'xaxis': plot.time_axis(anchor='y2', tickangle=0, nticks=8),
        'yaxis': plot.axis('power (MW)', domain=[0.53, 1.0]),
        'yaxis2': plot.axis('power (MW)', domain=[0.0, 0.47], matches='y'),
        'shapes': [
            plot.stripe(s.start_ns / 1e6, s.end_ns / 1e6, _COLOUR[s.kind], xref='x', opacity=0.14)
            for s in stretch.segments
        ],
        'showlegend': True,
    }
    caption = (
        f'<b>At {stretch.name} power: each line should cover the grey one.</b> Above the '
        "paper's static curve and valveflow's simulation, below the simulations of the other two. "
        'Shaded: <span class="key steady">steady-state</span> and '
        '<span class="key slope">slope-response</span> segments.'
    )
    words = f'Measured and predicted power over two hours at {stretch.name} power.'
    return Figure(f'stretch-{stretch.name}', caption, words, traces, layout, height=560)


def _fastest(data: Compared, low: bool) -> tuple[int, int] | None:
    """Return rows around the largest change of the flow in five minutes, at low or high power."""
    trial = data.result.trial
    flow = np.where(trial.good, data.result.predictions['proposed.static'], np.nan)
    rows = max(1, round(300.0 / trial.step_s))
    if len(flow) <= 2 * rows:
        return None
    before, after, middle = flow[:-rows], flow[rows:], np.nanmedian(flow)
    moved = np.abs(after - before)
    same = (after < middle) & (before < middle) if low else (after >= middle) & (before >= middle)
    moved = np.where(same & np.isfinite(moved), moved, -1.0)
    at = int(np.argmax(moved))
    if moved[at] <= 0.0:
        return None
    half = round(0.5 * _MOVE_S / trial.step_s)
    return max(0, at + rows // 2 - half), min(len(flow), at + rows // 2 + half)


def moves_figure(data: Compared) -> Figure | None:
    """Return the response of the power to the flow at low and at high power (Fig. 10)."""
    traces: list[Spec] = []
    layout: Spec = {'showlegend': True}
    for side, load, domain in (('', 'low', [0.0, 0.44]), ('2', 'high', [0.56, 1.0])):
        span = _fastest(data, load == 'low')
        if span is None:
            return None
        place: Spec = {'xaxis': f'x{side}', 'yaxis': f'y{side}', 'showlegend': not side}
        x, y, hover = _over_time(data, data.result.predictions['proposed.static'], *span)
        traces += [
            _measured(data, *span, **place),
            plot.line(x, y, 'steam flow F(u)', 'chosen', hover, width=1.4, legendgroup='proposed',
                 **place),
            *(_predicted(data, name, *span, **place)
              for name in ('proposed.dynamic', 'hammerstein.dynamic')
              if name in data.result.predictions),
        ]  # fmt: skip
        second = int(data.result.trial.time_ns[span[0]]) // NS_PER_S
        day = datetime.fromtimestamp(second, tz=timezone.utc)
        title = {'text': f'{load} power<br>{day:%d %b %Y} (UTC)',
                 'short': f'{load} power<br>{day:%d %b}'}  # fmt: skip
        layout[f'xaxis{side}'] = plot.axis(
            title, type='date', domain=domain, anchor=f'y{side}', nticks=3, tickformat='%H:%M',
            tickangle=0,
        )  # fmt: skip
        layout[f'yaxis{side}'] = plot.axis('' if side else 'power (MW)', anchor=f'x{side}')
    caption = (
        '<b>How long the power lags behind the flow.</b> Where one block for all loads answers '
        'too slowly on the left or too quickly on the right, the dynamics differ between loads.'
    )
    words = 'Steam flow and power in a large move at low and at high power.'
    return Figure('moves', caption, words, traces, layout, height=380)
