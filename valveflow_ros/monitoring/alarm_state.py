# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""An alarm by ANSI/ISA-18.2: its states, the ways between them, and what is announced."""

from __future__ import annotations

import enum
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import ClassVar, NamedTuple

import numpy as np

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
    """What an operator can do to alarms."""

    ACKNOWLEDGE = 'acknowledge'
    SHELVE = 'shelve'
    UNSHELVE = 'unshelve'


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
        """Return it as plain values."""
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


class AlarmStateMachine(Memory):
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

    REMEMBERED: ClassVar[tuple[str, ...]] = (
        'active', 'occurrence', 'raised_ns', 'shelved_until_ns', 'suppressed', '_below',
    )  # fmt: skip

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


# How often one alarm may be announced: a chattering one must not bury the others.

_WINDOW_NS = 600 * NS_PER_S
# Three announcements within a minute are chattering.
_MINUTE_NS = 60 * NS_PER_S
_CHATTER = 3


class FloodLimit(Memory):
    """Count the announcements of one alarm in the samples' own time.

    The first one always passes: only what was said shortly before can hold another back.

    Attributes
    ----------
    most : int
        Announcements that may fall within ten minutes.
    held : int
        How many were held back since the last one that passed.
    """

    REMEMBERED = ('held', '_times_ns')

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


_LAST_NS = (1 << 63) - 1
# What has stood so long since it was told is told again, so that no shift takes it for old news.
_AGAIN_NS = 86_400 * NS_PER_S
# So many announcements of others bury one that is not over: it is told again after them.
BURIED = 8


class Content(NamedTuple):
    """What an alarm was judged by, and a sentence about it."""

    value: float
    limit: float
    unit: str
    sentence: str


class Alarm(AlarmStateMachine, ABC):
    """An alarm whose changes are announced.

    The state is always true; what is announced follows it, held back by the flood limit. What was
    held back and stands is announced as soon as the limit lets it, and the next announcement tells
    how many were missed. What stands for a day, shelved or suppressed or not, is announced again,
    and so is what is not over when others have been announced `BURIED` times since: who comes late
    is given only the newest announcements. Neither counts for the limit, which is for what is new.

    Parameters
    ----------
    settings : Settings
        Latch, time on the shelf, flood limit.

    Attributes
    ----------
    last : AlarmChange or None
        What was announced last.
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
        self._others = 0  # announcements of other alarms since it was told
        self.last: AlarmChange | None = None
        self._beside: Sequence[Alarm] = (self,)
        self.configure(settings)

    def configure(self, settings: Settings) -> None:
        """Take new settings; states and counters stay."""
        self._latch = settings.flag('alarm_latch')
        self._shelf_ns = round(settings.real('alarm_shelve_time') * NS_PER_S)
        self._flood.most = settings.whole('alarm_flood')

    @abstractmethod
    def _content(self, state: AlarmState) -> Content:
        """Return what there is to say in a state of the condition."""

    @abstractmethod
    def _blind(self) -> str:
        """Say why it cannot be judged."""

    @property
    def held(self) -> int:
        """Return how many announcements the flood limit has held back since the last one."""
        return self._flood.held

    @property
    def due_ns(self) -> int | None:
        """Return when something happens without a cause from outside; None if never."""
        if self._waits:
            # None: the limit was raised meanwhile, and it may go out at once.
            return self._flood.free_ns or 0
        due = (self.shelved_until_ns, self._again_ns)
        return min((ns for ns in due if ns is not None), default=None)

    @property
    def _again_ns(self) -> int | None:
        """Return when it is to be told again; None if there is nothing that could be forgotten."""
        if self._others >= BURIED and self._told != AlarmState.NORMAL:
            return self._told_ns
        return self._told_ns + _AGAIN_NS if self.standing else None

    def stand_beside(self, alarms: Sequence[Alarm]) -> None:
        """Know the others, and this one among them, to tell which came first."""
        self._beside = tuple(alarms)

    def pass_time(self, time_ns: int, model_id: str) -> list[AlarmChange]:
        """Do what is due; return the change that makes, if any."""
        until_ns = self.shelved_until_ns
        if until_ns is not None and time_ns >= until_ns:
            self.unshelve()
        return self._tell(time_ns, model_id)

    def shift_time(self, step_ns: int) -> None:
        """Follow a clock that was set back, so that no shelf outlives its time."""
        self._flood.shift(step_ns)
        self._told_ns += step_ns
        if self.shelved_until_ns is not None:
            self.shelved_until_ns += step_ns

    def operate(
        self, action: AlarmAction, time_ns: int, model_id: str
    ) -> tuple[bool, list[AlarmChange]]:
        """Do what an operator asks; return whether it could be done, and the change announced.

        There may be none to announce: what was said before may still be true, or the flood limit
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
        """Announce the state, unless that was done or is held back."""
        state = self.state
        if state != self._now:
            self._before, self._now = self._now, state
        if state == self._told:
            self._waits = False
            again_ns = self._again_ns
            due = again_ns is not None and time_ns >= again_ns
            return [self._announced(state, time_ns, model_id)] if due else []
        if state == AlarmState.UNACKNOWLEDGED and not self._flood.allows(time_ns):
            self._flood.held += 0 if self._waits else 1
            self._waits = True
            return []
        return [self._announced(state, time_ns, model_id)]

    def _announced(self, state: AlarmState, time_ns: int, model_id: str) -> AlarmChange:
        again = state == self._told
        missed = self._flood.held
        if state == AlarmState.UNACKNOWLEDGED and not again:
            self._flood.passed(time_ns)
            # What is announced late is not missed.
            missed -= 1 if self._waits else 0
        self._flood.held, self._waits = 0, False
        previous = state if again else self._before
        self._told, self._told_ns = state, time_ns
        self._crowd_out()
        first = self._first_out()
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

    def _crowd_out(self) -> None:
        """Let the others know that there is one announcement more after theirs."""
        for alarm in self._beside:
            alarm._others += 1
        self._others = 0

    def _worded(self, state: AlarmState, previous: AlarmState, sentence: str) -> str:
        """Return the sentence, with what shelf and suppression have to do with it."""
        until_ns = self.shelved_until_ns
        if until_ns is not None:
            return f'Shelved until {_utc(until_ns)}; new alarms are not hidden.'
        if state == AlarmState.SUPPRESSED:
            return f'{self._blind()} The alarm keeps its state meanwhile.'
        if previous == state:
            return f'Active since {_utc(self.raised_ns)}. {sentence}'
        if previous == AlarmState.SHELVED:
            return f'No longer shelved. {sentence}'
        if previous == AlarmState.SUPPRESSED:
            return f'The alarm can be judged again. {sentence}'
        return sentence

    def _first_out(self) -> str:
        """Name the alarm that came first of those that stand."""
        standing = [alarm for alarm in self._beside if alarm.standing]
        return min(standing, key=lambda alarm: alarm.raised_ns).NAME if standing else ''

    def snapshot(self) -> State:
        """Return what is remembered, the last announcement among it."""
        return {**super().snapshot(), 'last': self.last and self.last.snapshot()}

    def restore(self, saved: State) -> None:
        """Go on from a state; in those of version 1 the machine's own part stands in another."""
        super().restore({**saved.get('life', {}), **saved})
        self.last = saved['last'] and AlarmChange.restored(saved['last'])


def _missed(count: int) -> str:
    """Say how many announcements were held back."""
    if count <= 0:
        return ''
    return (
        f'The alarm comes and goes: {count} announcement{"" if count == 1 else "s"} '
        f'{"was" if count == 1 else "were"} held back.'
    )


def _utc(time_ns: int) -> str:
    minute = str(np.datetime64(time_ns, 'ns').astype('datetime64[m]'))
    return f'{minute.replace("T", " ")} UTC'
