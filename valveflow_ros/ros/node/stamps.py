"""Which time a value belongs to, and which time a message is logged at."""

from __future__ import annotations

from bisect import bisect_right

_CLOCKS_KEPT = 16384


class LogClock:
    """Receipt times made strictly increasing, so that the order of a log is the order of feeding.

    Should the machine's clock be set back, times go on by a nanosecond a message
    until it has caught up.

    Parameters
    ----------
    after_ns : int
        The first time is later than this.
    """

    def __init__(self, after_ns: int = 0) -> None:
        self.last_ns = after_ns

    def stamp(self, received_ns: int) -> int:
        """Return the log time of a message."""
        self.last_ns = max(received_ns, self.last_ns + 1)
        return self.last_ns


class ClockTrack:
    """Remembers /clock, to say what it showed when a value was published.

    Both times used are the publisher's, so a value and the clock message sent
    just before it belong together however late either is taken.
    """

    def __init__(self) -> None:
        self._sent_ns: list[int] = []
        self._clock_ns: list[int] = []
        self._trimmed = False

    @property
    def newest_ns(self) -> int:
        """Return when the newest clock message was sent, 0 before the first."""
        return self._sent_ns[-1] if self._sent_ns else 0

    @property
    def first_ns(self) -> int:
        """Return what the first clock message showed, 0 before it."""
        return self._clock_ns[0] if self._clock_ns else 0

    def lead_ns(self, sent_ns: int) -> int:
        """Return how long before the first clock message something was sent, 0 if after it."""
        if self._trimmed or not self._sent_ns:
            return 0
        return max(0, self._sent_ns[0] - sent_ns)

    def note(self, sent_ns: int, clock_ns: int) -> None:
        """Take a message of /clock."""
        at = bisect_right(self._sent_ns, sent_ns)
        self._sent_ns.insert(at, sent_ns)
        self._clock_ns.insert(at, clock_ns)
        if len(self._sent_ns) > 2 * _CLOCKS_KEPT:
            self._trimmed = True
            del self._sent_ns[:_CLOCKS_KEPT]
            del self._clock_ns[:_CLOCKS_KEPT]

    def at(self, sent_ns: int) -> int:
        """Return what the clock showed at a publisher's time, 0 if that is not known."""
        at = bisect_right(self._sent_ns, sent_ns)
        return self._clock_ns[at - 1] if at else 0
