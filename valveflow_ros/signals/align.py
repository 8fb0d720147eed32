# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Alignment of asynchronous signals to one table on a time grid.

There is a row at each multiple of the sample period. It contains, for each signal,
the newest value with a stamp not after the row (zero-order hold), unless that value
is older than the hold limit. A row is closed as soon as every required signal has a
reading after it, or when any signal is later than the row by `lateness`. The rows
depend only on the readings and their order, so a replay of a recording gives the
same rows as the live run.

All dropped readings are counted; see `REASONS`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from valveflow_ros import state
from valveflow_ros.numerics import copied, helper, inlined, jit
from valveflow_ros.parameters import Settings
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
from valveflow_ros.signals.covariates import Arriving

# The loop that converts readings into rows; the module docstring describes the rules.

REASONS = (
    'accepted',  # used for the table
    'not_finite',  # NaN or infinite
    'bad_quality',  # the sender marked it as bad quality, or set no quality
    'impossible',  # outside the plausible range of its signal
    'duplicate',  # same stamp as the previous one
    'out_of_order',  # older than the newest of its own signal
    'time_outlier',  # stamp impossible, or far from the others and not confirmed
    'late',  # used, but its rows were closed already
)
_ACCEPTED, _NOT_FINITE, _BAD, _IMPOSSIBLE, _DUPLICATE, _ORDER, _OUTLIER, _LATE = range(8)

_AHEAD_CONFIRMED = 3  # instants that must agree before a jump forward is accepted
BEHIND_CONFIRMED = 20  # the same for a step back
NEVER = np.iinfo(np.int64).min
_LATEST_NS = 2**62  # the year 2116; later stamps would overflow

# Indices in the clock array.
_NEXT, NEWEST, _WAITING, _BELIEVED, _RESETS = range(5)


class State(NamedTuple):
    """The state of the kernel: arrays that it changes."""

    clock: IntArray  # next row, newest accepted stamp, waiting readings, confirmed ones, resets
    newest_ns: IntArray  # (5,) newest stamp of each signal
    held_ns: IntArray  # (5,) the newest value not after the next row
    held: FloatArray
    held_quality: ByteArray
    open_row: IntArray  # (5, spare) values for open rows: row number, stamp, value
    open_ns: IntArray
    open_value: FloatArray
    open_quality: ByteArray
    wait_ns: IntArray  # readings far off in time, waiting for confirmation
    wait_signal: IntArray
    wait: FloatArray
    wait_quality: ByteArray
    counts: IntArray  # (5, reasons)


def plausible_ranges(settings: Settings) -> FloatArray:
    """Return the lowest and highest possible value of each signal, (5, 2)."""
    limits = np.empty((N_SIGNALS, 2))
    for info in SIGNALS:
        name = 'valve_opening' if info.signal == Signal.VALVE_COMMAND else info.topic
        limits[info.signal] = settings.real(f'{name}_low'), settings.real(f'{name}_high')
    return limits


class Rules(NamedTuple):
    """The settings of the kernel."""

    limits: FloatArray  # (5, 2) plausible range of each signal
    required: ByteArray  # (5,)
    period_ns: int
    lateness_ns: int
    hold_ns: int
    jump_ns: int
    spare: int  # maximum number of open rows


class AlignedRows(NamedTuple):
    """Output arrays of the kernel."""

    time_ns: IntArray
    values: FloatArray
    quality: ByteArray


@inlined
def _accept(state: State, rules: Rules, time_ns: int, s: int, v: float, q: int) -> None:
    """Accept one checked reading: as held value, or for the open row to which it belongs."""
    if time_ns <= state.newest_ns[s]:
        why = _DUPLICATE if time_ns == state.newest_ns[s] else _ORDER
        state.counts[s, why] += 1
        return
    clock = state.clock
    row = -((-time_ns) // rules.period_ns)
    if clock[_NEXT] == NEVER:
        clock[_NEXT] = row * rules.period_ns
    elif time_ns <= clock[_NEXT] - rules.period_ns:
        state.counts[s, _LATE] += 1
    state.newest_ns[s] = time_ns
    state.counts[s, _ACCEPTED] += 1
    clock[NEWEST] = max(clock[NEWEST], time_ns)
    if time_ns <= clock[_NEXT]:
        state.held_ns[s], state.held[s], state.held_quality[s] = time_ns, v, q
        return
    k = row % rules.spare
    state.open_row[s, k], state.open_ns[s, k] = row, time_ns
    state.open_value[s, k], state.open_quality[s, k] = v, q


@inlined
def _can_close(state: State, rules: Rules) -> bool:
    """Return True if the next row can no longer change."""
    tick = state.clock[_NEXT]
    if state.clock[NEWEST] >= tick + rules.lateness_ns:
        return True
    for s in range(state.newest_ns.size):
        # Wait for an optional signal only while it is being sent.
        expected = rules.required[s] or state.newest_ns[s] >= tick - rules.hold_ns
        if expected and state.newest_ns[s] < tick:
            return False
    return True


@inlined
def _close(state: State, rules: Rules, rows: AlignedRows, place: int, coming_ns: int) -> bool:
    """Write the next row, if there was a recent reading, and advance to the following one.

    ``coming_ns`` is the stamp of a reading that is about to be accepted.
    """
    tick = state.clock[_NEXT]
    number = tick // rules.period_ns
    k = number % rules.spare
    alive = False
    for s in range(state.held_ns.size):
        if state.open_row[s, k] == number and state.open_ns[s, k] > state.held_ns[s]:
            state.held_ns[s], state.held[s] = state.open_ns[s, k], state.open_value[s, k]
            state.held_quality[s] = state.open_quality[s, k]
        if tick - rules.hold_ns <= state.held_ns[s] <= tick:
            rows.values[place, s] = state.held[s]
            rows.quality[place, s] = state.held_quality[s]
            alive = True
        else:
            rows.values[place, s] = np.nan
            rows.quality[place, s] = 2
    state.clock[_NEXT] = tick + rules.period_ns
    if alive:
        rows.time_ns[place] = tick
        return True
    # After a long time without readings the grid continues at the next reading.
    first = coming_ns
    for s in range(state.held_ns.size):
        for j in range(rules.spare):
            if state.open_row[s, j] > number:
                first = min(first, state.open_ns[s, j])
    if first != _LATEST_NS:
        row = -((-first) // rules.period_ns)
        state.clock[_NEXT] = max(tick + rules.period_ns, row * rules.period_ns)
    return False


@helper
def _drop_waiting(state: State) -> None:
    """Drop and count the waiting readings that were not confirmed."""
    for k in range(state.clock[_WAITING]):
        state.counts[state.wait_signal[k], _OUTLIER] += 1
    state.clock[_WAITING] = 0


@copied
def _wait(state: State, rules: Rules, time_ns: int, s: int, v: float, q: int) -> int:
    """Add a reading far off in time to the waiting ones; 1 confirms a jump ahead, -1 one back."""
    clock = state.clock
    if clock[_WAITING] > 0:
        last = state.wait_ns[clock[_WAITING] - 1]
        if abs(time_ns - last) > rules.jump_ns:
            _drop_waiting(state)
    n = clock[_WAITING]
    state.wait_ns[n], state.wait_signal[n] = time_ns, s
    state.wait[n], state.wait_quality[n] = v, q
    clock[_WAITING] = n + 1
    ahead = time_ns > clock[NEWEST]
    # Count different instants: values of one instant must not confirm each other.
    instants = 1
    for k in range(1, n + 1):
        if state.wait_ns[k] != state.wait_ns[k - 1]:
            instants += 1
    if n + 1 < BEHIND_CONFIRMED and (not ahead or instants < _AHEAD_CONFIRMED):
        return 0
    return 1 if ahead else -1


@copied
def _forget(state: State) -> None:
    """Reset after a step back of the clock; the waiting readings are confirmed."""
    state.clock[_RESETS] += 1
    state.clock[NEWEST] = NEVER
    state.clock[_NEXT] = NEVER
    state.newest_ns[:] = NEVER
    state.held_ns[:] = NEVER
    state.open_row[:] = NEVER


@helper
def _close_ready(
    state: State, rules: Rules, rows: AlignedRows, written: int, coming_ns: int, rest: bool
) -> int:
    """Close rows while there is space; return the number of rows written so far.

    With ``coming_ns`` only rows that this reading cannot change are closed, with
    ``rest`` all rows up to the newest stamp.
    """
    clock = state.clock
    while clock[_NEXT] != NEVER and written < rows.time_ns.size - rules.spare:
        tick = clock[_NEXT]
        if coming_ns != _LATEST_NS:
            ready = tick < coming_ns and tick + rules.lateness_ns <= coming_ns
        else:
            ready = (rest and tick <= clock[NEWEST]) or _can_close(state, rules)
        if not ready:
            break
        if _close(state, rules, rows, written, coming_ns):
            written += 1
    return written


@copied
def _refusal(t: int, v: float, q: int, low: float, high: float) -> int:
    """Return why a reading is rejected, or `_ACCEPTED`."""
    if not 0 <= t < _LATEST_NS:
        return _OUTLIER
    if not math.isfinite(v):
        return _NOT_FINITE
    if q >= 2:
        return _BAD
    return _ACCEPTED if low <= v <= high else _IMPOSSIBLE


@jit
def _offer_believed(state: State, rules: Rules, rows: AlignedRows, written: int) -> int:
    """Accept the readings of a confirmed jump while there is space; return the rows written."""
    clock = state.clock
    while 0 <= clock[_BELIEVED] < clock[_WAITING]:
        k = clock[_BELIEVED]
        t = state.wait_ns[k]
        written = _close_ready(state, rules, rows, written, t, False)
        if written >= rows.time_ns.size - rules.spare:
            return written
        _accept(state, rules, t, state.wait_signal[k], state.wait[k], state.wait_quality[k])
        clock[_BELIEVED] += 1
    if clock[_BELIEVED] >= 0:
        clock[_BELIEVED], clock[_WAITING] = -1, 0
    return written


@jit
def _go_back(state: State, rules: Rules, rows: AlignedRows, written: int) -> int:
    """Close the rows that were open before the step back with their present values, and reset."""
    clock = state.clock
    while clock[_NEXT] <= clock[NEWEST] and written < rows.time_ns.size:
        if _close(state, rules, rows, written, _LATEST_NS):
            written += 1
    _forget(state)
    return written


@jit
def _align(
    time_ns: IntArray,
    signal: NDArray[np.int8],
    value: FloatArray,
    quality: ByteArray,
    state: State,
    rules: Rules,
    rows: AlignedRows,
    i: int,
    written: int,
    final: bool,
) -> tuple[int, int, int]:
    """Process readings from ``i`` on until they or the space for rows end, or a jump is confirmed.

    Return the number of readings processed, of rows written, and 1 for a jump ahead, -1 for one
    back, else 0. A jump is left to the caller: it is rare, and its loops take long to compile.
    """
    # Calls with many arrays are slow, so the common path first checks if a call is needed.
    clock = state.clock
    limit = rows.time_ns.size - rules.spare
    while True:
        last = i >= time_ns.size
        if clock[NEWEST] >= clock[_NEXT] and ((final and last) or _can_close(state, rules)):
            written = _close_ready(state, rules, rows, written, _LATEST_NS, final and last)
        if written >= limit or last:
            break
        t, s, v, q = time_ns[i], int(signal[i]), value[i], quality[i]
        newest = clock[NEWEST]
        why = _refusal(t, v, q, rules.limits[s, 0], rules.limits[s, 1])
        if why != _ACCEPTED:
            state.counts[s, why] += 1
        elif newest == NEVER or abs(t - newest) <= rules.jump_ns:
            if t > clock[_NEXT] and t >= clock[_NEXT] + rules.lateness_ns:
                written = _close_ready(state, rules, rows, written, t, False)
                if written >= limit:
                    break
            _accept(state, rules, t, s, v, q)
            if clock[_WAITING] > 0:
                _drop_waiting(state)
        else:
            leap = _wait(state, rules, t, s, v, q)
            if leap != 0:
                return i + 1, written, leap
        i += 1
    if final and i >= time_ns.size:
        _drop_waiting(state)
    return i, written, 0


@dataclass(frozen=True, slots=True)
class Aligned:
    """The result of one call: rows, and the resets of the clock among them."""

    table: SampleTable  # the closed rows
    # Row numbers within ``table`` before which the clock was set back, (k,).
    resets: IntArray


class Aligner:
    """Convert readings into rows, in one pass and bounded memory.

    Parameters
    ----------
    settings : Settings
        Sample period, hold limit, lateness, clock jump, plausible ranges.
    covariates : tuple of str
        Entries of covariates, whose readings have the numbers that follow those of the signals;
        see `signals.covariates`. They have no influence on the rows of the signals.
    """

    _ROOM = 65536  # maximum number of rows of one call of the kernel

    def __init__(self, settings: Settings, covariates: tuple[str, ...] = ()) -> None:
        self._beside = Arriving(covariates) if covariates else None
        period = settings.real('sample_period')
        self._rules = Rules(
            limits=plausible_ranges(settings),
            required=np.array([info.required for info in SIGNALS], dtype=np.uint8),
            period_ns=round(period * NS_PER_S),
            lateness_ns=round(settings.real('lateness') * NS_PER_S),
            hold_ns=round(settings.real('hold_limit') * NS_PER_S),
            jump_ns=round(max(settings.real('clock_jump'), 3.0 * period) * NS_PER_S),
            spare=math.ceil(settings.real('lateness') / period) + 3,
        )
        spare = self._rules.spare
        self._state = State(
            clock=np.array([NEVER, NEVER, 0, -1, 0], dtype=np.int64),
            newest_ns=np.full(N_SIGNALS, NEVER, dtype=np.int64),
            held_ns=np.full(N_SIGNALS, NEVER, dtype=np.int64),
            held=np.full(N_SIGNALS, np.nan),
            held_quality=np.full(N_SIGNALS, int(Quality.BAD), dtype=np.uint8),
            open_row=np.full((N_SIGNALS, spare), NEVER, dtype=np.int64),
            open_ns=np.zeros((N_SIGNALS, spare), dtype=np.int64),
            open_value=np.zeros((N_SIGNALS, spare)),
            open_quality=np.zeros((N_SIGNALS, spare), dtype=np.uint8),
            wait_ns=np.zeros(BEHIND_CONFIRMED, dtype=np.int64),
            wait_signal=np.zeros(BEHIND_CONFIRMED, dtype=np.int64),
            wait=np.zeros(BEHIND_CONFIRMED),
            wait_quality=np.zeros(BEHIND_CONFIRMED, dtype=np.uint8),
            counts=np.zeros((N_SIGNALS, len(REASONS)), dtype=np.int64),
        )

    def feed(self, readings: Readings) -> Aligned:
        """Process readings in their order of arrival and return the rows that they close."""
        if self._beside is None:
            return self._run(readings, final=False)
        blocks, done = [], 0
        for k in np.flatnonzero(readings.signal >= N_SIGNALS).tolist():
            if k > done:
                blocks.append(self._run(readings.part(done, k), final=False))
            number = int(readings.signal[k]) - N_SIGNALS
            self._beside.take(number, int(readings.time_ns[k]), float(readings.value[k]))
            done = k + 1
        blocks.append(self._run(readings.part(done, len(readings)), final=False))
        return gathered(blocks)

    def finish(self) -> Aligned:
        """Close the rows up to the newest stamp; for the end of a file."""
        return self._run(Readings.of([]), final=True)

    @property
    def newest_ns(self) -> int:
        """Return the newest accepted stamp, 0 before the first."""
        return max(0, int(self._state.clock[NEWEST]))

    def counts(self) -> dict[str, dict[str, int]]:
        """Return the number of readings by result: ``{topic: {reason: count}}``."""
        counts = self._state.counts
        return {
            info.topic: {reason: int(counts[info.signal, k]) for k, reason in enumerate(REASONS)}
            for info in SIGNALS
        }

    def snapshot(self) -> state.State:
        """Return the state to be saved."""
        saved = state.copies(self._state._asdict())
        return saved if self._beside is None else {**saved, 'covariates': self._beside.snapshot()}

    def restore(self, saved: state.State) -> None:
        """Continue from a saved state; raise `DataError` if it is invalid."""
        state.put_back(self._state._asdict(), saved)
        if self._beside is not None:
            self._beside.restore(saved.get('covariates', {}))

    def _run(self, readings: Readings, final: bool) -> Aligned:
        tables: list[SampleTable] = []
        resets: list[int] = []
        done = before = 0
        room = (self._ROOM if len(readings) > 64 or final else 256) + self._rules.spare
        while True:
            rows = AlignedRows(
                np.empty(room, dtype=np.int64),
                np.empty((room, N_SIGNALS)),
                np.empty((room, N_SIGNALS), dtype=np.uint8),
            )
            done, written, jumps = self._fill(readings, done, rows, final)
            resets += [before + k for k in jumps]
            before += written
            tables.append(
                SampleTable(rows.time_ns[:written], rows.values[:written], rows.quality[:written])
            )
            if written < room - self._rules.spare and done >= len(readings):
                break
        table = tables[0] if len(tables) == 1 else SampleTable.concatenate(tables)
        if self._beside is not None:
            edges = itertools.pairwise([0, *resets, len(table)])
            beside = [self._beside.at(table.time_ns[start:end]) for start, end in edges]
            table = replace(table, covariates=np.concatenate(beside))
        return Aligned(table, np.array(resets, dtype=np.int64))

    def _fill(
        self, readings: Readings, done: int, rows: AlignedRows, final: bool
    ) -> tuple[int, int, list[int]]:
        """Process readings from ``done`` on until they or the space for rows end.

        Return the number of readings processed, of rows written, and the resets among these.
        """
        state, rules, clock = self._state, self._rules, self._state.clock
        written = 0
        resets: list[int] = []
        while True:
            if clock[_BELIEVED] >= 0:
                written = _offer_believed(state, rules, rows, written)
                if clock[_BELIEVED] >= 0:
                    break
            done, written, leap = _align(
                readings.time_ns, readings.signal, readings.value, readings.quality,
                state, rules, rows, done, written, final,
            )  # fmt: skip
            if leap == 0:
                break
            clock[_BELIEVED] = 0
            if leap < 0:
                written = _go_back(state, rules, rows, written)
                resets.append(written)
        return done, written, resets


# Alignment of a whole log without the engine, which takes long to load.

_BLOCK = 200_000  # readings between two reports of progress


def align_whole(
    readings: Readings, settings: Settings, progress: Callable[[float, str], None] | None = None
) -> tuple[SampleTable, IntArray, dict[str, dict[str, int]]]:
    """Return all rows, the row numbers before which the clock was set back, and the counts."""
    aligner = Aligner(settings)
    rows = gathered(aligned_blocks(aligner, readings, progress, 'putting rows together'))
    return rows.table, rows.resets, aligner.counts()


def aligned_blocks(
    aligner: Aligner, readings: Readings, progress: Callable[[float, str], None] | None, what: str
) -> Iterator[Aligned]:
    """Yield the rows block by block, including those closed by the end of the log."""
    for start in range(0, len(readings), _BLOCK):
        if progress is not None:
            progress(0.1 + 0.4 * start / len(readings), what)
        yield aligner.feed(readings.part(start, min(start + _BLOCK, len(readings))))
    yield aligner.finish()


def gathered(blocks: Iterable[Aligned]) -> Aligned:
    """Return the rows of all blocks in one block."""
    tables: list[SampleTable] = []
    resets: list[int] = []
    before = 0
    for block in blocks:
        resets += [before + int(k) for k in block.resets]
        before += len(block.table)
        tables.append(block.table)
    return Aligned(SampleTable.concatenate(tables), np.array(resets, dtype=np.int64))
