# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Receives the input messages, puts them in one order, and assigns their times."""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from valveflow_ros.ros.decoding import INPUT_ORDER, PLANT_SAMPLE, Decoder, Row, header_time_ns
from valveflow_ros.ros.node.polled_subscription import DEPTH, RawMessage

_CLOCKS_KEPT = 16384


class LogClock:
    """Makes receipt times strictly increasing, so that a log has the order of processing.

    If the machine's clock is set back, each message gets the last time plus 1 ns
    until the clock has caught up. The first time is later than ``after_ns``.
    """

    def __init__(self, after_ns: int = 0) -> None:
        self.last_ns = after_ns

    def stamp(self, received_ns: int) -> int:
        """Return the log time of a message."""
        self.last_ns = max(received_ns, self.last_ns + 1)
        return self.last_ns


class ClockTrack:
    """Stores /clock messages, to find the time of /clock when a value was published.

    Send times are compared, so a value is assigned to the clock message sent just
    before it, even if one of them is received late.
    """

    def __init__(self) -> None:
        self._sent_ns: list[int] = []
        self._clock_ns: list[int] = []
        self._trimmed = False

    @property
    def newest_ns(self) -> int:
        """Return the send time of the newest clock message; 0 before the first."""
        return self._sent_ns[-1] if self._sent_ns else 0

    @property
    def first_ns(self) -> int:
        """Return the time in the first clock message; 0 before it."""
        return self._clock_ns[0] if self._clock_ns else 0

    def lead_ns(self, sent_ns: int) -> int:
        """Return how long before the first clock message ``sent_ns`` is; 0 if after it."""
        if self._trimmed or not self._sent_ns:
            return 0
        return max(0, self._sent_ns[0] - sent_ns)

    def note(self, sent_ns: int, clock_ns: int) -> None:
        """Add a message of /clock."""
        at = bisect_right(self._sent_ns, sent_ns)
        self._sent_ns.insert(at, sent_ns)
        self._clock_ns.insert(at, clock_ns)
        if len(self._sent_ns) > 2 * _CLOCKS_KEPT:
            self._trimmed = True
            del self._sent_ns[:_CLOCKS_KEPT]
            del self._clock_ns[:_CLOCKS_KEPT]

    def at(self, sent_ns: int) -> int:
        """Return the time of /clock at a send time; 0 if unknown."""
        at = bisect_right(self._sent_ns, sent_ns)
        return self._clock_ns[at - 1] if at else 0


_STALE_LEAST_S = 2.0
_STALE_PERIODS = 2.5
_MEMORY = 0.1  # weight of the newest interval in the mean period


@dataclass(slots=True)
class TopicStatistics:
    """Statistics of one topic: rate, time of the last message, lost messages.

    Times are monotonic, in s.
    """

    received: int = 0  # messages received
    # Messages that were sent but not delivered, from gaps in the publisher's sequence numbers; not
    # counted while there is more than one publisher.
    lost: int = 0
    # Messages sent before the first one received; usually before the subscription.
    missed_at_start: int = 0
    # Sequence numbers that decreased: a publisher was restarted, or there are two.
    irregular: int = 0
    # malformed, without_time: messages that were recorded but not used
    malformed: int = 0
    without_time: int = 0
    # waiting, before_clock: messages that wait for the first /clock message, and those sent before
    # it
    waiting: int = 0
    before_clock: int = 0
    last_s: float | None = None
    period_s: float | None = None
    _number: int = 0
    _mixed: bool = False
    _anew: bool = False
    _several: bool = False
    _irregular_before: int = 0
    _lost_before: int = 0

    def note_number(self, number: int) -> None:
        """Count a message with its sequence number; 0 if the middleware gives none."""
        self.received += 1
        if number <= 0:
            return
        if self._number == 0:
            self.missed_at_start = number - 1
        elif number <= self._number:
            self.irregular += 1
            self._mixed = True
            # The last gap may have been the difference between the numbers of two publishers.
            self.lost = min(self.lost, self._lost_before)
        elif not self._mixed and not self._anew:
            self.lost += number - self._number - 1
        self._number, self._anew = number, False

    def note_publishers(self, count: int) -> None:
        """Set the current number of publishers.

        Each publisher has its own sequence numbers, and a message does not name its publisher,
        so losses cannot be counted with two. Counting resumes when only one is left.
        """
        if count > 1:
            # Since the last call, the numbers of two publishers may have been mixed.
            self.lost = min(self.lost, self._lost_before)
        self._lost_before = self.lost
        mixed = count > 1 or self.irregular > self._irregular_before
        # The last number may be from a publisher that has gone.
        self._anew = self._anew or (self._several and count <= 1) or count == 0
        self._mixed, self._several = mixed, count > 1
        self._irregular_before = self.irregular

    def note_arrival(self, count: int, now_s: float) -> None:
        """Store the time at which ``count`` messages were received."""
        if count == 0:
            return
        if self.last_s is not None:
            interval = (now_s - self.last_s) / count
            before = interval if self.period_s is None else self.period_s
            weight = 1.0 - (1.0 - _MEMORY) ** count
            self.period_s = (1.0 - weight) * before + weight * interval
        self.last_s = now_s

    def age_s(self, now_s: float) -> float | None:
        """Return the age of the newest message in s; None before the first."""
        return None if self.last_s is None else now_s - self.last_s

    def rate_hz(self) -> float | None:
        """Return the recent mean rate in Hz; None while unknown."""
        return 1.0 / self.period_s if self.period_s else None

    def stale(self, now_s: float) -> bool:
        """Return True if messages were received but have stopped."""
        age = self.age_s(now_s)
        return age is not None and age > max(_STALE_LEAST_S, _STALE_PERIODS * (self.period_s or 0))


_MOST_CLOCKS = 16 * DEPTH
# Limits for plain values that wait for the first /clock; waiting values are not on disk yet.
MAX_WAITING = 16 * DEPTH
LONGEST_WAIT_S = 5.0
_PATIENCE_S = 0.03
_CLOCK_PATIENCE_S = 0.2
# A message may have a receipt time shortly before it can be taken.
_IN_FLIGHT_NS = 200_000


class Arrival(NamedTuple):
    """An input message with its log time and the time of its values."""

    name: str
    data: bytes
    log_ns: int
    time_ns: int


class _Held(NamedTuple):
    """A message that waits: its sort keys, and the time at which it was taken."""

    received_ns: int
    order: int
    taken_s: float
    name: str
    message: RawMessage


class MessageSource(Protocol):
    """Interface of a source of messages."""

    def take(self, most: int = DEPTH) -> list[RawMessage]:
        """Return the messages that have arrived."""


class Intake:
    """Collects messages in the order in which they are recorded and processed.

    Parameters
    ----------
    sources : mapping of str to MessageSource
        By contract name of the input.
    decoder : Decoder
    log_clock : LogClock
        Shared with other writers of the same log.
    stamp_source : str
        'source', 'receive' or 'ros_time'; see the parameter of that name.
    clock : MessageSource, optional
        /clock; if given, it determines the time of every plain value.
    watch : callable
        Called with the topic's name and the readings of each message.

    Notes
    -----
    Topics are polled one after the other. While a plant runs faster than real time, a later topic
    would be ahead of an earlier one by many samples. A call therefore returns only messages that
    were received before it began, and keeps the rest for the next call. With a /clock, a value
    waits for a short time until a clock message arrives that was sent after it.

    A value sent before the first clock message waits for that message. Its time is that of the
    first clock message minus the difference of their send times. After `LONGEST_WAIT_S`, or if
    more than `MAX_WAITING` values wait, the oldest are logged with time 0 and not processed.
    """

    def __init__(
        self,
        sources: Mapping[str, MessageSource],
        decoder: Decoder,
        log_clock: LogClock,
        stamp_source: str = 'source',
        clock: MessageSource | None = None,
        watch: Callable[[str, list[Row]], None] = lambda _name, _rows: None,
    ) -> None:
        self._sources = dict(sources)
        self._decoder = decoder
        self._log_clock = log_clock
        # Without a /clock, ROS time is the machine's clock.
        self._by_receipt = stamp_source in ('receive', 'ros_time')
        self._clock = clock
        self._watch = watch
        self._track = ClockTrack()
        self._held: list[_Held] = []
        self._waiting: deque[_Held] = deque()
        self.statistics = {name: TopicStatistics() for name in self._sources}

    def collect(self, now_s: float, now_ns: int, last: bool = False) -> list[Arrival]:
        """Return the messages that are due, in their final order; all of them if ``last``.

        ``now_s`` is monotonic; ``now_ns`` is the machine's clock, for messages without a receipt
        time.
        """
        until_ns = now_ns - _IN_FLIGHT_NS
        for name, source in self._sources.items():
            found = source.take()
            if not found:
                continue
            statistics = self.statistics[name]
            statistics.note_arrival(len(found), now_s)
            for taken in found:
                statistics.note_number(taken.sequence)
                received_ns = taken.received_ns or now_ns
                held = _Held(received_ns, INPUT_ORDER.get(name, -1), now_s, name, taken)
                self._hold(held)
            if len(found) >= DEPTH:
                # The source has more messages, received after the last of these.
                until_ns = min(until_ns, received_ns)
        if self._clock is not None:
            for message in self._clock.take(_MOST_CLOCKS):
                self._track.note(message.source_ns, header_time_ns(message.data))
            self._release(now_s, last)
        if not self._held:
            return []
        # Sort by receipt time, then by topic; messages of one topic keep their order.
        self._held.sort(key=lambda held: held[:2])
        count = len(self._held)
        if not last:
            waiting = (k for k, h in enumerate(self._held) if not self._due(h, until_ns, now_s))
            count = next(waiting, count)
        ready, self._held = self._held[:count], self._held[count:]
        return [self._arrival(held) for held in ready]

    def _hold(self, held: _Held) -> None:
        """Store a message until it is due; a plain value waits for the first clock message."""
        if self._clock is None or self._track.newest_ns or held.name == PLANT_SAMPLE:
            self._held.append(held)
            return
        self._waiting.append(held)
        self.statistics[held.name].waiting += 1

    def _release(self, now_s: float, last: bool) -> None:
        """End the wait for the first clock message if it has come or a limit is reached."""
        most = 0 if last or self._track.newest_ns else MAX_WAITING
        while self._waiting and (
            len(self._waiting) > most or now_s - self._waiting[0].taken_s > LONGEST_WAIT_S
        ):
            held = self._waiting.popleft()
            self.statistics[held.name].waiting -= 1
            self._held.append(held)

    def _due(self, held: _Held, until_ns: int, now_s: float) -> bool:
        waited_s = now_s - held.taken_s
        if self._clock is None:
            # The time limit applies if the machine's clock was set back.
            return held.received_ns <= until_ns or waited_s > _PATIENCE_S
        ready = held.received_ns <= until_ns and held.message.source_ns < self._track.newest_ns
        return ready or waited_s > _CLOCK_PATIENCE_S

    def rows(self, arrivals: list[Arrival]) -> list[Row]:
        """Return the readings in the messages; count those without time or not decodable."""
        rows: list[Row] = []
        for arrival in arrivals:
            if arrival.time_ns <= 0:
                self.statistics[arrival.name].without_time += 1
                continue
            try:
                found = self._decoder.rows(arrival.name, arrival.data, arrival.time_ns)
            except ValueError:
                self.statistics[arrival.name].malformed += 1
                continue
            self._watch(arrival.name, found)
            rows += found
        return rows

    def _arrival(self, held: _Held) -> Arrival:
        received_ns, name, message = held.received_ns, held.name, held.message
        time_ns = received_ns if self._by_receipt else message.source_ns or received_ns
        if self._clock is not None:
            time_ns = self._clock_time(name, message)
        time_ns = max(0, self._decoder.time_ns(name, message.data, time_ns))
        return Arrival(name, message.data, self._log_clock.stamp(received_ns), time_ns)

    def _clock_time(self, name: str, message: RawMessage) -> int:
        """Return the time of /clock when a message was sent; 0 if unknown."""
        lead_ns = self._track.lead_ns(message.source_ns)
        if not lead_ns:
            return self._track.at(message.source_ns)
        if name != PLANT_SAMPLE:
            self.statistics[name].before_clock += 1
        return max(0, self._track.first_ns - lead_ns)
