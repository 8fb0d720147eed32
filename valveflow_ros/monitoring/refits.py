"""When a fit is to be asked for, and which outcome is awaited."""

from __future__ import annotations

import numpy as np

from valveflow_ros.config import Settings
from valveflow_ros.records import NS_PER_S, IntArray
from valveflow_ros.state import State


class Refits:
    """Counts segments and time towards the next request, and names requests.

    A request's name is the time of the row after which it was made.
    """

    def __init__(self) -> None:
        self.pending_ns: int | None = None
        self._last_ns: int | None = None
        self._later_ns: int | None = None
        self._last_name_ns = 0
        self._segments_at_request = 0
        self.segments_seen = 0

    def rows_until_due(self, time_ns: IntArray, settings: Settings) -> tuple[int, bool]:
        """Return how many rows to take before the period is over, and whether it is among them."""
        if self._last_ns is None:
            self._last_ns = int(time_ns[0])
        elif time_ns[0] < self._last_ns:
            # The clock went back, and the period is not to last the longer for it; but should it
            # come again, the period is not over at once.
            self._later_ns, self._last_ns = self._last_ns, int(time_ns[0])
        over = len(time_ns)
        if self._later_ns is not None:
            over = int(np.searchsorted(time_ns, self._later_ns, side='right'))
            if over == 0:
                self._last_ns, self._later_ns, over = self._later_ns, None, len(time_ns)
        period_ns = round(settings.real('refit_period') * NS_PER_S)
        if period_ns == 0:
            return over, False
        due = int(np.searchsorted(time_ns, self._last_ns + period_ns, side='left'))
        return (due + 1, True) if due < over else (over, False)

    def due(self, last_ns: int, closed: bool, by_time: bool, settings: Settings) -> bool:
        """Tell whether the time or the segments since the last request ask for one.

        Parameters
        ----------
        last_ns : int
            Time of the newest row.
        closed : bool
            A segment closed at it.
        by_time : bool
            The period ended at it.
        """
        if by_time:
            self._last_ns = last_ns
        if self.pending_ns is not None or settings.real('refit_period') <= 0.0:
            return False
        new = self.segments_seen - self._segments_at_request
        wanted = settings.whole('refit_segments')
        return (by_time and new > 0) or (closed and wanted > 0 and new >= wanted)

    def ask(self, last_ns: int) -> int:
        """Note a request made now; return its name."""
        # After the clock went back names must not come again.
        self.pending_ns = max(last_ns, self._last_name_ns + 1)
        self._last_name_ns = self.pending_ns
        self._last_ns, self._later_ns = last_ns, None
        self._segments_at_request = self.segments_seen
        return self.pending_ns

    def settle(self, request_ns: int) -> bool:
        """Take an outcome; tell whether it was awaited."""
        if request_ns != self.pending_ns:
            return False
        self.pending_ns = None
        return True

    def ask_again(self) -> None:
        """Wait no longer for the outcome that was asked for; its segments count as new."""
        if self.pending_ns is not None:
            self.pending_ns = None
            self.owe()

    def owe(self) -> None:
        """Let the segments of the last request count as new."""
        self._segments_at_request = min(self._segments_at_request, self.segments_seen - 1)

    def snapshot(self) -> State:
        """Return what is remembered; see `core.state`."""
        return {
            'pending_ns': self.pending_ns,
            'last_ns': self._last_ns,
            'later_ns': self._later_ns,
            'last_name_ns': self._last_name_ns,
            'segments_at_request': self._segments_at_request,
            'segments_seen': self.segments_seen,
        }

    def restore(self, saved: State) -> None:
        """Go on from a state."""
        self.pending_ns, self._last_ns = saved['pending_ns'], saved['last_ns']
        self._later_ns, self._last_name_ns = saved['later_ns'], saved['last_name_ns']
        self._segments_at_request = saved['segments_at_request']
        self.segments_seen = saved['segments_seen']
