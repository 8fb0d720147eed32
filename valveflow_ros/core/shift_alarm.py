"""The alarm on a shift of the curve: the states of the residual alarm, one judgement a curve."""

from __future__ import annotations

import math

from valveflow_ros.config import Settings
from valveflow_ros.core.alarms import AlarmChange, AlarmState, Priority
from valveflow_ros.core.shift import PieceShift, Shift

# A shift that was seen is over only when it is ten times less sure than it had to be.
_DOUBT = 10.0
# Share of a moved piece that must be judged unmoved: the ends of a curve, and its knots, lie
# a little elsewhere in every window.
_COVERED = 0.8


class ShiftAlarm:
    """Follow the judgements of adopted curves against the reference.

    Notes
    -----
    ISA-18.2 states as in `valveflow_ros.core.alarms.ResidualAlarm`, but without delays:
    a curve stands on days of data. A piece that moved and left the window with its load is
    not known to be back: the alarm stands until its u are judged again, or until there is a
    new reference.
    """

    NAME = 'curve_shift'

    def __init__(self) -> None:
        self._occurrence = 0
        self._raised_ns = 0
        self._value = 0.0
        self._limit = 0.0
        self._sentence = ''
        self._ranges: list[tuple[float, float]] = []
        self.active = False
        self.state = AlarmState.NORMAL

    @property
    def standing(self) -> bool:
        """Tell whether the alarm is anything but normal."""
        return self.state != AlarmState.NORMAL

    @property
    def ranges(self) -> tuple[tuple[float, float], ...]:
        """Return from which u to which u pieces moved that were not judged unmoved since."""
        return tuple(self._ranges)

    def judge(self, shift: Shift, time_ns: int, settings: Settings) -> list[AlarmChange]:
        """Take a judgement; return the change it makes, if any."""
        worst = shift.largest
        if worst is not None:
            self._value, self._limit = worst.shift_mw, worst.smallest_mw
            self._sentence = shift.sentence
        self._remember(shift, settings)
        if not self.active and worst is not None:
            self.active = True
            self._occurrence += 1
            self._raised_ns = time_ns
            return [self._enter(AlarmState.UNACKNOWLEDGED, time_ns, shift.model_id)]
        doubt = any(_stands(p, settings) for p in shift.pieces)
        if self.active and not doubt and not self._ranges:
            return self.end(shift.sentence, time_ns, shift.model_id, settings)
        return []

    def end(
        self, sentence: str, time_ns: int, model_id: str, settings: Settings
    ) -> list[AlarmChange]:
        """Let the condition be over, as with a new reference."""
        if not self.active:
            return []
        self.active = False
        self._ranges = []
        self._sentence, self._value = sentence, 0.0
        waits = settings.flag('alarm_latch') and self.state == AlarmState.UNACKNOWLEDGED
        after = AlarmState.RETURNED_UNACKNOWLEDGED if waits else AlarmState.NORMAL
        return [self._enter(after, time_ns, model_id)]

    def acknowledge(self, time_ns: int, model_id: str) -> list[AlarmChange]:
        """Acknowledge; empty when there is nothing to acknowledge."""
        if self.state == AlarmState.UNACKNOWLEDGED:
            return [self._enter(AlarmState.ACKNOWLEDGED, time_ns, model_id)]
        if self.state == AlarmState.RETURNED_UNACKNOWLEDGED:
            return [self._enter(AlarmState.NORMAL, time_ns, model_id)]
        return []

    def _remember(self, shift: Shift, settings: Settings) -> None:
        """Remember the ranges that moved; forget older ones that are judged anew."""
        settled = [
            p for p in shift.pieces
            if p.moved or (math.isfinite(p.smallest_mw) and not _stands(p, settings))
        ]  # fmt: skip
        self._ranges = [r for r in self._ranges if not _covered(r, settled)]
        self._ranges += [(p.u_from, p.u_to) for p in shift.pieces if p.moved]

    def _enter(self, state: AlarmState, time_ns: int, model_id: str) -> AlarmChange:
        previous, self.state = self.state, state
        sentence = self._sentence
        if state == AlarmState.ACKNOWLEDGED:
            sentence = f'Acknowledged. {sentence}'
        elif state == AlarmState.RETURNED_UNACKNOWLEDGED:
            sentence = f'{sentence} Acknowledge to clear the alarm.'
        return AlarmChange(
            time_ns, self.NAME, state, previous, Priority.MEDIUM, self._value, self._limit, 'MW',
            sentence, self._occurrence, self._raised_ns, model_id,
        )  # fmt: skip


def _covered(span: tuple[float, float], pieces: list[PieceShift]) -> bool:
    """Tell whether pieces cover nearly all of a range of u."""
    low, high = span
    inside = sum(max(0.0, min(p.u_to, high) - max(p.u_from, low)) for p in pieces)
    return inside >= _COVERED * (high - low)


def _stands(piece: PieceShift, settings: Settings) -> bool:
    """Tell whether a shift that was seen before is still there."""
    chance = min(1.0, _DOUBT * (1.0 - settings.real('shift_confidence')))
    least = (1.0 - settings.real('alarm_dead_band')) * settings.real('shift_least')
    return piece.p_value < chance and abs(piece.shift_mw) >= least
