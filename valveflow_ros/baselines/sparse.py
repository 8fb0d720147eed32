"""Sparse identification of nonlinear dynamics (SINDy), tuned on data of its own.

The library is that of Section IV of the paper, the solver sequentially thresholded
least squares. Columns are scaled to unit size first: u^3 is 1e10 and cos u is 1, and
one threshold must mean the same for both. How derivatives are taken and the
threshold are chosen by how well the last part of the identification data is
simulated from the first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from valveflow_ros.baselines import library
from valveflow_ros.baselines.derivative import Form, equations, forms_for
from valveflow_ros.baselines.holdout import cut_samples, run_mse
from valveflow_ros.baselines.sparse_model import SparseModel
from valveflow_ros.errors import DataError
from valveflow_ros.fit.problem import Samples
from valveflow_ros.records import BoolArray, FloatArray

THRESHOLDS = (0.0, *np.geomspace(1e-3, 1e3, 31).tolist())
_SPARE = 1.01  # a sparser model may be this much worse than the best
_ROUNDS = 30

Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class SparseFit:
    """The model and how it was chosen.

    Attributes
    ----------
    model : SparseModel
    form : Form
        How the equations were made.
    threshold : float
        On coefficients of scaled columns.
    mse_by_form : tuple of (kind, window in s, functions, mean squared error in MW^2)
        The best of each form on the part held out.
    """

    model: SparseModel
    form: Form
    threshold: float
    mse_by_form: tuple[tuple[str, float, int, float], ...]


@dataclass(frozen=True, slots=True)
class _Candidate:
    form: Form
    threshold: float
    support: BoolArray
    mse: float


def thresholded(theta: FloatArray, target: FloatArray, threshold: float) -> FloatArray:
    """Sequentially thresholded least squares.

    Parameters
    ----------
    theta : float64 (k, P)
    target : float64 (k,)
    threshold : float
        Smaller coefficients are set to zero and the rest is fitted again, until nothing changes.

    Returns
    -------
    float64 (P,)
    """
    kept = np.ones(theta.shape[1], dtype=bool)
    xi = np.zeros(theta.shape[1])
    for _ in range(_ROUNDS):
        xi[:] = 0.0
        if kept.any():
            xi[kept] = np.linalg.lstsq(theta[:, kept], target, rcond=None)[0]
        large = kept & (np.abs(xi) >= threshold)
        if np.array_equal(large, kept):
            break
        kept = large
    return xi


@dataclass(frozen=True, slots=True)
class _Folded:
    """Scaled columns (15, 14) and target (15,) folded into a triangle, and the scales (15,)."""

    theta: FloatArray
    target: FloatArray
    scale: FloatArray


def _triangle(rows: FloatArray) -> _Folded:
    """Scale columns to unit size and fold all rows into a triangle.

    Least squares in any subset of columns is the same in the triangle as in all rows.
    """
    scale = np.sqrt(np.mean(rows**2, axis=0))
    scale = np.where(scale > 0.0, scale, 1.0)
    r: FloatArray = np.asarray(np.linalg.qr(rows / scale / np.sqrt(len(rows)), mode='r'))
    return _Folded(r[:, :-1], r[:, -1], scale)


def fit_sparse(samples: Samples, progress: Progress = lambda _: None) -> SparseFit:
    """Identify a sparse model.

    Raises
    ------
    TooFewSamplesError
        Too few usable rows, or too few that lie far enough behind a gap.
    DataError
        No model of the library can be run over the data without running away.
    """
    learn, judge = cut_samples(samples)
    judge = judge.coarser()
    candidates: list[_Candidate] = []
    for form in forms_for(samples.step_s):
        progress(f'sparse model: {form.kind}, {form.window_s:g} s')
        candidates += _of_form(learn, judge, form)
    finite = [c for c in candidates if np.isfinite(c.mse)]
    if not finite:
        raise DataError(
            'Sparse identification found no model: each one from its library of functions runs '
            'away when it is simulated.'
        )
    best = min(finite, key=lambda c: c.mse)
    near = [c for c in finite if c.mse <= _SPARE * best.mse]
    chosen = min(near, key=lambda c: (int(c.support.sum()), c.mse))
    progress('sparse model: all data')
    folded = _triangle(equations(samples, chosen.form))
    model = _on_support(samples, folded, chosen.support)
    return SparseFit(model, chosen.form, chosen.threshold, _best_by_form(candidates))


def _of_form(learn: Samples, judge: Samples, form: Form) -> list[_Candidate]:
    rows = equations(learn, form)
    if len(rows) < 4 * library.SIZE:
        return []
    folded = _triangle(rows)
    found: dict[bytes, _Candidate] = {}
    for threshold in THRESHOLDS:
        support = thresholded(folded.theta, folded.target, threshold) != 0.0
        if support.any() and support.tobytes() not in found:
            model = _on_support(learn, folded, support)
            candidate = _Candidate(form, threshold, support, run_mse(model, judge))
            found[support.tobytes()] = candidate
    return list(found.values())


def _on_support(samples: Samples, folded: _Folded, support: BoolArray) -> SparseModel:
    """Fit the functions of a support."""
    xi = np.zeros(library.SIZE)
    xi[support] = np.linalg.lstsq(folded.theta[:, support], folded.target, rcond=None)[0]
    xi *= folded.scale[-1] / folded.scale[:-1]
    good = samples.usable > 0
    u, y = samples.u[good], samples.power_mw[good]
    return SparseModel(
        xi, float(u.min()), float(u.max()), float(y.min()), float(y.max()), float(y.mean()),
        samples.step_s,
    )  # fmt: skip


def _best_by_form(candidates: list[_Candidate]) -> tuple[tuple[str, float, int, float], ...]:
    best = []
    for form in dict.fromkeys(c.form for c in candidates):
        mine = [c for c in candidates if c.form == form]
        if mine:
            c = min(mine, key=lambda c: c.mse)
            best.append((form.kind, form.window_s, int(c.support.sum()), c.mse))
    return tuple(best)
