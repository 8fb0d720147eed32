"""A terminal, or whatever stands in its place, and how a frame is put on it."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Mapping
from contextlib import suppress
from types import FrameType, TracebackType
from typing import TextIO

from valveflow_ros.report.terminal.terminal_changes import changes, line
from valveflow_ros.report.terminal.terminal_draw import screen
from valveflow_ros.report.terminal.terminal_frame import Frame

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
