# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Turns changes of single values into one sample per period; the time is always an argument."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from valveflow_ros.opcua.mapping import UnitMapping
from valveflow_ros.records import N_SIGNALS, NS_PER_S, Quality

# Maximum lead of a source timestamp over this machine's clock.
AHEAD_NS = NS_PER_S
# Maximum number of periods sent at once after this process was suspended.
_MOST_DUE = 600


class Change(NamedTuple):
    """A value sent by the server, converted to the monitor's unit.

    ``source_ns`` is 0 if the server gave no time. ``value`` is NaN if there is no number.
    ``problem`` is 'wrong_type' or 'not_finite', or empty if the value is valid or marked as bad.
    """

    signal: int
    source_ns: int
    received_ns: int
    value: float
    quality: int
    problem: str = ''


class Sample(NamedTuple):
    """A sample: values in the monitor's units, NaN if bad; qualities, None if not mapped."""

    time_ns: int
    values: Sequence[float]
    quality: Sequence[int | None]


@dataclass(slots=True)
class Counts:
    """Counters of one signal."""

    # received, lost: changes received, and overflows of the server's queue (each loses at least
    # one change)
    received: int = 0
    lost: int = 0
    # uncertain, bad: changes with this StatusCode
    uncertain: int = 0
    bad: int = 0
    # wrong_type, not_finite: values that are no number, NaN or infinite; used as bad
    wrong_type: int = 0
    not_finite: int = 0
    # Source timestamps more than `AHEAD_NS` ahead; the value is used from its receipt, as
    # uncertain.
    future: int = 0
    # went_back, without_time: source timestamps earlier than the previous one, and missing ones
    went_back: int = 0
    without_time: int = 0


_BAD = (math.nan, int(Quality.BAD))


@dataclass(slots=True)
class _Held:
    """The values of a signal: the current one, and those that are valid from later times."""

    now: tuple[float, int] = _BAD
    later: deque[tuple[int, float, int]] = field(default_factory=deque)
    last_ns: int = 0
    source_ns: int = 0

    def add(self, time_ns: int, value: float, quality: int) -> None:
        self.last_ns = max(self.last_ns, time_ns)
        self.later.append((self.last_ns, value, quality))

    def at(self, time_ns: int) -> tuple[float, int]:
        while self.later and self.later[0][0] <= time_ns:
            _, *now = self.later.popleft()
            self.now = now[0], int(now[1])
        return self.now


class Sampler:
    """Stores the values of a unit and returns its samples, period by period.

    The first period ends after ``now_ns``.

    Notes
    -----
    A period is complete when the server has confirmed a time not before its end, by values or by
    a keep-alive. Its sample has the newest value of each signal with a source timestamp not after
    this end, which is the stamp of the sample. A value is therefore repeated as good only while
    the server responds. A period that is not confirmed within ``patience_ns`` is sent as bad.
    Stamps are whole multiples of the period and never decrease.
    """

    def __init__(self, unit: UnitMapping, now_ns: int) -> None:
        self._period_ns = unit.period_ns
        self._mapped = {int(node.signal) for node in unit.nodes}
        self._held = {signal: _Held() for signal in self._mapped}
        self.counts = {signal: Counts() for signal in sorted(self._mapped)}
        self.newest: dict[int, Change] = {}  # last change by signal
        self.patience_ns = self._least_patience_ns = unit.lateness_ns
        self.confirmed_ns = 0
        self._next_ns = (now_ns // unit.period_ns + 1) * unit.period_ns
        self.sent = self.unconfirmed = 0

    def keep_alive(self, seconds: float) -> None:
        """Set the time for which the server may be silent while nothing changes."""
        self.patience_ns = max(self._least_patience_ns, round(1.5 * seconds * NS_PER_S))

    def take(self, changes: Iterable[Change], confirmed_ns: int) -> None:
        """Add changes in order of arrival, and set the time that the server has confirmed."""
        for change in changes:
            held, counts = self._held[change.signal], self.counts[change.signal]
            counts.received += 1
            time_ns, quality = change.source_ns, change.quality
            if change.problem:
                setattr(counts, change.problem, getattr(counts, change.problem) + 1)
            counts.bad += quality == Quality.BAD and not change.problem
            counts.uncertain += quality == Quality.UNCERTAIN
            if not time_ns:
                counts.without_time += 1
                time_ns = change.received_ns
            elif time_ns > change.received_ns + AHEAD_NS:
                counts.future += 1
                time_ns, quality = change.received_ns, max(quality, int(Quality.UNCERTAIN))
            elif time_ns < held.source_ns:
                counts.went_back += 1
            held.source_ns = time_ns
            self.newest[change.signal] = change._replace(source_ns=time_ns, quality=quality)
            held.add(time_ns, change.value, quality)
        self.confirmed_ns = max(self.confirmed_ns, confirmed_ns)

    def lose(self) -> None:
        """Handle a lost link: all values are bad after the last confirmed time."""
        for held in self._held.values():
            held.add(self.confirmed_ns, *_BAD)

    def restore(self, history: Iterable[Change], now_ns: int) -> None:
        """Add the history of a gap, in time order for each signal, before `take` continues.

        A signal without history stays bad until now.
        """
        found = set()
        for change in history:
            self._held[change.signal].add(change.source_ns, change.value, change.quality)
            found.add(change.signal)
        for signal in self._mapped - found:
            self._held[signal].add(now_ns, *_BAD)

    def due(self, now_ns: int) -> list[Sample]:
        """Return the samples that can be sent now, in order."""
        self._next_ns = max(
            self._next_ns, (now_ns // self._period_ns - _MOST_DUE) * self._period_ns
        )
        samples = []
        while self._next_ns <= now_ns:
            confirmed = self.confirmed_ns >= self._next_ns
            if not confirmed and now_ns - self._next_ns < self.patience_ns:
                break
            if not confirmed:
                self.unconfirmed += 1
            samples.append(self._sample(self._next_ns, confirmed))
            self._next_ns += self._period_ns
        self.sent += len(samples)
        return samples

    def _sample(self, time_ns: int, confirmed: bool) -> Sample:
        values = [math.nan] * N_SIGNALS
        quality: list[int | None] = [None] * N_SIGNALS
        for signal, held in self._held.items():
            value, code = held.at(time_ns) if confirmed else _BAD
            bad = code == Quality.BAD or not math.isfinite(value)
            values[signal], quality[signal] = _BAD if bad else (value, code)
        return Sample(time_ns, values, quality)
