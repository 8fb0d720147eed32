"""A sparse model of the power: an ordinary differential equation, and where it rests."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from valveflow_ros.baselines import library
from valveflow_ros.fit.problem import Samples
from valveflow_ros.records import ByteArray, FloatArray

_START_S = 30.0  # power averaged to begin with after a gap
_PLACES = 400  # inputs at which the rest is searched, at least
_FINE_U = 0.25  # farthest apart where the rest swings with sin u or cos u: 25 to a period
_SWINGING = tuple(library.NAMES.index(name) for name in ('sin u', 'cos u'))
_GRID = 1500  # places at which a change of sign is looked for


@dataclass(frozen=True, slots=True)
class SparseModel:
    """y' = xi . theta(y, u).

    Attributes
    ----------
    xi : float64 (14,)
        MW/s per unit of each function; 0 is absent.
    u_from, u_to, power_from, power_to : float
        What the data it was made from covered.
    power_mean : float
        Their mean power.
    step_s : float
    """

    xi: FloatArray
    u_from: float
    u_to: float
    power_from: float
    power_to: float
    power_mean: float
    step_s: float

    @property
    def terms(self) -> tuple[str, ...]:
        """Return the names of the functions that are there."""
        return tuple(n for n, x in zip(library.NAMES, self.xi, strict=True) if x != 0.0)

    def run(self, samples: Samples) -> tuple[FloatArray, ByteArray]:
        """Return the simulated power in MW and where it has settled, shapes (n,).

        After a gap it begins at the measured power of the first half minute.
        """
        rows = max(1, round(_START_S / samples.step_s))
        begin = np.full(len(samples.u), self.power_mean)
        starts = np.flatnonzero(np.diff(samples.usable.astype(np.int8), prepend=0) == 1)
        for t in starts:
            part = slice(t, t + rows)
            begin[t] = np.mean(samples.power_mw[part][samples.usable[part] > 0])
        answer = np.empty(len(samples.u))
        settled = np.empty(len(samples.u), dtype=np.uint8)
        library.simulate(
            samples.u, samples.usable, begin, self.xi, samples.step_s,
            round(samples.settle_s / samples.step_s), answer, settled,
        )  # fmt: skip
        return answer, settled

    def static(self, u: FloatArray) -> FloatArray:
        """Return the power at which the model rests; NaN where it rests nowhere.

        A rest is a power where y' falls through zero. Where there are several, the
        curve goes on to the nearest from the middle of the data outwards. It is
        searched at evenly spaced inputs and straight between them, so ``u`` should hold no
        rows of gaps: they stretch the range that is searched.
        """
        u = np.asarray(u, dtype=np.float64)
        low, high = min(self.u_from, float(u.min())), max(self.u_to, float(u.max()))
        swings = bool(np.any(self.xi[list(_SWINGING)] != 0.0))
        count = math.ceil((high - low) / _FINE_U) + 1 if swings else 0
        places = np.linspace(low, high, max(_PLACES, count))
        return np.asarray(np.interp(u, places, self._rests(places)))

    def _rests(self, places: FloatArray) -> FloatArray:
        reach = 0.25 * (self.power_to - self.power_from)
        y = np.linspace(self.power_from - reach, self.power_to + reach, _GRID)
        curve = np.full(len(places), np.nan)
        middle = int(np.argmin(np.abs(places - 0.5 * (self.u_from + self.u_to))))
        for order in (range(middle, len(places)), range(middle, -1, -1)):
            near = curve[middle] if np.isfinite(curve[middle]) else self.power_mean
            for k in order:
                curve[k] = _rest(self.xi, float(places[k]), y, near)
                near = curve[k] if np.isfinite(curve[k]) else near
        return curve


def _rest(xi: FloatArray, u: float, y: FloatArray, near: float) -> float:
    """Return the stable rest nearest to ``near``, NaN if there is none."""
    values = library.columns(y, np.full(len(y), u)) @ xi
    falls = np.flatnonzero((values[:-1] > 0.0) & (values[1:] <= 0.0))
    if not len(falls):
        return float('nan')
    share = values[falls] / (values[falls] - values[falls + 1])
    rests = y[falls] + share * (y[1] - y[0])
    return float(rests[np.argmin(np.abs(rests - near))])
