"""The alarm on a shift of the curve: the states of the residual alarm, one judgement a curve."""

from __future__ import annotations

import math

from valveflow_ros.config import Settings
from valveflow_ros.curve.shift import PieceShift, Shift
from valveflow_ros.monitoring.alarm_records import AlarmChange, AlarmState
from valveflow_ros.monitoring.alarm_voice import Content, VoicedAlarm
from valveflow_ros.state import State

# A shift that was seen is over only when it is ten times less sure than it had to be.
_DOUBT = 10.0
# Share of a moved piece that must be judged unmoved: the ends of a curve, and its knots, lie
# a little elsewhere in every window.
_COVERED = 0.8


class ShiftAlarm(VoicedAlarm):
    """Follow the judgements of adopted curves against the reference.

    Notes
    -----
    ISA-18.2 states as of the residual alarm, but without delays: a curve stands on days of data,
    and for the same reason it is suppressed by a curve that cannot be judged, not by minutes of
    bad data. A piece that moved and left the window with its load is not known to be back: the
    alarm stands until its u are judged again, or until there is a new reference.

    Parameters
    ----------
    settings : Settings, optional
        Those given with a judgement are taken from then on.
    """

    NAME = 'curve_shift'

    def __init__(self, settings: Settings | None = None) -> None:
        self._value = 0.0
        self._limit = 0.0
        self._sentence = ''
        self._problem = ''
        self._ranges: list[tuple[float, float]] = []
        super().__init__(settings or Settings())

    @property
    def ranges(self) -> tuple[tuple[float, float], ...]:
        """Return from which u to which u pieces moved that were not judged unmoved since."""
        return tuple(self._ranges)

    def judge(self, shift: Shift, time_ns: int, settings: Settings) -> list[AlarmChange]:
        """Take a judgement; return the change it makes, if any."""
        self.configure(settings)
        self._life.resume()
        worst = shift.largest
        if worst is not None:
            self._value, self._limit = worst.shift_mw, worst.smallest_mw
            self._sentence = shift.sentence
        self._remember(shift, settings)
        if not self.active and worst is not None:
            self._life.begin(time_ns)
        doubt = any(_stands(p, settings) for p in shift.pieces)
        if self.active and not doubt and not self._ranges:
            self._end(shift.sentence)
        return self._tell(time_ns, shift.model_id)

    def unjudged(
        self, problem: str, time_ns: int, model_id: str, settings: Settings
    ) -> list[AlarmChange]:
        """Be suppressed, since a curve could not be judged, until the next one is."""
        self.configure(settings)
        self._problem = problem
        self._life.suppress()
        return self._tell(time_ns, model_id)

    def end(
        self, sentence: str, time_ns: int, model_id: str, settings: Settings
    ) -> list[AlarmChange]:
        """Let the condition be over, as with a new reference."""
        self.configure(settings)
        self._life.resume()
        if self.active:
            self._end(sentence)
        return self._tell(time_ns, model_id)

    def _end(self, sentence: str) -> None:
        self._ranges = []
        self._sentence, self._value = sentence, 0.0
        self._life.end(self._latch)

    def _remember(self, shift: Shift, settings: Settings) -> None:
        """Remember the ranges that moved; forget older ones that are judged anew."""
        settled = [
            p for p in shift.pieces
            if p.moved or (math.isfinite(p.smallest_mw) and not _stands(p, settings))
        ]  # fmt: skip
        self._ranges = [r for r in self._ranges if not _covered(r, settled)]
        self._ranges += [(p.u_from, p.u_to) for p in shift.pieces if p.moved]

    def _content(self, state: AlarmState) -> Content:
        sentence = self._sentence or 'No piece of the curve is known to have moved.'
        if state == AlarmState.ACKNOWLEDGED:
            sentence = f'Acknowledged. {sentence}'
        elif state == AlarmState.RETURNED_UNACKNOWLEDGED:
            sentence = f'{sentence} Acknowledge to clear the alarm.'
        return Content(self._value, self._limit, 'MW', sentence)

    def _blind(self) -> str:
        return f'The curve could not be judged against its reference: {self._problem}'

    def snapshot(self) -> State:
        """Return what is remembered; see `core.state`."""
        return {
            **super().snapshot(),
            'value': self._value,
            'limit': self._limit,
            'sentence': self._sentence,
            'problem': self._problem,
            'ranges': [list(r) for r in self._ranges],
        }

    def restore(self, saved: State) -> None:
        """Go on from a snapshot."""
        super().restore(saved)
        self._value, self._limit = saved['value'], saved['limit']
        self._sentence, self._problem = saved['sentence'], saved['problem']
        self._ranges = [(r[0], r[1]) for r in saved['ranges']]


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
