"""A part of the identification data held back to choose between candidates."""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np

from valveflow_ros.errors import TooFewSamplesError
from valveflow_ros.fit.problem import Samples
from valveflow_ros.fit.refine import least_rows
from valveflow_ros.records import BoolArray, ByteArray, FloatArray

LEARN_SHARE = 0.7
_LEAST_OF_PART = 0.1  # of the settled rows needed altogether, in each part


class Runnable(Protocol):
    """A model that can be run over measured inputs."""

    def run(self, samples: Samples) -> tuple[FloatArray, ByteArray]:
        """Return the simulated power in MW and where it has settled."""


def part_of(samples: Samples, start: int, end: int) -> Samples:
    """Return the rows ``[start, end)``."""
    cut = slice(start, end)
    return replace(
        samples, u=samples.u[cut], power_mw=samples.power_mw[cut], usable=samples.usable[cut]
    )


def cut_samples(samples: Samples) -> tuple[Samples, Samples]:
    """Return the part to learn from and the later part to choose by.

    Raises
    ------
    TooFewSamplesError
        Too few usable rows, or too few that lie far enough behind a gap: altogether, or in one
        of the two parts.
    """
    usable = int(samples.usable.sum())
    least = least_rows(samples.step_s)
    if usable < least:
        raise TooFewSamplesError('Rows with opening, pressure and power', usable, least)
    _settled_enough(samples, least)
    cut = round(LEARN_SHARE * samples.means) * samples.group
    learn, judge = part_of(samples, 0, cut), part_of(samples, cut, len(samples.u))
    for part in (learn, judge):
        _settled_enough(part, round(_LEAST_OF_PART * least))
    return learn, judge


def _settled_enough(samples: Samples, least: int) -> None:
    # As coarse as searches take them: a mean counts only if all its rows do.
    coarse = samples.coarser()
    factor = round(coarse.step_s / samples.step_s)
    settled = settled_rows(coarse)[: coarse.means * coarse.group]
    means = settled.reshape(coarse.means, coarse.group).all(axis=1)
    have = int(means.sum()) * coarse.group * factor
    if have < least:
        raise TooFewSamplesError(
            'Rows that follow each other for longer than the transient', have, least
        )


def settled_rows(samples: Samples) -> BoolArray:
    """Return where a row is usable and lies farther behind a gap than the transient lasts."""
    place = np.arange(1, len(samples.u) + 1)
    last = np.maximum.accumulate(np.where(samples.usable > 0, 0, place))
    return np.asarray(place - last > round(samples.settle_s / samples.step_s))


def run_mse(model: Runnable, samples: Samples) -> float:
    """Return the mean squared error in MW^2 of a free run; infinite where it runs away."""
    answer, settled = model.run(samples)
    keep = settled > 0
    if not keep.any():
        return float('inf')
    error = samples.power_mw[keep] - answer[keep]
    with np.errstate(over='ignore', invalid='ignore'):
        value = float(np.mean(error**2))
    return value if np.isfinite(value) else float('inf')
