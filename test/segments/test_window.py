# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from streams import START_NS, blocks_of, examples

from valveflow_ros.records import NS_PER_S, SegmentKind, SpecialSegment
from valveflow_ros.segments.segmenter import FoundSegment
from valveflow_ros.segments.window import RollingWindow
from valveflow_ros.state import from_bytes, to_bytes


def segment(number, first, end, start_ns, kind=SegmentKind.STEADY):
    record = SpecialSegment(
        number=number, kind=kind, start_ns=start_ns,
        end_ns=start_ns + (end - first - 1) * NS_PER_S, samples=end - first, u_start=0.0,
        u_end=0.0, u_rate_per_s=0.0, u_rms=0.0, power_start_mw=0.0, power_end_mw=0.0,
        power_rms_mw=0.0, temperature_mean_degc=540.0,
    )  # fmt: skip
    return FoundSegment(record, first, end)


def rows_after(last_ns, n, gap_s=0):
    return last_ns + (gap_s + 1 + np.arange(n, dtype=np.int64)) * NS_PER_S


RETURN = 10**6  # to where the time was before it went back, and a little on

actions = st.lists(
    st.tuples(
        st.one_of(st.integers(0, 40), st.integers(0, 200)),
        st.sampled_from([0, 0, 5, 300, RETURN, RETURN, -3, -30, -90, -1000]),
    ),
    min_size=1,
    max_size=25,
)


class NaiveWindow:
    """All rows one by one and all segments, for ever; the window is looked up when asked for."""

    def __init__(self, window_s):
        self.window_s = window_s
        self.most = max(16, window_s + 1)
        self.rows, self.aside, self.segments = [], [], []  # rows are (number, time, values)

    def take(self, row):
        if self.aside and row[1] > self.aside[-1][1]:
            step_s = (self.aside[-1][1] - self.earliest) / NS_PER_S
            if not self.rows or (row[1] - self.rows[-1][1]) / NS_PER_S > step_s / 2:
                # The time leapt over what it had gone back behind: it had not gone back.
                self.rows = [r for r in self.rows if r[0] < self.aside[0][0]] + self.aside
            self.aside = []
        self.rows = [*self.rows, row][-self.most :]
        if self.aside and row[0] - self.aside[-1][0] >= min(len(self.aside), 3600):
            self.aside = []

    def go_back(self, back_ns):
        time_ns = back_ns
        passed = [r for r in self.rows if r[1] >= time_ns]
        if self.aside:
            passed = [r for r in passed if r[0] < self.aside[0][0]]
            time_ns = min(time_ns, self.earliest)
        self.earliest = time_ns
        self.rows = [r for r in self.rows if r[1] < back_ns]
        self.aside = passed + self.aside

    def contents(self):
        if not self.rows:
            return [], []
        oldest = self.rows[-1][1] - self.window_s * NS_PER_S
        inside = [row for row in self.rows if row[1] > oldest]
        numbers = [row[0] for row in inside]
        spans = []
        for s in self.segments:
            # A step of the clock cuts off the end of one, and what is left is one.
            there = [n for n in range(s.first_row, s.end_row) if n in set(numbers)]
            if len(there) > 1 and there[0] == s.first_row:
                first, last = numbers.index(there[0]), numbers.index(there[-1])
                spans.append([first, last + 1, int(s.segment.kind)])
        return inside, spans


@examples(200)
@given(actions, st.sampled_from([20, 60, 333]), st.integers(0, 2**32 - 1))
def test_after_every_append_the_window_holds_what_the_slow_truth_holds(plan, window_s, seed):
    rng = np.random.default_rng(seed)
    fast, slow = RollingWindow(window_s, 1.0), NaiveWindow(window_s)
    last = START_NS
    counted, newest, times = 0, START_NS, []
    for n, gap in plan:
        if gap == RETURN:
            last, gap = newest, 3
        time_ns = rows_after(last, n, gap)
        columns = rng.normal(0.0, 1.0, (3, n))
        if n and gap < 0:
            fast.go_back(int(time_ns[0]))
            slow.go_back(int(time_ns[0]))
        columns[0, rng.random(n) < 0.1] = np.nan
        for start, end in blocks_of(n, sorted(rng.integers(0, n + 1, 2).tolist())):
            fast.append(time_ns[start:end], *columns[:, start:end])
        for row in zip(time_ns.tolist(), *columns.tolist(), strict=True):
            slow.take((counted, *row))
            times.append(row[0])
            counted += 1
        if n:
            last = int(time_ns[-1])
            newest = max(newest, last)
        first = counted - n - 15
        if n and gap < 0 <= first and times[first + 14] - times[first] == 14 * NS_PER_S:
            # One that was open when the clock went back.
            found = segment(2, first, first + 15, times[first])
            fast.add_segment(found)
            slow.segments.append(found)
        if n > 20:
            kind = SegmentKind(int(rng.integers(1, 3)))
            found = segment(1, counted - 15, counted - 5, int(time_ns[-15]), kind)
            fast.add_segment(found)
            slow.segments.append(found)
        if rng.random() < 0.2:
            saved = from_bytes(to_bytes(fast.snapshot()))
            fast = RollingWindow(window_s, 1.0)
            fast.restore(saved)
        rows, spans = slow.contents()
        held = fast.contents()
        assert fast.numbers().tolist() == [r[0] for r in rows]
        assert held.time_ns.tolist() == [r[1] for r in rows]
        span_s = (rows[-1][1] - rows[0][1]) / NS_PER_S + 1.0 if rows else 0.0
        assert fast.span_s == span_s
        for c, column in enumerate((held.u, held.power_mw, held.temperature_degc), start=2):
            assert np.array_equal(column, [r[c] for r in rows], equal_nan=True)
        assert held.spans.tolist() == spans
        assert fast.segments == len(spans) == len(fast.special_segments())
        assert held.special_rows().tolist() == [k for a, b, _ in spans for k in range(a, b)]
        for kind in SegmentKind:
            assert held.count(kind) == sum(s[2] == kind for s in spans)


@examples(30)
@given(actions, st.integers(0, 300))
def test_the_tail_is_the_newest_rows(plan, wanted):
    window = RollingWindow(100.0, 1.0)
    seen = []
    last = START_NS
    for n, gap in plan:
        time_ns = rows_after(last, n, abs(gap))
        window.append(time_ns, np.arange(n) + len(seen), np.zeros(n), np.zeros(n))
        seen += list(range(len(seen), len(seen) + n))
        last = int(time_ns[-1]) if n else last
    newest = window.tail(wanted)[1]
    assert newest.tolist() == (seen[-len(newest) :] if len(newest) else [])
    assert len(newest) >= min(wanted, len(seen), 101)


@pytest.mark.parametrize('least_s', [None, 60.0, 61.0])
@pytest.mark.parametrize('open_then', [False, True])
def test_a_segment_that_a_step_of_the_clock_cuts_goes_on_to_there_in_its_line(least_s, open_then):
    least = None if least_s is None else {SegmentKind.SLOPE: least_s}
    window = RollingWindow(86400.0, 1.0, 1.0, least)
    line = np.arange(101.0)
    time_ns = rows_after(START_NS, 101)
    opening = 20.0 + 0.1 * line
    window.append(time_ns, 16.0 * opening, 5.0 * line, np.full(101, 540.0), opening)
    found = segment(7, 0, 101, int(time_ns[0]), SegmentKind.SLOPE)
    record = replace(found.segment, u_start=320.0, u_end=480.0, power_end_mw=500.0)
    found = replace(found, segment=record)
    back = slice(60, 61)

    def go_back():
        window.go_back(int(time_ns[60]))
        window.append(time_ns[back], *np.zeros((3, 1)))

    for act in (go_back, None) if open_then else (None, go_back):
        (act or (lambda: window.add_segment(found)))()
    if least_s == 61.0:
        assert window.special_segments() == ()
        return
    (cut,) = window.special_segments()
    assert (cut.number, cut.kind, cut.start_ns) == (7, SegmentKind.SLOPE, int(time_ns[0]))
    assert (cut.samples, cut.end_ns) == (60, int(time_ns[59]))
    ends = (cut.u_start, cut.u_end, cut.power_end_mw, cut.opening_end_percent,
            cut.pressure_end_mpa)  # fmt: skip
    np.testing.assert_allclose(ends, (320.0, 16.0 * 25.9, 5.0 * 59.0, 25.9, 16.0))
    # Should the clock have been wrong only for a moment, it is whole again.
    later = rows_after(int(time_ns[-1]), 5)
    window.append(later, *np.zeros((3, 5)))
    (again,) = window.special_segments()
    assert (again.samples, again.end_ns, again.u_end) == (101, int(time_ns[100]), 480.0)
    assert window.contents().spans.tolist() == [[0, 101, 2]]


def feed(window, first_s, end_s, marks):
    """Append rows of a second, marked by a value of their own."""
    seconds = np.arange(first_s, end_s, dtype=np.int64)
    window.append(seconds * NS_PER_S, *np.full((3, len(seconds)), float(marks)))


def test_a_run_that_begins_again_and_again_is_the_last_one():
    window = RollingWindow(86400.0, 1.0)
    for run in range(1, 6):
        if run > 1:
            window.go_back(10 * NS_PER_S)
        feed(window, 10, 3000 - 100 * run, run)
    feed(window, 3200, 3210, 6)
    assert window.contents().u.tolist() == [5.0] * 2490 + [6.0] * 10


def test_memory_is_bounded_however_long_it_runs():
    window = RollingWindow(1000.0, 1.0)
    last = START_NS
    for _ in range(60):
        time_ns = rows_after(last, 777)
        window.append(time_ns, *np.zeros((3, 777)))
        last = int(time_ns[-1])
        assert len(window) <= 1000 * 5 // 4 + 20
    assert len(window.contents().time_ns) == 1000
