# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The rolling window of rows and special segments, in bounded memory."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from valveflow_ros.errors import DataError
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S, FloatArray, IntArray, SegmentKind, SpecialSegment
from valveflow_ros.segments.segmenter import FoundSegment, Segmenter
from valveflow_ros.signals.static_form import PAPER_EXPONENT, integrated_input, pressure_of
from valveflow_ros.state import State, perhaps

_NAMES = [field.name for field in fields(SpecialSegment)]
_WITHOUT_ENDS = len(_NAMES) - 5


def _found_values(found: FoundSegment) -> list[Any]:
    """Return a segment's rows and fields, for a saved state."""
    return [found.first_row, found.end_row, *(getattr(found.segment, name) for name in _NAMES)]


def _found_of(values: list[Any]) -> FoundSegment:
    """Return the segment with these values; raise `DataError` if they are invalid."""
    if [type(row) for row in values[:2]] != [int, int]:
        raise DataError('The saved state has a segment whose rows are no numbers.')
    try:
        # States of earlier versions contain no openings and pressures.
        given = dict(zip(_NAMES, values[2:], strict=len(values) - 2 != _WITHOUT_ENDS))
        segment = SpecialSegment(**{**given, 'kind': SegmentKind(given['kind'])})
    except (TypeError, ValueError):
        raise DataError('The saved state has a special segment that is none.') from None
    return FoundSegment(segment, values[0], values[1])


_FIRST_ROOM = 16384
# Rows of data before those of the covariates: u, power, temperature, opening and command.
_SIGNALS = 5
# A step back of the clock is accepted after this much of the new time.
_DOUBT_S = 3600.0


@dataclass(frozen=True, slots=True)
class WindowContents:
    """A copy of the contents of the window, n rows."""

    time_ns: IntArray
    u: FloatArray  # NaN in u or power if a row has no usable data
    power_mw: FloatArray
    temperature_degc: FloatArray
    spans: IntArray  # (k, 3) special segments as (first row, end row, kind) within these arrays
    # The opening from which u was computed, and the commanded one, NaN if there was none; empty if
    # there never was one.
    opening_percent: FloatArray = field(default_factory=lambda: np.empty(0))
    command_percent: FloatArray = field(default_factory=lambda: np.empty(0))
    # Values of further columns by entry; see `signals.covariates`.
    covariates: dict[str, FloatArray] = field(default_factory=dict)

    def special_rows(self) -> IntArray:
        """Return the rows in special segments, in chronological order."""
        if not len(self.spans):
            return np.empty(0, dtype=np.int64)
        return np.concatenate([np.arange(a, b, dtype=np.int64) for a, b, _ in self.spans])

    def count(self, kind: SegmentKind) -> int:
        """Return the number of segments of a kind."""
        return int((self.spans[:, 2] == kind).sum())


NO_ROWS = WindowContents(
    np.empty(0, dtype=np.int64), np.empty(0), np.empty(0), np.empty(0),
    np.empty((0, 3), dtype=np.int64),
)  # fmt: skip


@dataclass(slots=True)
class _Aside:
    """Rows after the time to which the clock was set back, and the segments in them."""

    from_ns: int
    time_ns: IntArray
    number: IntArray
    data: FloatArray
    segments: list[FoundSegment]

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.time_ns)


class RollingWindow:
    """Rows of the last days, and the special segments in them.

    Parameters
    ----------
    window_s, period_s : float
        Length of the window and step of the rows; together they limit the memory.
    exponent : float
        m of the u = V p^m of the rows.
    least_s : mapping of SegmentKind to float, optional
        Minimum length of a segment of a kind that is kept if a clock step cuts it.
    covariates : tuple of str
        Entries of further columns, in the order in which `append` receives them.

    Notes
    -----
    A clock may be set back permanently, or temporarily because a gateway has no time yet. So the
    rows after the new time are set aside. They replace the newer rows when the time jumps forward
    again by at least half of the step back. They are discarded after as many new rows, or one
    hour of them.
    After a jump ahead, old rows outside the window are kept, as many as fill a window without
    gaps. They are inside the window again if the jump is reversed.
    """

    def __init__(
        self,
        window_s: float,
        period_s: float,
        exponent: float = PAPER_EXPONENT,
        least_s: Mapping[SegmentKind, float] | None = None,
        covariates: tuple[str, ...] = (),
    ) -> None:
        self._exponent = exponent
        self._covariates = covariates
        self._least = {
            kind: math.ceil(seconds / period_s) for kind, seconds in (least_s or {}).items()
        }
        self._window_ns = round(window_s * NS_PER_S)
        self._period_ns = round(period_s * NS_PER_S)
        self._doubt = max(1, math.ceil(_DOUBT_S / period_s))
        self._rows = max(16, math.ceil(window_s / period_s) + 1)
        # Rows are dropped in parts of a sixteenth of the window.
        self._most_room = self._rows * 17 // 16 + 16
        self._seen = 0
        self._segments: deque[FoundSegment] = deque()
        self._aside: _Aside | None = None
        self._end = 0
        self._clear()

    @classmethod
    def of(cls, settings: Settings, covariates: tuple[str, ...] = ()) -> RollingWindow:
        """Return an empty window of the length in the settings."""
        return cls(
            86400.0 * settings.real('window_days'), settings.real('sample_period'),
            settings.real('pressure_exponent'),
            {
                SegmentKind.STEADY: settings.real('steady_min'),
                SegmentKind.SLOPE: settings.real('slope_min'),
            },
            covariates,
        )  # fmt: skip

    def __len__(self) -> int:
        """Return the number of rows stored, without those set aside."""
        return self._end

    @property
    def segments(self) -> int:
        """Return the number of special segments inside the window."""
        return len(self.special_segments())

    def special_segments(self, since_ns: int = 0) -> tuple[SpecialSegment, ...]:
        """Return the special segments inside the window that began since a time, in order."""
        return tuple(f.segment for f in self._inside() if f.segment.start_ns >= since_ns)

    @property
    def special_samples(self) -> int:
        """Return the number of samples in those segments."""
        return sum(segment.samples for segment in self.special_segments())

    @property
    def span_s(self) -> float:
        """Return the time from the oldest row inside the window to the end of the newest."""
        if self._end == 0:
            return 0.0
        span_ns = int(self._time_ns[self._end - 1]) - int(self._time_ns[self._first()])
        return (span_ns + self._period_ns) / NS_PER_S

    def append(
        self, time_ns: IntArray, u: FloatArray, power_mw: FloatArray,
        temperature_degc: FloatArray, opening_percent: FloatArray | None = None,
        command_percent: FloatArray | None = None, covariates: FloatArray | None = None,
    ) -> None:  # fmt: skip
        """Append rows in chronological order; rows outside the window are dropped."""
        data = np.full((len(self._data), len(time_ns)), np.nan)
        data[0], data[1], data[2] = u, power_mw, temperature_degc
        if opening_percent is not None:
            data[3] = opening_percent
        if command_percent is not None:
            data[4] = command_percent
        if covariates is not None:
            data[_SIGNALS:] = covariates.T
        number = np.arange(self._seen, self._seen + len(time_ns), dtype=np.int64)
        self._seen += len(time_ns)
        done = 0
        while self._aside is not None and done < len(time_ns):
            done = self._append_in_doubt(self._aside, time_ns, number, data, done)
        self._add(time_ns[done:], number[done:], data[:, done:])
        self._forget()

    def add_segment(self, found: FoundSegment) -> None:
        """Add a special segment that has closed.

        If it was open when the clock was set back, only the part before that is kept.
        """
        aside = self._aside
        if aside is not None and found.end_row - 1 in aside.number:
            aside.segments.append(self._with_ends(found, aside.number, aside.data))
        self._segments.extend(self._part(found))
        self._forget()

    def _part(self, found: FoundSegment) -> list[FoundSegment]:
        """Return the part of a segment whose rows are stored; none if the part is too short.

        Its ends are taken from the straight line of the segment.
        """
        number, s = self._number[: self._end], found.segment
        first, end = (int(k) for k in np.searchsorted(number, (found.first_row, found.end_row)))
        rows = end - first
        if rows == s.samples:
            return [self._with_ends(found, number, self._data[:, : self._end])]
        if rows < max(2, self._least.get(s.kind, 2)) or number[first] != found.first_row:
            return []
        share = (rows - 1) / (s.samples - 1)
        part = replace(
            s, samples=rows, end_ns=int(self._time_ns[end - 1]),
            u_end=s.u_start + share * (s.u_end - s.u_start),
            power_end_mw=s.power_start_mw + share * (s.power_end_mw - s.power_start_mw),
        )  # fmt: skip
        cut = FoundSegment(part, found.first_row, int(number[end - 1]) + 1)
        return [self._with_ends(cut, number, self._data[:, : self._end])]

    def _with_ends(self, found: FoundSegment, number: IntArray, data: FloatArray) -> FoundSegment:
        """Return a segment with opening and pressure at its ends from lines through its rows."""
        first, end = np.searchsorted(number, (found.first_row, found.end_row))
        u, opening = data[0, first:end], data[3, first:end]
        pressure = pressure_of(u, opening, self._exponent)
        known = np.isfinite(pressure)
        if known.sum() < 2:
            return found
        place = np.linspace(0.0, 1.0, len(u))[known]
        v, p = (np.polyfit(place, x[known], 1) for x in (opening, pressure))
        return replace(found, segment=replace(
            found.segment,
            opening_start_percent=float(v[1]), opening_end_percent=float(v[0] + v[1]),
            pressure_start_mpa=float(p[1]), pressure_end_mpa=float(p[0] + p[1]),
            exponent=self._exponent,
        ))  # fmt: skip

    def go_back(self, time_ns: int) -> None:
        """Set aside the rows from the time on to which the clock was set back."""
        self._drop_oldest()
        cut = int(np.searchsorted(self._time_ns[: self._end], time_ns, side='left'))
        old, stop = self._aside, self._end
        if old is not None:
            # Rows since an earlier step back belong to neither of the two times: drop them.
            stop = cut + int(np.searchsorted(self._number[cut : self._end], old.number[0]))
        passed = _Aside(
            time_ns, self._time_ns[cut:stop].copy(), self._number[cut:stop].copy(),
            self._data[:, cut:stop].copy(), [],
        )  # fmt: skip
        newest = -1 if stop == cut else int(passed.number[-1])
        known = {found.first_row for found in old.segments} if old is not None else set()
        self._end = cut
        stay: deque[FoundSegment] = deque()
        for found in self._segments:
            if found.segment.end_ns < time_ns:
                stay.append(found)
                continue
            # A segment cut by an earlier step back is already set aside as a whole.
            if found.end_row - 1 <= newest and found.first_row not in known:
                passed.segments.append(found)
            stay.extend(self._part(found))
        self._segments = stay
        self._give_back_room()
        if old is not None:
            passed = _Aside(
                min(time_ns, old.from_ns),
                np.concatenate([passed.time_ns, old.time_ns]),
                np.concatenate([passed.number, old.number]),
                np.concatenate([passed.data, old.data], axis=1),
                passed.segments + old.segments,
            )
        self._aside = passed if len(passed) else None

    def numbers(self) -> IntArray:
        """Return the numbers of the rows inside the window, counted from the first ever."""
        return self._number[self._first() : self._end].copy()

    def tail(self, rows: int) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
        """Return copies of time, ``u``, power and opening of the last ``rows`` stored rows."""
        part = slice(max(0, self._end - rows), self._end)
        u, power, opening = (self._data[k, part].copy() for k in (0, 1, 3))
        return self._time_ns[part].copy(), u, power, opening

    def contents(self, since_ns: int = 0, *, covariates: bool = False) -> WindowContents:
        """Return a copy of the rows inside the window since a time, and their segments."""
        since = int(np.searchsorted(self._time_ns[: self._end], since_ns))
        inside = slice(max(self._first(), since), self._end)
        number = self._number[inside]
        if not len(number):
            return NO_ROWS
        spans = [
            (*np.searchsorted(number, (s.first_row, s.end_row)).tolist(), int(s.segment.kind))
            for s in self._inside()
            if s.first_row >= number[0]
        ]
        command = self._data[4, inside]
        u, power, temperature = (column[inside].copy() for column in self._data[:3])
        return WindowContents(
            self._time_ns[inside].copy(),
            u,
            power,
            temperature,
            np.array(spans, dtype=np.int64).reshape(-1, 3),
            self._data[3, inside].copy(),
            # Most units do not log the command, and a snapshot is sent to another process.
            command.copy() if np.isfinite(command).any() else np.empty(0),
            self._beside(self._data[:, inside]) if covariates else {},
        )

    def _beside(self, data: FloatArray) -> dict[str, FloatArray]:
        """Return copies of the covariates in some rows, by entry."""
        return {e: data[k].copy() for k, e in enumerate(self._covariates, start=_SIGNALS)}

    def snapshot(self) -> State:
        """Return the state to be saved."""
        rows, aside = self._held(), self._aside
        return {
            'seen': self._seen,
            **self._plain(_Aside(
                0, self._time_ns[rows], self._number[rows], self._data[:, rows],
                list(self._segments),
            )),
            'aside': aside and self._plain(aside),
        }  # fmt: skip

    def restore(self, saved: State) -> None:
        """Continue from a saved state; raise `DataError` if it is invalid."""
        rows, aside = self._rows_of(saved), perhaps(saved, 'aside', dict)
        self._clear()
        self._seen = perhaps(saved, 'seen', int) or 0
        self._add(rows.time_ns, rows.number, rows.data)
        self._segments = deque(rows.segments)
        self._aside = None if aside is None else self._rows_of(aside)

    def find_segments_anew(
        self, settings: Settings, exponent: float, found_before: int
    ) -> Segmenter:
        """Replace the segments by those found with these settings; return the segmenter.

        Rows set aside are dropped. ``exponent`` is the former m of u = V p^m of the rows; the
        numbering continues from ``found_before``.
        """
        rows = slice(0, self._end)
        if exponent != self._exponent:
            u, opening = self._data[0, rows], self._data[3, rows]
            pressure = pressure_of(u, opening, exponent)
            known = np.where(u == 0.0, 0.0, math.nan)
            anew = integrated_input(opening, pressure, self._exponent)
            self._data[0, rows] = np.where(np.isfinite(pressure), anew, known)
        segmenter, found = Segmenter.over(
            settings, self._number[rows], self._time_ns[rows], self._data[:3, rows], self._seen,
            found_before,
        )  # fmt: skip
        self._aside = None
        self._segments.clear()
        for segment in found:
            self.add_segment(segment)
        return segmenter

    def _clear(self) -> None:
        self._allocate(min(_FIRST_ROOM, self._most_room))
        self._end = 0

    def _allocate(self, room: int) -> None:
        self._room = room
        self._time_ns, self._number = np.empty((2, room), dtype=np.int64)
        self._data = np.empty((_SIGNALS + len(self._covariates), room))

    def _add(self, time_ns: IntArray, number: IntArray, data: FloatArray) -> None:
        done = 0
        while done < len(time_ns):
            if self._end == self._room:
                self._make_room()
            take = min(self._room - self._end, len(time_ns) - done)
            part, place = slice(done, done + take), slice(self._end, self._end + take)
            self._time_ns[place], self._number[place] = time_ns[part], number[part]
            self._data[:, place] = data[:, part]
            self._end += take
            done += take

    def _append_in_doubt(
        self, aside: _Aside, time_ns: IntArray, number: IntArray, data: FloatArray, done: int
    ) -> int:
        """Append rows until it is decided whether the step back of the clock is permanent."""
        # Rows dropped by a further step back count, too; otherwise there might be no decision.
        since = int(number[done] - aside.number[-1]) - 1
        enough = done + min(len(aside), self._doubt) - since
        over = done + int(np.searchsorted(time_ns[done:], aside.time_ns[-1], side='right'))
        until = min(enough, over, len(time_ns))
        self._add(time_ns[done:until], number[done:until], data[:, done:until])
        if until == enough:
            self._aside = None
        elif until == over and until < len(time_ns):
            before_ns = self._time_ns[self._end - 1] if self._end else 0
            self._aside = None
            # A return to the old time is a jump as large as the step back; a smaller one is a gap.
            if time_ns[over] - before_ns > (aside.time_ns[-1] - aside.from_ns) // 2:
                self._take_back(aside)
        return until

    def _take_back(self, aside: _Aside) -> None:
        last = aside.number[-1]
        self._end = int(np.searchsorted(self._number[: self._end], last))
        whole = {found.first_row for found in aside.segments}
        self._segments = deque(
            s for s in self._segments if s.end_row - 1 <= last and s.first_row not in whole
        )
        self._segments.extend(aside.segments)
        self._add(aside.time_ns, aside.number, aside.data)

    def _inside(self) -> list[FoundSegment]:
        if not self._end:
            return []
        oldest = int(self._time_ns[self._end - 1]) - self._window_ns
        return [found for found in self._segments if found.segment.start_ns > oldest]

    def _held(self) -> slice:
        """Return the slice of the last rows, as many as a full window has."""
        return slice(max(0, self._end - self._rows), self._end)

    def _first(self) -> int:
        """Return the index of the oldest row inside the window."""
        if self._end == 0:
            return 0
        held = self._held()
        oldest = self._time_ns[self._end - 1] - self._window_ns
        return int(held.start + np.searchsorted(self._time_ns[held], oldest, side='right'))

    def _make_room(self) -> None:
        """Enlarge the arrays up to the window's size, then drop old rows, many at a time."""
        if self._room < self._most_room:
            self._resize(min(self._most_room, 2 * self._room))
            return
        self._drop_oldest()

    def _drop_oldest(self) -> None:
        """Drop the oldest rows, keeping as many as a full window has."""
        if self._end <= self._rows:
            return
        held = self._held()
        # One column at a time: a copy of all would be as large as the window itself.
        for column in (self._time_ns, self._number, *self._data):
            column[: self._rows] = column[held].copy()
        self._end = self._rows

    def _give_back_room(self) -> None:
        """Shrink the arrays if few rows are left, because the rows set aside need memory, too."""
        if self._room > _FIRST_ROOM and 4 * self._end < self._room:
            self._resize(min(self._most_room, max(_FIRST_ROOM, 2 * self._end)))

    def _resize(self, room: int) -> None:
        end = self._end
        time_ns, number, data = self._time_ns, self._number, self._data
        self._allocate(room)
        self._time_ns[:end], self._number[:end] = time_ns[:end], number[:end]
        self._data[:, :end] = data[:, :end]

    def _forget(self) -> None:
        if not self._end:
            return
        first = int(self._number[self._held().start])
        while self._segments and self._segments[0].first_row < first:
            self._segments.popleft()

    def _plain(self, rows: _Aside) -> State:
        """Return rows and segments as plain values; most units do not log the command."""
        command = rows.data[4]
        beside = {'covariates': self._beside(rows.data)} if self._covariates else {}
        return {
            'from_ns': rows.from_ns,
            'time_ns': rows.time_ns.copy(),
            'number': rows.number.copy(),
            'rows': rows.data[:4].copy(),
            'command': command.copy() if np.isfinite(command).any() else np.empty(0),
            'segments': [_found_values(found) for found in rows.segments],
            **beside,
        }

    def _rows_of(self, saved: State) -> _Aside:
        """Return rows and segments from plain values; raise `DataError` if they are invalid.

        Covariates that were not saved are NaN.
        """
        time_ns, number, rows, command = (
            saved[n] for n in ('time_ns', 'number', 'rows', 'command')
        )
        n, beside = len(time_ns), saved.get('covariates', {})
        unknown = np.full(n, np.nan)
        last = [command if len(command) else unknown]
        last += [beside.get(entry, unknown) for entry in self._covariates]
        if rows.shape != (4, n) or len(number) != n or any(x.shape != (n,) for x in last):
            raise DataError('The saved state has rows of different lengths.')
        segments = [_found_of(values) for values in saved['segments']]
        data = np.concatenate([rows, np.stack(last)])
        return _Aside(perhaps(saved, 'from_ns', int) or 0, time_ns, number, data, segments)
