"""The residual alarm: ISA-18.2 states with delays, dead band, latch and acknowledgement."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from valveflow_ros.config import Settings
from valveflow_ros.core.jit import jit
from valveflow_ros.records import NS_PER_S, FloatArray, IntArray


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
    """One change of an alarm's state."""

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


class Judged(NamedTuple):
    """A moment, the evidence then, and the shift it speaks of."""

    time_ns: int
    evidence: float
    shift_mw: float


_LIMIT = 1.0
# Places in the alarm's memory.
_ACTIVE, _SINCE, _COUNTING, _LAST_NS = range(4)


@jit
def _watch(
    time_ns: IntArray,
    value: FloatArray,
    limit: float,
    dead_band: float,
    on_ns: int,
    off_ns: int,
    gap_ns: int,
    memory: IntArray,
) -> int:
    """Run until the condition turns; return the row after the turn, or 0.

    NaN leaves everything as it is: bad data neither raise nor clear. A delay
    does not run through a gap in time, where nobody was watching.
    """
    for t in range(value.size):
        step_ns = time_ns[t] - memory[_LAST_NS]
        memory[_LAST_NS] = time_ns[t]
        if step_ns > gap_ns or step_ns <= 0:
            memory[_COUNTING] = 0
        v = abs(value[t])
        if math.isnan(v):
            # Delays stand still while there is nothing to judge.
            memory[_SINCE] += step_ns
            continue
        if memory[_ACTIVE] == 0:
            beyond = v > limit
            delay = on_ns
        else:
            beyond = v < limit * (1.0 - dead_band)
            delay = off_ns
        if not beyond:
            memory[_COUNTING] = 0
            continue
        if memory[_COUNTING] == 0:
            memory[_COUNTING] = 1
            memory[_SINCE] = time_ns[t]
        if time_ns[t] - memory[_SINCE] >= delay:
            memory[_ACTIVE] = 1 - memory[_ACTIVE]
            memory[_COUNTING] = 0
            return t + 1
    return 0


class ResidualAlarm:
    """Judge the evidence that the plant has left the curve: beyond 1 or -1 it has.

    Parameters
    ----------
    settings : Settings
        Delays, dead band, latch.
    """

    NAME = 'residual'

    def __init__(self, settings: Settings) -> None:
        self._memory = np.zeros(4, dtype=np.int64)
        self._occurrence = 0
        self._raised_ns = 0
        self.state = AlarmState.NORMAL
        self.configure(settings)

    def configure(self, settings: Settings) -> None:
        """Take new delays, dead band and latch; states and counters stay."""
        self._dead_band = settings.real('alarm_dead_band')
        self._on_ns = round(settings.real('alarm_on_delay') * NS_PER_S)
        self._off_ns = round(settings.real('alarm_off_delay') * NS_PER_S)
        self._latch = settings.flag('alarm_latch')
        self._gap_ns = round(1.5 * settings.real('sample_period') * NS_PER_S)

    @property
    def active(self) -> bool:
        """Tell whether the condition holds now."""
        return bool(self._memory[_ACTIVE])

    @property
    def standing(self) -> bool:
        """Tell whether the alarm is anything but normal."""
        return self.state != AlarmState.NORMAL

    def feed(
        self, time_ns: IntArray, evidence: FloatArray, shift_mw: FloatArray, model_id: str
    ) -> list[tuple[int, AlarmChange]]:
        """Judge rows; return changes, each with the number of rows up to it.

        Parameters
        ----------
        time_ns : int64 (n,)
        evidence : float64 (n,)
            NaN where there is nothing to judge.
        shift_mw : float64 (n,)
            The shift it speaks of, for the sentence.
        model_id : str
        """
        changes: list[tuple[int, AlarmChange]] = []
        done = 0
        while done < len(time_ns):
            turned = _watch(
                time_ns[done:], evidence[done:], _LIMIT, self._dead_band,
                self._on_ns, self._off_ns, self._gap_ns, self._memory,
            )  # fmt: skip
            if not turned:
                break
            done += turned
            judged = Judged(
                int(time_ns[done - 1]), float(evidence[done - 1]), float(shift_mw[done - 1])
            )
            changes.append((done, self._turn(judged, model_id)))
        return changes

    def acknowledge(self, judged: Judged, model_id: str) -> AlarmChange | None:
        """Acknowledge; None when there is nothing to acknowledge."""
        if self.state == AlarmState.UNACKNOWLEDGED:
            return self._enter(AlarmState.ACKNOWLEDGED, judged, model_id)
        if self.state == AlarmState.RETURNED_UNACKNOWLEDGED:
            return self._enter(AlarmState.NORMAL, judged, model_id)
        return None

    def _turn(self, judged: Judged, model_id: str) -> AlarmChange:
        """Change state because the condition has begun or ended."""
        if self.active:
            self._occurrence += 1
            self._raised_ns = judged.time_ns
            return self._enter(AlarmState.UNACKNOWLEDGED, judged, model_id)
        latched = self._latch and self.state == AlarmState.UNACKNOWLEDGED
        after = AlarmState.RETURNED_UNACKNOWLEDGED if latched else AlarmState.NORMAL
        return self._enter(after, judged, model_id)

    def _enter(self, state: AlarmState, judged: Judged, model_id: str) -> AlarmChange:
        previous, self.state = self.state, state
        return AlarmChange(
            judged.time_ns, self.NAME, state, previous, Priority.MEDIUM, judged.evidence, _LIMIT,
            '', _sentence(state, judged.shift_mw), self._occurrence, self._raised_ns, model_id,
        )  # fmt: skip


def _sentence(state: AlarmState, shift_mw: float) -> str:
    """Say what happened in words an operator can act on."""
    side = 'more' if shift_mw > 0.0 else 'less'
    if state == AlarmState.UNACKNOWLEDGED:
        return (
            f'The unit gives {abs(shift_mw):.1f} MW {side} than the valve curve says, and it '
            'lasts: check what changed, or re-identify.'
        )
    if state == AlarmState.ACKNOWLEDGED and not abs(shift_mw) > 0.0:
        return 'Acknowledged; there is no residual to tell yet.'
    if state == AlarmState.ACKNOWLEDGED:
        return f'Acknowledged; the unit still gives {abs(shift_mw):.1f} MW {side} than expected.'
    if state == AlarmState.RETURNED_UNACKNOWLEDGED:
        return 'The unit follows the valve curve again; acknowledge to clear the alarm.'
    return 'The unit follows the valve curve.'
