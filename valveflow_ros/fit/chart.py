"""A chart that watches the residual for a lasting shift: whitened block means, two-sided CUSUMs.

The residual is averaged over blocks of a minute, which takes the fast noise out; what is left is
correlated from block to block, and a chart with limits for independent values would cry wolf
eighty times as often as it says. So each block is whitened by the autocorrelation that the curve's
own clean residual had. Two cumulative sums (Page, Biometrika 41, 1954) watch each side: one for
small shifts that last, one for large ones that must be seen within minutes. Their limits come with
the curve (`run_length`): they belong to a wanted time between false alarms.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.curve.chart_design import ChartDesign
from valveflow_ros.jit import jit
from valveflow_ros.records import NS_PER_S, FloatArray, IntArray
from valveflow_ros.state import ArrayMemory

# One wild block cannot raise the alarm alone.
_CLIP = 4.0
# A sum that grew for hours would take hours to come down again.
_CEILING = 1.25
_BLOCK, _GOOD = range(2)
_SUM, _LAST, _EVIDENCE, _SHIFT = range(4)
# For each of four sums: its value, the residuals added since it left zero, and how many.
_C, _TOTAL, _COUNT = range(3)
SMALL, LARGE = 0, 1


@jit
def innovation(mean: float, before: float, correlation: float, sd: float) -> float:
    """Return the whitened block mean, clipped; ``before`` is NaN behind a gap."""
    if math.isnan(before):
        e = mean * math.sqrt(1.0 - correlation * correlation) / sd
    else:
        e = (mean - correlation * before) / sd
    return min(max(e, -_CLIP), _CLIP)


@jit
def add(sums: FloatArray, e: float, mean: float, slack: FloatArray, limit: FloatArray) -> None:
    """Add one block to the four sums (4, 3): up and down for small, then for large shifts."""
    for k in range(4):
        which = k // 2
        sign = 1.0 if k % 2 == 0 else -1.0
        value = sums[k, _C] + sign * e - slack[which]
        if value <= 0.0:
            sums[k, :] = 0.0
            continue
        sums[k, _C] = min(value, _CEILING * limit[which])
        sums[k, _TOTAL] += mean
        sums[k, _COUNT] += 1.0


@jit
def _judge(sums: FloatArray, limit: FloatArray, state: FloatArray) -> None:
    """Write the strongest evidence, signed, and the shift it speaks of."""
    state[_EVIDENCE] = 0.0
    state[_SHIFT] = 0.0
    for k in range(4):
        share = sums[k, _C] / limit[k // 2]
        if share > abs(state[_EVIDENCE]):
            state[_EVIDENCE] = share if k % 2 == 0 else -share
            state[_SHIFT] = sums[k, _TOTAL] / sums[k, _COUNT]


@jit
def _run(
    time_ns: IntArray,
    residual: FloatArray,
    block_ns: int,
    least: int,
    correlation: float,
    sd: float,
    slack: FloatArray,
    limit: FloatArray,
    place: IntArray,
    state: FloatArray,
    sums: FloatArray,
    evidence: FloatArray,
    shift: FloatArray,
) -> None:
    """Run rows through the chart; a block is judged by the first row behind it."""
    for t in range(residual.size):
        block = time_ns[t] // block_ns
        if block != place[_BLOCK]:
            if place[_GOOD] >= least:
                mean = state[_SUM] / place[_GOOD]
                e = innovation(mean, state[_LAST], correlation, sd)
                add(sums, e, mean, slack, limit)
                _judge(sums, limit, state)
                state[_LAST] = mean
            else:
                state[_LAST] = np.nan
            if block != place[_BLOCK] + 1:
                state[_LAST] = np.nan
            place[_BLOCK], place[_GOOD], state[_SUM] = block, 0, 0.0
        if math.isfinite(residual[t]):
            place[_GOOD] += 1
            state[_SUM] += residual[t]
        evidence[t] = state[_EVIDENCE]
        shift[t] = state[_SHIFT]


class ResidualChart(ArrayMemory):
    """Watch the residual of one curve, in constant time a row.

    Parameters
    ----------
    design : ChartDesign
    step_s : float
        Step of the rows. Blocks with less than half their rows are not judged.
    """

    def __init__(self, design: ChartDesign, step_s: float) -> None:
        self.design = design
        block_s = max(design.block_s, step_s)
        self._block_ns = round(block_s * NS_PER_S)
        self._least = max(1, math.ceil(0.5 * block_s / step_s))
        self._slack, self._limit = np.array(design.slack), np.array(design.limit)
        self._place = np.array([-1, 0], dtype=np.int64)
        self._state = np.array([0.0, math.nan, math.nan, math.nan])
        self._sums = np.zeros((4, 3))

    def _memory(self) -> dict[str, NDArray[Any]]:
        return {'place': self._place, 'state': self._state, 'sums': self._sums}

    def follow(self, other: ResidualChart) -> None:
        """Go on where the chart of an earlier curve was: a new curve undoes no evidence.

        The sums keep their shares of the limits. With another length of blocks it starts afresh.
        """
        if other._block_ns != self._block_ns:
            return
        np.copyto(self._place, other._place)
        np.copyto(self._state, other._state)
        np.copyto(self._sums, other._sums)
        self._sums[:, _C] *= np.repeat(self._limit / other._limit, 2)

    def feed(self, time_ns: IntArray, residual_mw: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the evidence and the shift it speaks of after each row, shapes (n,).

        Parameters
        ----------
        time_ns : int64 (n,)
        residual_mw : float64 (n,)
            NaN where there is nothing to judge.

        Returns
        -------
        evidence : float64 (n,)
            Share of the limit that the strongest sum has reached, positive where the plant gives
            more than expected: beyond 1 or -1 there is an alarm. NaN before the first block.
        shift_mw : float64 (n,)
            Mean residual since that sum left zero.
        """
        evidence, shift = np.empty(len(time_ns)), np.empty(len(time_ns))
        _run(
            time_ns, residual_mw, self._block_ns, self._least, self.design.correlation,
            self.design.innovation_mw, self._slack, self._limit, self._place, self._state,
            self._sums, evidence, shift,
        )  # fmt: skip
        return evidence, shift
