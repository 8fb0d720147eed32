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

from valveflow_ros.numerics import gram
from valveflow_ros.records import BoolArray, FloatArray, IntArray

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


# A broken line through samples in order of time: joined at free knots, or with jumps.


_LINE_ROUNDS = 4
_STEPS = 6
_LITTLE = 0.03  # log-likelihood not worth another step
_LEAST_SHARE = 0.01  # of the samples, in a piece
_NARROWEST = 0.004  # of the range


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """A broken line and how well it explains the samples.

    Attributes
    ----------
    knots : float64 (J - 1,)
        In the scaled u, 0 to 1.
    coefficients : float64 (J + 1 + jumps,)
        Value at u = 0, slope, changes of slope, jumps; MW.
    jumps : bool (J - 1,)
        At which knots the line jumps; these knots stay where they are.
    noise : Noise
        Relearnt from this line's own residual.
    log_likelihood : float
    information : float64 (2 J, 2 J)
        Of coefficients and free knots.
    """

    knots: FloatArray
    coefficients: FloatArray
    jumps: BoolArray
    noise: Noise
    log_likelihood: float
    information: FloatArray

    @property
    def pieces(self) -> int:
        """Return J."""
        return len(self.knots) + 1


class Workshop:
    """Samples, scaled, and what is done with lines through them."""

    def __init__(self, series: Series, rows: IntArray) -> None:
        low, high = float(series.u.min()), float(series.u.max())
        self.low, self.span = low, high - low
        self.x = (series.u - low) / self.span
        self.y = series.y
        self.rows = rows
        self._sorted = np.sort(self.x)
        self._places = np.unique(self.x)
        self.least = max(3, math.ceil(_LEAST_SHARE * len(self.x)))

    def scaled(self, u: FloatArray) -> FloatArray:
        """Return places of u on the scale 0 to 1."""
        return np.asarray((u - self.low) / self.span)

    def roomy(self, knots: FloatArray) -> bool:
        """Tell whether the knots ascend with enough samples in each piece."""
        if not np.all(np.diff(knots) > _NARROWEST):
            return False
        for values, least in ((self._sorted, self.least), (self._places, 2)):
            edges = [0, *np.searchsorted(values, knots), len(values)]
            if np.diff(edges).min() < least:
                return False
        return True

    def design(self, knots: FloatArray, jumps: BoolArray) -> FloatArray:
        """Return the columns of the coefficients, shape (n, J + 1 + jumps)."""
        hinges = np.maximum(self.x[:, None] - knots[None, :], 0.0)
        steps = self.x[:, None] >= knots[None, jumps]
        return np.column_stack([np.ones(len(self.x)), self.x, hinges, steps])

    def residual(
        self, knots: FloatArray, jumps: BoolArray, coefficients: FloatArray
    ) -> FloatArray:
        """Return measurement minus line in MW, shape (n,)."""
        count = len(knots)
        corners = np.concatenate([[0.0], knots, [1.0]])
        slopes = np.cumsum(coefficients[1 : 2 + count])
        rises = np.concatenate([[0.0], np.cumsum(slopes * np.diff(corners))])
        rest = self.y - np.interp(self.x, corners, coefficients[0] + rises)
        for knot, jump in zip(knots[jumps], coefficients[2 + count :], strict=True):
            rest[self.x >= knot] -= jump
        return np.asarray(rest)

    def _normal(
        self, knots: FloatArray, jumps: BoolArray, coefficients: FloatArray | None, noise: Noise,
        weight: FloatArray,
    ) -> FloatArray:  # fmt: skip
        """Return the Gram matrix of all columns and, last, what is to be explained."""
        columns = [self.design(knots, jumps)]
        rest = self.y
        if coefficients is not None:
            bends = coefficients[2 : 2 + len(knots)][~jumps]
            columns.append(-bends * (self.x[:, None] > knots[None, ~jumps]))
            rest = self.residual(knots, jumps, coefficients)
        table = noise.innovations(np.column_stack([*columns, rest]), self.rows)
        return np.asarray(gram(np.ascontiguousarray(table * np.sqrt(weight)[:, None])))

    def straight(
        self, knots: FloatArray, jumps: BoolArray, noise: Noise, weight: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the best coefficients for fixed knots, and their information."""
        if weight is None:
            weight = np.ones(len(self.rows))
        sums = self._normal(knots, jumps, None, noise, weight)
        coefficients = _solve(sums[:-1, :-1], sums[:-1, -1])
        return coefficients, sums[:-1, :-1] / noise.sigma**2

    def errors(
        self, knots: FloatArray, jumps: BoolArray, coefficients: FloatArray, noise: Noise
    ) -> FloatArray:
        """Return the innovations of a line."""
        return noise.innovations(self.residual(knots, jumps, coefficients), self.rows)

    def fit(self, knots: FloatArray, noise: Noise, jumps: BoolArray | None = None) -> Line:
        """Fit coefficients, knots and the noise's memory and size together."""
        if jumps is None:
            jumps = np.zeros(len(knots), dtype=bool)
        coefficients, _ = self.straight(knots, jumps, noise)
        last = -math.inf
        for _ in range(_LINE_ROUNDS):
            noise = noise.learn(self.residual(knots, jumps, coefficients), self.rows)
            weight = noise.weights(self.errors(knots, jumps, coefficients, noise))
            coefficients, _ = self.straight(knots, jumps, noise, weight)
            knots, coefficients = self._move(knots, jumps, coefficients, noise)
            value = noise.log_likelihood(self.errors(knots, jumps, coefficients, noise))
            if value - last < _LITTLE:
                break
            last = value
        noise = noise.learn(self.residual(knots, jumps, coefficients), self.rows)
        e = self.errors(knots, jumps, coefficients, noise)
        sums = self._normal(knots, jumps, coefficients, noise, noise.weights(e))
        information = sums[:-1, :-1] / noise.sigma**2
        return Line(knots, coefficients, jumps, noise, noise.log_likelihood(e), information)

    def _move(
        self, knots: FloatArray, jumps: BoolArray, coefficients: FloatArray, noise: Noise
    ) -> tuple[FloatArray, FloatArray]:
        """Levenberg-Marquardt in coefficients and free knots under a given noise."""
        if jumps.all():
            return knots, coefficients
        j, damping = len(coefficients), 1e-3
        e = self.errors(knots, jumps, coefficients, noise)
        value = noise.log_likelihood(e)
        for _ in range(_STEPS):
            sums = self._normal(knots, jumps, coefficients, noise, noise.weights(e))
            gained = 0.0
            for _ in range(6):
                step = _solve(sums[:-1, :-1], sums[:-1, -1], damping)
                trial_knots = knots.copy()
                trial_knots[~jumps] += step[j:]
                if self.roomy(trial_knots):
                    trial = coefficients + step[:j]
                    trial_e = self.errors(trial_knots, jumps, trial, noise)
                    gained = noise.log_likelihood(trial_e) - value
                    if gained > 0.0:
                        break
                damping *= 8.0
            if not gained > 0.0:
                break
            knots, coefficients, e, value = trial_knots, trial, trial_e, value + gained
            damping = max(damping / 8.0, 1e-8)
            if gained < _LITTLE:
                break
        return knots, coefficients

    def worth(self, line: Line) -> FloatArray:
        """Return each coefficient's square over its variance, the knots held."""
        weight = line.noise.weights(
            self.errors(line.knots, line.jumps, line.coefficients, line.noise)
        )
        values, information = self.straight(line.knots, line.jumps, line.noise, weight)
        variance = np.diag(np.linalg.pinv(information, hermitian=True))
        return np.asarray(values**2 / np.maximum(variance, 1e-300))

    def without_weakest(self, line: Line) -> FloatArray:
        """Return the knots of a joined line but for the one whose bend is least certain."""
        return np.asarray(np.delete(line.knots, int(np.argmin(self.worth(line)[2:]))))

    def plain(self, knots: FloatArray, noise: Noise, jumps: BoolArray | None = None) -> Line:
        """Return the line with its knots where they are, under a given noise."""
        if jumps is None:
            jumps = np.zeros(len(knots), dtype=bool)
        coefficients, information = self.straight(knots, jumps, noise)
        e = self.errors(knots, jumps, coefficients, noise)
        return Line(knots, coefficients, jumps, noise, noise.log_likelihood(e), information)


def _solve(matrix: FloatArray, side: FloatArray, damping: float = 0.0) -> FloatArray:
    """Solve normal equations, scaled so that no column counts for its unit."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-12 * max(float(np.diag(matrix).max()), 1e-300)))
    scaled = matrix / np.outer(scale, scale) + (damping + 1e-12) * np.eye(len(scale))
    return np.asarray(np.linalg.solve(scaled, side / scale) / scale)


def thinned(workshop: Workshop, knots: FloatArray) -> FloatArray:
    """Return the knots, those left out that would make a piece too narrow."""
    kept: list[float] = []
    for knot in np.sort(knots):
        if workshop.roomy(np.array([*kept, float(knot)])):
            kept.append(float(knot))
    return np.array(kept)


# How probable each number of pieces is, given samples in order of time.
#
# Eq. (24) of the paper looks for the sharpest turn in the costs. It has no scale,
# so it cannot answer one piece, one strong knee hides weak ones, and it does not
# know that neighbouring samples share their error. Here every number of pieces is
# given its best continuous broken line, and these are compared by the evidence:
# the likelihood of the samples under noise whose width along u, tails and memory
# are learnt, times the share of all bends and knots thought possible beforehand
# that explain the samples about as well (Laplace's approximation).


_RICH = 18  # knots of an even grid, to begin with
_JUMP = 15.0  # square over variance from which a jump is tried
_ROWS_A_KNOT = 12  # fewer samples have no noise left to judge a knot by
_LOG_2PI = math.log(2.0 * math.pi)
# A further knee is thought four times less probable beforehand, and logarithms of the
# evidence are taken by four fifths, because width, tails and memory of the noise are
# estimates. Both were set on 300 random curves and 240 of fixed kinds, so that what is called
# 90 % sure is right in 90 %; `benchmarks.selection_study` tries them on others.
_KNEE_ODDS = 4.0
_TEMPER = 0.8


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What the samples say about the number of pieces.

    Attributes
    ----------
    pieces : int
        The most probable J.
    probability : dict
        Of J = 1, 2, ..., summing to 1.
    log_evidence : dict
        In natural units, relative to the best.
    knots : float64 (J - 1,)
        Of the most probable line, % MPa^m.
    memory : float
        How many samples one independent sample is worth.
    dof : float
        Tails of the noise; infinite for normal ones.
    """

    pieces: int
    probability: dict[int, float]
    log_evidence: dict[int, float]
    knots: FloatArray
    memory: float
    dof: float


def weigh(series: Series, most: int, starts: dict[int, FloatArray]) -> Evidence:
    """Weigh J = 1 .. ``most``.

    Parameters
    ----------
    series : Series
    most : int
    starts : dict
        Inner breaks of the exact partition into J pieces, % MPa^m.
    """
    series = series.coarser()
    workshop, rich = _rich(series)
    lines = _path(workshop, rich, most, starts)
    spread = _spread(workshop)
    value = {
        j: _TEMPER * _evidence(line, spread) - (j - 1) * math.log(_KNEE_ODDS)
        for j, line in lines.items()
    }
    best = max(value.values())
    relative = {j: v - best for j, v in sorted(value.items())}
    weight = {j: math.exp(v) for j, v in relative.items()}
    total = sum(weight.values())
    pieces = max(relative, key=lambda j: (relative[j], -j))
    chosen = lines[pieces]
    memory = 1.0 / max(1.0 - float(chosen.noise.ar.sum()), 1e-3) ** 2
    if len(chosen.noise.ar):
        memory *= _innovation_share(chosen.noise.ar)
    return Evidence(
        pieces=pieces,
        probability={j: w / total for j, w in weight.items()},
        log_evidence=relative,
        knots=workshop.low + workshop.span * chosen.knots,
        memory=max(1.0, memory),
        dof=chosen.noise.dof,
    )


def _innovation_share(ar: FloatArray) -> float:
    """Return the share of an autoregressive series' variance that its innovations have."""
    impulse = np.zeros(2000)
    impulse[0] = 1.0
    for t in range(1, len(impulse)):
        back = min(t, len(ar))
        impulse[t] = sum(ar[k] * impulse[t - 1 - k] for k in range(back))
    return float(1.0 / np.sum(impulse**2))


def _rich(series: Series) -> tuple[Workshop, Line]:
    """Return a line with more knots than needed, and the noise about it."""
    rows = np.arange(len(series.u))
    workshop = Workshop(series, rows)
    count = min(_RICH, len(rows) // _ROWS_A_KNOT)
    grid = np.quantile(workshop.x, np.arange(1, count + 1) / (count + 1.0))
    flat = Noise(np.ones(len(series.u)), math.inf, np.zeros(0), 1.0)
    knots = thinned(workshop, grid)
    line = workshop.plain(knots, flat)
    noise, rows = describe(series, workshop.residual(knots, line.jumps, line.coefficients))
    workshop = Workshop(series, rows)
    return workshop, workshop.plain(knots, noise)


def _path(
    workshop: Workshop, rich: Line, most: int, starts: dict[int, FloatArray]
) -> dict[int, Line]:
    """Return the best line found for each number of pieces, by pruning and from the partition."""
    spread = _spread(workshop)
    line = rich
    while line.pieces > min(most, 1 + len(workshop.rows) // _ROWS_A_KNOT):
        line = workshop.plain(workshop.without_weakest(line), rich.noise)
    lines: dict[int, Line] = {}
    line = workshop.fit(line.knots, line.noise)
    while True:
        knots = workshop.scaled(starts.get(line.pieces, np.empty(0)))
        if len(knots) and workshop.roomy(knots):
            other = workshop.fit(knots, line.noise)
            line = max(line, other, key=lambda found: found.log_likelihood)
            broken = _broken(workshop, knots, line)
            lines[line.pieces] = max(line, broken, key=lambda found: _evidence(found, spread))
        else:
            lines[line.pieces] = line
        if line.pieces == 1:
            return lines
        line = workshop.fit(workshop.without_weakest(line), line.noise)


def _broken(workshop: Workshop, knots: FloatArray, joined: Line) -> Line:
    """Return the line with those jumps at the partition's breaks that stand out of the noise."""
    jumps = np.ones(len(knots), dtype=bool)
    j = len(knots) + 2
    line = workshop.plain(knots, joined.noise, jumps)
    jumps = workshop.worth(line)[j:] > _JUMP
    if not jumps.any():
        return joined
    line = workshop.fit(knots, joined.noise, jumps)
    kept = workshop.worth(line)[j:] > _JUMP
    if kept.all():
        return line
    jumps[jumps] = kept
    return workshop.fit(knots, joined.noise, jumps) if jumps.any() else joined


def _spread(workshop: Workshop) -> float:
    """Return the slope that a line through the whole cloud would have."""
    return float(np.std(workshop.y)) / max(float(np.std(workshop.x)), 1e-9)


def _evidence(line: Line, spread: float) -> float:
    """Return the log of the evidence, but for what all numbers of pieces share.

    Beforehand a knot may lie anywhere; bends are normal with the sd ``spread``, jumps with
    that of a line of this slope through the range. The place of a jump is known to about as
    many samples as its height must be averaged over to be seen.
    """
    count, free = len(line.knots), int((~line.jumps).sum())
    bends, jumps = line.coefficients[2 : 2 + count], line.coefficients[2 + count :]
    sd = np.concatenate([np.full(count, spread), np.full(len(jumps), spread)])
    changes = np.concatenate([bends, jumps])
    prior = math.lgamma(count + 1.0) - float(np.sum(0.5 * (changes / sd) ** 2 + np.log(sd)))
    prior -= 0.5 * len(changes) * _LOG_2PI
    # A uniform knot has the variance 1/12.
    precision = np.concatenate([np.zeros(2), sd**-2.0, np.full(free, 12.0)])
    log_det = float(np.linalg.slogdet(line.information + np.diag(precision))[1])
    rows = len(line.noise.width)
    size = float(np.mean(line.noise.width)) * line.noise.sigma
    seen = np.maximum(1.0, 2.0 * (size / np.maximum(np.abs(jumps), 1e-300)) ** 2)
    place = float(np.sum(np.minimum(0.0, np.log(seen / rows))))
    parameters = len(changes) + free
    return line.log_likelihood + prior + place + 0.5 * parameters * _LOG_2PI - 0.5 * log_det
