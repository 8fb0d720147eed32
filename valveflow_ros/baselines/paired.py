"""Is a mean difference zero? Paired t tests that count samples, and ones that do not.

The paper's test takes each sample of a segment for independent (its reference
[38]). At 1 Hz the noise of the power is correlated over a minute or more, so that
test sees ten or a hundred times the evidence there is. Beside it stand tests
that count what the samples are worth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtr, stdtrit

from valveflow_ros.fit.whitening import inflation
from valveflow_ros.records import FloatArray, IntArray

_LONGEST_S = 300.0


@dataclass(frozen=True, slots=True)
class PairedTest:
    """A t test of a mean difference against zero.

    Attributes
    ----------
    mean : float
    stderr : float
    t : float
    p_value : float
        Two-sided.
    effective : float
        Number of independent values the data are worth; degrees of freedom are one less.
    """

    mean: float
    stderr: float
    t: float
    p_value: float
    effective: float

    def interval(self, level: float = 0.05) -> tuple[float, float]:
        """Return the range the mean lies in with confidence 1 - ``level``; NaN if not known."""
        if not (math.isfinite(self.stderr) and self.effective > 1.0):
            return math.nan, math.nan
        reach = float(stdtrit(self.effective - 1.0, 1.0 - 0.5 * level)) * self.stderr
        return self.mean - reach, self.mean + reach

    def zero_is_rejected(self, level: float = 0.05) -> bool:
        """Tell whether zero is ruled out; a test that could not be done rules nothing out."""
        return self.p_value < level


def _test(mean: float, stderr: float, effective: float) -> PairedTest:
    if not (math.isfinite(mean) and math.isfinite(stderr) and effective > 1.0):
        return PairedTest(mean, math.nan, math.nan, math.nan, effective)
    if stderr == 0.0:
        t = math.copysign(math.inf, mean) if mean else 0.0
        return PairedTest(mean, 0.0, t, 0.0 if mean else 1.0, effective)
    t = mean / stderr
    return PairedTest(mean, stderr, t, float(2.0 * stdtr(effective - 1.0, -abs(t))), effective)


def over_samples(difference: FloatArray) -> PairedTest:
    """Test as the paper does: each sample counts.

    Parameters
    ----------
    difference : float64 (n,)
    """
    return with_effective_size(difference, 1.0)


def with_effective_size(difference: FloatArray, widening: float) -> PairedTest:
    """Test with n / widening independent values.

    Parameters
    ----------
    difference : float64 (n,)
    widening : float
        How many times the variance of a long mean exceeds that of independent samples.

    Notes
    -----
    A stretch that is worth fewer than two values gives no verdict (NaN).
    """
    n = len(difference)
    effective = n / max(widening, 1.0)
    if n < 2 or effective < 2.0:
        mean = float(difference.mean()) if n else math.nan
        return PairedTest(mean, math.nan, math.nan, math.nan, effective)
    stderr = float(difference.std(ddof=1)) / math.sqrt(effective)
    return _test(float(difference.mean()), stderr, effective)


def over_blocks(blocks: FloatArray) -> PairedTest:
    """Test means of blocks, allowing for correlation from block to block.

    Parameters
    ----------
    blocks : float64 (k,)
        In order of time; one value a block, such as a segment.

    Notes
    -----
    The variance is that of Newey and West with Bartlett weights over
    ``4 (k / 100)^(2/9)`` lags; it may widen the ordinary one, never narrow it.
    """
    k = len(blocks)
    if k < 2:
        return _test(float(blocks.mean()) if k else math.nan, math.nan, float(k))
    e = blocks - blocks.mean()
    own = float(e @ e) / k
    lags = min(k - 1, math.floor(4.0 * (k / 100.0) ** (2.0 / 9.0)))
    long_run = own
    for lag in range(1, lags + 1):
        long_run += 2.0 * (1.0 - lag / (lags + 1.0)) * float(e[lag:] @ e[:-lag]) / k
    long_run = max(own, long_run)
    effective = k * own / long_run if long_run > 0.0 else float(k)
    return _test(float(blocks.mean()), math.sqrt(long_run / (k - 1)), effective)


def widening_of(residual: FloatArray, spans: IntArray, step_s: float) -> float:
    """Return how many times correlation in time widens the variance of a mean.

    Parameters
    ----------
    residual : float64 (n,)
    spans : int64 (k, 2)
        First and end row of the stretches that count; rows of different stretches are
        not taken for neighbours.
    step_s : float

    Notes
    -----
    The stretches are pooled, about their common mean: about its own mean each would
    look less correlated than it is. So a misfit that changes from stretch to stretch
    counts as correlation, on the cautious side.
    """
    if not len(spans):
        return 1.0
    parts = [residual[a:b] for a, b in spans[:, :2].tolist()]
    mean = float(np.concatenate(parts).mean())
    series = np.concatenate([np.append(part - mean, 0.0) for part in parts])
    weight = np.concatenate(
        [np.append(np.ones(len(part), dtype=np.uint8), np.uint8(0)) for part in parts]
    )
    half = float(np.median(spans[:, 1] - spans[:, 0])) / 2.0
    return inflation(series, weight, max(1, int(min(_LONGEST_S / step_s, half))))
