"""How probable each number of pieces is, given samples in order of time.

Eq. (24) of the paper looks for the sharpest turn in the costs. It has no scale,
so it cannot answer one piece, one strong knee hides weak ones, and it does not
know that neighbouring samples share their error. Here every number of pieces is
given its best continuous broken line, and these are compared by the evidence:
the likelihood of the samples under noise whose width along u, tails and memory
are learnt, times the share of all bends and knots thought possible beforehand
that explain the samples about as well (Laplace's approximation).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from valveflow_ros.partition.selection_lines import Line, Workshop, thinned
from valveflow_ros.partition.selection_series import Noise, Series, describe
from valveflow_ros.records import FloatArray

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
