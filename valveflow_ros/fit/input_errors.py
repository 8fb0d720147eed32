"""Errors of the measured input, which make a plant look slower than it is, and their correction.

Least squares take opening and pressure for exact. Their sensors' noise goes through the model and
not through the plant, so a fit prefers a model that lets less of it pass: time constants come out
a few per cent too long. Simulation and extrapolation (Cook and Stefanski, J. Am. Stat. Assoc. 89,
1994) takes that back: noise of the same size is added once more, the fit moves by the bias that
once more of it causes, and is moved back by as much.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from valveflow_ros.curve.model import RegionalModel
from valveflow_ros.fit.problem import Problem, Samples, in_bounds, move
from valveflow_ros.records import BoolArray, ByteArray, FloatArray

_SEED = 20240229
_LEAST_PAIRS = 1000
_LEAST_DOUBLING = 0.85  # of what the movement should grow by from two rows to four
_MEDIAN_TO_SD = 0.6744897501960817


def relative_noise(u: FloatArray, usable: ByteArray) -> float:
    """Return the sd of the noise of ``u`` from row to row, as a share of ``u``.

    A second difference of values one row apart holds the noise and what a wandering valve moves
    in one row; of values two rows apart the same noise and twice the movement. Their
    extrapolation to no row at all is the noise alone. Straight ramps vanish in both, medians
    keep leaps out; too few rows, no noise, or rows too slow to tell, give 0.
    """
    run = usable > 0
    if len(u) < _LEAST_PAIRS:
        return 0.0
    good = run[8:] & run[6:-2] & run[5:-3] & run[4:-4] & run[3:-5] & run[2:-6] & run[:-8]
    with np.errstate(divide='ignore', invalid='ignore'):
        level = np.log(np.where(run & (u > 0.0), u, np.nan))
    middle = 2.0 * level[4:-4]
    bends = [(level[4 + k : len(u) - 4 + k] + level[4 - k : len(u) - 4 - k] - middle)[good]
             for k in (1, 2, 4)]  # fmt: skip
    known = np.isfinite(bends[0]) & np.isfinite(bends[1]) & np.isfinite(bends[2])
    if known.sum() < _LEAST_PAIRS:
        return 0.0
    # The median of |x| is 0.6745 sd; the noise enters a second difference six times.
    one, two, four = ((np.median(np.abs(d[known])) / _MEDIAN_TO_SD) ** 2 for d in bends)
    # Where rows are slow against the valve, movement no longer doubles and would pass for noise.
    if two - one > 0.1 * one and four - two < _LEAST_DOUBLING * 2.0 * (two - one):
        return 0.0
    return float(np.sqrt(max(0.0, (2.0 * one - two) / 6.0)))


def corrected(
    samples: Samples, problem: Problem, model: RegionalModel, ar: FloatArray, free: BoolArray
) -> RegionalModel:
    """Take the bias back that errors of the input cause; ``model`` has converged on ``problem``.

    The extrapolation is linear. Where it would leave what a plant can have, the model stays.
    """
    share = relative_noise(samples.u, samples.usable)
    if share == 0.0:
        return model
    drawn = np.random.default_rng(_SEED).standard_normal(len(samples.u))
    noisier = Problem(replace(problem.samples, u=samples.u * (1.0 + share * drawn)))
    moved, _ = move(noisier, model, ar, free, 2)
    packed = 2.0 * model.pack() - moved.pack()
    packed[-model.regions :] = np.maximum(packed[-model.regions :], 0.0)
    trial = model.unpack(packed)
    return trial if in_bounds(trial, problem.samples) else model
