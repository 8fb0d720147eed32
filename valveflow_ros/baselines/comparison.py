"""The comparison of Section IV of the paper: three methods on one log, judged on another."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from valveflow_ros.baselines.hammerstein_fit import HammersteinFit, fit_hammerstein
from valveflow_ros.baselines.judged import (
    JudgedSegment,
    Judgement,
    OtherData,
    PairedTest,
    Trial,
    dynamic,
    judge,
    trial_of,
)
from valveflow_ros.baselines.library import NAMES
from valveflow_ros.baselines.sparse import SparseFit, fit_sparse
from valveflow_ros.baselines.truth import CurveError, Truth, curve_error, pieces_error
from valveflow_ros.baselines.verdict import Pair, everywhere, finding_of, pairs_on_segments
from valveflow_ros.curve.characteristic import Characteristic, Piece
from valveflow_ros.errors import DataError
from valveflow_ros.fit.problem import Samples
from valveflow_ros.records import FloatArray, SegmentKind

Progress = Callable[[float, str], None]


@dataclass(frozen=True, slots=True)
class Line:
    """A piecewise-linear curve as numbers; knots (J + 1,), slopes and intercepts (J,)."""

    knots: FloatArray
    slopes: FloatArray
    intercepts: FloatArray

    def __call__(self, u: FloatArray) -> FloatArray:
        """Evaluate; the outer pieces go on."""
        k = np.searchsorted(self.knots[1:-1], u, side='right')
        return np.asarray(self.slopes[k] * u + self.intercepts[k])


@dataclass(frozen=True, slots=True)
class Comparison:
    """What came out.

    Attributes
    ----------
    characteristic : Characteristic
        Of the proposed method.
    hammerstein : HammersteinFit
    sparse : SparseFit or None
    failure : str
        Why there is no sparse model; empty if there is one.
    lines : mapping of Line
        Curves with pieces: 'paper' (the exact partition of the special segments, as the
        paper fits it), 'proposed' (this program's) and 'hammerstein'.
    predictions : mapping of float64 (n,)
        On the other data, in MW: each method's '.static' curve and its '.dynamic' simulation.
    trial : Trial
    judgement : Judgement
    all_rows : mapping
        Mean squared error in MW^2 of the simulations over every row that can be judged.
    pairs : tuple of Pair
        Who is better than whom, and on what terms.
    errors : mapping of CurveError
        Against the truth, by method; empty if it is not known.
    truth : Truth or None
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


def _quiet(_share: float, _what: str) -> None:
    """Show no progress."""


def compare(
    learn: Samples,
    characteristic: Characteristic,
    other: OtherData,
    truth: Truth | None = None,
    progress: Progress = _quiet,
) -> Comparison:
    """Identify by the two methods of the literature and judge all on other data.

    Parameters
    ----------
    learn : Samples
        The rows ``characteristic`` was identified from; the other methods use them all.
    characteristic : Characteristic
    other : OtherData
    truth : Truth, optional

    Raises
    ------
    DataError
        A method finds no model in the data, or the other data hold nothing to judge by.
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
    sparse, failure = _sparse(learn, lambda what: progress(0.75, what))
    progress(0.85, 'judging')
    lines = _lines(characteristic, hammerstein)
    trial = trial_of(other, characteristic)
    predictions = _predictions(characteristic, lines, hammerstein, sparse, other.samples)
    judgement = judge(trial, predictions)
    all_rows, rows_pairs = everywhere(trial, predictions)
    return Comparison(
        characteristic=characteristic,
        hammerstein=hammerstein,
        sparse=sparse,
        failure=failure,
        lines=lines,
        predictions=predictions,
        trial=trial,
        judgement=judgement,
        all_rows=all_rows,
        pairs=(*pairs_on_segments(judgement, predictions), *rows_pairs),
        errors=_errors(characteristic, lines, sparse, truth),
        truth=truth,
    )


def _lines(characteristic: Characteristic, hammerstein: HammersteinFit) -> dict[str, Line]:
    h = hammerstein.model
    lines = {'proposed': line_of(characteristic.pieces)}
    if characteristic.partition_pieces:
        lines = {'paper': line_of(characteristic.partition_pieces), **lines}
    return {**lines, 'hammerstein': Line(h.knots, h.slopes(), h.intercepts())}


def _predictions(
    characteristic: Characteristic,
    lines: Mapping[str, Line],
    hammerstein: HammersteinFit,
    sparse: SparseFit | None,
    samples: Samples,
) -> dict[str, FloatArray]:
    """Return each method's curve along the input, and its simulation."""
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


def _sparse(learn: Samples, progress: Callable[[str], None]) -> tuple[SparseFit | None, str]:
    """Return the sparse model, or why there is none: the others can be compared without it."""
    try:
        return fit_sparse(learn, progress), ''
    except DataError as error:
        return None, str(error)


def line_of(pieces: tuple[Piece, ...]) -> Line:
    """Return pieces as a curve; between pieces that do not touch the left one goes on."""
    return Line(
        np.array([pieces[0].u_from, *(p.u_to for p in pieces)]),
        np.array([p.slope for p in pieces]),
        np.array([p.intercept for p in pieces]),
    )


def _errors(
    characteristic: Characteristic, lines: Mapping[str, Line], sparse: SparseFit | None,
    truth: Truth | None,
) -> dict[str, CurveError]:  # fmt: skip
    """Return how far each curve is from the truth where the proposed one is known."""
    if truth is None:
        return {}
    ends = float(characteristic.breakpoints[0]), float(characteristic.breakpoints[-1])
    found = {}
    for name, line in lines.items():
        e = curve_error(line, truth, *ends)
        off = pieces_error(line.knots, line.slopes, line.intercepts, truth)
        found[name] = CurveError(e.rmse_mw, e.largest_mw, e.known, *off)
    if sparse is not None:
        found['sparse'] = curve_error(sparse.model.static, truth, *ends)
    return found


# A comparison as JSON: what ``comparison.json`` holds.

FORMAT = 'valveflow/comparison'
VERSION = 1


def number(value: float) -> float | None:
    """JSON has neither NaN nor infinity: absent is null."""
    return float(value) if math.isfinite(value) else None


def paired_json(test: PairedTest) -> dict[str, Any]:
    """Return a test."""
    return {
        'mean': number(test.mean),
        'stderr': number(test.stderr),
        't': number(test.t),
        'p_value': number(test.p_value),
        'effective': number(test.effective),
    }


def segment_json(segment: JudgedSegment) -> dict[str, Any]:
    """Return one special segment with the scores of all predictions."""
    return {
        'number': segment.number,
        'kind': segment.kind.name.lower(),
        'start_ns': segment.start_ns,
        'end_ns': segment.end_ns,
        'samples': len(segment.rows),
        'power_mw': segment.power_mw,
        'scores': {
            name: {
                'mse_mw2': number(score.mse_mw2),
                'each_sample': paired_json(score.samples),
                'correlation_counted': paired_json(score.effective),
            }
            for name, score in segment.scores.items()
        },
    }


def total_json(judgement: Judgement, name: str) -> dict[str, Any]:
    """Return one prediction over all segments."""
    each, of_each = judgement.passed(name, as_paper=True)
    counted, of_counted = judgement.passed(name, as_paper=False)
    return {
        'mse_mw2': number(judgement.mse(name)),
        'mse_steady_mw2': number(judgement.mse(name, SegmentKind.STEADY)),
        'mse_slope_mw2': number(judgement.mse(name, SegmentKind.SLOPE)),
        'mean_difference_mw': paired_json(judgement.bias(name)),
        'zero_stands': {
            'each_sample': {'segments': each, 'of': of_each},
            'correlation_counted': {'segments': counted, 'of': of_counted},
        },
        'segments_not_finite': judgement.failed(name),
    }


def _line_json(line: Line) -> list[dict[str, float]]:
    return [
        {
            'u_from': float(line.knots[j]),
            'u_to': float(line.knots[j + 1]),
            'slope': float(line.slopes[j]),
            'intercept': float(line.intercepts[j]),
        }
        for j in range(len(line.slopes))
    ]


def _methods(c: Comparison) -> dict[str, Any]:
    methods: dict[str, Any] = {
        name: {'pieces': _line_json(line)} for name, line in c.lines.items()
    }
    methods['proposed'] |= {
        'model_id': c.characteristic.model_id,
        'dynamics': [
            {
                'power_from': d.power_from,
                'power_to': d.power_to,
                'time_constant_s': d.time_constant_s,
                'delay_s': d.delay_s,
            }
            for d in c.characteristic.dynamics
        ],
    }
    m = c.hammerstein.model
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
    methods['sparse'] = {'failure': c.failure} if c.sparse is None else _sparse_json(c.sparse)
    return methods


def _sparse_json(s: SparseFit) -> dict[str, Any]:
    return {
        'functions': dict(zip(NAMES, s.model.xi.tolist(), strict=True)),
        'form': s.form.kind,
        'window_s': s.form.window_s,
        'threshold': s.threshold,
        'tried': [
            {'form': kind, 'window_s': window, 'functions': terms, 'mse_mw2': number(mse)}
            for kind, window, terms, mse in s.mse_by_form
        ],
    }


def _pair_json(pair: Pair) -> dict[str, Any]:
    return {
        'terms': pair.terms.value,
        'ours': pair.ours,
        'theirs': pair.theirs,
        'mse_ours_mw2': number(pair.mse_ours_mw2),
        'mse_theirs_mw2': number(pair.mse_theirs_mw2),
        'theirs_less_ours': paired_json(pair.test),
        'segments_not_finite': pair.failed,
        'ours_is': pair.outcome.value,
    }


def _error_json(error: CurveError) -> dict[str, Any]:
    return {
        'rmse_mw': number(error.rmse_mw),
        'largest_mw': number(error.largest_mw),
        'known_share': error.known,
        'largest_slope_error': number(error.slope),
        'largest_knee_error': number(error.knee),
        'largest_intercept_error_mw': number(error.intercept),
    }


def to_json(c: Comparison) -> dict[str, Any]:
    """Return the content of ``comparison.json``, without the words."""
    j = c.judgement
    return {
        'format': FORMAT,
        'version': VERSION,
        'pressure_exponent': c.characteristic.pressure_exponent,
        'finding': finding_of(c.pairs).value,
        'methods': _methods(c),
        'pairs': [_pair_json(p) for p in c.pairs],
        'totals': {name: total_json(j, name) for name in c.predictions},
        'all_rows_mse_mw2': {name: number(v) for name, v in c.all_rows.items()},
        'errors_against_truth': {m: _error_json(e) for m, e in c.errors.items()} or None,
        'judged': {
            'segments': len(j.segments),
            'samples': j.samples,
            'samples_not_judged': j.outside,
            'samples_per_independent_value': j.widening,
        },
        'segments': [segment_json(s) for s in j.segments],
    }
