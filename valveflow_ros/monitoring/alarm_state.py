# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""An alarm according to ANSI/ISA-18.2: its states, transitions and announcements."""

from __future__ import annotations

import enum
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import ClassVar, NamedTuple

from valveflow_ros.curve.shift import minute
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S
from valveflow_ros.state import Memory, State


class AlarmState(enum.IntEnum):
    """States of an alarm (ANSI/ISA-18.2, figure of alarm state transitions)."""

    NORMAL = 0
    UNACKNOWLEDGED = 1
    ACKNOWLEDGED = 2
    RETURNED_UNACKNOWLEDGED = 3
    SHELVED = 4
    SUPPRESSED = 5
    OUT_OF_SERVICE = 6


class AlarmAction(enum.Enum):
    """Actions of an operator on alarms."""

    ACKNOWLEDGE = 'acknowledge'
    SHELVE = 'shelve'
    UNSHELVE = 'unshelve'


class Priority(enum.IntEnum):
    """How soon an operator must act; residual alarms ask for maintenance, not for a trip."""

    LOW = 1
    MEDIUM = 2
    HIGH = 3


@dataclass(frozen=True, slots=True)
class AlarmChange:
    """One announced change of the state of an alarm."""

    time_ns: int
    name: str
    # state, previous: the new state and the one before it, whether or not that one was announced.
    # Both are equal if an alarm that has been standing for long is announced again.
    state: AlarmState
    previous: AlarmState
    priority: Priority
    value: float
    limit: float
    unit: str
    sentence: str
    occurrence: int  # how many times the condition has begun, whether or not that was announced
    raised_ns: int
    model_id: str
    first_out: str = ''  # the standing alarm that was raised first; empty if none stands

    def snapshot(self) -> State:
        """Return the change as plain values."""
        numbers = {name: int(getattr(self, name)) for name in ('state', 'previous', 'priority')}
        return {**asdict(self), **numbers}

    @classmethod
    def restored(cls, saved: State) -> AlarmChange:
        """Return the change in a snapshot."""
        states = {name: AlarmState(saved[name]) for name in ('state', 'previous')}
        return cls(**{**saved, **states, 'priority': Priority(saved['priority'])})


class Judged(NamedTuple):
    """A time, the evidence at that time, the corresponding shift, and the valve opening."""

    time_ns: int
    evidence: float
    shift_mw: float
    opening_percent: float = math.nan


class AlarmStateMachine(Memory):
    """Keep the state of one alarm, independent of its cause and its announcements.

    There are three layers: the condition with its acknowledgement, suppression while the alarm
    cannot be judged, and shelving. The topmost layer determines the visible state. The lower ones
    are still updated, so that nothing is lost when an upper one ends.
    """

    REMEMBERED: ClassVar[tuple[str, ...]] = (
        'active', 'occurrence', 'raised_ns', 'shelved_until_ns', 'suppressed', '_below',
    )  # fmt: skip

    def __init__(self) -> None:
        self.active = False  # True if the condition holds
        # occurrence, raised_ns: how many times the condition has begun, and when it last did; 0 if
        # never
        self.occurrence = 0
        self.raised_ns = 0
        # Time when the shelving ends automatically; None if it is not shelved.
        self.shelved_until_ns: int | None = None
        self.suppressed = False
        self._below = AlarmState.NORMAL

    @property
    def state(self) -> AlarmState:
        """Return the visible state."""
        if self.shelved_until_ns is not None:
            return AlarmState.SHELVED
        return AlarmState.SUPPRESSED if self.suppressed else self._below

    @property
    def standing(self) -> bool:
        """Return True if it was raised and is not cleared, even if shelved or suppressed."""
        return self._below != AlarmState.NORMAL

    def begin(self, time_ns: int) -> None:
        """Start the condition."""
        self.active = True
        self.occurrence += 1
        self.raised_ns = time_ns
        self._below = AlarmState.UNACKNOWLEDGED

    def end(self, latch: bool) -> None:
        """End the condition; a latched alarm then waits for its acknowledgement."""
        self.active = False
        waits = latch and self._below == AlarmState.UNACKNOWLEDGED
        self._below = AlarmState.RETURNED_UNACKNOWLEDGED if waits else AlarmState.NORMAL

    def acknowledge(self) -> bool:
        """Acknowledge the visible state; return True if there was something to acknowledge."""
        if self.state == AlarmState.UNACKNOWLEDGED:
            self._below = AlarmState.ACKNOWLEDGED
        elif self.state == AlarmState.RETURNED_UNACKNOWLEDGED:
            self._below = AlarmState.NORMAL
        else:
            return False
        return True

    def shelve(self, until_ns: int) -> bool:
        """Shelve the alarm if it stands; the end of an earlier shelving is not changed."""
        if not self.standing or self.shelved_until_ns is not None:
            return False
        self.shelved_until_ns = until_ns
        return True

    def unshelve(self) -> bool:
        """Unshelve it: unacknowledged if the condition holds, otherwise cleared."""
        if self.shelved_until_ns is None:
            return False
        self.shelved_until_ns = None
        self._below = AlarmState.UNACKNOWLEDGED if self.active else AlarmState.NORMAL
        return True


_WINDOW_NS = 600 * NS_PER_S
# Three announcements within a minute are chattering.
_MINUTE_NS = 60 * NS_PER_S
_CHATTER = 3


class FloodLimit(Memory):
    """Limit the announcements of one alarm: a chattering one must not hide the others.

    The time is that of the samples. The first one always passes: only recent announcements can
    hold another one back.
    """

    REMEMBERED = ('held', '_times_ns')

    def __init__(self) -> None:
        self.most = 1  # maximum number of announcements within ten minutes
        self.held = 0  # number of announcements held back since the last one that passed
        self._times_ns: list[int] = []

    @property
    def free_ns(self) -> int:
        """Return the time from which the next one may pass; 0 if at any time."""
        times = self._times_ns
        limits = ((self.most, _WINDOW_NS), (_CHATTER - 1, _MINUTE_NS))
        return max((times[-n] + span for n, span in limits if len(times) >= n), default=0)

    def passed(self, time_ns: int) -> None:
        """Record an announcement."""
        self._times_ns = [t for t in self._times_ns if t > time_ns - _WINDOW_NS] + [time_ns]

    def shift(self, step_ns: int) -> None:
        """Shift the stored times by a step of the clock, so that no waiting time is repeated."""
        self._times_ns = [t + step_ns for t in self._times_ns]


_LAST_NS = (1 << 63) - 1
# A standing alarm is repeated after this time, so that every shift sees a recent announcement.
_AGAIN_NS = 86_400 * NS_PER_S
# An alarm that is not cleared is repeated after this many announcements of other alarms.
BURIED = 8


class Content(NamedTuple):
    """The value and limit of an alarm, and a sentence about it."""

    value: float
    limit: float
    unit: str
    sentence: str


class Alarm(AlarmStateMachine, ABC):
    """An alarm whose changes are announced.

    The state is always up to date; announcements follow it within the flood limit. A state that
    was held back is announced as soon as the limit allows, and the next announcement gives the
    number of missed ones. A standing alarm (also if shelved or suppressed) is announced again
    after a day, or after `BURIED` announcements of others, as late subscribers get only the newest
    ones. These repetitions do not count for the limit, which applies to changes.

    Parameters
    ----------
    settings : Settings
        Latch, shelving time, flood limit.
    """

    NAME = ''

    REMEMBERED = (
        *AlarmStateMachine.REMEMBERED, '_flood', '_told', '_now', '_before', '_waits', '_told_ns',
        '_others',
    )  # fmt: skip

    def __init__(self, settings: Settings) -> None:
        super().__init__()
        self._flood = FloodLimit()
        self._told = self._now = self._before = AlarmState.NORMAL
        self._waits = False
        self._told_ns = 0
        self._others = 0  # announcements of other alarms since the last one of this alarm
        self.last: AlarmChange | None = None  # the last announcement
        self._beside: Sequence[Alarm] = (self,)
        self.configure(settings)

    def configure(self, settings: Settings) -> None:
        """Apply new settings; states and counters stay."""
        self._latch = settings.flag('alarm_latch')
        self._shelf_ns = round(settings.real('alarm_shelve_time') * NS_PER_S)
        self._flood.most = settings.whole('alarm_flood')

    @abstractmethod
    def _content(self, state: AlarmState) -> Content:
        """Return value, limit and sentence for a state of the condition."""

    @abstractmethod
    def _blind(self) -> str:
        """Return why it cannot be judged."""

    @property
    def held(self) -> int:
        """Return the number of announcements held back since the last one."""
        return self._flood.held

    @property
    def due_ns(self) -> int | None:
        """Return the time of the next change or repetition due to time alone; None if never."""
        if self._waits:
            return self._flood.free_ns
        due = (self.shelved_until_ns, self._again_ns)
        return min((ns for ns in due if ns is not None), default=None)

    @property
    def _again_ns(self) -> int | None:
        """Return the time of the next repetition."""
        if self._others >= BURIED and self._told != AlarmState.NORMAL:
            return self._told_ns
        return self._told_ns + _AGAIN_NS if self.standing else None

    def stand_beside(self, alarms: Sequence[Alarm]) -> None:
        """Set the list of all alarms, including this one, to find which was raised first."""
        self._beside = tuple(alarms)

    def pass_time(self, time_ns: int, model_id: str) -> list[AlarmChange]:
        """Perform time-dependent changes; return the announcement, if any."""
        until_ns = self.shelved_until_ns
        if until_ns is not None and time_ns >= until_ns:
            self.unshelve()
        return self._tell(time_ns, model_id)

    def shift_time(self, step_ns: int) -> None:
        """Shift the stored times after a step of the clock, so that shelving ends in time."""
        self._flood.shift(step_ns)
        self._told_ns += step_ns
        if self.shelved_until_ns is not None:
            self.shelved_until_ns += step_ns

    def operate(
        self, action: AlarmAction, time_ns: int, model_id: str
    ) -> tuple[bool, list[AlarmChange]]:
        """Perform the action of an operator; return whether it was possible, and the announcement.

        There may be no announcement: the announced state may still be valid, or the flood limit
        holds it back.
        """
        if action is AlarmAction.ACKNOWLEDGE:
            done = self.acknowledge()
        elif action is AlarmAction.SHELVE:
            done = self.shelve(min(time_ns + self._shelf_ns, _LAST_NS))
        else:
            done = self.unshelve()
        return done, self._tell(time_ns, model_id) if done else []

    def _tell(self, time_ns: int, model_id: str) -> list[AlarmChange]:
        """Announce the state, unless it was announced already or is held back."""
        state = self.state
        if state != self._now:
            self._before, self._now = self._now, state
        if state == self._told:
            self._waits = False
            again_ns = self._again_ns
            due = again_ns is not None and time_ns >= again_ns
            return [self._announced(state, time_ns, model_id)] if due else []
        if state == AlarmState.UNACKNOWLEDGED and time_ns < self._flood.free_ns:
            self._flood.held += 0 if self._waits else 1
            self._waits = True
            return []
        return [self._announced(state, time_ns, model_id)]

    def _announced(self, state: AlarmState, time_ns: int, model_id: str) -> AlarmChange:
        again = state == self._told
        missed = self._flood.held
        if state == AlarmState.UNACKNOWLEDGED and not again:
            self._flood.passed(time_ns)
            # A delayed announcement is not a missed one.
            missed -= 1 if self._waits else 0
        self._flood.held, self._waits = 0, False
        previous = state if again else self._before
        self._told, self._told_ns = state, time_ns
        for alarm in self._beside:
            alarm._others += 1
        self._others = 0
        standing = [alarm for alarm in self._beside if alarm.standing]
        first = min(standing, key=lambda alarm: alarm.raised_ns).NAME if standing else ''
        content = self._content(state)
        parts = [
            self._worded(state, previous, content.sentence),
            _missed(missed),
            '' if first in ('', self.NAME) else f'The alarm {first} came first.',
        ]
        self.last = AlarmChange(
            time_ns, self.NAME, state, previous, Priority.MEDIUM, content.value, content.limit,
            content.unit, ' '.join(p for p in parts if p), self.occurrence, self.raised_ns,
            model_id, first,
        )  # fmt: skip
        return self.last

    def _worded(self, state: AlarmState, previous: AlarmState, sentence: str) -> str:
        until_ns = self.shelved_until_ns
        if until_ns is not None:
            return f'Shelved until {minute(until_ns)}; new alarms are not hidden.'
        if state == AlarmState.SUPPRESSED:
            return f'{self._blind()} The alarm keeps its state meanwhile.'
        if previous == state:
            return f'Active since {minute(self.raised_ns)}. {sentence}'
        if previous == AlarmState.SHELVED:
            return f'No longer shelved. {sentence}'
        if previous == AlarmState.SUPPRESSED:
            return f'The alarm can be judged again. {sentence}'
        return sentence

    def snapshot(self) -> State:
        """Return the state, including the last announcement."""
        return {**super().snapshot(), 'last': self.last and self.last.snapshot()}

    def restore(self, saved: State) -> None:
        """Continue from a saved state; version 1 stores the state machine under another key."""
        super().restore({**saved.get('life', {}), **saved})
        self.last = saved['last'] and AlarmChange.restored(saved['last'])


def _missed(count: int) -> str:
    if count <= 0:
        return ''
    return (
        f'The alarm comes and goes: {count} announcement{"" if count == 1 else "s"} '
        f'{"was" if count == 1 else "were"} held back.'
    )
