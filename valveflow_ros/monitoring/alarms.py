"""The residual alarm: whether the plant has left the curve, with delays and a dead band."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from valveflow_ros.config import Settings
from valveflow_ros.jit import jit
from valveflow_ros.monitoring.alarm_records import AlarmChange, AlarmState, Judged, Priority
from valveflow_ros.monitoring.alarm_voice import Content, VoicedAlarm
from valveflow_ros.records import NS_PER_S, FloatArray, IntArray
from valveflow_ros.state import State, put_back

__all__ = ['AlarmChange', 'AlarmState', 'Judged', 'Priority', 'ResidualAlarm']

_LIMIT = 1.0
# Places in the alarm's memory: the condition, the delay that runs, the time of the last row; how
# long nothing could be judged and how long it could be again, and whether it is suppressed for it;
# what happened at the last row, and the step of time before it.
_ACTIVE, _SINCE, _COUNTING, _LAST_NS, _BLIND, _SIGHT, _DARK, _WHAT, _STEP = range(9)
_PLACES = 9
# What happened, as bits.
_TURNED, _DARKENED, _SEEING, _SET_BACK, _DUE = 1, 2, 4, 8, 16
_NEVER = (1 << 63) - 1


@jit
def _turns(
    time_ns: int,
    v: float,
    limit: float,
    dead_band: float,
    on_ns: int,
    off_ns: int,
    memory: IntArray,
) -> bool:
    """Judge one value; tell whether the condition turned."""
    if memory[_ACTIVE] == 0:
        beyond = v > limit
        delay = on_ns
    else:
        beyond = v < limit * (1.0 - dead_band)
        delay = off_ns
    if not beyond:
        memory[_COUNTING] = 0
        return False
    if memory[_COUNTING] == 0:
        memory[_COUNTING] = 1
        memory[_SINCE] = time_ns
    if time_ns - memory[_SINCE] < delay:
        return False
    memory[_ACTIVE] = 1 - memory[_ACTIVE]
    memory[_COUNTING] = 0
    return True


@jit
def _sight(
    judged: bool, turned: bool, watched_ns: int, dark_ns: int, back_ns: int, memory: IntArray
) -> int:
    """Follow how long the alarm has been blind, or could see again; return what that brings.

    Each takes back from the other, so that a single row on either side decides nothing; who has
    seen for long enough has not been blind. Time that nobody watched does not count: a silence
    alone suppresses nothing.
    """
    if not judged:
        memory[_SIGHT] = max(0, memory[_SIGHT] - watched_ns)
        memory[_BLIND] += watched_ns
        if memory[_DARK] == 0 and memory[_BLIND] >= dark_ns:
            memory[_DARK], memory[_SIGHT] = 1, 0
            return _DARKENED
        return 0
    memory[_SIGHT] = min(memory[_SIGHT] + watched_ns, back_ns)
    seen = memory[_SIGHT] >= back_ns
    memory[_BLIND] = 0 if seen else max(0, memory[_BLIND] - watched_ns)
    if memory[_DARK] != 0 and (seen or turned):
        memory[_DARK] = memory[_BLIND] = 0
        return _SEEING
    return 0


@jit
def _watch(
    time_ns: IntArray,
    value: FloatArray,
    limit: float,
    dead_band: float,
    on_ns: int,
    off_ns: int,
    gap_ns: int,
    dark_ns: int,
    back_ns: int,
    due_ns: int,
    memory: IntArray,
) -> int:
    """Run until something happens; return the row after it, or 0.

    NaN leaves the condition as it is: bad data neither raise nor clear. A delay
    does not run through a gap in time, where nobody was watching.
    """
    for t in range(value.size):
        step_ns = time_ns[t] - memory[_LAST_NS]
        memory[_LAST_NS] = time_ns[t]
        watched = 0 < step_ns <= gap_ns
        if not watched:
            memory[_COUNTING] = 0
        v = abs(value[t])
        judged = not math.isnan(v)
        turned = False
        if judged:
            turned = _turns(time_ns[t], v, limit, dead_band, on_ns, off_ns, memory)
        else:
            # Delays stand still while there is nothing to judge.
            memory[_SINCE] += step_ns
        what = _sight(judged, turned, step_ns if watched else 0, dark_ns, back_ns, memory)
        if turned:
            what += _TURNED
        if step_ns <= 0:
            what += _SET_BACK
        if time_ns[t] >= due_ns:
            what += _DUE
        if what:
            memory[_WHAT], memory[_STEP] = what, step_ns
            return t + 1
    return 0


class ResidualAlarm(VoicedAlarm):
    """Judge the evidence that the plant has left the curve: beyond 1 or -1 it has.

    Where the evidence cannot be judged for long, the alarm is suppressed. By ISA-18.2 that is no
    annunciation, and it must not flutter: a valve that runs beyond the curve for some minutes,
    some times a day, suppresses nothing. The alarm comes back when the evidence could be judged
    as long as a return of the condition has to last, less what could not, and at once if the
    condition turns.

    Parameters
    ----------
    settings : Settings
        Delays, dead band, latch, time on the shelf, flood limit.

    Attributes
    ----------
    judged : Judged
        What the next change speaks of.
    """

    NAME = 'residual'

    def __init__(self, settings: Settings) -> None:
        self._memory = np.zeros(_PLACES, dtype=np.int64)
        self.judged = Judged(0, math.nan, math.nan)
        super().__init__(settings)

    def configure(self, settings: Settings) -> None:
        """Take new settings; states and counters stay."""
        super().configure(settings)
        self._dead_band = settings.real('alarm_dead_band')
        self._on_ns = round(settings.real('alarm_on_delay') * NS_PER_S)
        self._off_ns = round(settings.real('alarm_off_delay') * NS_PER_S)
        self._gap_ns = round(1.5 * settings.real('sample_period') * NS_PER_S)
        self._dark_ns = round(settings.real('alarm_suppress_time') * NS_PER_S)
        # A return lasts as long as that of the condition, and at least a block: evidence from
        # before it is of old data.
        back_s = max(settings.real('alarm_block'), settings.real('alarm_off_delay'))
        self._back_ns = round(back_s * NS_PER_S)

    def feed(
        self,
        time_ns: IntArray,
        evidence: FloatArray,
        shift_mw: FloatArray,
        model_id: str,
        beside: Sequence[VoicedAlarm] = (),
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
        beside : sequence of VoicedAlarm
            Others, for which the time passes row by row as well.
        """
        changes: list[tuple[int, AlarmChange]] = []
        everyone = [self, *beside]
        done = 0
        while done < len(time_ns):
            due = [alarm.due_ns for alarm in everyone]
            taken = _watch(
                time_ns[done:], evidence[done:], _LIMIT, self._dead_band,
                self._on_ns, self._off_ns, self._gap_ns, self._dark_ns, self._back_ns,
                min((d for d in due if d is not None), default=_NEVER), self._memory,
            )  # fmt: skip
            if not taken:
                break
            done += taken
            now_ns = int(time_ns[done - 1])
            self.judged = Judged(now_ns, float(evidence[done - 1]), float(shift_mw[done - 1]))
            self._happened(now_ns, everyone)
            changes += [(done, c) for a in everyone for c in a.pass_time(now_ns, model_id)]
        return changes

    def _happened(self, now_ns: int, everyone: Sequence[VoicedAlarm]) -> None:
        """Let lives go on by what happened at a row."""
        what = int(self._memory[_WHAT])
        if what & _SET_BACK:
            for alarm in everyone:
                alarm.shift_time(int(self._memory[_STEP]))
        if what & _DARKENED:
            self._life.suppress()
        if what & _SEEING:
            self._life.resume()
        if what & _TURNED and self._memory[_ACTIVE]:
            self._life.begin(now_ns)
        elif what & _TURNED:
            self._life.end(self._latch)

    def _content(self, state: AlarmState) -> Content:
        value, shift_mw = self.judged.evidence, self.judged.shift_mw
        return Content(value, _LIMIT, '', _sentence(state, shift_mw))

    def _blind(self) -> str:
        minutes = self._dark_ns / (60.0 * NS_PER_S)
        return (
            f'The residual could not be judged for {minutes:g} min: inputs are bad, or the valve '
            'is outside the curve.'
        )

    def snapshot(self) -> State:
        """Return what is remembered; see `core.state`."""
        return {**super().snapshot(), 'memory': self._memory.copy(), 'judged': list(self.judged)}

    def restore(self, saved: State) -> None:
        """Go on from a snapshot; raises `DataError` if it does not fit."""
        put_back({'memory': self._memory}, saved)
        super().restore(saved)
        self.judged = Judged(*saved['judged'])


def _sentence(state: AlarmState, shift_mw: float) -> str:
    """Say what happened in words an operator can act on."""
    side = 'more' if shift_mw > 0.0 else 'less'
    known = abs(shift_mw) > 0.0
    if state == AlarmState.UNACKNOWLEDGED and not known:
        return 'The unit has left its valve curve; there is no residual to tell by how much.'
    if state == AlarmState.UNACKNOWLEDGED:
        return (
            f'The unit gives {abs(shift_mw):.1f} MW {side} than the valve curve says, and it '
            'lasts: check what changed, or re-identify.'
        )
    if state == AlarmState.ACKNOWLEDGED and not known:
        return 'Acknowledged; there is no residual to tell yet.'
    if state == AlarmState.ACKNOWLEDGED:
        return f'Acknowledged; the unit still gives {abs(shift_mw):.1f} MW {side} than expected.'
    if state == AlarmState.RETURNED_UNACKNOWLEDGED:
        return 'The unit follows the valve curve again; acknowledge to clear the alarm.'
    return 'The unit follows the valve curve.'
