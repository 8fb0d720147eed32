"""How often one alarm may be announced: a chattering one must not bury the others."""

from __future__ import annotations

from valveflow_ros.records import NS_PER_S
from valveflow_ros.state import State

_WINDOW_NS = 600 * NS_PER_S
# Three announcements within a minute are chattering.
_MINUTE_NS = 60 * NS_PER_S
_CHATTER = 3


class FloodLimit:
    """Count the announcements of one alarm in the samples' own time.

    The first one always passes: only what was said shortly before can hold another back.

    Attributes
    ----------
    most : int
        Announcements that may fall within ten minutes.
    held : int
        How many were held back since the last one that passed.
    """

    def __init__(self) -> None:
        self.most = 1
        self.held = 0
        self._times_ns: list[int] = []

    @property
    def free_ns(self) -> int | None:
        """Return from when on the next may pass; None if at any time."""
        times = self._times_ns
        free = [
            times[-count] + span
            for count, span in ((self.most, _WINDOW_NS), (_CHATTER - 1, _MINUTE_NS))
            if len(times) >= count
        ]
        return max(free, default=None)

    def allows(self, time_ns: int) -> bool:
        """Tell whether an announcement may pass."""
        free_ns = self.free_ns
        return free_ns is None or time_ns >= free_ns

    def passed(self, time_ns: int) -> None:
        """Note an announcement that was made."""
        self._times_ns = [t for t in self._times_ns if t > time_ns - _WINDOW_NS] + [time_ns]

    def shift(self, step_ns: int) -> None:
        """Follow a clock that was set by a step, so that no time is waited for twice."""
        self._times_ns = [t + step_ns for t in self._times_ns]

    def snapshot(self) -> State:
        """Return what is remembered; see `core.state`."""
        return {'held': self.held, 'times_ns': list(self._times_ns)}

    def restore(self, saved: State) -> None:
        """Go on from a snapshot."""
        self.held, self._times_ns = saved['held'], list(saved['times_ns'])
