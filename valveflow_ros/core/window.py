"""The rolling window of rows and special segments, in bounded memory."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from itertools import islice

import numpy as np

from valveflow_ros.config import Settings
from valveflow_ros.core.segment_state import found_of, found_values
from valveflow_ros.core.segmenter import FoundSegment
from valveflow_ros.core.state import State
from valveflow_ros.errors import DataError
from valveflow_ros.records import NS_PER_S, FloatArray, IntArray, SegmentKind, SpecialSegment

_FIRST_ROOM = 16384


@dataclass(frozen=True, slots=True)
class WindowContents:
    """A copy of what the window holds.

    Attributes
    ----------
    time_ns : int64 (n,)
    u, power_mw, temperature_degc : float64 (n,)
        NaN in ``u`` or ``power_mw`` where a row has no usable data.
    spans : int64 (k, 3)
        Special segments as (first row, end row, kind), rows counted within these arrays.
    opening_percent : float64 (n,) or (0,)
        The opening that u was made from, NaN where it was not given; empty where unknown.
    command_percent : float64 (n,) or (0,)
        The commanded opening, NaN where there was none; empty where there never was.
    """

    time_ns: IntArray
    u: FloatArray
    power_mw: FloatArray
    temperature_degc: FloatArray
    spans: IntArray
    opening_percent: FloatArray = field(default_factory=lambda: np.empty(0))
    command_percent: FloatArray = field(default_factory=lambda: np.empty(0))

    def special_rows(self) -> IntArray:
        """Return the rows that lie in special segments, in order of time."""
        if not len(self.spans):
            return np.empty(0, dtype=np.int64)
        return np.concatenate([np.arange(a, b, dtype=np.int64) for a, b, _ in self.spans])

    def count(self, kind: SegmentKind) -> int:
        """Return the number of segments of a kind."""
        return int((self.spans[:, 2] == kind).sum())


NO_ROWS = WindowContents(
    np.empty(0, dtype=np.int64),
    np.empty(0),
    np.empty(0),
    np.empty(0),
    np.empty((0, 3), dtype=np.int64),
)


class RollingWindow:
    """Rows of the last days, and the special segments among them.

    Parameters
    ----------
    window_s, period_s : float
        Length of the window and step of the rows; together they bound the memory.
    """

    def __init__(self, window_s: float, period_s: float) -> None:
        self._window_ns = round(window_s * NS_PER_S)
        self._rows = max(16, int(np.ceil(window_s / period_s)) + 1)
        # Rows are dropped a sixteenth of the window at a time.
        self._most_room = self._rows * 17 // 16 + 16
        self._room = min(_FIRST_ROOM, self._most_room)
        self._time_ns = np.empty(self._room, dtype=np.int64)
        self._data = np.empty((5, self._room))
        self._end = 0
        self._base = 0
        # A leap ahead may be taken back: segments it put outside stay while their rows do.
        self._segments: deque[FoundSegment] = deque()
        self._outside = 0

    @classmethod
    def of(cls, settings: Settings) -> RollingWindow:
        """Return an empty window of the length in the settings."""
        return cls(86400.0 * settings.real('window_days'), settings.real('sample_period'))

    def __len__(self) -> int:
        """Return the number of rows held."""
        return self._end

    @property
    def rows_seen(self) -> int:
        """Return the number of rows ever appended; the next row's absolute number."""
        return self._base + self._end

    @property
    def segments(self) -> int:
        """Return the number of special segments inside the window."""
        return len(self._segments) - self._outside

    def special_segments(self) -> tuple[SpecialSegment, ...]:
        """Return the special segments inside the window, in order of time."""
        return tuple(s.segment for s in islice(self._segments, self._outside, None))

    @property
    def special_samples(self) -> int:
        """Return the number of samples in those segments."""
        return sum(segment.samples for segment in self.special_segments())

    @property
    def span_s(self) -> float:
        """Return the time from the oldest row inside the window to the newest."""
        if self._end == 0:
            return 0.0
        held_ns = int(self._time_ns[self._end - 1]) - int(self._time_ns[0])
        return min(held_ns, self._window_ns) / NS_PER_S

    def append(
        self,
        time_ns: IntArray,
        u: FloatArray,
        power_mw: FloatArray,
        temperature_degc: FloatArray,
        opening_percent: FloatArray | None = None,
        command_percent: FloatArray | None = None,
    ) -> None:
        """Append rows, later than all there are; those that have left the window are forgotten."""
        done = 0
        while done < len(time_ns):
            if self._end == self._room:
                self._make_room()
            take = min(self._room - self._end, len(time_ns) - done)
            part, place = slice(done, done + take), slice(self._end, self._end + take)
            self._time_ns[place] = time_ns[part]
            self._data[0, place] = u[part]
            self._data[1, place] = power_mw[part]
            self._data[2, place] = temperature_degc[part]
            self._data[3, place] = np.nan if opening_percent is None else opening_percent[part]
            self._data[4, place] = np.nan if command_percent is None else command_percent[part]
            self._end += take
            done += take
        self._forget()

    def add_segment(self, found: FoundSegment) -> None:
        """Remember a special segment that has closed."""
        self._segments.append(found)

    def cut(self, time_ns: int) -> int:
        """Let go of the rows from a time on, and of the segments that reach into them.

        What a leap ahead had put outside the window, and is among its last rows, is inside again.
        Returns by how much the numbers of the rows that stay grow, so that those of the rows to
        come follow them.
        """
        held = self._held()
        end = int(np.searchsorted(self._time_ns[held], time_ns, side='left'))
        gone = int(self._end - held.start - end)
        for column in (self._time_ns, *self._data):
            column[:end] = column[held][:end].copy()
        self._base += held.start + gone
        self._end = end
        stay = [s for s in self._segments if s.segment.end_ns < time_ns]
        self._segments = deque(segment.moved(gone) for segment in stay)
        self._count()
        return gone

    def tail(self, rows: int) -> tuple[IntArray, FloatArray, FloatArray]:
        """Return copies of time, ``u`` and power of the last ``rows`` rows, or of all held."""
        part = slice(max(0, self._end - rows), self._end)
        return self._time_ns[part].copy(), self._data[0, part].copy(), self._data[1, part].copy()

    def contents(self) -> WindowContents:
        """Return a copy of the rows inside the window and their segments."""
        if self._end == 0:
            return NO_ROWS
        first = self._first()
        offset = self._base + first
        spans = [
            (s.first_row - offset, s.end_row - offset, int(s.segment.kind))
            for s in islice(self._segments, self._outside, None)
            if s.first_row >= offset
        ]
        command = self._data[4, first : self._end]
        return WindowContents(
            self._time_ns[first : self._end].copy(),
            self._data[0, first : self._end].copy(),
            self._data[1, first : self._end].copy(),
            self._data[2, first : self._end].copy(),
            np.array(spans, dtype=np.int64).reshape(-1, 3),
            self._data[3, first : self._end].copy(),
            # Most units do not log it, and a snapshot goes to another process.
            command.copy() if np.isfinite(command).any() else np.empty(0),
        )

    def snapshot(self) -> State:
        """Return what is remembered; see `core.state`."""
        rows = self._held()
        command = self._data[4, rows]
        return {
            'time_ns': self._time_ns[rows].copy(),
            'rows': self._data[:4, rows].copy(),
            'command': command.copy() if np.isfinite(command).any() else np.empty(0),
            'base': self._base + rows.start,
            'segments': [found_values(s) for s in self._segments],
        }

    def restore(self, saved: State) -> None:
        """Go on from a state; raises `DataError` if it does not fit."""
        time_ns, rows, command = saved['time_ns'], saved['rows'], saved['command']
        if rows.shape != (4, len(time_ns)) or len(command) not in (0, len(time_ns)):
            raise DataError('The saved state has rows of different lengths.')
        self._end, self._base = 0, int(saved['base'])
        self.append(time_ns, rows[0], rows[1], rows[2], rows[3], command if len(command) else None)
        self._segments = deque(found_of(values) for values in saved['segments'])
        self._count()

    def _held(self) -> slice:
        """Return the places of the last rows, as many as a full window has."""
        return slice(max(0, self._end - self._rows), self._end)

    def _first(self) -> int:
        """Return the place of the oldest row inside the window."""
        if self._end == 0:
            return 0
        oldest = self._time_ns[self._end - 1] - self._window_ns
        return int(np.searchsorted(self._time_ns[: self._end], oldest, side='right'))

    def _make_room(self) -> None:
        """Grow until the window fits, then drop the oldest rows many at a time."""
        limit = self._most_room
        if self._room < limit:
            self._room = min(limit, 2 * self._room)
            time_ns = np.empty(self._room, dtype=np.int64)
            data = np.empty((5, self._room))
            time_ns[: self._end] = self._time_ns[: self._end]
            data[:, : self._end] = self._data[:, : self._end]
            self._time_ns, self._data = time_ns, data
            return
        drop = self._end - self._rows
        # One column at a time: a copy of all would be as large as the window itself.
        for column in (self._time_ns, *self._data):
            column[: self._rows] = column[drop : self._end].copy()
        self._base += drop
        self._end = self._rows

    def _forget(self) -> None:
        """Let go of segments whose rows are gone, and pass over those before the window."""
        first = self._base + self._held().start
        while self._segments and self._segments[0].first_row < first:
            self._segments.popleft()
            self._outside = max(0, self._outside - 1)
        if self._end:
            oldest = int(self._time_ns[self._end - 1]) - self._window_ns
            while self.segments and self._segments[self._outside].segment.start_ns <= oldest:
                self._outside += 1

    def _count(self) -> None:
        """Count anew what lies outside."""
        self._outside = 0
        self._forget()
