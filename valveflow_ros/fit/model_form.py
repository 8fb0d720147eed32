"""Where the knees of a valve stand: at fixed integrated input V p^m, or at fixed opening V.

The paper has P = F(V p^m) (Eq. 1). A choked valve passes flow in proportion to the pressure, which
gives P = p^m F(V) + c. Both are fitted to means inside special segments, which carry no dynamics,
with the same number of knots, and judged on stretches of time that were held out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from valveflow_ros.records import FloatArray, IntArray

_MEAN_S = 60.0
_KNOTS = 8
_FOLDS, _STRETCHES = 5, 40
_LEAST_MEANS = 200
# Both forms are tried with each: a wrong exponent is another matter than a wrong form.
_EXPONENTS = (1.0, 1.0625, 1.125, 1.1875, 1.25)
# The worst are left out of an error: a held-out stretch may lie beyond what the others visit.
_WORST = 0.05
# The paper's form is doubted where the other one has so much less error, and less in such a share
# of the stretches, and where the two differ by such a share of the power's range.
_LEAST_RATIO, _LEAST_SURE, _LEAST_APART = 1.5, 0.6, 0.005

Columns = Callable[[FloatArray, FloatArray, float], FloatArray]


@dataclass(frozen=True, slots=True)
class ModelForm:
    """The paper's form and the other one, on stretches held out.

    Attributes
    ----------
    rmse_mw, rmse_other_mw : float
        Error of the paper's form and of the one with knees at fixed opening.
    apart_mw : float
        Root mean square of the difference between the two over what was visited.
    worst : tuple of float
        Opening in %, pressure in MPa and difference in MW where 1 % of the means differ more.
    """

    rmse_mw: float
    rmse_other_mw: float
    apart_mw: float
    worst: tuple[float, float, float]

    @property
    def sentence(self) -> str:
        """Return what to think of the curve."""
        opening, pressure, error = self.worst
        return (
            'Do not rely on this curve where the pressure differs: on stretches held out the '
            f'power follows p^m F(V) + c to {self.rmse_other_mw:.2g} MW and the form of this '
            f'curve, F(V p^m), only to {self.rmse_mw:.2g} MW. The knees of this valve stand at '
            f'fixed openings. The two differ by {self.apart_mw:.2g} MW (root mean square), at '
            f'{opening:.0f} % and {pressure:.1f} MPa by {error:.2g} MW.'
        )


def find_wrong_form(
    opening: FloatArray, pressure: FloatArray, power: FloatArray, spans: IntArray, period_s: float
) -> ModelForm | None:
    """Return how much better the knees stand at fixed openings; None unless that is sure.

    Parameters
    ----------
    opening, pressure, power : float64 (n,)
        Rows in %, MPa and MW, NaN where not known.
    spans : int64 (k, 2)
        First and end row of each special segment.
    period_s : float
        From row to row.
    """
    v, p, y = _means(np.column_stack([opening, pressure, power]), spans, period_s).T
    if len(y) < _LEAST_MEANS:
        return None
    paper, other = _best(v, p, y, _paper_columns), _best(v, p, y, _opening_columns)
    error, error_other = paper[0], other[0]
    rmse, rmse_other = _root(error), _root(error_other)
    if not rmse > _LEAST_RATIO * rmse_other:
        return None
    # Not by the mean: a stretch far from the others outweighs all of them.
    stretches = np.array_split(error**2 - error_other**2, _STRETCHES)
    if not np.mean([part.mean() > 0.0 for part in stretches]) > _LEAST_SURE:
        return None
    apart = np.abs(paper[1] - other[1])
    if not _root(apart) > _LEAST_APART * np.ptp(y):
        return None
    at = int(np.argsort(apart)[int(0.99 * len(apart))])
    return ModelForm(
        rmse, rmse_other, _root(apart), (float(v[at]), float(p[at]), float(apart[at]))
    )


def _means(rows: FloatArray, spans: IntArray, period_s: float) -> FloatArray:
    """Return means of a minute inside segments, without those that hold a NaN; shape (b, 3)."""
    length = max(1, round(_MEAN_S / period_s))
    found = [np.empty((0, rows.shape[1]))]
    for first, end in spans.tolist():
        whole = (end - first) // length
        part = rows[first : first + whole * length]
        found.append(part.reshape(whole, length, -1).mean(axis=1))
    means = np.concatenate(found)
    return means[np.isfinite(means).all(axis=1)]


def _best(
    v: FloatArray, p: FloatArray, y: FloatArray, columns: Columns
) -> tuple[FloatArray, FloatArray]:
    """Return held-out errors and the fit to all, with the exponent that has the least error."""
    fold = np.arange(len(y)) * _STRETCHES // len(y) % _FOLDS
    tried = []
    for exponent in _EXPONENTS:
        x = columns(v, p, exponent)
        error = np.empty(len(y))
        for k in range(_FOLDS):
            out = fold == k
            error[out] = y[out] - x[out] @ np.linalg.lstsq(x[~out], y[~out], rcond=None)[0]
        tried.append((error, x @ np.linalg.lstsq(x, y, rcond=None)[0]))
    return min(tried, key=lambda each: _root(each[0]))


def _paper_columns(v: FloatArray, p: FloatArray, exponent: float) -> FloatArray:
    return _hinges(v * p**exponent)


def _opening_columns(v: FloatArray, p: FloatArray, exponent: float) -> FloatArray:
    return np.column_stack([np.ones(len(v)), p[:, None] ** exponent * _hinges(v)])


def _hinges(x: FloatArray) -> FloatArray:
    """Return a constant, ``x``, and one hinge at each inner quantile."""
    knots = np.quantile(x, np.linspace(0.0, 1.0, _KNOTS + 2)[1:-1])
    return np.column_stack([np.ones(len(x)), x, np.maximum(x[:, None] - knots, 0.0)])


def _root(error: FloatArray) -> float:
    """Return the root mean square without the worst."""
    least = np.sort(np.abs(error))[: max(1, round((1.0 - _WORST) * len(error)))]
    return float(np.sqrt(np.mean(least**2)))
