"""A terminal, or whatever stands in its place, and how a frame is put on it."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Iterator, Mapping
from contextlib import suppress
from types import FrameType, TracebackType
from typing import TextIO

from valveflow_ros.report.terminal.draw import screen
from valveflow_ros.report.terminal.frame import (
    Frame,
    HealthView,
    alarm_words,
    curve_words,
    diagnosis_words,
    health_words,
)
from valveflow_ros.report.terminal.text import clean
from valveflow_ros.report.words import moment

# What changed between two frames, a sentence each: the view of whoever has no terminal.


def changes(before: Frame, now: Frame) -> list[tuple[str, str]]:
    """Return what changed: curve, alarm, input, recorder, diagnosis or note, and a sentence.

    Values that move all the time are no changes.
    """
    return [(what, clean(told)) for what, told in _changes(before, now)]


def line(now_ns: int, what: str, told: str) -> str:
    """Return a change as one line."""
    when = moment(now_ns) if now_ns else 'no data yet'
    return f'{when}  {what}: {told}'


def _changes(before: Frame, now: Frame) -> Iterator[tuple[str, str]]:
    if now.note and now.note != before.note:
        yield 'note', now.note
    if now.curve is not None and now.curve != before.curve:
        # Its age is not news.
        yield 'curve', curve_words(now.curve, 0)[0]
    old = {alarm.name: alarm for alarm in before.alarms}
    for alarm in now.alarms:
        if old.get(alarm.name) != alarm:
            yield 'alarm', alarm_words(alarm)[0]
    levels = {item.name: item.level for item in before.inputs}
    for item in now.inputs:
        if levels.get(item.name) != item.level:
            yield 'input', health_words(item)[0]
    if now.recorder is not None and _differs(before.recorder, now.recorder):
        yield 'recorder', now.recorder.sentence
    if now.diagnosis is not None and now.diagnosis != before.diagnosis:
        yield 'diagnosis', diagnosis_words(now.diagnosis)[0]


def _differs(before: HealthView | None, now: HealthView) -> bool:
    return before is None or before.level != now.level


_ENTER = '\x1b[?1049h\x1b[?25l'  # the other screen, no cursor
_LEAVE = '\x1b[?25h\x1b[?1049l'
_USUAL = (80, 24)


class Screen:
    """Shows frames: in place on a terminal, as a line per change anywhere else.

    Parameters
    ----------
    out : text stream
    environment : mapping, optional
        Where ``TERM`` and ``NO_COLOR`` are looked up; the process's by default.
    """

    def __init__(self, out: TextIO, environment: Mapping[str, str] | None = None) -> None:
        known = os.environ if environment is None else environment
        self._out = out
        terminal = out.isatty()
        self.in_place = terminal and known.get('TERM', 'dumb') not in ('dumb', '')
        self._colour = self.in_place and not known.get('NO_COLOR')
        self._unicode = (out.encoding or '').lower().replace('-', '').startswith('utf')
        self._before = Frame()
        self._entered = False
        self._handlers: dict[signal.Signals, object] = {}

    def __enter__(self) -> Screen:
        """Take the terminal; a request to end comes as `KeyboardInterrupt` from now on."""
        for number in (signal.SIGTERM, signal.SIGHUP):
            with suppress(ValueError):  # not in the main thread
                self._handlers[number] = signal.signal(number, _interrupt)
        if self.in_place:
            self._out.write(_ENTER)
            self._entered = True
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Give the terminal back as it was."""
        if self._entered:
            with suppress(OSError):
                self._out.write(_LEAVE)
                self._out.flush()
        for number, handler in self._handlers.items():
            signal.signal(number, handler)  # type: ignore[arg-type]

    def show(self, frame: Frame) -> None:
        """Show a frame, or what has changed since the last one."""
        if self.in_place:
            rows = self._rows(frame)
            body = '\x1b[K\r\n'.join(rows)
            self._out.write(f'\x1b[H{body}\x1b[K\x1b[J')
        else:
            for what, told in changes(self._before, frame):
                self._out.write(self._plain(line(frame.now_ns, what, told)) + '\n')
        self._before = frame
        self._out.flush()

    def text(self, frame: Frame) -> str:
        """Return a frame as text that stays."""
        return '\n'.join(self._rows(frame)).rstrip()

    def _rows(self, frame: Frame) -> list[str]:
        size = shutil.get_terminal_size(_USUAL)
        return screen(frame, size.columns, size.lines, colour=self._colour, unicode=self._unicode)

    def _plain(self, text: str) -> str:
        return text if self._unicode else text.encode('ascii', 'replace').decode()


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt
