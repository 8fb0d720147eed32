"""The comparison of Section IV of the paper: three methods on one log, judged on another."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from valveflow_ros.baselines.hammerstein_fit import HammersteinFit, fit_hammerstein
from valveflow_ros.baselines.judged import Judgement, OtherData, Trial, judge
from valveflow_ros.baselines.proposed import dynamic, trial_of
from valveflow_ros.baselines.sparse import SparseFit, fit_sparse
from valveflow_ros.baselines.truth import CurveError, Truth, curve_error, pieces_error
from valveflow_ros.baselines.verdict import Pair, everywhere, pairs_on_segments
from valveflow_ros.curve.characteristic import Characteristic, Piece
from valveflow_ros.errors import DataError
from valveflow_ros.fit.problem import Samples
from valveflow_ros.records import FloatArray

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
