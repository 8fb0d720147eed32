"""The life of one alarm by ISA-18.2: states and what leads from one to the next."""

from __future__ import annotations

from valveflow_ros.monitoring.alarm_records import AlarmState
from valveflow_ros.state import State


class AlarmLife:
    """Keep the state of one alarm; know neither why it comes nor who is told.

    Three layers lie upon one another: the condition with its acknowledgement, suppression while
    it cannot be judged, and the shelf. The upper one shows, and the lower ones live on below it,
    so that nothing is lost when it is taken away.

    Attributes
    ----------
    active : bool
        Whether the condition holds.
    occurrence : int
        How often it has begun.
    raised_ns : int
        When it began last; 0 before.
    shelved_until_ns : int or None
        When the shelf lets it go by itself; None if it is not shelved.
    """

    def __init__(self) -> None:
        self.active = False
        self.occurrence = 0
        self.raised_ns = 0
        self.shelved_until_ns: int | None = None
        self.suppressed = False
        self._below = AlarmState.NORMAL

    @property
    def state(self) -> AlarmState:
        """Return the state that shows."""
        if self.shelved_until_ns is not None:
            return AlarmState.SHELVED
        return AlarmState.SUPPRESSED if self.suppressed else self._below

    @property
    def standing(self) -> bool:
        """Tell whether it has come and is not cleared, shelved and suppressed ones included."""
        return self._below != AlarmState.NORMAL

    def begin(self, time_ns: int) -> None:
        """Let the condition begin."""
        self.active = True
        self.occurrence += 1
        self.raised_ns = time_ns
        self._below = AlarmState.UNACKNOWLEDGED

    def end(self, latch: bool) -> None:
        """Let the condition end; latched, it waits for who has not acknowledged it yet."""
        self.active = False
        waits = latch and self._below == AlarmState.UNACKNOWLEDGED
        self._below = AlarmState.RETURNED_UNACKNOWLEDGED if waits else AlarmState.NORMAL

    def acknowledge(self) -> bool:
        """Acknowledge what shows; tell whether there was anything to acknowledge."""
        if self.state == AlarmState.UNACKNOWLEDGED:
            self._below = AlarmState.ACKNOWLEDGED
        elif self.state == AlarmState.RETURNED_UNACKNOWLEDGED:
            self._below = AlarmState.NORMAL
        else:
            return False
        return True

    def shelve(self, until_ns: int) -> bool:
        """Put it aside if it stands; one that is shelved already stays so no longer for it."""
        if not self.standing or self.shelved_until_ns is not None:
            return False
        self.shelved_until_ns = until_ns
        return True

    def unshelve(self) -> bool:
        """Take it from the shelf: to be acknowledged if the condition holds, or else cleared."""
        if self.shelved_until_ns is None:
            return False
        self.shelved_until_ns = None
        self._below = AlarmState.UNACKNOWLEDGED if self.active else AlarmState.NORMAL
        return True

    def suppress(self) -> None:
        """Keep it as it is while it cannot be judged."""
        self.suppressed = True

    def resume(self) -> None:
        """Let it be what it was; it can be judged again."""
        self.suppressed = False

    def snapshot(self) -> State:
        """Return what is remembered; see `core.state`."""
        return {
            'active': self.active,
            'occurrence': self.occurrence,
            'raised_ns': self.raised_ns,
            'shelved_until_ns': self.shelved_until_ns,
            'suppressed': self.suppressed,
            'below': int(self._below),
        }

    def restore(self, saved: State) -> None:
        """Go on from a snapshot."""
        self.active, self.occurrence = saved['active'], saved['occurrence']
        self.raised_ns, self.suppressed = saved['raised_ns'], saved['suppressed']
        self.shelved_until_ns = saved['shelved_until_ns']
        self._below = AlarmState(saved['below'])
