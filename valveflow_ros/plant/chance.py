"""Random numbers and filters that go on from part to part.

Each source of chance has a generator of its own, made from the seed and the
number of the source. So a longer run begins with the shorter one, a run cut
into parts equals the run in one piece, and nothing that is switched on takes
numbers away from anything else.
"""

from __future__ import annotations

import enum

import numpy as np

from valveflow_ros.jit import jit
from valveflow_ros.records import FloatArray


class Source(enum.IntEnum):
    """The sources of chance; a number once given is never used for another."""

    LOAD = 1
    PULSES = 2
    PRESSURE = 3
    TEMPERATURE = 4
    JITTER = 5
    SLOW_NOISE = 6
    WHITE_NOISE = 7
    OPENING_SENSOR = 8
    PRESSURE_SENSOR = 9
    TEMPERATURE_SENSOR = 10
    WANDER_NOISE = 11


def generator(seed: int, source: Source) -> np.random.Generator:
    """Return the generator of one source."""
    return np.random.default_rng([seed, int(source)])


@jit
def _filter(drive: FloatArray, decay: float, gain: float, state: float) -> FloatArray:
    """Return s with ``s[t] = decay s[t-1] + gain drive[t]``, where s[-1] is ``state``."""
    out = np.empty_like(drive)
    for t in range(drive.size):
        state = decay * state + gain * drive[t]
        out[t] = state
    return out


class Wander:
    """An Ornstein-Uhlenbeck path of mean 0 and standard deviation 1, stationary from its start."""

    def __init__(self, rng: np.random.Generator, time_s: float, step_s: float) -> None:
        self._rng = rng
        self._decay = float(np.exp(-step_s / time_s))
        self._gain = float(np.sqrt(1.0 - self._decay**2))
        self._state = float(rng.standard_normal())

    def advance(self, count: int) -> FloatArray:
        """Return the next values, shape (count,)."""
        path = _filter(self._rng.standard_normal(count), self._decay, self._gain, self._state)
        if count:
            self._state = float(path[-1])
        return np.asarray(path)


class LowPass:
    """A first-order lag that starts in equilibrium with the first value it meets."""

    def __init__(self, time_s: float, step_s: float) -> None:
        self._decay = float(np.exp(-step_s / time_s))
        self._state = np.nan

    def advance(self, signal: FloatArray) -> FloatArray:
        """Return the filtered values, same shape."""
        if signal.size == 0:
            return signal
        if np.isnan(self._state):
            self._state = float(signal[0])
        out = _filter(signal, self._decay, 1.0 - self._decay, self._state)
        self._state = float(out[-1])
        return np.asarray(out)
