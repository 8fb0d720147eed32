"""Four asynchronous signals become one table on a time grid.

A row stands at each multiple of the sample period. It holds, for each signal,
the newest value whose stamp is not after the row (zero-order hold), as long as
that value is not older than the hold limit. A row is closed as soon as every
required signal has spoken after it, or when any signal is `lateness` past it.
Which rows come out, and what stands in them, depends only on the readings in
their order, so a recording gives back the rows of the live run.

Nothing is dropped without a count; see `REASONS`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np

from valveflow_ros.config import Settings
from valveflow_ros.core.jit import JIT
from valveflow_ros.records import (
    N_SIGNALS,
    NS_PER_S,
    SIGNALS,
    ByteArray,
    FloatArray,
    IntArray,
    Quality,
    Readings,
    SampleTable,
    Signal,
)

REASONS = (
    'accepted',  # taken into the table
    'not_finite',  # NaN or infinite
    'bad_quality',  # the sender itself calls it bad
    'impossible',  # outside the plausible range of its signal
    'duplicate',  # same stamp as the one before
    'out_of_order',  # older than the newest of its own signal
    'time_outlier',  # stamp far from everybody else's and not confirmed
    'late',  # taken, but rows it belonged to were closed already
)
_ACCEPTED, _NOT_FINITE, _BAD, _IMPOSSIBLE, _DUPLICATE, _ORDER, _OUTLIER, _LATE = range(8)

_AHEAD_CONFIRMED = 3  # readings that must agree before a leap forward is believed
_BEHIND_CONFIRMED = 20  # and before the clock is believed to have gone back
_NEVER = np.iinfo(np.int64).min

# Places in the integer state.
_NEXT, _NEWEST, _PENDING, _RESETS, _ROWS = range(5)


@dataclass(frozen=True, slots=True)
class Aligned:
    """What came out of one call: rows, and where a restart of the clock lies among them.

    Attributes
    ----------
    table : SampleTable
        The rows closed.
    resets : int64 (k,)
        Row numbers within ``table`` before which the clock was set back.
    """

    table: SampleTable
    resets: IntArray


@numba.njit(**JIT)
def _accept(
    time_ns: int,
    s: int,
    v: float,
    q: int,
    clock: IntArray,
    held_ns: IntArray,
    held: FloatArray,
    held_q: ByteArray,
    counts: IntArray,
    period_ns: int,
) -> None:
    """Take one checked reading into the held values."""
    if time_ns == held_ns[s]:
        counts[s, _DUPLICATE] += 1
        return
    if time_ns < held_ns[s]:
        counts[s, _ORDER] += 1
        return
    if clock[_NEXT] == _NEVER:
        clock[_NEXT] = -((-time_ns) // period_ns) * period_ns
    elif time_ns <= clock[_NEXT] - period_ns:
        counts[s, _LATE] += 1
    held_ns[s] = time_ns
    held[s] = v
    held_q[s] = q
    counts[s, _ACCEPTED] += 1
    clock[_NEWEST] = max(clock[_NEWEST], time_ns)


@numba.njit(**JIT)
def _can_close(
    clock: IntArray, held_ns: IntArray, required: ByteArray, lateness_ns: int, hold_ns: int
) -> bool:
    """Tell whether the next row can no longer change."""
    tick = clock[_NEXT]
    if clock[_NEWEST] >= tick + lateness_ns:
        return True
    for s in range(held_ns.size):
        # An optional signal is waited for only while it is being sent.
        expected = required[s] or held_ns[s] >= tick - hold_ns
        if expected and held_ns[s] < tick:
            return False
    return True


@numba.njit(**JIT)
def _check(v: float, q: int, low: float, high: float) -> int:
    """Return the reason to refuse a value, or `_ACCEPTED`."""
    if not math.isfinite(v):
        return _NOT_FINITE
    if q >= 2:
        return _BAD
    if not low <= v <= high:
        return _IMPOSSIBLE
    return _ACCEPTED


@numba.njit(**JIT)
def _align(
    time_ns: IntArray,
    signal: ByteArray,
    value: FloatArray,
    quality: ByteArray,
    clock: IntArray,
    held_ns: IntArray,
    held: FloatArray,
    held_q: ByteArray,
    wait_ns: IntArray,
    wait_s: IntArray,
    wait_v: FloatArray,
    wait_q: IntArray,
    counts: IntArray,
    limits: FloatArray,
    required: ByteArray,
    spans: IntArray,
    out_ns: IntArray,
    out: FloatArray,
    out_q: ByteArray,
    resets: IntArray,
    final: bool,
) -> tuple[int, int, int]:
    """Run over readings until they or the room for rows end.

    Returns the readings consumed, the rows written and the resets met.
    ``spans`` is (period, lateness, hold limit, clock jump) in ns.
    """
    period, lateness, hold, jump = spans[0], spans[1], spans[2], spans[3]
    n_out = 0
    n_resets = 0
    i = 0
    while True:
        # Close every row that is ready before looking at the next reading.
        while clock[_NEXT] != _NEVER and n_out < out_ns.size:
            tick = clock[_NEXT]
            ready = _can_close(clock, held_ns, required, lateness, hold)
            if final and i >= time_ns.size and tick <= clock[_NEWEST]:
                ready = True
            if not ready:
                break
            oldest_needed = tick - hold
            alive = False
            for s in range(held_ns.size):
                if oldest_needed <= held_ns[s] <= tick:
                    out[n_out, s] = held[s]
                    out_q[n_out, s] = held_q[s]
                    alive = True
                else:
                    out[n_out, s] = np.nan
                    out_q[n_out, s] = 2
            if alive:
                out_ns[n_out] = tick
                n_out += 1
                clock[_NEXT] = tick + period
            else:
                # Nobody has spoken for long: the grid goes on where somebody does.
                first = clock[_NEWEST]
                for s in range(held_ns.size):
                    if held_ns[s] > tick:
                        first = min(first, held_ns[s])
                clock[_NEXT] = max(tick + period, -((-first) // period) * period)
        if n_out >= out_ns.size or i >= time_ns.size:
            return i, n_out, n_resets
        s = signal[i]
        why = _check(value[i], quality[i], limits[s, 0], limits[s, 1])
        if why != _ACCEPTED:
            counts[s, why] += 1
            i += 1
            continue
        t = time_ns[i]
        newest = clock[_NEWEST]
        off = newest != _NEVER and (t > newest + jump or t < newest - jump)
        if not off:
            for k in range(clock[_PENDING]):
                counts[wait_s[k], _OUTLIER] += 1
            clock[_PENDING] = 0
            _accept(t, s, value[i], quality[i], clock, held_ns, held, held_q, counts, period)
            i += 1
            continue
        n_wait = clock[_PENDING]
        if n_wait > 0 and abs(t - wait_ns[n_wait - 1]) > jump:
            for k in range(n_wait):
                counts[wait_s[k], _OUTLIER] += 1
            n_wait = 0
        wait_ns[n_wait], wait_s[n_wait] = t, s
        wait_v[n_wait], wait_q[n_wait] = value[i], quality[i]
        n_wait += 1
        clock[_PENDING] = n_wait
        i += 1
        ahead = t > newest
        if n_wait >= (_AHEAD_CONFIRMED if ahead else _BEHIND_CONFIRMED):
            if not ahead:
                resets[n_resets] = n_out
                n_resets += 1
                clock[_RESETS] += 1
                clock[_NEWEST] = _NEVER
                clock[_NEXT] = _NEVER
                held_ns[:] = _NEVER
            for k in range(n_wait):
                _accept(
                    wait_ns[k], wait_s[k], wait_v[k], wait_q[k],
                    clock, held_ns, held, held_q, counts, period,
                )  # fmt: skip
            clock[_PENDING] = 0


class Aligner:
    """Turn readings into rows, in one pass and bounded memory.

    Parameters
    ----------
    settings : Settings
        Sample period, hold limit, lateness, clock jump, plausible ranges.
    """

    _ROOM = 65536  # rows a single call of the kernel can write

    def __init__(self, settings: Settings) -> None:
        period = settings.real('sample_period')
        self._spans = np.array(
            [
                round(period * NS_PER_S),
                round(settings.real('lateness') * NS_PER_S),
                round(settings.real('hold_limit') * NS_PER_S),
                round(max(settings.real('clock_jump'), 3.0 * period) * NS_PER_S),
            ],
            dtype=np.int64,
        )
        self._limits = np.empty((N_SIGNALS, 2))
        for info in SIGNALS:
            name = 'valve_opening' if info.signal == Signal.VALVE_COMMAND else info.topic
            self._limits[info.signal] = (
                settings.real(f'{name}_low'),
                settings.real(f'{name}_high'),
            )
        self._required = np.array([info.required for info in SIGNALS], dtype=np.uint8)
        self._clock = np.zeros(5, dtype=np.int64)
        self._clock[_NEXT] = self._clock[_NEWEST] = _NEVER
        self._held_ns = np.full(N_SIGNALS, _NEVER, dtype=np.int64)
        self._held = np.full(N_SIGNALS, np.nan)
        self._held_q = np.full(N_SIGNALS, int(Quality.BAD), dtype=np.uint8)
        self._wait_ns = np.zeros(_BEHIND_CONFIRMED, dtype=np.int64)
        self._wait_s = np.zeros(_BEHIND_CONFIRMED, dtype=np.int64)
        self._wait_v = np.zeros(_BEHIND_CONFIRMED)
        self._wait_q = np.zeros(_BEHIND_CONFIRMED, dtype=np.int64)
        self._counts = np.zeros((N_SIGNALS, len(REASONS)), dtype=np.int64)

    def feed(self, readings: Readings) -> Aligned:
        """Take readings in their order of arrival and return the rows they close."""
        return self._run(readings, final=False)

    def finish(self) -> Aligned:
        """Close the rows up to the newest stamp; for the end of a file."""
        return self._run(Readings.of([]), final=True)

    def counts(self) -> dict[str, dict[str, int]]:
        """Return what became of the readings: ``{topic: {reason: count}}``."""
        return {
            info.topic: {
                reason: int(self._counts[info.signal, k]) for k, reason in enumerate(REASONS)
            }
            for info in SIGNALS
        }

    def _run(self, readings: Readings, final: bool) -> Aligned:
        tables: list[SampleTable] = []
        resets: list[int] = []
        done = rows = 0
        room = self._ROOM if len(readings) > 64 or final else 256
        while True:
            out_ns = np.empty(room, dtype=np.int64)
            out = np.empty((room, N_SIGNALS))
            out_q = np.empty((room, N_SIGNALS), dtype=np.uint8)
            found = np.empty(max(1, len(readings)), dtype=np.int64)
            consumed, written, n_resets = _align(
                readings.time_ns[done:],
                readings.signal[done:],
                readings.value[done:],
                readings.quality[done:],
                self._clock,
                self._held_ns,
                self._held,
                self._held_q,
                self._wait_ns,
                self._wait_s,
                self._wait_v,
                self._wait_q,
                self._counts,
                self._limits,
                self._required,
                self._spans,
                out_ns,
                out,
                out_q,
                found,
                final,
            )
            done += consumed
            resets += [rows + int(k) for k in found[:n_resets]]
            rows += written
            tables.append(SampleTable(out_ns[:written], out[:written], out_q[:written]))
            if written < room:
                break
        table = tables[0] if len(tables) == 1 else SampleTable.concatenate(tables)
        return Aligned(table, np.array(resets, dtype=np.int64))
