# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The comparison of Section IV of the paper: three methods on one log, tested on another."""

from __future__ import annotations

import enum
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from valveflow_ros.baselines.hammerstein import HammersteinFit, fit_hammerstein
from valveflow_ros.baselines.judged import (
    Judgement,
    OtherData,
    PairedTest,
    Trial,
    dynamic,
    judge,
    over_blocks,
    trial_of,
)
from valveflow_ros.baselines.sparse import NAMES, SparseFit, fit_sparse
from valveflow_ros.baselines.truth import CurveError, Line, Truth, curve_error
from valveflow_ros.curve.characteristic import Characteristic, Piece
from valveflow_ros.curve.characteristic_json import number
from valveflow_ros.errors import DataError
from valveflow_ros.fit.problem import Samples
from valveflow_ros.records import FloatArray, SegmentKind

Progress = Callable[[float, str], None]

FORMAT = 'valveflow/comparison'
VERSION = 1
BASELINES = ('hammerstein', 'sparse')
_BLOCK_S = 1800.0
_LEVEL = 0.05


class Terms(enum.Enum):
    """The kinds of predictions that are compared."""

    AS_PAPER = 'as the paper'
    STATIC = 'curve against curve, steady-state segments'
    DYNAMIC = 'simulation against simulation, special segments'
    ALL_ROWS = 'simulation against simulation, all rows'


class ErrorOrder(enum.Enum):
    """Which of two methods has the smaller squared error."""

    BETTER = 'better'
    WORSE = 'worse'
    OPEN = 'not told apart'


class Finding(enum.Enum):
    """Whether the paper's finding is confirmed."""

    CONFIRMED = 'confirmed'
    CONTRADICTED = 'contradicted'
    OPEN = 'open'


@dataclass(frozen=True, slots=True)
class Pair:
    """Two predictions compared."""

    terms: Terms
    ours: str  # names of the predictions
    theirs: str
    mse_ours_mw2: float
    mse_theirs_mw2: float
    test: PairedTest  # of squared errors, theirs minus ours, over segments or blocks
    failed: int = 0  # segments or blocks in which theirs is not finite; the test omits them
    judged: int = 0  # all segments or blocks

    @property
    def baseline(self) -> str:
        """Return the other method."""
        return self.theirs.partition('.')[0]

    @property
    def outcome(self) -> ErrorOrder:
        """Return which method is better at the 5 % level.

        Without a significant difference theirs loses only if it is mostly not finite: a few
        such segments are no evidence for the others.
        """
        if not self.test.zero_is_rejected(_LEVEL):
            return ErrorOrder.BETTER if 2 * self.failed > self.judged else ErrorOrder.OPEN
        return ErrorOrder.BETTER if self.test.mean > 0.0 else ErrorOrder.WORSE


def pairs_on_segments(
    judgement: Judgement, predictions: Mapping[str, FloatArray]
) -> tuple[Pair, ...]:
    """Compare the proposed method with both others on special segments.

    As in the paper, the static curve is compared with the others' simulations on the special
    segments. In addition, simulation is compared with simulation, and curve with curve in
    steady-state segments, because on a ramp the power lags behind any curve.
    """
    paper = 'paper' if 'paper.static' in predictions else 'proposed'
    met = [
        (terms, ours, f'{name}.{theirs}')
        for name in BASELINES
        for terms, ours, theirs in (
            (Terms.AS_PAPER, f'{paper}.static', 'dynamic'),
            (Terms.STATIC, 'proposed.static', 'static'),
            (Terms.DYNAMIC, 'proposed.dynamic', 'dynamic'),
        )
    ]
    found = []
    for terms, ours, theirs in met:
        kind = SegmentKind.STEADY if terms is Terms.STATIC else None
        count = len(judgement.kinds(kind))
        if ours in predictions and theirs in predictions and count:
            found.append(Pair(
                terms, ours, theirs, judgement.mse(ours, kind), judgement.mse(theirs, kind),
                judgement.gain(ours, theirs, kind), judgement.failed(theirs, kind), count,
            ))  # fmt: skip
    return tuple(found)


def everywhere(
    trial: Trial, predictions: Mapping[str, FloatArray]
) -> tuple[dict[str, float], tuple[Pair, ...]]:
    """Compare simulations on all rows, with tests over blocks of half an hour.

    Return the mean squared error in MW^2 of each simulation, and the pairs.
    """
    good = trial.good
    with np.errstate(over='ignore', invalid='ignore'):
        squares = {
            name: (trial.power_mw - predicted)[good] ** 2
            for name, predicted in predictions.items() if name.endswith('.dynamic')
        }  # fmt: skip
    mse = {name: float(np.mean(s)) if len(s) else float('nan') for name, s in squares.items()}
    ours = 'proposed.dynamic'
    if ours not in squares:
        return mse, ()
    block = np.flatnonzero(good) // max(1, round(_BLOCK_S / trial.step_s))
    counts = np.bincount(block)
    there = counts > 0
    pairs = []
    for theirs in (f'{b}.dynamic' for b in BASELINES if f'{b}.dynamic' in squares):
        with np.errstate(over='ignore', invalid='ignore'):
            sums = np.bincount(block, weights=squares[theirs] - squares[ours])[there]
        finite = np.isfinite(sums)
        rows = counts[there][finite]
        test = over_blocks(sums[finite] / rows.mean() if len(rows) else np.empty(0))
        pairs.append(Pair(
            Terms.ALL_ROWS, ours, theirs, mse[ours], mse[theirs], test, int((~finite).sum()),
            len(sums),
        ))  # fmt: skip
    return mse, tuple(pairs)


def finding_of(pairs: Iterable[Pair]) -> Finding:
    """Return whether the proposed curve is better than both others, as the paper finds.

    The test is that of the paper, on special segments of other data. One better baseline
    contradicts the finding. Both must exist and be worse to confirm it.
    """
    met = [(p.baseline, p.outcome) for p in pairs if p.terms is Terms.AS_PAPER]
    outcomes = {outcome for _, outcome in met}
    if ErrorOrder.WORSE in outcomes:
        return Finding.CONTRADICTED
    both = {name for name, _ in met} == set(BASELINES)
    return Finding.CONFIRMED if both and outcomes == {ErrorOrder.BETTER} else Finding.OPEN


@dataclass(frozen=True, slots=True)
class Comparison:
    """The result of the comparison.

    Attributes
    ----------
    characteristic : Characteristic
        The curve of the proposed method.
    failure : str
        Why there is no sparse model; empty if there is one.
    lines : mapping of Line
        Curves with pieces: 'paper' (the exact partition of the special segments, as the
        paper fits it), 'proposed' (this program's) and 'hammerstein'.
    predictions : mapping of float64 (n,)
        For the other data, in MW: the '.static' curve and '.dynamic' simulation of each method.
    all_rows : mapping
        Mean squared error in MW^2 of the simulations over all rows that can be used.
    errors : mapping of CurveError
        Errors relative to the truth, by method; empty if it is unknown.
    """

    characteristic: Characteristic
    hammerstein: HammersteinFit
    sparse: SparseFit | None
    failure: str
    lines: Mapping[str, Line]
    predictions: Mapping[str, FloatArray]
    trial: Trial
    judgement: Judgement
    all_rows: Mapping[str, float]
    pairs: tuple[Pair, ...]
    errors: Mapping[str, CurveError]
    truth: Truth | None

    def curve(self, method: str) -> Callable[[FloatArray], FloatArray]:
        """Return the steady-state curve of a method."""
        if method == 'sparse' and self.sparse is not None:
            return self.sparse.model.static
        return self.lines[method]

    @property
    def methods(self) -> tuple[str, ...]:
        """Return the names of the methods that found a curve."""
        return (*self.lines, *(('sparse',) if self.sparse else ()))


def compare(
    learn: Samples, characteristic: Characteristic, other: OtherData,
    truth: Truth | None = None, progress: Progress = lambda _share, _what: None,
) -> Comparison:  # fmt: skip
    """Identify with the two methods of the literature and test all methods on other data.

    Parameters
    ----------
    learn : Samples
        The rows from which ``characteristic`` was identified; the other methods use all of them.

    Raises
    ------
    DataError
        A method finds no model in the data, or the other data cannot be used for a test.
    """
    if (
        truth is not None
        and abs(truth.pressure_exponent - characteristic.pressure_exponent) > 1e-9
    ):
        raise DataError(
            f'The truth is a curve over V p^{truth.pressure_exponent:g}, the identified one over '
            f'V p^{characteristic.pressure_exponent:g}: the two cannot be held together.'
        )
    hammerstein = fit_hammerstein(
        learn, len(characteristic.pieces), lambda what: progress(0.5, what)
    )
    sparse, failure = None, ''
    try:
        sparse = fit_sparse(learn, lambda what: progress(0.75, what))
    except DataError as error:
        # The others can be compared without it.
        failure = str(error)
    progress(0.85, 'judging')
    lines = _lines(characteristic, hammerstein)
    trial = trial_of(other, characteristic)
    predictions = _predictions(characteristic, lines, hammerstein, sparse, other.samples)
    judgement = judge(trial, predictions)
    all_rows, rows_pairs = everywhere(trial, predictions)
    return Comparison(
        characteristic=characteristic, hammerstein=hammerstein, sparse=sparse, failure=failure,
        lines=lines, predictions=predictions, trial=trial, judgement=judgement, all_rows=all_rows,
        pairs=(*pairs_on_segments(judgement, predictions), *rows_pairs),
        errors=_errors(characteristic, lines, sparse, truth), truth=truth,
    )  # fmt: skip


def _lines(characteristic: Characteristic, hammerstein: HammersteinFit) -> dict[str, Line]:
    h = hammerstein.model
    lines = {'proposed': line_of(characteristic.pieces)}
    if characteristic.partition_pieces:
        lines = {'paper': line_of(characteristic.partition_pieces), **lines}
    return {**lines, 'hammerstein': Line(h.knots, h.slopes(), h.intercepts())}


def _predictions(
    characteristic: Characteristic, lines: Mapping[str, Line], hammerstein: HammersteinFit,
    sparse: SparseFit | None, samples: Samples,
) -> dict[str, FloatArray]:  # fmt: skip
    """Return the curve of each method at the input, and its simulation."""
    found = {f'{name}.static': line(samples.u) for name, line in lines.items()}
    if characteristic.dynamics:
        found['proposed.dynamic'] = dynamic(characteristic, samples)
    found['hammerstein.dynamic'] = hammerstein.model.run(samples)[0]
    if sparse is not None:
        there = samples.usable > 0
        rests = np.full(len(samples.u), np.nan)
        rests[there] = sparse.model.static(samples.u[there])
        found['sparse.static'] = rests
        found['sparse.dynamic'] = sparse.model.run(samples)[0]
    return found


def line_of(pieces: tuple[Piece, ...]) -> Line:
    """Return pieces as a curve; the left piece is extended up to the next one."""
    return Line(
        np.array([pieces[0].u_from, *(p.u_to for p in pieces)]),
        np.array([p.slope for p in pieces]),
        np.array([p.intercept for p in pieces]),
    )


def _errors(
    characteristic: Characteristic, lines: Mapping[str, Line], sparse: SparseFit | None,
    truth: Truth | None,
) -> dict[str, CurveError]:  # fmt: skip
    """Return the error of each curve relative to the truth in the range of the proposed curve."""
    if truth is None:
        return {}
    ends = float(characteristic.breakpoints[0]), float(characteristic.breakpoints[-1])
    curves: dict[str, Callable[[FloatArray], FloatArray]] = dict(lines)
    if sparse is not None:
        curves['sparse'] = sparse.model.static
    return {name: curve_error(curve, truth, *ends) for name, curve in curves.items()}


def to_json(c: Comparison) -> dict[str, Any]:
    """Return the content of ``comparison.json``, without the texts."""
    return {
        'format': FORMAT,
        'version': VERSION,
        'pressure_exponent': c.characteristic.pressure_exponent,
        'finding': finding_of(c.pairs).value,
        'methods': _methods_json(c),
        'pairs': [
            {
                'terms': p.terms.value, 'ours': p.ours, 'theirs': p.theirs,
                'mse_ours_mw2': number(p.mse_ours_mw2),
                'mse_theirs_mw2': number(p.mse_theirs_mw2),
                'theirs_less_ours': fields_json(p.test), 'segments_not_finite': p.failed,
                'ours_is': p.outcome.value,
            }
            for p in c.pairs
        ],
        'totals': totals_json(c.judgement, c.predictions),
        'all_rows_mse_mw2': {name: number(v) for name, v in c.all_rows.items()},
        'errors_against_truth': {
            method: fields_json(
                error, known='known_share', slope='largest_slope_error', knee='largest_knee_error',
                intercept='largest_intercept_error_mw',
            )
            for method, error in c.errors.items()
        } or None,
        **judged_json(c.judgement),
    }  # fmt: skip


def _methods_json(c: Comparison) -> dict[str, Any]:
    names = ('u_from', 'u_to', 'slope', 'intercept')
    methods: dict[str, Any] = {}
    for method, line in c.lines.items():
        table = zip(
            line.knots[:-1].tolist(), line.knots[1:].tolist(), line.slopes.tolist(),
            line.intercepts.tolist(), strict=True,
        )  # fmt: skip
        methods[method] = {'pieces': [dict(zip(names, row, strict=True)) for row in table]}
    names = ('power_from', 'power_to', 'time_constant_s', 'delay_s')
    methods['proposed'] |= {
        'model_id': c.characteristic.model_id,
        'dynamics': [{n: getattr(d, n) for n in names} for d in c.characteristic.dynamics],
    }
    m, s = c.hammerstein.model, c.sparse
    methods['hammerstein'] |= {
        'numerator': m.b.tolist(),
        'denominator': [1.0, *m.denominator.tolist()],
        'delay_s': m.delay * m.step_s,
        'step_s': m.step_s,
        'time_constants_s': m.time_constants_s.tolist(),
        'noise': c.hammerstein.noise,
        'tried': [
            {'taps': n_b, 'poles': n_f, 'noise': noise, 'mse_mw2': number(mse)}
            for n_b, n_f, noise, mse in c.hammerstein.tried
        ],
    }
    methods['sparse'] = {'failure': c.failure} if s is None else {
        'functions': dict(zip(NAMES, s.model.xi.tolist(), strict=True)),
        'form': s.form.kind,
        'window_s': s.form.window_s,
        'threshold': s.threshold,
        'tried': [
            {'form': kind, 'window_s': window, 'functions': terms, 'mse_mw2': number(mse)}
            for kind, window, terms, mse in s.mse_by_form
        ],
    }  # fmt: skip
    return methods


def fields_json(value: Any, **renamed: str) -> dict[str, Any]:
    """Return the fields of a dataclass of numbers, some of them renamed."""
    return {renamed.get(f.name, f.name): number(getattr(value, f.name)) for f in fields(value)}


def totals_json(judgement: Judgement, names: Iterable[str]) -> dict[str, Any]:
    """Return each prediction over all segments."""
    totals = {}
    for name in names:
        stands = {}
        for key, as_paper in (('each_sample', True), ('correlation_counted', False)):
            count, of = judgement.passed(name, as_paper=as_paper)
            stands[key] = {'segments': count, 'of': of}
        totals[name] = {
            'mse_mw2': number(judgement.mse(name)),
            'mse_steady_mw2': number(judgement.mse(name, SegmentKind.STEADY)),
            'mse_slope_mw2': number(judgement.mse(name, SegmentKind.SLOPE)),
            'mean_difference_mw': fields_json(judgement.bias(name)),
            'zero_stands': stands,
            'segments_not_finite': judgement.failed(name),
        }
    return totals


def judged_json(judgement: Judgement) -> dict[str, Any]:
    """Return a summary, and each special segment with the scores of all predictions."""
    return {
        'judged': {
            'segments': len(judgement.segments),
            'samples': judgement.samples,
            'samples_not_judged': judgement.outside,
            'samples_per_independent_value': judgement.widening,
        },
        'segments': [
            {
                'number': s.number,
                'kind': s.kind.name.lower(),
                'start_ns': s.start_ns,
                'end_ns': s.end_ns,
                'samples': len(s.rows),
                'power_mw': s.power_mw,
                'scores': {
                    name: {
                        'mse_mw2': number(score.mse_mw2),
                        'each_sample': fields_json(score.samples),
                        'correlation_counted': fields_json(score.effective),
                    }
                    for name, score in s.scores.items()
                },
            }
            for s in judgement.segments
        ],
    }
