"""What there is to say of an alarm: its states, its priority, one change."""

from __future__ import annotations

import enum
from dataclasses import asdict, dataclass
from typing import NamedTuple

from valveflow_ros.state import State


class AlarmState(enum.IntEnum):
    """States of an alarm (ANSI/ISA-18.2, figure of alarm state transitions)."""

    NORMAL = 0
    UNACKNOWLEDGED = 1
    ACKNOWLEDGED = 2
    RETURNED_UNACKNOWLEDGED = 3
    SHELVED = 4
    SUPPRESSED = 5
    OUT_OF_SERVICE = 6


class Priority(enum.IntEnum):
    """How soon somebody has to look; residual alarms ask for maintenance, not for a trip."""

    LOW = 1
    MEDIUM = 2
    HIGH = 3


@dataclass(frozen=True, slots=True)
class AlarmChange:
    """One change of an alarm's state, as it is announced.

    Attributes
    ----------
    state, previous : AlarmState
        From now on, and just before, whether or not that was announced; the same where one that
        has stood for long is only told again.
    occurrence : int
        How often the condition has begun, whether or not that was announced.
    first_out : str
        The alarm that came first of those that stand; empty if none stands.
    """

    time_ns: int
    name: str
    state: AlarmState
    previous: AlarmState
    priority: Priority
    value: float
    limit: float
    unit: str
    sentence: str
    occurrence: int
    raised_ns: int
    model_id: str
    first_out: str = ''

    def snapshot(self) -> State:
        """Return it as plain values; see `core.state`."""
        numbers = {name: int(getattr(self, name)) for name in ('state', 'previous', 'priority')}
        return {**asdict(self), **numbers}

    @classmethod
    def restored(cls, saved: State) -> AlarmChange:
        """Return the change in a snapshot."""
        states = {name: AlarmState(saved[name]) for name in ('state', 'previous')}
        return cls(**{**saved, **states, 'priority': Priority(saved['priority'])})


class Judged(NamedTuple):
    """A moment, the evidence then, and the shift it speaks of."""

    time_ns: int
    evidence: float
    shift_mw: float
