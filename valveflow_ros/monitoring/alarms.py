# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The alarms of the monitor: on the residual and on a shift of the curve; the list of both."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from valveflow_ros.curve.shift import PieceShift, Shift, minute
from valveflow_ros.errors import DataError, listed
from valveflow_ros.monitoring.alarm_state import (
    Alarm,
    AlarmAction,
    AlarmChange,
    AlarmState,
    Content,
    Judged,
    Priority,
)
from valveflow_ros.numerics import jit
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S, FloatArray, IntArray
from valveflow_ros.state import State

if TYPE_CHECKING:
    from valveflow_ros.monitoring.prediction import PredictionBlock


__all__ = ['AlarmChange', 'AlarmState', 'Judged', 'Priority', 'ResidualAlarm']

_LIMIT = 1.0
# Indices of the alarm state: condition, start of the running delay, delay running, time of the
# last row; time without judgement, time with judgement, suppressed; events at the last row, time
# step before it; last time without evidence.
(
    _ACTIVE, _SINCE, _COUNTING, _LAST_NS, _UNJUDGED_NS, _JUDGED_NS, _SUPPRESSED, _WHAT, _STEP,
    _CALM_NS,
) = range(10)  # fmt: skip
_PLACES = 10
# The onset is the last time when the evidence was below this fraction of the limit.
CALM = 0.25
# Suppression ends after at most this many blocks that can be judged.
_BLOCKS_TO_SEE = 5.0
# An alarm within this many return delays after the last return continues the earlier one; its
# return delay is then doubled, up to this factor.
_SOON, _LONGEST = 7, 8
# Events at a row, as bits.
_TURNED, _DARKENED, _SEEING, _SET_BACK, _DUE = 1, 2, 4, 8, 16
_NEVER = (1 << 63) - 1
_SHOWN = (AlarmState.UNACKNOWLEDGED, AlarmState.ACKNOWLEDGED)


class _Delays(NamedTuple):
    """Settings of the alarm in the form of the kernel."""

    dead_band: float
    on_ns: int
    off_ns: int
    gap_ns: int  # rows with a larger time difference are separated by a gap
    dark_ns: int  # without judgement, until suppression
    back_ns: int  # with judgement, until its end


@jit
def _turns(time_ns: int, v: float, delays: _Delays, memory: IntArray) -> bool:
    """Judge one value; return True if the condition changed."""
    if memory[_ACTIVE] == 0:
        beyond = v > _LIMIT
        delay = delays.on_ns
    else:
        beyond = v < _LIMIT * (1.0 - delays.dead_band)
        delay = delays.off_ns
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
def _sight(judged: bool, turned: bool, watched_ns: int, delays: _Delays, memory: IntArray) -> int:
    """Update how long the alarm could not, or could, be judged; return the resulting event.

    Each time reduces the other one, so that a single row has no effect; after enough time with
    judgement, the time without it is reset. Gaps do not count: missing rows alone do not suppress
    the alarm.
    """
    if not judged:
        memory[_JUDGED_NS] = max(0, memory[_JUDGED_NS] - watched_ns)
        memory[_UNJUDGED_NS] += watched_ns
        if memory[_SUPPRESSED] == 0 and memory[_UNJUDGED_NS] >= delays.dark_ns:
            memory[_SUPPRESSED], memory[_JUDGED_NS] = 1, 0
            return _DARKENED
        return 0
    memory[_JUDGED_NS] = min(memory[_JUDGED_NS] + watched_ns, delays.back_ns)
    seen = memory[_JUDGED_NS] >= delays.back_ns
    memory[_UNJUDGED_NS] = 0 if seen else max(0, memory[_UNJUDGED_NS] - watched_ns)
    if memory[_SUPPRESSED] != 0 and (seen or turned):
        memory[_SUPPRESSED] = memory[_UNJUDGED_NS] = 0
        return _SEEING
    return 0


@jit
def _elsewhere(v: float, u: float, dead_band: float, span: FloatArray) -> bool:
    """Update the range of u where the condition was seen; return True for a calm row outside."""
    if v > _LIMIT:
        span[0], span[1] = min(span[0], u), max(span[1], u)
    return v < _LIMIT * (1.0 - dead_band) and not span[0] <= u <= span[1]


@jit
def _watch(
    time_ns: IntArray, value: FloatArray, u: FloatArray, delays: _Delays, due_ns: int,
    memory: IntArray, span: FloatArray,
) -> int:  # fmt: skip
    """Process rows until an event; return the index of the row after it, or 0.

    NaN does not change the condition: bad data neither raise nor clear the alarm. A
    delay does not run through a gap in time. A return is judged only in the range of
    u where the condition was seen: a fault at full load does not end because
    the unit runs at half load.
    """
    for t in range(value.size):
        step_ns = time_ns[t] - memory[_LAST_NS]
        memory[_LAST_NS] = time_ns[t]
        watched = 0 < step_ns <= delays.gap_ns
        if not watched:
            memory[_COUNTING] = 0
        v = abs(value[t])
        judged = not math.isnan(v)
        turned = False
        if judged and v < CALM * _LIMIT:
            memory[_CALM_NS] = time_ns[t]
        if judged and memory[_ACTIVE] == 0:
            turned = _turns(time_ns[t], v, delays, memory)
            if turned:
                span[:] = u[t]
        elif judged and not _elsewhere(v, u[t], delays.dead_band, span):
            turned = _turns(time_ns[t], v, delays, memory)
        else:
            # Delays pause while there is nothing to judge.
            memory[_SINCE] += step_ns
        what = _sight(judged, turned, step_ns if watched else 0, delays, memory)
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


class ResidualAlarm(Alarm):
    """Raise an alarm if the evidence that the plant has left the curve is beyond 1 or -1.

    If the evidence cannot be judged for a long time, the alarm is suppressed. In ISA-18.2 terms it
    is then not annunciated. Suppression must not chatter: a few minutes outside the curve, several
    times a day, have no effect. It ends when the evidence could be judged for several blocks, net
    of the time when it could not, or at once if the condition changes.
    The condition ends only in the range of u where it was seen: elsewhere the return delay pauses.
    An alarm that comes back soon after a return counts as the same one: each time its return delay
    is doubled.

    Parameters
    ----------
    settings : Settings
        Delays, dead band, latch, shelving time, flood limit.
    """

    NAME = 'residual'
    REMEMBERED = (
        *Alarm.REMEMBERED, '_memory', '_span', 'judged', 'onset_ns', '_returned_ns', '_longer',
        '_left_mw', '_opening_percent',
    )  # fmt: skip

    def __init__(self, settings: Settings) -> None:
        self._memory = np.zeros(_PLACES, dtype=np.int64)
        self._span = np.zeros(2)
        # Time when the evidence for the last occurrence began to grow; 0 if none.
        self.onset_ns = 0
        self._returned_ns: int | None = None
        self._longer = 1  # factor of the return delay
        # Difference from the curve, and valve opening, when the alarm was raised.
        self._left_mw, self._opening_percent = 0.0, math.nan
        # Time, evidence and shift for the next announcement.
        self.judged = Judged(0, math.nan, math.nan)
        super().__init__(settings)

    def configure(self, settings: Settings) -> None:
        """Apply new settings; states and counters stay."""
        super().configure(settings)
        block_s, off_s = settings.real('alarm_block'), settings.real('alarm_off_delay')
        # At least one block, because earlier evidence contains old data. The return delay may be a
        # day, but the suppression must not last that long.
        back_s = max(block_s, min(off_s, _BLOCKS_TO_SEE * block_s))
        seconds = (
            settings.real('alarm_on_delay'), off_s, 1.5 * settings.real('sample_period'),
            settings.real('alarm_suppress_time'), back_s,
        )  # fmt: skip
        self._delays = _Delays(
            settings.real('alarm_dead_band'), *(round(s * NS_PER_S) for s in seconds)
        )

    def restore(self, saved: State) -> None:
        """Continue from a saved state; earlier versions did not store the range of u."""
        new = {'returned_ns': None, 'longer': 1, 'left_mw': 0.0, 'opening_percent': math.nan}
        saved = {**new, **saved.get('life', {}), **saved}
        memory = saved.get('memory')
        if 'span' not in saved and isinstance(memory, np.ndarray):
            saved = {
                **saved, 'memory': np.append(memory, 0), 'span': np.array([-math.inf, math.inf]),
                'onset_ns': saved.get('raised_ns'),
            }  # fmt: skip
        super().restore(saved)

    def reset(self, time_ns: int, model_id: str) -> list[AlarmChange]:
        """End the condition, as after a new reference."""
        self._returned_ns, self._longer = None, 1
        if not self.active:
            return []
        self._memory[_ACTIVE] = self._memory[_COUNTING] = 0
        self.judged = Judged(time_ns, 0.0, 0.0)
        self.end(self._latch)
        return self._tell(time_ns, model_id)

    def feed(
        self,
        time_ns: IntArray,
        evidence: FloatArray,
        shift_mw: FloatArray,
        model_id: str,
        beside: Sequence[Alarm] = (),
        u: FloatArray | None = None,
        opening_percent: FloatArray | None = None,
    ) -> list[tuple[int, AlarmChange]]:
        """Judge rows; return changes, each with the number of rows up to it.

        Parameters
        ----------
        time_ns : int64 (n,)
        evidence, shift_mw : float64 (n,)
            NaN if there is nothing to judge; the corresponding shift, for the sentence.
        beside : sequence of Alarm
            Other alarms, whose time advances row by row as well.
        u : float64 (n,), optional
            Position of the unit on the curve.
        opening_percent : float64 (n,), optional
            Valve opening, for the sentence.
        """
        u = np.zeros(len(time_ns)) if u is None else u
        opening = np.full(len(time_ns), math.nan) if opening_percent is None else opening_percent
        changes: list[tuple[int, AlarmChange]] = []
        everyone = [self, *beside]
        done = 0
        while done < len(time_ns):
            due = [alarm.due_ns for alarm in everyone]
            delays = self._delays._replace(off_ns=self._longer * self._delays.off_ns)
            taken = _watch(
                time_ns[done:], evidence[done:], u[done:], delays,
                min((d for d in due if d is not None), default=_NEVER), self._memory, self._span,
            )  # fmt: skip
            if not taken:
                break
            done += taken
            now_ns = int(time_ns[done - 1])
            self.judged = Judged(
                now_ns, *(float(a[done - 1]) for a in (evidence, shift_mw, opening))
            )
            self._happened(now_ns, everyone)
            changes += [(done, c) for a in everyone for c in a.pass_time(now_ns, model_id)]
        return changes

    def shift_time(self, step_ns: int) -> None:
        """Shift the stored times after a step of the clock."""
        super().shift_time(step_ns)
        if self._returned_ns is not None:
            self._returned_ns += step_ns

    def _happened(self, now_ns: int, everyone: Sequence[Alarm]) -> None:
        what = int(self._memory[_WHAT])
        if what & _SET_BACK:
            for alarm in everyone:
                alarm.shift_time(int(self._memory[_STEP]))
        if what & _DARKENED:
            self.suppressed = True
        if what & _SEEING:
            self.suppressed = False
        if what & _TURNED and self._memory[_ACTIVE]:
            self.onset_ns = int(self._memory[_CALM_NS])
            before_ns = self._returned_ns
            again = before_ns is not None and now_ns - before_ns <= _SOON * self._delays.off_ns
            self._longer = min(2 * self._longer, _LONGEST) if again else 1
            self._left_mw = self.judged.shift_mw
            self._opening_percent = self.judged.opening_percent
            self.begin(now_ns)
        elif what & _TURNED:
            self._returned_ns = now_ns
            self.end(self._latch)

    def _content(self, state: AlarmState) -> Content:
        value, shift_mw = self.judged.evidence, self.judged.shift_mw
        where = ''
        if state in _SHOWN and math.isfinite(self._opening_percent):
            where = f' The alarm was raised at {self._opening_percent:.0f} % opening.'
        if abs(shift_mw) > 0.0 or state != AlarmState.UNACKNOWLEDGED or not self._left_mw:
            return Content(value, _LIMIT, '', _sentence(state, shift_mw, self.onset_ns) + where)
        side = 'more' if self._left_mw > 0.0 else 'less'
        sentence = (
            f'The unit gave {abs(self._left_mw):.1f} MW {side} than its valve curve (mean over '
            'the loads seen). Since then the difference has been within the limit, but not for '
            'long enough at the openings of the alarm.'
        )
        return Content(value, _LIMIT, '', sentence + where)

    def _blind(self) -> str:
        minutes = self._delays.dark_ns / (60.0 * NS_PER_S)
        return (
            f'The residual could not be judged for {minutes:g} min: inputs are bad, or the valve '
            'is outside the curve.'
        )


def _sentence(state: AlarmState, shift_mw: float, onset_ns: int) -> str:
    known = abs(shift_mw) > 0.0
    size = f'{abs(shift_mw):.1f} MW {"more" if shift_mw > 0.0 else "less"}'
    since = f', since about {minute(onset_ns)}' if onset_ns > 0 else ''
    if state == AlarmState.UNACKNOWLEDGED and not known:
        return 'The unit does not follow its valve curve; the difference in MW is not known.'
    if state == AlarmState.UNACKNOWLEDGED:
        return (
            f'The unit gives {size} than its valve curve (mean over the loads seen){since}. '
            'Check what changed then. If the change was intended, request a new curve (~/refit) '
            'and make it the reference (~/set_reference).'
        )
    if state == AlarmState.ACKNOWLEDGED and not known:
        return 'Acknowledged; the difference in MW is not known yet.'
    if state == AlarmState.ACKNOWLEDGED:
        return (
            f'Acknowledged; the unit still gives {size} than its valve curve (mean over the loads '
            'seen).'
        )
    if state == AlarmState.RETURNED_UNACKNOWLEDGED:
        return 'The unit follows the valve curve again; acknowledge to clear the alarm.'
    return 'The unit follows the valve curve.'


# A reported shift ends only when its p-value exceeds ten times the limit for reporting it.
_DOUBT = 10.0
# Fraction of a shifted piece that must be judged as not shifted: the ends and the breakpoints of
# the curve differ slightly from window to window.
_COVERED = 0.8
# A shift is announced again if its size changes by this fraction and by two standard errors, which
# are about half of the smallest detectable shift.
_ANOTHER = 0.25
# A shift larger than this multiple of the smallest detectable one needs no second curve.
_CLEAR = 2.0
# Two pieces count as the same if they share this fraction of the shorter one.
_OVERLAP = 0.5
# Judgements are independent after this fraction of the refit period (< 1, as fits take time).
_APART = 0.9


class ShiftAlarm(Alarm):
    """Raise an alarm if adopted curves differ from the reference.

    The states are those of ISA-18.2, as for the residual alarm, but without delays: a curve is
    based on days of data. So it is suppressed if a curve cannot be judged, not by minutes of bad
    data. Two consecutive judgements must find the shift, unless it is large. If the loads in the
    window no longer cover a shifted piece, the alarm stands until its range of u is judged again,
    or until a new reference is set. The alarm is announced again if the size of the shift changes:
    the first curves after a change are inaccurate. Settings given with a judgement replace earlier
    ones.
    """

    NAME = 'curve_shift'
    REMEMBERED = (
        *Alarm.REMEMBERED, '_value', '_limit', '_sentence', '_problem', '_ranges', '_seen',
        '_seen_ns',
    )  # fmt: skip

    def __init__(self, settings: Settings | None = None) -> None:
        self._value = self._limit = 0.0
        self._sentence = self._problem = ''
        self._ranges: list[tuple[float, float]] = []
        self._seen: list[list[float]] = []  # u and MW of the shifted pieces at the last judgement
        self._seen_ns = 0
        super().__init__(settings or Settings())

    @property
    def ranges(self) -> tuple[tuple[float, float], ...]:
        """Return the ranges of u of shifted pieces that were not judged as unshifted since."""
        return tuple((low, high) for low, high in self._ranges)

    def judge(self, shift: Shift, time_ns: int, settings: Settings) -> list[AlarmChange]:
        """Process a judgement; return the resulting change, if any."""
        self.configure(settings)
        self.suppressed = False
        # Two curves requested within a short time use nearly the same data.
        another = time_ns - self._seen_ns >= _APART * settings.real('refit_period') * NS_PER_S
        if not self.active and self._confirmed(shift, self._seen if another else []):
            self.begin(time_ns)
        seen = [[p.u_from, p.u_to, p.shift_mw] for p in shift.pieces if p.moved]
        if another or not self._seen:
            self._seen, self._seen_ns = seen, time_ns
        if self.active:
            self._follow(shift, settings)
        return self._tell(time_ns, shift.model_id)

    def unjudged(
        self, problem: str, time_ns: int, model_id: str, settings: Settings
    ) -> list[AlarmChange]:
        """Suppress the alarm, because a curve could not be judged, until the next judgement."""
        self.configure(settings)
        self._problem, self.suppressed = problem, True
        return self._tell(time_ns, model_id)

    def restore(self, saved: State) -> None:
        """Continue from a saved state; earlier versions have no stored judgement."""
        super().restore({'seen': [], 'seen_ns': 0, **saved})

    def reset(
        self, sentence: str, time_ns: int, model_id: str, settings: Settings
    ) -> list[AlarmChange]:
        """End the condition, as after a new reference."""
        self.configure(settings)
        self.suppressed = False
        self.forget()
        if self.active:
            self._end(sentence)
        return self._tell(time_ns, model_id)

    @property
    def _again_ns(self) -> int | None:
        """Return now if the announced size is out of date."""
        told = self.last
        if self.active and told is not None and self.state == told.state in _SHOWN:
            surely = max(_ANOTHER * abs(told.value), 0.5 * self._limit)
            if abs(self._value - told.value) > surely:
                return self._told_ns
        return super()._again_ns

    def shift_time(self, step_ns: int) -> None:
        """Shift the stored times after a step of the clock."""
        super().shift_time(step_ns)
        self._seen_ns += step_ns

    def forget(self) -> None:
        """Forget the last judgement, because it referred to another reference."""
        self._seen = []

    def _end(self, sentence: str) -> None:
        self._ranges = []
        self.forget()
        self._sentence, self._value = sentence, 0.0
        self.end(self._latch)

    def _follow(self, shift: Shift, settings: Settings) -> None:
        """Update the size of the shift; end the condition if it is over."""
        worst = shift.largest
        if worst is not None:
            self._value, self._limit = worst.shift_mw, worst.smallest_mw
            self._sentence = shift.sentence
        # Ranges that were judged again are replaced.
        settled = [
            p for p in shift.pieces
            if p.moved or (math.isfinite(p.smallest_mw) and not _stands(p, settings))
        ]  # fmt: skip
        self._ranges = [r for r in self._ranges if not _covered(r, settled)]
        self._ranges += [(p.u_from, p.u_to) for p in shift.pieces if p.moved]
        if not self._ranges and not any(_stands(p, settings) for p in shift.pieces):
            self._end(shift.sentence)

    def _confirmed(self, shift: Shift, seen: list[list[float]]) -> bool:
        """Return True if a piece is shifted as in the last judgement, or by a large amount."""
        return any(
            abs(p.shift_mw) > _CLEAR * p.smallest_mw
            or any(
                p.shift_mw * mw > 0.0
                and min(p.u_to, high) - max(p.u_from, low)
                >= _OVERLAP * min(p.u_to - p.u_from, high - low)
                for low, high, mw in seen
            )
            for p in shift.pieces
            if p.moved
        )

    def _content(self, state: AlarmState) -> Content:
        sentence = self._sentence or 'No piece of the curve is known to have changed.'
        cleared = AlarmState.RETURNED_UNACKNOWLEDGED, AlarmState.NORMAL
        if state == AlarmState.ACKNOWLEDGED or (self._before, state) == cleared:
            sentence = f'Acknowledged. {sentence}'
        elif state == AlarmState.RETURNED_UNACKNOWLEDGED:
            sentence = f'{sentence} Acknowledge to clear the alarm.'
        return Content(self._value, self._limit, 'MW', sentence)

    def _blind(self) -> str:
        return f'The curve could not be judged against its reference: {self._problem}'


def _covered(span: tuple[float, float], pieces: list[PieceShift]) -> bool:
    """Return True if pieces cover nearly all of a range of u."""
    low, high = span
    inside = sum(max(0.0, min(p.u_to, high) - max(p.u_from, low)) for p in pieces)
    return inside >= _COVERED * (high - low)


def _stands(piece: PieceShift, settings: Settings) -> bool:
    """Return True if a shift that was seen before is still there."""
    chance = min(1.0, _DOUBT * (1.0 - settings.real('shift_confidence')))
    least = (1.0 - settings.real('alarm_dead_band')) * settings.real('shift_least')
    return piece.p_value < chance and abs(piece.shift_mw) >= least


_NOTHING_TO_DO = {
    AlarmAction.ACKNOWLEDGE: 'There is no alarm to acknowledge.',
    AlarmAction.SHELVE: 'There is no alarm to shelve.',
    AlarmAction.UNSHELVE: 'There is no shelved alarm.',
}
_NOTHING_TO_DO_TO = {
    AlarmAction.ACKNOWLEDGE: 'There is nothing to acknowledge of the alarm {}.',
    AlarmAction.SHELVE: 'The alarm {} does not stand, or is shelved already.',
    AlarmAction.UNSHELVE: 'The alarm {} is not shelved.',
}


class Alarms:
    """All alarms of the monitor, in one list."""

    def __init__(self, residual: ResidualAlarm, shift: ShiftAlarm) -> None:
        self._residual, self._shift = residual, shift
        self._all: tuple[Alarm, ...] = (residual, shift)
        for alarm in self._all:
            alarm.stand_beside(self._all)

    def configure(self, settings: Settings) -> None:
        """Apply new settings; states and counters stay."""
        for alarm in self._all:
            alarm.configure(settings)

    def feed(
        self, block: PredictionBlock, opening_percent: FloatArray | None = None
    ) -> list[AlarmChange]:
        """Judge predicted rows; return the changes in the order of the rows."""
        judged = np.where(np.isfinite(block.residual_mw), block.evidence, np.nan)
        changes = self._residual.feed(
            block.time_ns, judged, block.shift_mw, block.model_id, [self._shift], block.u,
            opening_percent,
        )  # fmt: skip
        return [change for _, change in changes]

    def operate(
        self, action: AlarmAction, judged: Judged, model_id: str, name: str | None = None
    ) -> list[AlarmChange]:
        """Apply an operator action to the alarm of a name, or to all; return the announcements.

        ``judged`` is the last one, by the curve ``model_id``. Raises `DataError` if there is no
        alarm of that name, or the action applies to none of them.
        """
        meant = [alarm for alarm in self._all if name in (None, alarm.NAME)]
        if not meant:
            names = listed([alarm.NAME for alarm in self._all], 'or')
            raise DataError(f"There is no alarm '{name}'; choose {names}.")
        self._residual.judged = judged
        done = [alarm.operate(action, judged.time_ns, model_id) for alarm in meant]
        if not any(could for could, _ in done):
            words = _NOTHING_TO_DO if name is None else _NOTHING_TO_DO_TO
            raise DataError(words[action].format(name))
        return [change for _, changes in done for change in changes]
