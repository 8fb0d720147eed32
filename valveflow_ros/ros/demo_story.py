"""What the demo tells while it runs: one story, each thing when it first happens."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import datetime, timedelta, timezone

from valveflow_ros.errors import counted

_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)
_HOUR_NS = 3600 * 10**9


def moment(time_ns: int) -> str:
    """Return a time as the monitor's own sentences write it."""
    at = _EPOCH + timedelta(microseconds=time_ns // 1000)
    return at.strftime('%Y-%m-%d %H:%M')


def knees_of(knees: Sequence[float]) -> str:
    """Return where a curve bends."""
    return f'knees at u = {", ".join(f"{u:.0f}" for u in knees)}' if len(knees) else 'no knee'


class Story:
    """Chooses what is worth a line.

    A fault of one valve shows only while that valve is at work, so its alarm comes and goes with
    the load; a monitor learns a curve anew every few hours. The first of each is told in full,
    and of the others that they came.

    Parameters
    ----------
    fault_ns : int
        When the hidden fault begins.
    tell : callable
        Takes a line for a person.

    Attributes
    ----------
    curves : int
        Curves so far.
    raised : list of int
        When the alarm came, each time.
    """

    def __init__(self, fault_ns: int, tell: Callable[[str], None]) -> None:
        self._fault_ns = fault_ns
        self._tell = tell
        self._begun = False
        self._last = ''
        self._occurrences: dict[str, int] = {}
        self._named: tuple[str, ...] = ()
        self.curves = 0
        self.raised: list[int] = []

    def reached(self, time_ns: int) -> None:
        """Say that the fault begins, once the plant has come so far."""
        if self._begun or time_ns < self._fault_ns:
            return
        self._begun = True
        known = 'no curve so far'
        if self.curves:
            known = f'{counted(self.curves, "curve")} so far, the last with {self._last}'
        self._say(self._fault_ns, f'--- the fault begins; {known} ---')

    def waits(self, time_ns: int, cause: str) -> None:
        """Say why there is no curve."""
        self._say(time_ns, cause)

    def curve(self, time_ns: int, knees: Sequence[float]) -> None:
        """Tell of a curve: of the first one, or one with another number of pieces."""
        self.reached(time_ns)
        before, bends = self._last.partition(',')[0], len(knees)
        self._last = f'{counted(bends + 1, "piece")}, {knees_of(knees)}'
        self.curves += 1
        if self.curves == 1:
            self._say(time_ns, f'first curve: {self._last}')
        elif not self._begun and self._last.partition(',')[0] != before:
            self._say(time_ns, f'new curve: {self._last}')

    def came(self, time_ns: int, name: str, occurrence: int, sentence: str) -> None:
        """Tell that an alarm came, or came again."""
        self.reached(time_ns)
        # One that could not be judged for a while and stands again is not a new one.
        if occurrence == self._occurrences.get(name):
            return
        self._occurrences[name] = occurrence
        self.raised.append(time_ns)
        if len(self.raised) == 1:
            self._say(time_ns, f'ALARM {name}: {sentence}')
        else:
            self._say(time_ns, f'the alarm comes again, the {_nth(len(self.raised))} time')

    def went_on(self, time_ns: int, word: str) -> None:
        """Tell how the first alarm went on."""
        if len(self.raised) == 1:
            self._say(time_ns, word)

    def diagnosed(self, until_ns: int, names: tuple[str, ...], word: str, sentence: str) -> None:
        """Tell of a diagnosis of the data until a time."""
        self.reached(until_ns)
        if names:
            told = f'named {", ".join(names)}'
            told += ', as before' if names == self._named else f'. {sentence}'
            self._named = names
        elif self._begun:
            hours = (until_ns - self._fault_ns) / _HOUR_NS
            told = f'{word}; {hours:.0f} h of them are with the fault'
        else:
            told = word
        self._say(until_ns, f'diagnosis of the data until then: {told}')

    def outcome(self) -> str:
        """Return how the fault was met, in a sentence."""
        told = [time_ns for time_ns in self.raised if time_ns >= self._fault_ns]
        if not told:
            return 'The fault raised no alarm.'
        hours = (told[0] - self._fault_ns) / _HOUR_NS
        text = f'The fault began {moment(self._fault_ns)}; the alarm came {hours:.1f} h later'
        if len(told) > 1:
            text += (
                f', and {len(told)} times in all: the fault is that of one valve, and shows only '
                'while that valve is at work'
            )
        return f'{text}.'

    def _say(self, time_ns: int, words: str) -> None:
        self._tell(f'{moment(time_ns)}  {words}')


def _nth(n: int) -> str:
    return {2: 'second', 3: 'third'}.get(n, f'{n}th')
