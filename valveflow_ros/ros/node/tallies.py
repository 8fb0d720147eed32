"""Account of what arrived on one topic: how often, how lately, and what was lost on the way."""

from __future__ import annotations

from dataclasses import dataclass

_STALE_LEAST_S = 2.0
_STALE_PERIODS = 2.5
_MEMORY = 0.1  # weight of the newest interval in the mean period


@dataclass(slots=True)
class Tally:
    """Counts and times of one topic; times by a clock that never goes back.

    Attributes
    ----------
    received : int
        Messages taken.
    lost : int
        Messages the publisher sent and the middleware did not deliver, by gaps in
        the publisher's numbering; not counted while there is more than one publisher.
    missed_at_start : int
        Messages sent before the first one that came; most were sent before we listened.
    irregular : int
        Numbers that went back: a publisher started anew, or there are two.
    malformed, without_time : int
        Messages recorded and not used.
    waiting, before_clock : int
        Messages that wait for the first /clock now, and those that were sent before it.
    """

    received: int = 0
    lost: int = 0
    missed_at_start: int = 0
    irregular: int = 0
    malformed: int = 0
    without_time: int = 0
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
        """Take the publisher's number of a message; 0 where the middleware gives none."""
        self.received += 1
        if number <= 0:
            return
        if self._number == 0:
            self.missed_at_start = number - 1
        elif number <= self._number:
            self.irregular += 1
            self._mixed = True
            # What was taken for a gap may have been the step to the other one's numbers.
            self.lost = min(self.lost, self._lost_before)
        elif not self._mixed and not self._anew:
            self.lost += number - self._number - 1
        self._number, self._anew = number, False

    def note_publishers(self, count: int) -> None:
        """Take how many publish the topic now.

        Each numbers its own messages, and a message does not tell whose it is: what is lost of
        two cannot be told. It is counted again when one is left and its numbers go forward.
        """
        if count > 1:
            # Since the last look the numbers of two may have been taken for those of one.
            self.lost = min(self.lost, self._lost_before)
        self._lost_before = self.lost
        mixed = count > 1 or self.irregular > self._irregular_before
        # The last number may be that of the one which is gone.
        self._anew = self._anew or (self._several and count <= 1) or count == 0
        self._mixed, self._several = mixed, count > 1
        self._irregular_before = self.irregular

    def note_arrival(self, count: int, now_s: float) -> None:
        """Take the time at which ``count`` messages were found."""
        if count == 0:
            return
        if self.last_s is not None:
            interval = (now_s - self.last_s) / count
            before = interval if self.period_s is None else self.period_s
            weight = 1.0 - (1.0 - _MEMORY) ** count
            self.period_s = (1.0 - weight) * before + weight * interval
        self.last_s = now_s

    def age_s(self, now_s: float) -> float | None:
        """Return how long ago the newest message came; None before the first."""
        return None if self.last_s is None else now_s - self.last_s

    def rate_hz(self) -> float:
        """Return the mean rate of late, 0 while it is not known."""
        return 1.0 / self.period_s if self.period_s else 0.0

    def stale(self, now_s: float) -> bool:
        """Tell whether a topic that spoke has fallen silent."""
        age = self.age_s(now_s)
        return age is not None and age > max(_STALE_LEAST_S, _STALE_PERIODS * (self.period_s or 0))
