# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""From changes of single values to one sample a period; no clock, no link: time is an argument."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from valveflow_ros.opcua.mapping import UnitMapping
from valveflow_ros.records import N_SIGNALS, NS_PER_S, Quality

# How far a source timestamp may be ahead of this machine's clock.
AHEAD_NS = NS_PER_S
# More periods than these are not sent at once after this process stood still.
_MOST_DUE = 600


class Change(NamedTuple):
    """A value as the server sent it, in the monitor's unit.

    ``source_ns`` is 0 where the server gave no time. ``value`` is NaN where there is no number;
    ``problem`` is then 'wrong_type' or 'not_finite', or empty if the server itself said bad.
    """

    signal: int
    source_ns: int
    received_ns: int
    value: float
    quality: int
    problem: str = ''


class Sample(NamedTuple):
    """One sample: values in the monitor's units, NaN where bad; qualities, None: not mapped."""

    time_ns: int
    values: Sequence[float]
    quality: Sequence[int | None]


@dataclass(slots=True)
class Counts:
    """What came for one signal.

    Attributes
    ----------
    received, lost : int
        Changes that came, and overflows of the server's queue, each at least one change lost.
    uncertain, bad : int
        Changes with that StatusCode.
    wrong_type, not_finite : int
        Values that are no number, NaN or infinite; used as bad.
    future : int
        Source timestamps more than `AHEAD_NS` ahead; the value counts from its receipt, as
        uncertain.
    went_back, without_time : int
        Source timestamps before the one before them, and absent ones.
    """

    received: int = 0
    lost: int = 0
    uncertain: int = 0
    bad: int = 0
    wrong_type: int = 0
    not_finite: int = 0
    future: int = 0
    went_back: int = 0
    without_time: int = 0


_BAD = (math.nan, int(Quality.BAD))


@dataclass(slots=True)
class _Held:
    """A signal: the value that counts now, and those that count from later on."""

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
    """Holds the values of a unit and gives its samples, period by period.

    Parameters
    ----------
    unit : UnitMapping
    now_ns : int
        The first period ends after this time.

    Notes
    -----
    A period is closed when the server has confirmed a time after its end: by values, or by saying
    that nothing changed (keep-alive). Its sample holds the newest value of each signal whose
    source timestamp is not after that end, which is its stamp. So a value is repeated as good
    only as long as the server answers. A period that is not confirmed within the patience is sent
    as bad. Stamps are whole multiples of the period and never go back.
    """

    def __init__(self, unit: UnitMapping, now_ns: int) -> None:
        self._period_ns = unit.period_ns
        self._mapped = {int(node.signal) for node in unit.nodes}
        self._held = {signal: _Held() for signal in self._mapped}
        self.counts = {signal: Counts() for signal in sorted(self._mapped)}
        self.newest: dict[int, Change] = {}  # by signal, as it came last
        self.patience_ns = self._least_patience_ns = unit.lateness_ns
        self.confirmed_ns = 0
        self._next_ns = (now_ns // unit.period_ns + 1) * unit.period_ns
        self.sent = self.unconfirmed = 0

    def keep_alive(self, seconds: float) -> None:
        """Take how long the server may be silent while nothing changes."""
        self.patience_ns = max(self._least_patience_ns, round(1.5 * seconds * NS_PER_S))

    def take(self, changes: Iterable[Change], confirmed_ns: int) -> None:
        """Take changes in the order of their arrival; the server has confirmed that time."""
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
        """Take that the link is lost: no value counts after what was confirmed last."""
        for held in self._held.values():
            held.add(self.confirmed_ns, *_BAD)

    def restore(self, history: Iterable[Change], now_ns: int) -> None:
        """Take the history of the gap, by signal in the order of time, before `take` goes on.

        A signal without any stays bad until now.
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
