"""A part of the identification data held back to choose between candidates."""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np

from valveflow_ros.core.problem import Samples
from valveflow_ros.core.refine import least_rows
from valveflow_ros.errors import TooFewSamplesError
from valveflow_ros.records import ByteArray, FloatArray

LEARN_SHARE = 0.7


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
        Too few usable rows.
    """
    usable = int(samples.usable.sum())
    least = least_rows(samples.step_s)
    if usable < least:
        raise TooFewSamplesError('Rows with opening, pressure and power', usable, least)
    cut = round(LEARN_SHARE * samples.means) * samples.group
    return part_of(samples, 0, cut), part_of(samples, cut, len(samples.u))


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
