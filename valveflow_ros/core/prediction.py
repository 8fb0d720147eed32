"""What the running curve expects, row by row, and by how much the plant differs."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

import numba
import numpy as np

from valveflow_ros.core.jit import JIT
from valveflow_ros.core.characteristic import Characteristic
from valveflow_ros.core.regional_kernel import curve, region_of
from valveflow_ros.core.segmenter_kernel import NO_DATA, SETTLED_SLOPE, SETTLED_STEADY
from valveflow_ros.records import ByteArray, FloatArray, IntArray

_LONGEST_DELAY_S = 600.0
_AGE, _PLACE = range(2)
_ANSWER, _AVERAGE = range(2)


class PredictionState(enum.IntEnum):
    """What a residual is worth; the same numbers stand in the message."""

    UNKNOWN = 0
    TRANSIENT = 1
    STEADY = 2
    SLOPE = 3
    OUTSIDE = 4
    BAD_DATA = 5


@dataclass(frozen=True, slots=True)
class PredictionBlock:
    """Predictions for consecutive rows; all arrays have shape (n,).

    Attributes
    ----------
    time_ns : int64
    u : float64
        Integrated input, % MPa^m.
    measured_mw, static_mw, dynamic_mw, residual_mw : float64
        NaN where unknown. The residual is measured minus dynamic prediction, or
        minus static prediction in settled rows when no dynamics are known.
    average_mw : float64
        The running mean of the residual that the alarm judges; NaN before the first.
    state : uint8
        A `PredictionState`.
    limit_mw : float
        The alarm's limit on ``average_mw``, +- this; NaN without a curve.
    model_id : str
    """

    time_ns: IntArray
    u: FloatArray
    measured_mw: FloatArray
    static_mw: FloatArray
    dynamic_mw: FloatArray
    residual_mw: FloatArray
    average_mw: FloatArray
    state: ByteArray
    limit_mw: float
    model_id: str

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.time_ns)


@numba.njit(**JIT)
def _predict(
    u: FloatArray,
    y: FloatArray,
    kinds: ByteArray,
    knots: FloatArray,
    left: FloatArray,
    right: FloatArray,
    levels: FloatArray,
    decay: FloatArray,
    delay: FloatArray,
    settle: int,
    forget: float,
    place: IntArray,
    memory: FloatArray,
    past: FloatArray,
    static: FloatArray,
    dynamic: FloatArray,
    residual: FloatArray,
    average: FloatArray,
    state: ByteArray,
) -> None:
    """Predict rows; ``past`` is a ring of flows, ``place`` and ``memory`` the filter's state."""
    room = past.size
    known = decay.size > 0
    for t in range(u.size):
        static[t] = dynamic[t] = residual[t] = np.nan
        if kinds[t] == NO_DATA or not (math.isfinite(u[t]) and math.isfinite(y[t])):
            place[_AGE] = 0
            state[t] = 5
            average[t] = memory[_AVERAGE]
            continue
        x = curve(u[t], knots, left, right)
        inside = knots[0] <= u[t] <= knots[-1]
        age = place[_AGE]
        past[place[_PLACE]] = x
        if known:
            r = region_of(x, levels)
            whole = int(delay[r])
            part = delay[r] - whole
            near = past[(place[_PLACE] - min(whole, age)) % room]
            far = past[(place[_PLACE] - min(whole + 1, age)) % room]
            late = near * (1.0 - part) + far * part
            if age == 0:
                memory[_ANSWER] = x
            memory[_ANSWER] = decay[r] * memory[_ANSWER] + (1.0 - decay[r]) * late
        place[_PLACE] = (place[_PLACE] + 1) % room
        place[_AGE] = age + 1
        if inside:
            static[t] = x
        judged = False
        if known and age >= settle:
            dynamic[t] = memory[_ANSWER]
            residual[t] = y[t] - dynamic[t]
            judged = inside
        elif not known and kinds[t] != 0:
            residual[t] = y[t] - x
            judged = inside
        if not inside:
            state[t] = 4
        elif kinds[t] == SETTLED_STEADY:
            state[t] = 2
        elif kinds[t] == SETTLED_SLOPE:
            state[t] = 3
        else:
            state[t] = 1
        if judged:
            if math.isnan(memory[_AVERAGE]):
                memory[_AVERAGE] = 0.0
            memory[_AVERAGE] = forget * memory[_AVERAGE] + (1.0 - forget) * residual[t]
        elif not inside:
            residual[t] = np.nan
        average[t] = memory[_AVERAGE]


class Predictor:
    """Predict from one curve, recursively, in constant time a row.

    Parameters
    ----------
    characteristic : Characteristic
    step_s : float
        Step of the rows.
    settle_s : float
        After a gap the dynamic prediction is not trusted for this long.
    average_s : float
        Time constant of the residual's running mean.
    """

    def __init__(
        self, characteristic: Characteristic, step_s: float, settle_s: float, average_s: float
    ) -> None:
        self.characteristic = characteristic
        self._model = characteristic.model
        self._decay = self._model.decays(step_s)
        self._delay = self._model.delays / step_s
        self._settle = round(settle_s / step_s)
        self._forget = math.exp(-step_s / average_s)
        self._place = np.zeros(2, dtype=np.int64)
        self._memory = np.array([0.0, math.nan])
        self._past = np.zeros(int(_LONGEST_DELAY_S / step_s) + 4)

    @property
    def warm_up_rows(self) -> int:
        """Return how many rows bring the filter into its stride."""
        return 2 * self._settle + 1

    def warm_up(self, u: FloatArray, power_mw: FloatArray) -> None:
        """Run over rows of the past; the residual's mean starts afresh afterwards."""
        kinds = np.full(len(u), SETTLED_STEADY, dtype=np.uint8)
        self.predict(np.zeros(len(u), dtype=np.int64), u, power_mw, kinds, math.nan)
        self._memory[_AVERAGE] = math.nan

    def predict(
        self,
        time_ns: IntArray,
        u: FloatArray,
        power_mw: FloatArray,
        kinds: ByteArray,
        limit_mw: float,
    ) -> PredictionBlock:
        """Predict rows of shape (n,); ``kinds`` are the segmenter's."""
        n = len(u)
        static, dynamic, residual, average = (np.empty(n) for _ in range(4))
        state = np.empty(n, dtype=np.uint8)
        m = self._model
        _predict(
            u, power_mw, kinds, m.knots, m.left, m.right, m.levels, self._decay, self._delay,
            self._settle, self._forget, self._place, self._memory, self._past,
            static, dynamic, residual, average, state,
        )  # fmt: skip
        return PredictionBlock(
            time_ns, u, power_mw, static, dynamic, residual, average, state, limit_mw,
            self.characteristic.model_id,
        )  # fmt: skip


def no_prediction(
    time_ns: IntArray, u: FloatArray, power_mw: FloatArray, kinds: ByteArray
) -> PredictionBlock:
    """Return the block for rows before there is a curve."""
    nan = np.full(len(u), math.nan)
    state = np.where(
        kinds == NO_DATA, int(PredictionState.BAD_DATA), int(PredictionState.UNKNOWN)
    ).astype(np.uint8)
    return PredictionBlock(
        time_ns, u, power_mw, nan, nan, nan, nan, state, math.nan, ''
    )  # fmt: skip
