# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The power expected from a curve, row by row, and the residual of the plant."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.regional_model import curve, lag_step, region_of
from valveflow_ros.fit.residual_chart import ResidualChart
from valveflow_ros.numerics import jit
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S, ByteArray, FloatArray, IntArray
from valveflow_ros.segments.kernel import NO_DATA, SETTLED_SLOPE, SETTLED_STEADY
from valveflow_ros.signals.static_form import PAPER_EXPONENT
from valveflow_ros.state import Memory

_LONGEST_DELAY_S = 600.0
_AGE, _PLACE, _LAST_NS = range(3)
_ANSWER, _AVERAGE = range(2)


class PredictionState(enum.IntEnum):
    """The validity of a residual; the message uses the same numbers."""

    UNKNOWN = 0
    TRANSIENT = 1
    STEADY = 2
    SLOPE = 3
    OUTSIDE = 4
    BAD_DATA = 5


@dataclass(frozen=True, slots=True)
class PredictionBlock:
    """Predictions for consecutive rows; all arrays have shape (n,)."""

    time_ns: IntArray
    u: FloatArray  # argument of the curve: integrated input, % MPa^m, or opening, %
    # NaN where unknown. The residual is measured minus dynamic prediction, or minus static
    # prediction in settled rows when no dynamics are known.
    measured_mw: FloatArray
    static_mw: FloatArray
    dynamic_mw: FloatArray
    residual_mw: FloatArray
    average_mw: FloatArray  # running mean of the residual; NaN before the first
    evidence: FloatArray  # of the alarm: beyond 1 or -1 the plant has left the curve
    shift_mw: FloatArray  # shift that corresponds to the evidence
    state: ByteArray  # a `PredictionState`
    width_mw: float  # 95 % of the measurements lie within +- this; NaN without a curve
    model_id: str

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.time_ns)


class _Filter(NamedTuple):
    """The curve, the dynamics and the state of the filter."""

    knots: FloatArray
    left: FloatArray
    right: FloatArray
    offset: float  # MW
    levels: FloatArray
    taps: FloatArray  # (I, 7), empty if the dynamics are unknown
    settle: int  # rows
    forget: float
    gap_ns: int  # rows with a larger time difference are separated by a gap
    place: IntArray  # rows since the last gap, index in the ring buffer, time of the last row
    memory: FloatArray  # filter output, mean of the residual
    past: FloatArray  # ring buffer of flows


class _Columns(NamedTuple):
    """The output arrays, one value per row."""

    static: FloatArray
    dynamic: FloatArray
    residual: FloatArray
    average: FloatArray
    state: ByteArray


@jit
def _filter(f: _Filter, x: float) -> None:
    age = f.place[_AGE]
    place = f.place[_PLACE]
    f.past[place] = x
    if f.taps.shape[0] > 0:
        tap = f.taps[region_of(x, f.levels)]
        before = x if age == 0 else f.memory[_ANSWER]
        f.memory[_ANSWER] = lag_step(f.past, place, age, tap, before)
    f.place[_PLACE] = (place + 1) % f.past.size
    f.place[_AGE] = age + 1


@jit
def _state_of(inside: bool, kind: int) -> int:
    if not inside:
        return 4
    if kind == SETTLED_STEADY:
        return 2
    return 3 if kind == SETTLED_SLOPE else 1


@jit
def _predict(
    time_ns: IntArray, u: FloatArray, scale: FloatArray, y: FloatArray, kinds: ByteArray,
    f: _Filter, out: _Columns,
) -> None:  # fmt: skip
    known = f.taps.shape[0] > 0
    for t in range(u.size):
        out.static[t] = out.dynamic[t] = out.residual[t] = np.nan
        out.average[t] = f.memory[_AVERAGE]
        step_ns = time_ns[t] - f.place[_LAST_NS]
        f.place[_LAST_NS] = time_ns[t]
        if step_ns > f.gap_ns or step_ns <= 0:
            f.place[_AGE] = 0
            f.memory[_AVERAGE] = np.nan
            out.average[t] = np.nan
        if kinds[t] == NO_DATA or not (math.isfinite(u[t]) and math.isfinite(y[t])):
            f.place[_AGE] = 0
            out.state[t] = 5
            continue
        x = scale[t] * curve(u[t], f.knots, f.left, f.right) + f.offset
        inside = f.knots[0] <= u[t] <= f.knots[-1]
        _filter(f, x)
        out.state[t] = _state_of(inside, kinds[t])
        if not inside:
            continue
        out.static[t] = x
        if known and f.place[_AGE] > f.settle:
            out.dynamic[t] = f.memory[_ANSWER]
            out.residual[t] = y[t] - out.dynamic[t]
        elif not known and kinds[t] != 0:
            out.residual[t] = y[t] - x
        else:
            continue
        mean = 0.0 if math.isnan(f.memory[_AVERAGE]) else f.memory[_AVERAGE]
        f.memory[_AVERAGE] = f.forget * mean + (1.0 - f.forget) * out.residual[t]
        out.average[t] = f.memory[_AVERAGE]


class Predictor(Memory):
    """Predict from one curve, recursively, in constant time per row.

    After a gap the dynamic prediction is valid from ``settle_s`` on. ``average_s`` is the time
    constant of the residual's running mean. With a ``limit_mw`` above zero the evidence is this
    mean divided by the limit; otherwise it is that of the control chart of the curve. ``exponent``
    is the m of the u = V p^m in the rows.
    """

    REMEMBERED = ('_place', '_memory', '_past', '_chart')

    def __init__(
        self,
        characteristic: Characteristic,
        step_s: float,
        settle_s: float,
        average_s: float,
        limit_mw: float = 0.0,
        exponent: float = PAPER_EXPONENT,
    ) -> None:
        self.characteristic = characteristic
        self._form, self._exponent = characteristic.static_form, exponent
        self.limit_mw = limit_mw
        design = characteristic.residuals.chart
        self._chart = None if design is None else ResidualChart(design, step_s)
        m = characteristic.model
        self._place = np.zeros(3, dtype=np.int64)
        self._memory = np.array([0.0, math.nan])
        self._past = np.zeros(int(_LONGEST_DELAY_S / step_s) + 4)
        self._filter = _Filter(
            m.knots, m.left, m.right, m.offset, m.levels, m.taps(step_s),
            settle=round(settle_s / step_s),
            forget=math.exp(-step_s / average_s),
            gap_ns=round(1.5 * step_s * NS_PER_S),
            place=self._place,
            memory=self._memory,
            past=self._past,
        )  # fmt: skip

    @classmethod
    def of(cls, characteristic: Characteristic, settings: Settings) -> Predictor:
        """Return the predictor for a curve with these settings."""
        return cls(
            characteristic, settings.real('sample_period'), settings.settle_s,
            settings.real('alarm_average'), settings.real('alarm_limit'),
            settings.real('pressure_exponent'),
        )  # fmt: skip

    def configure(self, settings: Settings) -> None:
        """Apply the fixed limit and the time constant of the running mean; the mean continues."""
        self.limit_mw = settings.real('alarm_limit')
        forget = math.exp(-settings.real('sample_period') / settings.real('alarm_average'))
        self._filter = self._filter._replace(forget=forget)

    @property
    def warm_up_rows(self) -> int:
        """Return the number of rows until the filter has settled."""
        return 2 * self._filter.settle + 1

    def follow(self, other: Predictor) -> None:
        """Copy the evidence that the chart of an earlier curve had accumulated."""
        if self._chart is not None and other._chart is not None:
            self._chart.follow(other._chart)

    def warm_up(
        self, time_ns: IntArray, u: FloatArray, power_mw: FloatArray,
        opening_percent: FloatArray | None = None,
    ) -> None:  # fmt: skip
        """Run over past rows; the mean of the residual is reset afterwards."""
        kinds = np.full(len(u), SETTLED_STEADY, dtype=np.uint8)
        self._rows(time_ns, *self._input(u, opening_percent), power_mw, kinds)
        self._filter.memory[_AVERAGE] = math.nan

    def predict(
        self, time_ns: IntArray, u: FloatArray, power_mw: FloatArray, kinds: ByteArray,
        opening_percent: FloatArray | None = None,
    ) -> PredictionBlock:  # fmt: skip
        """Predict rows of shape (n,); ``kinds`` are those of the segmenter.

        ``u`` is V p^m. Curves with another input need the opening, and give no data without it.
        """
        u, scale = self._input(u, opening_percent)
        out = self._rows(time_ns, u, scale, power_mw, kinds)
        evidence = shift = np.full(len(u), math.nan)
        if self._chart is not None:
            evidence, shift = self._chart.feed(time_ns, out.residual)
        if self.limit_mw > 0.0:
            evidence, shift = out.average / self.limit_mw, out.average
        return PredictionBlock(
            time_ns, u, power_mw, out.static, out.dynamic, out.residual, out.average, evidence,
            shift, out.state, self.characteristic.residuals.width_mw,
            self.characteristic.model_id,
        )  # fmt: skip

    def _input(
        self, u: FloatArray, opening_percent: FloatArray | None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the argument of the curve and its factor."""
        if opening_percent is None:
            opening_percent = np.full(len(u), math.nan)
        x, scale = self._form.of_integrated_input(u, opening_percent, self._exponent)
        return x, np.ones(len(u)) if scale is None else scale

    def _rows(
        self, time_ns: IntArray, u: FloatArray, scale: FloatArray, power_mw: FloatArray,
        kinds: ByteArray,
    ) -> _Columns:  # fmt: skip
        static, dynamic, residual, average = np.empty((4, len(u)))
        state = np.empty(len(u), dtype=np.uint8)
        out = _Columns(static, dynamic, residual, average, state)
        _predict(time_ns, u, scale, power_mw, kinds, self._filter, out)
        return out


def no_prediction(
    time_ns: IntArray, u: FloatArray, power_mw: FloatArray, kinds: ByteArray
) -> PredictionBlock:
    """Return the block for rows without a curve."""
    nan = np.full(len(u), math.nan)
    state = (PredictionState.BAD_DATA * (kinds == NO_DATA)).astype(np.uint8)
    return PredictionBlock(
        time_ns, u, power_mw, nan, nan, nan, nan, nan, nan, state, math.nan, ''
    )  # fmt: skip
