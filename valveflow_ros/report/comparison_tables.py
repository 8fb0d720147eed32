"""The tables of a comparison: II, III and IV of the paper, and who is better than whom."""

from __future__ import annotations

import math
from collections.abc import Sequence

from valveflow_ros.baselines.comparison import Line
from valveflow_ros.baselines.judged import JudgedSegment
from valveflow_ros.baselines.verdict import Pair, Terms
from valveflow_ros.records import SegmentKind
from valveflow_ros.report.comparison_data import LABELS, METHODS, PREDICTIONS, Compared
from valveflow_ros.report.numbers import decimals, interval, moment, plain
from valveflow_ros.report.page import paragraph, table, text

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


def parameters_table(data: Compared) -> str:
    """Return Table II: slopes, intercepts and pieces of the curves that have them."""
    rows = []
    for method in METHODS:
        if method in data.result.lines:
            rows += _pieces(LABELS[method], data.result.lines[method])
    head = ['method', 'piece', 'slope (MW per unit of u)', 'intercept (MW)', 'u']
    return table(head, rows, caption="As in the paper's Table II.")


def _pieces(label: str, line: Line) -> list[list[str]]:
    return [
        [
            text(label) if j == 0 else '',
            str(j + 1),
            plain(float(line.slopes[j])),
            decimals(float(line.intercepts[j]), 2),
            f'{decimals(float(line.knots[j]), 1)} to {decimals(float(line.knots[j + 1]), 1)}',
        ]
        for j in range(len(line.slopes))
    ]


def errors_table(data: Compared) -> str:
    """Return Table IV: parameters against the true ones; empty if there is no truth."""
    r = data.result
    if r.truth is None:
        return ''
    rows = []
    for method in METHODS:
        line = r.lines.get(method)
        if line is None or len(line.slopes) != len(r.truth.slopes):
            continue
        for j in range(len(line.slopes)):
            rows.append(
                [
                    text(LABELS[method]) if j == 0 else '',
                    str(j + 1),
                    plain(float(line.slopes[j])),
                    plain(float(r.truth.slopes[j])),
                    decimals(float(line.intercepts[j]), 2),
                    decimals(float(r.truth.intercepts[j]), 2),
                    decimals(float(line.knots[j + 1]), 1) if j + 1 < len(line.slopes) else '',
                    decimals(float(r.truth.knots[j + 1]), 1) if j + 1 < len(line.slopes) else '',
                ]
            )
    head = [
        'method', 'piece', 'slope', 'true slope', 'intercept (MW)', 'true intercept (MW)', 'knee',
        'true knee',
    ]  # fmt: skip
    told = table(head, rows, caption="As in the paper's Table IV.") if rows else ''
    return told + _largest(data)


def _largest(data: Compared) -> str:
    rows = [
        [
            text(LABELS[m]), plain(e.rmse_mw, 3), plain(e.largest_mw, 3),
            plain(e.slope, 2) if math.isfinite(e.slope) else '–',
            plain(e.knee, 2) if math.isfinite(e.knee) else '–',
            plain(e.intercept, 2) if math.isfinite(e.intercept) else '–',
        ]
        for m, e in data.result.errors.items()
    ]  # fmt: skip
    head = [
        'method', 'curve, rms (MW)', 'curve, largest (MW)', 'largest slope error',
        'largest knee error', 'largest intercept error (MW)',
    ]  # fmt: skip
    return table(head, rows, caption='Errors against the truth, where the curve is known.')


def totals_table(data: Compared) -> str:
    """Return the mean squared errors over all segments, and how often zero mean stands."""
    r = data.result
    rows = []
    for name in data.predictions:
        j = r.judgement
        paper, all_paper = j.passed(name, as_paper=True)
        counted, all_counted = j.passed(name, as_paper=False)
        bias = j.bias(name)
        rows.append(
            [
                text(PREDICTIONS[name]),
                mse_cell(j.mse(name)),
                mse_cell(j.mse(name, SegmentKind.STEADY)),
                mse_cell(j.mse(name, SegmentKind.SLOPE)),
                mse_cell(r.all_rows[name]) if name in r.all_rows else '–',
                f'{decimals(bias.mean, 3)} ({_p(bias.p_value)})'
                if math.isfinite(bias.mean)
                else '–',
                f'{paper} of {all_paper}',
                f'{counted} of {all_counted}',
            ]
        )
    head = [
        'prediction', 'all segments (MW²)', 'steady (MW²)', 'slope (MW²)', 'all rows (MW²)',
        'mean difference (MW)', 'zero stands, each sample counted',
        'zero stands, correlation counted',
    ]  # fmt: skip
    return table(head, rows, caption='Mean squared errors on the data to judge by.')


def mse_cell(value: float) -> str:
    """Write a mean squared error: endless where an answer ran away, a dash where there is none."""
    return plain(value) if math.isfinite(value) else '∞' if math.isinf(value) else '–'


def _p(value: float) -> str:
    if not math.isfinite(value):
        return 'not tested'
    return 'p < 0.0001' if value < 1e-4 else f'p = {plain(value, 2)}'


def pairs_table(pairs: Sequence[Pair]) -> str:
    """Return who is better than whom, on which terms."""
    rows = [
        [
            _TERMS[p.terms],
            text(LABELS[p.baseline]),
            mse_cell(p.mse_ours_mw2),
            mse_cell(p.mse_theirs_mw2),
            _difference(p),
            _verdict(p),
        ]
        for p in sorted(pairs, key=lambda p: list(_TERMS).index(p.terms))
    ]
    head = [
        'terms', 'against', 'ours (MW²)', 'theirs (MW²)', 'theirs less ours, 95 % (MW²)',
        'ours is',
    ]  # fmt: skip
    words = (
        "The paper's way: its static curve against simulations of the others, all special "
        'segments. Otherwise like against like, and ours is valveflow.'
    )
    return paragraph(words) + table(head, rows)


def _verdict(pair: Pair) -> str:
    """Return who is better and what that rests on: without answers of theirs not on the test."""
    tested = _p(pair.test.p_value)
    if pair.failed:
        told = f'theirs has no finite answer in {pair.failed} of {pair.judged}'
        tested = f'{told}; the others: {tested}'
    return f'<b>{pair.outcome.value}</b>, {tested}'


def _difference(pair: Pair) -> str:
    return interval(*pair.test.interval())


def _ts(each: float, worth: float) -> str:
    """Return two t values in brackets; nothing where an endless error has none."""
    if not (math.isfinite(each) or math.isfinite(worth)):
        return ''
    return f' ({plain(each, 2)}; {plain(worth, 2)})'


def segments_table(data: Compared, segments: Sequence[JudgedSegment]) -> str:
    """Return Table III for some of the segments: mean squared errors and t values."""
    names = [n for n in _SHORT if n in data.predictions]
    rows = []
    for s in segments:
        cells = [
            mse_cell(s.scores[n].mse_mw2) + _ts(s.scores[n].samples.t, s.scores[n].effective.t)
            for n in names
        ]
        number = [f'{KIND[s.kind]} {s.number}', moment(s.start_ns)[5:16], str(len(s.rows))]
        rows.append([*number, decimals(s.power_mw, 0), *cells])
    head = ['segment', 'from', 'samples', 'MW', *(text(_SHORT[n]) for n in names)]
    words = (
        "As the paper's Table III, for the segments shown: mean squared error in MW², and in "
        'brackets the t value of a mean difference of zero, first with each sample counted, then '
        'with what correlated samples are worth. All segments stand in segments.csv.'
    )
    return paragraph(words) + table(head, rows)
