# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Online detection of special segments (Section III.B of the paper)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from valveflow_ros.parameters import Settings
from valveflow_ros.records import (
    NS_PER_S,
    ByteArray,
    FloatArray,
    IntArray,
    SegmentKind,
    SpecialSegment,
)
from valveflow_ros.segments import kernel
from valveflow_ros.segments.kernel import BINS, LINE_SIZE, WARM_UP
from valveflow_ros.state import Memory


@dataclass(frozen=True, slots=True)
class FoundSegment:
    """A special segment and its row numbers, counted from the first row ever fed."""

    segment: SpecialSegment
    first_row: int
    end_row: int


@dataclass(frozen=True, slots=True)
class Segmented:
    """The result of one call."""

    # uint8 (n,): `kernel.TRANSIENT`, `SETTLED_STEADY`, `SETTLED_SLOPE` or `NO_DATA`, as far as
    # known when the row arrived.
    kinds: ByteArray
    # Closed segments, each with the number of rows of this call processed by then.
    found: list[tuple[int, FoundSegment]]

    @property
    def rows(self) -> int:
        """Return the number of rows processed."""
        return len(self.kinds)


@dataclass(frozen=True, slots=True)
class NoiseLevel:
    """The noise for the thresholds: sd of block means about a line."""

    input: float
    power_mw: float
    learnt: bool


class Segmenter(Memory):
    """Online segmentation in constant time per row and bounded memory.

    The segments and kinds do not depend on the division of the rows into calls
    of `feed`; they are identical bit for bit.
    """

    REMEMBERED = ('_state', '_sums', '_lines', '_blocks', '_histograms', '_number')

    def __init__(self, settings: Settings) -> None:
        period = settings.real('sample_period')
        rows = max(1, round(settings.real('block') / period))
        block_s = rows * period

        def in_blocks(seconds: float) -> int:
            return math.ceil(seconds / block_s - 1e-9)

        settle, longest = in_blocks(settings.settle_s), in_blocks(settings.real('longest_segment'))
        # A ramp is detected only when it exceeds the noise: up to a minute before belongs to it.
        trim = min(6, in_blocks(60.0))
        names = 'break_limit', 'steady_limit', 'slope_limit', 'input_noise', 'power_noise'
        self._setting = np.array([
            rows, settle, max(6, longest), max(3, in_blocks(settings.real('steady_min'))),
            max(3, in_blocks(settings.real('slope_min'))), trim, *map(settings.real, names),
            period * NS_PER_S,
        ])  # fmt: skip
        self._period_s = period
        self._block_rows = rows
        self._state = np.zeros(kernel.INT_STATE, dtype=np.int64)
        self._state[[kernel.SKIP, kernel.LAST_NS]] = settle, -(2**62)
        self._sums = np.zeros(kernel.SUMS)
        self._lines = np.zeros((kernel.LINES, LINE_SIZE))
        self._blocks = np.zeros((3, max(6, longest) + settle + trim + 32))
        self._histograms = np.zeros((2, BINS))
        self._found = np.zeros(kernel.SEG_SIZE)
        self._number = 0
        self._arrays = kernel.Arrays(
            self._state, self._sums, self._lines, self._blocks, self._histograms, self._setting,
            self._found,
        )  # fmt: skip

    @classmethod
    def over(
        cls, settings: Settings, number: IntArray, time_ns: IntArray, values: FloatArray,
        next_number: int, found_before: int = 0,
    ) -> tuple[Segmenter, list[FoundSegment]]:  # fmt: skip
        """Return a segmenter that has processed past rows, and the segments found in them.

        Parameters
        ----------
        number : int64 (n,)
            Numbers of the rows, increasing. A missing number ends the open segment.
        time_ns : int64 (n,)
        values : float64 (3, n)
            ``u``, power in MW and temperature in degC, as for `feed`.
        next_number : int
            Number of the row that will be fed next.
        found_before : int
            Number of segments found before; the numbering continues from it.
        """
        made = cls(settings)
        made._number = found_before
        found: list[FoundSegment] = []
        period_ns = round(made._period_s * NS_PER_S)
        begins = np.flatnonzero(np.diff(number, prepend=-2) != 1)
        for start, end in pairwise([*begins.tolist(), len(number)]):
            made._state[[kernel.ROW, kernel.FIRST_ROW]] = number[start]
            found += [f for _, f in made.feed(time_ns[start:end], *values[:, start:end]).found]
            if number[end - 1] + 1 != (next_number if end == len(number) else number[end]):
                # A row without data ends the open segment.
                after_ns = time_ns[end - 1 : end] + period_ns
                found += [f for _, f in made.feed(after_ns, *np.full((3, 1), math.nan)).found]
        made._state[[kernel.ROW, kernel.FIRST_ROW]] += next_number - made._state[kernel.ROW]
        return made, found

    def noise(self) -> NoiseLevel:
        """Return the noise level in use now."""
        given = self._setting[kernel.NOISE_U] > 0.0 and self._setting[kernel.NOISE_Y] > 0.0
        learnt = bool(self._state[kernel.STRETCHES] >= WARM_UP)
        u, y = kernel.noise_now(self._histograms, self._setting)
        return NoiseLevel(float(u), float(y), learnt or bool(given))

    def feed(
        self, time_ns: IntArray, u: FloatArray, power_mw: FloatArray,
        temperature_degc: FloatArray, most: int | None = None,
    ) -> Segmented:  # fmt: skip
        """Process rows; NaN in ``u`` or ``power_mw`` marks a row without usable data.

        Parameters
        ----------
        time_ns : int64 (n,)
        u : float64 (n,)
            Integrated input, % MPa^m.
        power_mw, temperature_degc : float64 (n,)
        most : int, optional
            Stop after the row that closed this many segments; the remaining
            rows are not processed.
        """
        kinds = np.empty(len(u), dtype=np.uint8)
        found: list[tuple[int, FoundSegment]] = []
        done = 0
        while done < len(u):
            taken, closed = kernel.run(
                time_ns[done:], u[done:], power_mw[done:], temperature_degc[done:], self._arrays,
                kinds[done:],
            )  # fmt: skip
            done += taken
            if closed:
                found.append((done, self._describe()))
                if most is not None and len(found) >= most:
                    break
        return Segmented(kinds[:done], found)

    def _describe(self) -> FoundSegment:
        f = self._found
        first, end = int(f[kernel.SEG_FIRST]), int(f[kernel.SEG_END])
        period_ns = round(self._period_s * NS_PER_S)
        end_ns = int(self._state[kernel.END_NS])
        half = 0.5 * ((end - first) / self._block_rows - 1.0)
        self._number += 1
        segment = SpecialSegment(
            number=self._number,
            kind=SegmentKind(int(f[kernel.SEG_KIND])),
            start_ns=end_ns - (end - first - 1) * period_ns,
            end_ns=end_ns,
            samples=end - first,
            u_start=float(f[kernel.SEG_U_MEAN] - half * f[kernel.SEG_U_SLOPE]),
            u_end=float(f[kernel.SEG_U_MEAN] + half * f[kernel.SEG_U_SLOPE]),
            u_rate_per_s=float(f[kernel.SEG_U_SLOPE] / (self._block_rows * self._period_s)),
            u_rms=float(f[kernel.SEG_U_RMS]),
            power_start_mw=float(f[kernel.SEG_Y_MEAN] - half * f[kernel.SEG_Y_SLOPE]),
            power_end_mw=float(f[kernel.SEG_Y_MEAN] + half * f[kernel.SEG_Y_SLOPE]),
            power_rms_mw=float(f[kernel.SEG_Y_RMS]),
            temperature_mean_degc=float(f[kernel.SEG_T]),
        )
        return FoundSegment(segment, first, end)
