"""Watch, at little cost, whether the model still fits.

The residual's chart sees that the power is off. What is off only at one load, in one direction,
at one time of day or after moves leaves the mean of the residual alone; so here each minute's
residual is set against what such a fault would make it proportional to: a scalar least squares
that forgets within three days, one for each statistic. How far an estimate may be from zero by
chance is taken from the scores of blocks of two hours and of neighbouring blocks (White; Newey and
West, Econometrica 55, 1987), so that neither the residual's correlation nor a noise that depends
on the load has to be known. It says that the model does not fit and at best hints at why: naming
the cause takes the whole record (`valveflow_ros.diagnosis`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from valveflow_ros.curve.model import RegionalModel
from valveflow_ros.monitoring import mismatch_kernel as k
from valveflow_ros.monitoring.prediction import PredictionBlock
from valveflow_ros.records import NS_PER_S, FloatArray, IntArray
from valveflow_ros.state import State, copies, put_back

# What is below this share of the residual's sd is not worth a word, however sure it is.
FLOOR = 0.05
# Blocks of two hours that must speak of a statistic before it is judged.
LEAST_BLOCKS = 10.0
NAMES = (
    'offset', 'gain', 'input', 'temperature', 'time of day (cosine)', 'time of day (sine)',
    'direction', 'lag at low load', 'lag at high load',
    *(f'move {minutes} min ago' for minutes in range(k.MOVES)),
    *(f'bin {number} of u' for number in range(k.BINS)),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Misfit:
    """The statistic that speaks loudest.

    Attributes
    ----------
    score : float
        As a normal deviate, signed; 0 where nothing can be judged.
    name : str
        One of `NAMES`; empty where nothing can be judged.
    hint : str
        What the residual depends on, as the end of a sentence.
    """

    score: float
    name: str
    hint: str


NOTHING = Misfit(0.0, '', '')


class Mismatch:
    """Recursive statistics of the residual, in constant memory and time a row.

    Parameters
    ----------
    step_s : float
        Step of the rows.
    """

    def __init__(self, step_s: float) -> None:
        self._minute_ns = max(k.MINUTE_NS, round(step_s * NS_PER_S))
        self._least = max(1, math.ceil(0.5 * self._minute_ns / NS_PER_S / step_s))
        self._place = np.array([-1, -1, 0], dtype=np.int64)
        self._minute, self._z = np.zeros(k.MINUTE), np.zeros(k.FEATURES)
        self._state = np.zeros(k.STATE)
        self._state[k.PLAY :] = math.nan
        self._block, self._kept = np.zeros((k.FEATURES, 3)), np.zeros((k.FEATURES, k.KEPT))
        self._ends = 0.0, 0.0

    def feed(
        self, block: PredictionBlock, temperature_degc: FloatArray, model: RegionalModel
    ) -> None:
        """Take rows that ``model`` has predicted; a new model goes on where the last one stopped.

        Parameters
        ----------
        block : PredictionBlock
        temperature_degc : float64 (n,)
            Main steam temperature of the same rows.
        model : RegionalModel
        """
        self._ends = float(model.knots[0]), float(model.knots[-1])
        k.run(
            block.time_ns, block.u, temperature_degc, block.static_mw, block.dynamic_mw,
            block.residual_mw, self._minute_ns, self._least, model.knots, model.left, model.right,
            self._place, self._minute, self._state, self._block, self._kept, self._z,
        )  # fmt: skip

    def snapshot(self) -> State:
        """Return what is remembered; see `core.state`."""
        return {**copies(self._memory()), 'ends': list(self._ends)}

    def restore(self, saved: State) -> None:
        """Go on from a state; raises `DataError` if it does not fit."""
        put_back(self._memory(), saved)
        self._ends = saved['ends'][0], saved['ends'][1]

    def _memory(self) -> dict[str, FloatArray | IntArray]:
        return {
            'place': self._place,
            'minute': self._minute,
            'z': self._z,
            'state': self._state,
            'block': self._block,
            'kept': self._kept,
        }

    def scores(self) -> FloatArray:
        """Return the statistics as normal deviates, shape (len(NAMES),); 0 where not judged."""
        with np.errstate(over='ignore', invalid='ignore'):
            theta, spread, blocks = self._estimates()
        # Numbers so large that their squares are none say nothing either.
        judged = (blocks >= LEAST_BLOCKS) & (spread > 0.0) & np.isfinite(theta + spread)
        t = np.divide(theta, spread, out=np.zeros_like(theta), where=judged)
        # Student's t with few blocks as the normal deviate of the same chance (Wallace, 1959).
        n = np.maximum(blocks - 1.0, 1.0)
        factor = (8.0 * n + 1.0) / (8.0 * n + 3.0)
        return np.asarray(np.sign(t) * factor * np.sqrt(n * np.log1p(t * t / n)))

    def judge(self) -> Misfit:
        """Return the statistic that speaks loudest."""
        scores = self.scores()
        j = int(np.argmax(np.abs(scores)))
        if scores[j] == 0.0:
            return NOTHING
        effect = self._estimates()[0][j] * self._size()[j]
        return Misfit(float(scores[j]), NAMES[j], self._hint(j, float(effect)))

    def _size(self) -> FloatArray:
        """Return the root mean square of what each statistic is in proportion to."""
        kept = self._kept
        count = np.maximum(kept[:, k.SUM_N], 1.0)
        return np.asarray(np.sqrt(kept[:, k.SUM_Q] / count))

    def _estimates(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return estimates, their standard errors, and how many blocks they rest on."""
        kept = self._kept
        q, qq = kept[:, k.SUM_Q], kept[:, k.SUM_QQ]
        there = (q > 0.0) & (qq > 0.0)
        q = np.where(there, q, 1.0)
        theta = np.where(there, kept[:, k.SUM_S] / q, 0.0)
        own = kept[:, k.SUM_SS] - 2.0 * theta * kept[:, k.SUM_SQ] + theta**2 * qq
        cross = (
            kept[:, k.NEXT_SS] - theta * (kept[:, k.NEXT_SQ] + kept[:, k.NEXT_QS])
            + theta**2 * kept[:, k.NEXT_QQ]
        )  # fmt: skip
        own = np.maximum(own, 0.0)
        variance = np.maximum(own, own + 2.0 * cross) / q**2
        noise = math.sqrt(self._state[k.POWER] / max(self._state[k.COUNT], 1.0))
        floor = FLOOR * noise / np.where(there, self._size(), 1.0)
        spread = np.where(there, np.sqrt(variance + floor**2), 0.0)
        return theta, spread, np.where(there, q**2 / np.where(there, qq, 1.0), 0.0)

    def _hint(self, j: int, effect: float) -> str:
        """Say what a statistic means; ``effect`` in MW."""
        size, side = f'{abs(effect):.2g} MW', 'more' if effect > 0.0 else 'less'
        if j >= k.BIN:
            low, high = self._ends
            at = low + (high - low) * (j - k.BIN) / (k.BINS - 1)
            return f'around u = {at:.0f} the unit gives {size} {side} than it says'
        if j >= k.MOVE:
            return f'in the minutes after a move the power is off by {size}'
        if j in (k.LAG_LOW, k.LAG_HIGH):
            how = 'faster' if effect > 0.0 else 'slower'
            return f'the power follows moves {how} at {"low" if j == k.LAG_LOW else "high"} load'
        if j == k.DIRECTION:
            return f'opening and closing to the same place differ by {2.0 * abs(effect):.2g} MW'
        return {
            k.OFFSET: f'the unit gives {size} {side} than it says',
            k.GAIN: f'the unit gives {size} {side}, in proportion to the load',
            k.INPUT: f'the unit gives {size} {side} where the curve is steep',
            k.TEMPERATURE: f'the power goes with the main steam temperature, by {size}',
        }.get(j, f'the power swings with the time of day, by {size}')
