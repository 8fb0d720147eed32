# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The tables of a comparison, as HTML and CSV: Tables II, III and IV of the paper."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from valveflow_ros.baselines.comparison import Comparison, Pair, Terms
from valveflow_ros.baselines.judged import JudgedSegment, Judgement
from valveflow_ros.baselines.truth import Line
from valveflow_ros.records import FloatArray, SegmentKind
from valveflow_ros.report import page as html
from valveflow_ros.report import words as say
from valveflow_ros.report.figure import csv_text
from valveflow_ros.report.page import Cells
from valveflow_ros.segments.window import WindowContents

# In the order of the tables; the names in files, and those for people.
METHODS = ('paper', 'proposed', 'hammerstein', 'sparse')
LABELS = {
    'paper': "the paper's curve of special segments",
    'proposed': 'valveflow',
    'hammerstein': 'Hammerstein',
    'sparse': 'sparse (SINDy)',
}
PREDICTIONS = {
    'paper.static': "the paper's curve",
    'proposed.static': 'valveflow, curve',
    'hammerstein.static': 'Hammerstein, curve',
    'sparse.static': 'sparse, curve',
    'proposed.dynamic': 'valveflow, simulated',
    'hammerstein.dynamic': 'Hammerstein, simulated',
    'sparse.dynamic': 'sparse, simulated',
}
KIND = {SegmentKind.STEADY: 'steady', SegmentKind.SLOPE: 'slope'}
_SHORT = {
    'paper.static': "paper's curve",
    'proposed.dynamic': 'valveflow',
    'hammerstein.dynamic': 'Hammerstein',
    'sparse.dynamic': 'sparse',
}
_TERMS = {
    Terms.AS_PAPER: "the paper's way",
    Terms.STATIC: 'curves, steady segments',
    Terms.DYNAMIC: 'simulations, all segments',
    Terms.ALL_ROWS: 'simulations, all rows',
}
_PLACES = 500


@dataclass(frozen=True, slots=True)
class Compared:
    """A comparison and its data."""

    source: str  # name of the log for fitting
    other: str  # and of that for testing
    held_out: bool  # both are parts of one log
    result: Comparison
    learnt: WindowContents
    judged: WindowContents
    notes: tuple[str, ...] = ()  # about how the data were read

    @property
    def predictions(self) -> tuple[str, ...]:
        """Return the names of the available predictions, in the order of the tables."""
        return tuple(name for name in PREDICTIONS if name in self.result.predictions)


def mse_cell(value: float) -> str:
    """Return a mean squared error as text: '∞' if the prediction diverged, '–' if missing."""
    return say.plain(value) if math.isfinite(value) else '∞' if math.isinf(value) else '–'


def _pieces(data: Compared) -> Iterator[tuple[str, int, Line]]:
    for method in METHODS:
        if (line := data.result.lines.get(method)) is not None:
            for j in range(len(line.slopes)):
                yield method, j, line


def parameters_cells(data: Compared) -> Cells:
    """Return the cells of Table II: slopes, intercepts and pieces of the curves."""
    rows = [
        [
            '' if j else LABELS[method], str(j + 1), say.plain(float(line.slopes[j])),
            say.decimals(float(line.intercepts[j]), 2),
            say.span(line.knots[j], line.knots[j + 1], 1),
        ]
        for method, j, line in _pieces(data)
    ]  # fmt: skip
    head = ['method', 'piece', 'slope (MW per unit of u)', 'intercept (MW)', 'u']
    return head, rows


def errors_table(data: Compared) -> str:
    """Return Table IV: parameters and true ones; empty if the true curve is unknown."""
    truth = data.result.truth
    if truth is None:
        return ''
    rows = []
    for method, j, line in _pieces(data):
        if len(line.slopes) == len(truth.slopes):
            last = j + 1 == len(line.slopes)
            rows.append([
                '' if j else html.text(LABELS[method]), str(j + 1),
                *(say.plain(float(c.slopes[j])) for c in (line, truth)),
                *(say.decimals(float(c.intercepts[j]), 2) for c in (line, truth)),
                *('' if last else say.decimals(float(c.knots[j + 1]), 1) for c in (line, truth)),
            ])  # fmt: skip
    head = [
        'method', 'piece', 'slope', 'true slope', 'intercept (MW)', 'true intercept (MW)',
        'breakpoint', 'true breakpoint',
    ]  # fmt: skip
    told = html.table(head, rows, caption="As in the paper's Table IV.") if rows else ''
    rows = [
        [
            html.text(LABELS[m]), say.plain(e.rmse_mw, 3), say.plain(e.largest_mw, 3),
            *(say.plain(v, 2) if math.isfinite(v) else '–'
              for v in (e.slope, e.knee, e.intercept)),
        ]
        for m, e in data.result.errors.items()
    ]  # fmt: skip
    head = [
        'method', 'curve, rms (MW)', 'curve, largest (MW)', 'largest slope error',
        'largest breakpoint error', 'largest intercept error (MW)',
    ]  # fmt: skip
    return told + html.table(
        head, rows, caption='Errors against the truth, where the curve is known.'
    )


def totals_cells(data: Compared) -> Cells:
    """Return the cells of the mean squared errors, and of the tests for zero mean."""
    j, all_rows = data.result.judgement, data.result.all_rows
    rows = []
    for name in data.predictions:
        bias = j.bias(name)
        rows.append([
            PREDICTIONS[name],
            *(mse_cell(j.mse(name, k)) for k in (None, SegmentKind.STEADY, SegmentKind.SLOPE)),
            mse_cell(all_rows.get(name, math.nan)),
            f'{say.decimals(bias.mean, 3)} ({say.p_value(bias.p_value)})'
            if math.isfinite(bias.mean) else '–',
            *('{} of {}'.format(*j.passed(name, as_paper=paper)) for paper in (True, False)),
        ])  # fmt: skip
    head = [
        'mean squared error of', 'all segments (MW²)', 'steady (MW²)', 'slope (MW²)',
        'all rows (MW²)', 'mean difference (MW)', 'zero stands, each sample counted',
        'zero stands, correlation counted',
    ]  # fmt: skip
    return head, rows


def pairs_table(pairs: Sequence[Pair]) -> str:
    """Return which method is better, and on which terms."""
    rows = []
    for p in sorted(pairs, key=lambda p: list(_TERMS).index(p.terms)):
        tested = say.p_value(p.test.p_value)
        if p.failed:
            # The verdict is based on these failures, not only on the test.
            told = f'theirs has no finite answer in {p.failed} of {p.judged}'
            tested = f'{told}; the others: {tested}'
        rows.append([
            _TERMS[p.terms], html.text(LABELS[p.baseline]), mse_cell(p.mse_ours_mw2),
            mse_cell(p.mse_theirs_mw2), say.interval(*p.test.interval()),
            f'<b>{p.outcome.value}</b>, {tested}',
        ])  # fmt: skip
    head = [
        'terms', 'against', 'ours (MW²)', 'theirs (MW²)', 'theirs less ours, 95 % (MW²)',
        'ours is',
    ]  # fmt: skip
    words = (
        "The paper's way: its static curve against simulations of the others, all special "
        'segments. Otherwise like against like, and ours is valveflow.'
    )
    return html.paragraph(words) + html.table(head, rows)


def segments_table(data: Compared, segments: Sequence[JudgedSegment]) -> str:
    """Return Table III for some of the segments: mean squared errors and t values."""
    names = [n for n in _SHORT if n in data.predictions]

    def cell(segment: JudgedSegment, name: str) -> str:
        score = segment.scores[name]
        each, worth = score.samples.t, score.effective.t
        if not (math.isfinite(each) or math.isfinite(worth)):
            return mse_cell(score.mse_mw2)
        return f'{mse_cell(score.mse_mw2)} ({say.plain(each, 2)}; {say.plain(worth, 2)})'

    rows = [
        [
            f'{KIND[s.kind]} {s.number}', say.moment(s.start_ns)[5:16], str(len(s.rows)),
            say.decimals(s.power_mw, 0), *(cell(s, n) for n in names),
        ]
        for s in segments
    ]  # fmt: skip
    head = ['segment', 'from', 'samples', 'MW', *(html.text(_SHORT[n]) for n in names)]
    words = (
        "As the paper's Table III, for the segments shown: mean squared error in MW², and in "
        'brackets the t value of a mean difference of zero, first with each sample counted, then '
        'with what correlated samples are worth. All segments are in segments.csv.'
    )
    return html.paragraph(words) + html.table(head, rows)


def segments_csv(judgement: Judgement, names: Sequence[str]) -> str:
    """Return one row per special segment (Table III), unrounded."""
    columns = ('mse_mw2', 'mean_mw', 't', 'p', 'samples_effective', 't_effective', 'p_effective')
    head = ['segment', 'kind', 'start_ns', 'end_ns', 'samples', 'power_mw']
    head += [f'{name}.{column}' for name in names for column in columns]
    rows = []
    for s in judgement.segments:
        row: list[object] = [
            s.number, KIND[s.kind], s.start_ns, s.end_ns, len(s.rows), s.power_mw,
        ]  # fmt: skip
        for score in (s.scores[name] for name in names):
            each, worth = score.samples, score.effective
            row += [score.mse_mw2, each.mean, each.t, each.p_value, worth.effective, worth.t,
                    worth.p_value]  # fmt: skip
        rows.append(row)
    return csv_text(head, rows)


def parameters_csv(data: Compared) -> str:
    """Return one row per piece (Table II, and IV if the true curve is known), unrounded."""
    truth = data.result.truth
    rows = []
    for method, j, line in _pieces(data):
        values = [line.slopes[j], line.intercepts[j], line.knots[j], line.knots[j + 1]]
        if truth is not None and len(truth.slopes) == len(line.slopes):
            values += [truth.slopes[j], truth.intercepts[j]]
        else:
            values += [math.nan, math.nan]
        rows.append([method, j + 1, *map(float, values)])
    head = ['method', 'piece', 'slope', 'intercept', 'u_from', 'u_to', 'true_slope',
            'true_intercept']  # fmt: skip
    return csv_text(head, rows)


def curves_csv(data: Compared) -> str:
    """Return the curves of all methods at evenly spaced inputs (Figs. 7 and 11)."""
    curves = curves_of(data)
    return csv_text(list(curves), zip(*(c.tolist() for c in curves.values()), strict=True))


def curves_of(data: Compared) -> Mapping[str, FloatArray]:
    """Return u and the curve of each method there, MW; NaN where a method has none."""
    r = data.result
    ends = r.characteristic.breakpoints
    u = np.linspace(float(ends[0]), float(ends[-1]), _PLACES)
    curves = {'u': u, **{m: r.curve(m)(u) for m in METHODS if m in r.methods}}
    return curves if r.truth is None else {**curves, 'truth': r.truth(u)}
