"""What a cause with a memory does to rows as they come.

Causes that need only the row at hand are asked by their own ``act``. Those here carry a state:
the same formulas as in the catalogue, with their own small classes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.curve.model import RegionalModel
from valveflow_ros.curve.regional_kernel import make_taps
from valveflow_ros.diagnosis import streaming_kernels as kernels
from valveflow_ros.diagnosis.cause import Active, Stage
from valveflow_ros.diagnosis.scene import Reference
from valveflow_ros.errors import DataError
from valveflow_ros.records import ByteArray, FloatArray, IntArray
from valveflow_ros.state import ArrayMemory, State, put_back

_DRAWS = 10  # as many as the catalogue's stiction averages over
_SEED = 20_240
_LONGEST_DELAY_S = 660.0


class Valve(Protocol):
    """A cause between the position sensor and the plug."""

    def feed(self, v: FloatArray, time_ns: IntArray) -> FloatArray:
        """Return the opening in % behind it, shape (n,); NaN is passed."""
        ...

    def snapshot(self) -> State:
        """Return what is remembered."""
        ...

    def restore(self, saved: State) -> None:
        """Go on from a state."""
        ...


class Stop(ArrayMemory):
    """A saturation, or any cause of the opening without a memory."""

    def __init__(self, active: Active, reference: Reference) -> None:
        del reference
        self._active = active

    def feed(self, v: FloatArray, time_ns: IntArray) -> FloatArray:
        """Return what the cause itself says."""
        del time_ns
        return np.asarray(self._active.cause.act(v, self._active.values, None), dtype=np.float64)


class Slack(ArrayMemory):
    """A backlash: the plug stays where it is until a flank reaches it."""

    def __init__(self, active: Active, reference: Reference) -> None:
        del reference
        self._half = 0.5 * active.values[0]
        self._state = np.full(1, np.nan)

    def feed(self, v: FloatArray, time_ns: IntArray) -> FloatArray:
        """Follow, keeping the place over gaps."""
        del time_ns
        out = np.empty(len(v))
        kernels.play(v, self._half, self._state, out)
        return out

    def _memory(self) -> dict[str, NDArray[Any]]:
        return {'place': self._state}


class SlowServo(ArrayMemory):
    """A rate limit, by the time between rows."""

    def __init__(self, active: Active, reference: Reference) -> None:
        del reference
        self._rate = active.values[0]
        self._state, self._last_ns = np.full(1, np.nan), np.zeros(1, dtype=np.int64)

    def feed(self, v: FloatArray, time_ns: IntArray) -> FloatArray:
        """Follow; what was missed in a gap is made up for."""
        out = np.empty(len(v))
        kernels.rate_limit(v, time_ns, self._rate, self._state, self._last_ns, out)
        return out

    def _memory(self) -> dict[str, NDArray[Any]]:
        return {'place': self._state, 'last_ns': self._last_ns}


class Sticking:
    """A stiction, averaged over draws of the sensor's noise.

    The catalogue takes the noise from the record; here it is the one the model was made
    with. The draws come from a generator of their own, row by row, so that blocks do
    not matter and a replay repeats them. They all count alike: the diagnosis weighs them
    by the power measured (`draws`), which explains somewhat more, but would let the
    measured power into its own prediction.
    """

    def __init__(self, active: Active, reference: Reference) -> None:
        self._band, self._jump = active.values[0], min(active.values[1], active.values[0])
        self._noise = reference.opening_noise
        self._state = np.full(_DRAWS, np.nan)
        self._chance = np.random.default_rng(_SEED)

    def feed(self, v: FloatArray, time_ns: IntArray) -> FloatArray:
        """Return the mean place of the plug."""
        del time_ns
        out = np.empty(len(v))
        noise = self._noise * self._chance.standard_normal((len(v), _DRAWS))
        kernels.stick_slip(v, noise, self._band, self._jump, self._state, out)
        return out

    def snapshot(self) -> State:
        """Return what is remembered, the generator's place among it."""
        return {'places': self._state.copy(), 'chance': self._chance.bit_generator.state}

    def restore(self, saved: State) -> None:
        """Go on from a state; raises `DataError` if it does not fit."""
        put_back({'places': self._state}, saved)
        self._chance.bit_generator.state = saved['chance']


class Response(ArrayMemory):
    """Regional dynamics, run on a flow as it comes."""

    def __init__(self, model: RegionalModel, step_s: float) -> None:
        self._levels, self._taps = model.levels, model.taps(step_s)
        self._place, self._answer = np.zeros(2, dtype=np.int64), np.zeros(1)
        self._past = np.zeros(int(_LONGEST_DELAY_S / step_s) + 4)

    def feed(self, x: FloatArray, begin: ByteArray) -> FloatArray:
        """Return the power in MW, NaN without data."""
        out = np.empty(len(x))
        kernels.respond(
            x, begin, self._levels, self._taps, self._place, self._answer, self._past, out
        )
        return out

    def _memory(self) -> dict[str, NDArray[Any]]:
        return {'place': self._place, 'answer': self._answer, 'past': self._past}


class Refill(ArrayMemory):
    """A reheater behind part of the turbine."""

    def __init__(self, active: Active, step_s: float) -> None:
        self._share = active.values[0]
        self._taps = make_taps(np.array([active.values[1]]), np.zeros(1), step_s)[0]
        self._state = np.zeros(2)

    def feed(self, y: FloatArray, begin: ByteArray) -> FloatArray:
        """Return the power shown."""
        late = np.empty(len(y))
        kernels.lag(y, begin, self._taps, self._state, late)
        return np.asarray(self._share * y + (1.0 - self._share) * late)

    def _memory(self) -> dict[str, NDArray[Any]]:
        return {'state': self._state}


class LateClock(ArrayMemory):
    """A series as it was some time ago."""

    def __init__(self, delay_s: float, step_s: float) -> None:
        late = delay_s / step_s
        self._whole = int(np.floor(late))
        self._part = late - self._whole
        self._place, self._past = np.zeros(2, dtype=np.int64), np.zeros(self._whole + 2)

    def feed(self, y: FloatArray, jumps: ByteArray) -> FloatArray:
        """Return the series delayed; NaN where what it was is not known."""
        out = np.empty(len(y))
        kernels.delay(y, jumps, self._whole, self._part, self._place, self._past, out)
        return out

    def _memory(self) -> dict[str, NDArray[Any]]:
        return {'place': self._place, 'past': self._past}


_VALVES: dict[str, Callable[[Active, Reference], Valve]] = {
    'backlash': Slack,
    'stiction': Sticking,
    'rate_limit': SlowServo,
    'saturation': Stop,
}
REFILL, CLOCK = 'reheater', 'clock'
_SHOWN = {REFILL, CLOCK, 'output_offset_drift'}


def valves(chain: tuple[Active, ...], reference: Reference) -> list[Valve]:
    """Return what causes of the opening do, from the oil to the plug."""
    return [_VALVES[a.name](a, reference) for a in sorted(chain, key=lambda a: a.cause.order)]


def check_streams(active: tuple[Active, ...]) -> None:
    """Refuse a cause whose memory is not known here.

    Raises
    ------
    DataError
    """
    for a in active:
        known = {Stage.OPENING: set(_VALVES), Stage.OUTPUT: _SHOWN}.get(a.cause.stage)
        if known is not None and a.name not in known:
            raise DataError(f"The cause '{a.name}' cannot be taken out of rows as they come yet.")
