"""A record on the grids the diagnosis works on: fine rows, model rows, scored means, blocks."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from valveflow_ros.diagnosis import kernels
from valveflow_ros.records import NS_PER_S, BoolArray, ByteArray, FloatArray

DAY_S = 86_400.0
SUBS_IN_BLOCK = 8
FOLDS = 5
SEALED_FOLD = 4
ORDER = 4


@dataclass(frozen=True, slots=True)
class Reference:
    """What causes count from; kept with an extended model, so that it means the same elsewhere.

    Attributes
    ----------
    span_s : float
        Length of the record.
    temperature_degc, log_pressure : float
        Means over it.
    pressure_level, pressure_slope : float
        Line of the sliding pressure over the power, MPa and MPa per MW.
    opening_noise : float
        Standard deviation of the white noise of the opening, %; 0 where it is not known.
    """

    span_s: float
    temperature_degc: float
    log_pressure: float
    pressure_level: float
    pressure_slope: float
    opening_noise: float = 0.0


@dataclass(frozen=True, slots=True)
class Scene:
    """Everything measured, as arrays that the model and the statistics need.

    Attributes
    ----------
    start_ns, fine_s, step_s : int, float, float
        Time of the first row, step of the fine rows and of the model rows.
    v, density : float64 (nn,)
        Opening in % and p^m on the fine grid, NaN where there is none.
    command : float64 (nn,)
        Commanded opening in %, NaN where there is none.
    u, pressure, temperature, time_s : float64 (n,)
        Model rows: integrated input, MPa, degC, seconds since the first row.
    usable : uint8 (n,)
    power : float64 (m,)
        Scored means of the power in MW; 0 where not scored.
    scored : bool (m,)
        Means with power whose inputs have settled.
    whole : bool (m,)
        Scored, with the history that whitening needs.
    sub : int64 (m,)
        Which sub-block a mean lies in.
    reference : Reference
    """

    start_ns: int
    fine_s: float
    step_s: float
    settle_s: float
    exponent: float
    v: FloatArray
    density: FloatArray
    command: FloatArray
    u: FloatArray
    pressure: FloatArray
    temperature: FloatArray
    time_s: FloatArray
    usable: ByteArray
    power: FloatArray
    scored: BoolArray
    whole: BoolArray
    sub: np.ndarray
    reference: Reference
    cache: dict[object, FloatArray] = field(default_factory=dict)

    @property
    def group(self) -> int:
        """Return the number of model rows in a scored mean."""
        return len(self.u) // len(self.power)

    @property
    def mean_s(self) -> float:
        """Return the length of a scored mean."""
        return self.group * self.step_s

    @property
    def subs(self) -> int:
        """Return the number of sub-blocks."""
        return int(self.sub[-1]) + 1

    @property
    def block_of_sub(self) -> np.ndarray:
        """Return the block each sub-block lies in, shape (subs,)."""
        return np.arange(self.subs) // SUBS_IN_BLOCK

    @property
    def fold_of_sub(self) -> np.ndarray:
        """Return the fold of each sub-block; `SEALED_FOLD` is sealed."""
        return self.block_of_sub % FOLDS

    @property
    def days(self) -> float:
        """Return the time from first to last row in days."""
        return float(len(self.u) * self.step_s / DAY_S)

    @property
    def open_rows(self) -> BoolArray:
        """Return the whole means outside the sealed blocks, shape (m,)."""
        return np.asarray(self.whole & (self.fold_of_sub[self.sub] != SEALED_FOLD))

    @property
    def sealed_rows(self) -> BoolArray:
        """Return the whole means inside the sealed blocks, shape (m,)."""
        return np.asarray(self.whole & (self.fold_of_sub[self.sub] == SEALED_FOLD))

    @property
    def sub_middle_s(self) -> FloatArray:
        """Return the middle of each sub-block, seconds since the first row."""
        count = np.bincount(self.sub, minlength=self.subs)
        ends = np.cumsum(count) * self.mean_s
        return np.asarray(ends - 0.5 * count * self.mean_s)

    def clock_s(self, time_s: FloatArray) -> FloatArray:
        """Return the seconds since a midnight UTC of times since the first row."""
        first = self.start_ns % (int(DAY_S) * NS_PER_S) / NS_PER_S
        return np.asarray(np.mod(time_s + first, DAY_S))

    def means(self, rows: FloatArray) -> FloatArray:
        """Return means of model rows over the scored means, (n,) to (m,)."""
        out = np.empty(len(self.power))
        kernels.means(rows, self.group, out)
        return out

    def coarse(self, fine: FloatArray) -> FloatArray:
        """Return means of fine rows over the model rows, (nn,) to (n,)."""
        out = np.empty(len(self.u))
        kernels.means(fine, len(fine) // len(self.u), out)
        return out
