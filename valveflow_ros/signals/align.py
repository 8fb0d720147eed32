"""Four asynchronous signals become one table on a time grid.

A row stands at each multiple of the sample period. It holds, for each signal,
the newest value whose stamp is not after the row (zero-order hold), as long as
that value is not older than the hold limit. A row is closed as soon as every
required signal has spoken after it, or when any signal is `lateness` past it.
Which rows come out, and what stands in them, depends only on the readings in
their order, so a recording gives back the rows of the live run.

Nothing is dropped without a count; see `align_kernel.REASONS`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.config import Settings
from valveflow_ros.records import (
    N_SIGNALS,
    NS_PER_S,
    SIGNALS,
    IntArray,
    Quality,
    Readings,
    SampleTable,
    Signal,
)
from valveflow_ros.signals.align_kernel import (
    BEHIND_CONFIRMED,
    NEVER,
    NEWEST,
    REASONS,
    Rows,
    Rules,
    State,
    align,
)
from valveflow_ros.state import ArrayMemory


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


class Aligner(ArrayMemory):
    """Turn readings into rows, in one pass and bounded memory.

    Parameters
    ----------
    settings : Settings
        Sample period, hold limit, lateness, clock jump, plausible ranges.
    """

    _ROOM = 65536  # rows a single call of the kernel can write

    def __init__(self, settings: Settings) -> None:
        period = settings.real('sample_period')
        limits = np.empty((N_SIGNALS, 2))
        for info in SIGNALS:
            name = 'valve_opening' if info.signal == Signal.VALVE_COMMAND else info.topic
            limits[info.signal] = settings.real(f'{name}_low'), settings.real(f'{name}_high')
        self._rules = Rules(
            limits=limits,
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
        """Take readings in their order of arrival and return the rows they close."""
        return self._run(readings, final=False)

    def finish(self) -> Aligned:
        """Close the rows up to the newest stamp; for the end of a file."""
        return self._run(Readings.of([]), final=True)

    @property
    def newest_ns(self) -> int:
        """Return the newest stamp taken, 0 before the first."""
        return max(0, int(self._state.clock[NEWEST]))

    def counts(self) -> dict[str, dict[str, int]]:
        """Return what became of the readings: ``{topic: {reason: count}}``."""
        counts = self._state.counts
        return {
            info.topic: {reason: int(counts[info.signal, k]) for k, reason in enumerate(REASONS)}
            for info in SIGNALS
        }

    def _memory(self) -> dict[str, NDArray[Any]]:
        return self._state._asdict()

    def _run(self, readings: Readings, final: bool) -> Aligned:
        tables: list[SampleTable] = []
        resets: list[int] = []
        done = before = 0
        room = (self._ROOM if len(readings) > 64 or final else 256) + self._rules.spare
        while True:
            rows = Rows(
                np.empty(room, dtype=np.int64),
                np.empty((room, N_SIGNALS)),
                np.empty((room, N_SIGNALS), dtype=np.uint8),
                np.empty(max(1, len(readings)), dtype=np.int64),
            )
            rest = readings.part(done, len(readings))
            consumed, written, n_resets = align(
                rest.time_ns, rest.signal, rest.value, rest.quality,
                self._state, self._rules, rows, final,
            )  # fmt: skip
            done += consumed
            resets += [before + int(k) for k in rows.resets[:n_resets]]
            before += written
            tables.append(
                SampleTable(rows.time_ns[:written], rows.values[:written], rows.quality[:written])
            )
            if written < room - self._rules.spare and done >= len(readings):
                break
        table = tables[0] if len(tables) == 1 else SampleTable.concatenate(tables)
        return Aligned(table, np.array(resets, dtype=np.int64))
