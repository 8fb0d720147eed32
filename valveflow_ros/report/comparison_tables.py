"""The tables of a comparison: II, III and IV of the paper, and who is better than whom."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from valveflow_ros.baselines.comparison import Comparison, Line
from valveflow_ros.baselines.judged import JudgedSegment, Judgement
from valveflow_ros.baselines.verdict import Pair, Terms
from valveflow_ros.records import FloatArray, SegmentKind
from valveflow_ros.report.page import paragraph, table, text
from valveflow_ros.report.words import decimals, interval, moment, plain
from valveflow_ros.segments.window import WindowContents

# What the report of a comparison is made from.


# In the order in which they are told; the names of the numbers, and those for people.
METHODS = ('paper', 'proposed', 'hammerstein', 'sparse')
LABELS = {
    'paper': "the paper's curve of special segments",
    'proposed': 'valveflow',
    'hammerstein': 'Hammerstein',
    'sparse': 'sparse (SINDy)',
}
# In a legend there is little room.
LEGEND = {**LABELS, 'paper': "the paper's curve"}
PREDICTIONS = {
    'paper.static': "the paper's curve",
    'proposed.static': 'valveflow, curve',
    'hammerstein.static': 'Hammerstein, curve',
    'sparse.static': 'sparse, curve',
    'proposed.dynamic': 'valveflow, simulated',
    'hammerstein.dynamic': 'Hammerstein, simulated',
    'sparse.dynamic': 'sparse, simulated',
}


@dataclass(frozen=True, slots=True)
class Compared:
    """A comparison and the data it came from.

    Attributes
    ----------
    source, other : str
        Names of the logs: learnt from, and judged on.
    held_out : bool
        Both are the same log, cut in two.
    result : Comparison
    learnt, judged : WindowContents
    notes : tuple of str
        Sentences about how the data were read.
    """

    source: str
    other: str
    held_out: bool
    result: Comparison
    learnt: WindowContents
    judged: WindowContents
    notes: tuple[str, ...] = ()

    @property
    def predictions(self) -> tuple[str, ...]:
        """Return the names of the predictions that there are, in the order of the tables."""
        return tuple(name for name in PREDICTIONS if name in self.result.predictions)


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


# The tables of a comparison as CSV, unrounded.

_PLACES = 500


def _csv(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table; what is not finite becomes an empty cell."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator='\n')
    writer.writerow(head)
    for row in rows:
        writer.writerow(['' if isinstance(v, float) and not math.isfinite(v) else v for v in row])
    return out.getvalue()


def segments_csv(judgement: Judgement, names: Sequence[str]) -> str:
    """Return one row a special segment (Table III)."""
    head = ['segment', 'kind', 'start_ns', 'end_ns', 'samples', 'power_mw']
    for name in names:
        head += [
            f'{name}.{column}'
            for column in ('mse_mw2', 'mean_mw', 't', 'p', 'samples_effective', 't_effective',
                           'p_effective')
        ]  # fmt: skip
    rows = []
    for s in judgement.segments:
        row: list[object] = [
            s.number, KIND[s.kind], s.start_ns, s.end_ns, len(s.rows), s.power_mw,
        ]  # fmt: skip
        for name in names:
            score = s.scores[name]
            row += [
                score.mse_mw2, score.samples.mean, score.samples.t, score.samples.p_value,
                score.effective.effective, score.effective.t, score.effective.p_value,
            ]  # fmt: skip
        rows.append(row)
    return _csv(head, rows)


def parameters_csv(data: Compared) -> str:
    """Return one row a piece (Table II, and IV where the truth is known)."""
    truth = data.result.truth
    rows: list[list[object]] = []
    for method in METHODS:
        line = data.result.lines.get(method)
        for j in range(0 if line is None else len(line.slopes)):
            assert line is not None
            same = truth is not None and len(truth.slopes) == len(line.slopes)
            true = [truth.slopes[j], truth.intercepts[j]] if truth and same else [math.nan] * 2
            rows.append(
                [
                    method, j + 1, *(float(v) for v in (line.slopes[j], line.intercepts[j],
                                                        line.knots[j], line.knots[j + 1])),
                    *(float(v) for v in true),
                ]
            )  # fmt: skip
    head = ['method', 'piece', 'slope', 'intercept', 'u_from', 'u_to', 'true_slope',
            'true_intercept']  # fmt: skip
    return _csv(head, rows)


def curves_csv(data: Compared) -> str:
    """Return the curves of all methods at evenly spaced inputs (Figs. 7 and 11)."""
    curves = curves_of(data)
    return _csv(list(curves), zip(*(c.tolist() for c in curves.values()), strict=True))


def curves_of(data: Compared) -> Mapping[str, FloatArray]:
    """Return u and each method's curve there, MW; NaN where a method says nothing."""
    r = data.result
    ends = r.characteristic.breakpoints
    u = np.linspace(float(ends[0]), float(ends[-1]), _PLACES)
    curves: dict[str, FloatArray] = {'u': u}
    for method in METHODS:
        if method in r.methods:
            curves[method] = r.curve(method)(u)
    if r.truth is not None:
        curves['truth'] = r.truth(u)
    return curves
