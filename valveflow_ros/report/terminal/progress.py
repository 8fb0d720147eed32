# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Progress of long work: a bar on a terminal, otherwise occasional lines."""

from __future__ import annotations

import math
import shutil
import threading
import time
from collections.abc import Callable
from typing import TextIO

_BAR = 20
_REDRAW_S = 0.1
_TICK_S = 0.5
# Below these values no estimate is given.
_LEAST_S, _LEAST_SHARE = 2.0, 0.03
# Without a terminal: delay of the first line, and growth of the pauses.
_FIRST_LINE_S, _LONGER, _LONGEST_PAUSE_S = 15.0, 2.0, 120.0


class Progress:
    """Keeps a bar, or a few lines, up to date; updates the time also between two calls."""

    def __init__(
        self, err: TextIO, bar: bool, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._err, self._bar, self._clock = err, bar, clock
        wide = (getattr(err, 'encoding', None) or 'utf-8').lower().startswith('utf')
        self._blocks = '█░' if wide else '#.'
        self._lock = threading.RLock()
        self._begun_s: float | None = None
        self._share, self._what = 0.0, ''
        self._ends_s = math.inf
        self._drawn_s = -math.inf
        self._next_line_s = math.inf
        self._pause_s = _FIRST_LINE_S
        self._shown = False
        self._done = threading.Event()
        self._ticker: threading.Thread | None = None

    def at(self, share: float, what: str) -> None:
        """Report progress as a fraction from 0 to 1, and the current step."""
        with self._lock:
            if self._done.is_set():
                return
            now = self._clock()
            if self._begun_s is None:
                self._begun_s = now
                self._next_line_s = now + self._pause_s
                self._start()
            new = what != self._what
            # Progress never decreases.
            self._share = max(self._share, min(max(share, 0.0), 1.0))
            self._what = what
            gone = now - self._begun_s
            if gone >= _LEAST_S and self._share >= _LEAST_SHARE:
                self._ends_s = now + gone * (1.0 - self._share) / self._share
            if new or now - self._drawn_s >= _REDRAW_S:
                self._tell(now)

    def tick(self) -> None:
        """Update the displayed time."""
        with self._lock:
            now = self._clock()
            if self._begun_s is not None and now - self._drawn_s >= _TICK_S:
                self._tell(now)

    def clear(self) -> None:
        """Remove the bar until the next call or tick."""
        with self._lock:
            if self._shown:
                self._err.write('\r\x1b[K')
                self._err.flush()
                self._shown = False

    def write(self, line: str) -> None:
        """Write a line in place of the bar; the bar appears again below it."""
        with self._lock:
            self.clear()
            self._err.write(line + '\n')
            self._err.flush()
            self._drawn_s = self._clock()

    def end(self) -> None:
        """Remove the bar permanently."""
        with self._lock:
            self._done.set()
            self._begun_s = None
            self.clear()

    def left_s(self) -> float:
        """Return the estimated remaining time in seconds; infinity if unknown."""
        return max(0.0, self._ends_s - self._clock())

    def _tell(self, now: float) -> None:
        if self._bar:
            self._draw(now)
        elif now >= self._next_line_s:
            when = self._gone(now) + self._left(now)
            self._err.write(f'{100.0 * self._share:.0f} %  {when}{self._what}\n')
            self._err.flush()
            self._pause_s = min(_LONGER * self._pause_s, _LONGEST_PAUSE_S)
            self._next_line_s = now + self._pause_s

    def _draw(self, now: float) -> None:
        full = round(_BAR * self._share)
        bar = self._blocks[0] * full + self._blocks[1] * (_BAR - full)
        when = self._left(now) or self._gone(now)
        text = f'{bar} {100.0 * self._share:3.0f} %  {when}{self._what}'
        # A wrapped line could not be erased.
        width = shutil.get_terminal_size().columns - 1
        self._err.write(f'\r\x1b[K{text[: max(width, 1)]}')
        self._err.flush()
        self._drawn_s = now
        self._shown = True

    def _gone(self, now: float) -> str:
        assert self._begun_s is not None
        gone = now - self._begun_s
        return f'{in_words(gone)} so far  ' if gone >= _LEAST_S else ''

    def _left(self, now: float) -> str:
        left = self._ends_s - now
        return f'about {in_words(left)} left  ' if math.isfinite(left) and left >= 0.5 else ''

    def _start(self) -> None:
        self._ticker = threading.Thread(target=self._run, name='progress', daemon=True)
        self._ticker.start()

    def _run(self) -> None:
        while not self._done.wait(_TICK_S):
            try:
                self.tick()
            except (OSError, ValueError):  # the stream is closed
                return


def in_words(seconds: float) -> str:
    """Return '8 s', '2 min 10 s', '1 h 5 min': above a minute in steps of five seconds.

    `words.duration` is not used: every command loads this module, and numpy is slow to load.
    """
    whole = round(seconds) if seconds < 60.0 else round(seconds / 5.0) * 5
    if whole < 60:
        return f'{whole} s'
    minutes, rest = divmod(whole, 60)
    if minutes < 60:
        return f'{minutes} min {rest} s' if rest else f'{minutes} min'
    hours, minutes = divmod(minutes, 60)
    return f'{hours} h {minutes} min' if minutes else f'{hours} h'
