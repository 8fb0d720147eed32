"""One look at all inputs: take, put in order, give each message its times."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple, Protocol

from rosgraph_msgs.msg import Clock

from valveflow_ros.ros.inputs import INPUT_ORDER, Decoder, Row, header_time_ns
from valveflow_ros.ros.stamps import ClockTrack, LogClock
from valveflow_ros.ros.taking import DEPTH, Taken
from valveflow_ros.ros.tallies import Tally

__all__ = ['Arrival', 'Clock', 'Intake']

_MOST_CLOCKS = 16 * DEPTH


class Arrival(NamedTuple):
    """A message of an input with the times it is logged at and belongs to."""

    name: str
    data: bytes
    log_ns: int
    time_ns: int


class Source(Protocol):
    """Something messages can be taken from."""

    def take(self, most: int = DEPTH) -> list[Taken]:
        """Return what has arrived."""


class Intake:
    """Collects arrivals in the one order in which they are recorded and fed.

    Parameters
    ----------
    sources : mapping of str to Source
        By the contract's names of the inputs.
    decoder : Decoder
    log_clock : LogClock
        Shared with whoever else writes to the same log.
    stamp_source : str
        'source' or 'receive'; see the parameter of that name.
    clock : Source, optional
        /clock; if given, it gives every plain value its time.
    watch : callable
        Is shown the readings of each message, with the topic's name.

    Notes
    -----
    With a /clock each message is held back until the next look, so that the
    clock message sent just before it cannot still be on its way.
    """

    def __init__(
        self,
        sources: Mapping[str, Source],
        decoder: Decoder,
        log_clock: LogClock,
        stamp_source: str = 'source',
        clock: Source | None = None,
        watch: Callable[[str, list[Row]], None] = lambda _name, _rows: None,
    ) -> None:
        self._sources = dict(sources)
        self._decoder = decoder
        self._log_clock = log_clock
        self._by_receipt = stamp_source == 'receive'
        self._clock = clock
        self._watch = watch
        self._track = ClockTrack()
        self._held: list[tuple[int, int, str, Taken]] = []
        self.tallies = {name: Tally() for name in self._sources}
        self.clock_tally = Tally()

    def collect(self, now_s: float, now_ns: int, last: bool = False) -> list[Arrival]:
        """Return the arrivals of this look.

        Parameters
        ----------
        now_s : float
            Time by a clock that never goes back.
        now_ns : int
            Time by the machine's clock, for messages without a receipt time.
        last : bool
            Hold nothing back.
        """
        fresh: list[tuple[int, int, str, Taken]] = []
        for name, source in self._sources.items():
            found = source.take()
            tally = self.tallies[name]
            tally.note_arrival(len(found), now_s)
            for taken in found:
                tally.note_number(taken.sequence)
                fresh.append((taken.received_ns or now_ns, INPUT_ORDER[name], name, taken))
        fresh.sort(key=lambda entry: entry[:2])
        if self._clock is None:
            return [self._arrival(*entry) for entry in fresh]
        self._follow_clock(self._clock, now_s)
        ready, self._held = self._held, fresh
        if last:
            ready, self._held = ready + fresh, []
        return [self._arrival(*entry) for entry in ready]

    def rows(self, arrivals: list[Arrival]) -> list[Row]:
        """Return the readings in arrivals; what has no time or no meaning is counted."""
        rows: list[Row] = []
        for arrival in arrivals:
            if arrival.time_ns <= 0:
                self.tallies[arrival.name].without_time += 1
                continue
            try:
                found = self._decoder.rows(arrival.name, arrival.data, arrival.time_ns)
            except ValueError:
                self.tallies[arrival.name].malformed += 1
                continue
            self._watch(arrival.name, found)
            rows += found
        return rows

    def _follow_clock(self, clock: Source, now_s: float) -> None:
        found = clock.take(_MOST_CLOCKS)
        self.clock_tally.note_arrival(len(found), now_s)
        for taken in found:
            self.clock_tally.note_number(taken.sequence)
            self._track.note(taken.source_ns, header_time_ns(taken.data))

    def _arrival(self, received_ns: int, _order: int, name: str, taken: Taken) -> Arrival:
        if self._clock is not None:
            time_ns = self._track.at(taken.source_ns)
        elif self._by_receipt:
            time_ns = received_ns
        else:
            time_ns = taken.source_ns or received_ns
        time_ns = max(0, self._decoder.time_ns(name, taken.data, time_ns))
        return Arrival(name, taken.data, self._log_clock.stamp(received_ns), time_ns)
