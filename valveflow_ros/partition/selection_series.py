"""Special samples in order of time, and the noise that is left of them.

Whether a bend is real is a question about the noise: how wide it is where, how
heavy its tails are, and for how long it remembers. All three are learnt here
from the residual of a curve, and taken out of residual and regressors alike.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaln

from valveflow_ros.records import BoolArray, FloatArray, IntArray
from valveflow_ros.sums import gram

_MOST_ROWS = 6000
_CELLS = 12  # stretches of u, each with its own width of the noise
_DOFS = (2.5, 3.0, 4.0, 6.0, 10.0, 30.0, math.inf)
_ORDERS = (0, 1, 2, 4)
_ROWS_AN_ORDER = 30
_LARGEST_ROOT = 0.995
_ROUNDS = 6


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Samples in order of time.

    Attributes
    ----------
    u, y : float64 (n,)
    fresh : bool (n,)
        Where a sample does not follow the one before it.
    """

    u: FloatArray
    y: FloatArray
    fresh: BoolArray

    @classmethod
    def of_spans(cls, u: FloatArray, y: FloatArray, spans: IntArray) -> Series:
        """Return the samples of segments (first row, end row, ...) of a table of rows."""
        parts = [np.arange(a, b) for a, b in spans[:, :2]]
        rows = np.concatenate(parts) if parts else np.empty(0, dtype=np.int64)
        fresh = np.ones(len(rows), dtype=bool)
        fresh[1:] = np.diff(rows) != 1
        return cls(u[rows], y[rows], fresh)

    def coarser(self, most: int = _MOST_ROWS) -> Series:
        """Return means over samples that follow each other, so that at most ``most`` are left.

        What is left over at the end of a run is dropped when it is less than a full mean.
        """
        run = np.cumsum(self.fresh) - 1
        first = np.flatnonzero(self.fresh)
        length = np.diff(np.append(first, len(self.u)))
        # Runs shorter than a mean would vanish: half of them at most may be that short.
        group = min(-(-len(self.u) // most), max(1, int(np.median(length)) // 2))
        if group < 2:
            return self
        place = np.arange(len(self.u)) - first[run]
        keep = place < (length // group * group)[run]
        shape = (-1, group)
        fresh = (self.fresh[keep]).reshape(shape)[:, 0]
        return Series(
            self.u[keep].reshape(shape).mean(axis=1), self.y[keep].reshape(shape).mean(axis=1),
            fresh,
        )  # fmt: skip

    def with_history(self, order: int) -> IntArray:
        """Return the rows that have ``order`` predecessors."""
        run = np.cumsum(self.fresh) - 1
        first = np.flatnonzero(self.fresh)
        return np.flatnonzero(np.arange(len(self.u)) - first[run] >= order)


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """What is known of the noise.

    Attributes
    ----------
    width : float64 (n,)
        Its width at each sample, MW.
    dof : float
        Of Student's t that the innovations follow.
    ar : float64 (order,)
        Of the residual over its width.
    sigma : float
        Of the innovations over their width.
    """

    width: FloatArray
    dof: float
    ar: FloatArray
    sigma: float

    def innovations(self, columns: FloatArray, rows: IntArray) -> FloatArray:
        """Return columns (n, P) over the width and freed of memory, shape (len(rows), P)."""
        scaled = columns / (self.width[:, None] if columns.ndim == 2 else self.width)
        # Rows in one run, as of one long segment, need no copying about.
        whole = len(rows) > 0 and int(rows[-1] - rows[0]) == len(rows) - 1
        begin, end = (int(rows[0]), int(rows[-1]) + 1) if whole else (0, 0)
        out = scaled[begin:end].copy() if whole else scaled[rows]
        for k, a in enumerate(self.ar, start=1):
            out -= a * (scaled[begin - k : end - k] if whole else scaled[rows - k])
        return np.asarray(out)

    def weights(self, e: FloatArray) -> FloatArray:
        """Return the weight of each innovation in a fit that far ones do not pull."""
        if not math.isfinite(self.dof):
            return np.ones(len(e))
        return np.asarray((self.dof + 1.0) / (self.dof + (e / self.sigma) ** 2))

    def log_likelihood(self, e: FloatArray) -> float:
        """Return the log-likelihood of innovations, but for what no curve changes."""
        return _log_likelihood(e, self.sigma, self.dof)

    def learn(self, residual: FloatArray, rows: IntArray) -> Noise:
        """Return memory and size relearnt from a residual (n,), width and tails kept."""
        noise = self
        scaled = residual / self.width
        order = len(self.ar)
        past = np.column_stack([scaled[rows - k] for k in range(order + 1)])
        for _ in range(_ROUNDS):
            e = past[:, 0] - past[:, 1:] @ noise.ar if order else past[:, 0]
            sigma = _sigma(e, noise.dof, noise.sigma)
            noise = replace(noise, sigma=sigma)
            if not order:
                break
            root = np.sqrt(noise.weights(e))
            sums = gram(np.ascontiguousarray(past * root[:, None]))
            ar = _regress(sums)
            total = float(ar.sum())
            if total > _LARGEST_ROOT:
                ar = ar * (_LARGEST_ROOT / total)
            done = np.abs(ar - noise.ar).max() < 1e-4
            noise = replace(noise, ar=ar)
            if done:
                break
        e = self._errors(past, noise)
        return replace(noise, sigma=_sigma(e, noise.dof, noise.sigma))

    @staticmethod
    def _errors(past: FloatArray, noise: Noise) -> FloatArray:
        return past[:, 0] - past[:, 1:] @ noise.ar if len(noise.ar) else past[:, 0]


def _regress(sums: FloatArray) -> FloatArray:
    """Return the coefficients of the first column on the others, from their Gram matrix."""
    ar = np.linalg.lstsq(sums[1:, 1:], sums[1:, 0], rcond=1e-12)[0]
    return np.asarray(ar, dtype=np.float64)


def _sigma(e: FloatArray, dof: float, start: float) -> float:
    """Return the scale of Student's t by maximum likelihood."""
    sigma = start
    if not math.isfinite(dof):
        return max(float(np.sqrt(np.mean(e * e))), 1e-300)
    sigma = max(float(np.median(np.abs(e))) * 1.4, 1e-300)
    for _ in range(30):
        weight = (dof + 1.0) / (dof + (e / sigma) ** 2)
        new = max(float(np.sqrt(np.mean(weight * e * e))), 1e-300)
        if abs(new / sigma - 1.0) < 1e-6:
            return new
        sigma = new
    return sigma


def _log_likelihood(e: FloatArray, sigma: float, dof: float) -> float:
    n = len(e)
    if not math.isfinite(dof):
        return float(-n * (math.log(sigma) + 0.5 * math.log(2.0 * math.pi))
                     - 0.5 * np.sum((e / sigma) ** 2))  # fmt: skip
    head = gammaln(0.5 * (dof + 1.0)) - gammaln(0.5 * dof) - 0.5 * math.log(math.pi * dof)
    tail = 0.5 * (dof + 1.0) * np.sum(np.log1p((e / sigma) ** 2 / dof))
    return float(n * (head - math.log(sigma)) - tail)


def describe(series: Series, residual: FloatArray) -> tuple[Noise, IntArray]:
    """Learn width, tails and order of memory from the residual of a rich curve.

    Returns
    -------
    noise : Noise
    rows : int64
        The samples that are scored: those with a history of the largest order.
    """
    width = _width(series.u, residual)
    rows = series.with_history(max(_ORDERS))
    if len(rows) < len(series.u) // 2:
        rows = series.with_history(1)
        orders: tuple[int, ...] = (0, 1) if len(rows) >= len(series.u) // 2 else (0,)
        rows = rows if len(orders) > 1 else np.arange(len(series.u))
    else:
        orders = _ORDERS
    best, least = None, math.inf
    for order in orders:
        if order and len(rows) < _ROWS_AN_ORDER * order:
            continue
        noise = Noise(width, math.inf, np.zeros(order), 1.0).learn(residual, rows)
        e = noise.innovations(residual, rows)
        price = -2.0 * noise.log_likelihood(e) + order * math.log(len(rows))
        if price < least:
            best, least = noise, price
    assert best is not None
    return _tails(best, residual, rows), rows


def _tails(noise: Noise, residual: FloatArray, rows: IntArray) -> Noise:
    """Choose the tails that make the innovations most likely."""
    e = noise.innovations(residual, rows)
    likely = [_log_likelihood(e, _sigma(e, dof, noise.sigma), dof) for dof in _DOFS]
    return replace(noise, dof=_DOFS[int(np.argmax(likely))]).learn(residual, rows)


def _width(u: FloatArray, residual: FloatArray) -> FloatArray:
    """Return the typical size of the residual along u, straight between stretches of u."""
    order = np.argsort(u, kind='stable')
    cells = max(1, min(_CELLS, len(u) // 40))
    parts = np.array_split(order, cells)
    middle = np.array([float(np.median(u[p])) for p in parts])
    size = np.array([float(np.mean(np.abs(residual[p]))) for p in parts])
    overall = float(np.mean(np.abs(residual)))
    if overall <= 0.0:
        return np.ones(len(u))
    # Three stretches together, so that the width follows the noise and not its chances.
    padded = np.concatenate([size[:1], size, size[-1:]])
    smooth = (padded[:-2] + 2.0 * padded[1:-1] + padded[2:]) / 4.0
    return np.asarray(np.maximum(np.interp(u, middle, smooth), 0.05 * overall))
