"""A broken line through samples in order of time: joined at free knots, or with jumps."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from valveflow_ros.partition.selection_series import Noise, Series
from valveflow_ros.records import BoolArray, FloatArray, IntArray
from valveflow_ros.sums import gram

_ROUNDS = 4
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
        for _ in range(_ROUNDS):
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
