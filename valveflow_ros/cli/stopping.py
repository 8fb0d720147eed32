"""A wish to stop, by Ctrl-C or from the system, at whatever moment it comes."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

# Whoever presses it twice means it once: what is cleaned up meanwhile is not to be cut.
_ONCE_S = 2.0


def _unheard(_: sys.UnraisableHookArgs) -> None:
    """Say nothing."""


class Stop:
    """Turns signals into `KeyboardInterrupt` and remembers the first.

    Attributes
    ----------
    number : int
        The signal that came; 0: none.
    """

    def __init__(self) -> None:
        self.number = 0
        self._at_s = 0.0

    def _come(self, number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        if self.number and now - self._at_s < _ONCE_S:
            return
        self.number, self._at_s = number, now
        # What a library has half made complains when it is cleared away, until the process ends.
        sys.unraisablehook = _unheard
        raise KeyboardInterrupt

    @contextmanager
    def listening(self) -> Iterator[Stop]:
        """Listen for the length of a block; the handlers before come back after it."""
        before: dict[int, object] = {}
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            # A shell lets what it starts in the background ignore Ctrl-C, and nohup a hang-up.
            if signal.getsignal(number) == signal.SIG_IGN:
                continue
            with suppress(ValueError):  # not in the main thread
                before[number] = signal.signal(number, self._come)
        try:
            yield self
        finally:
            for taken, handler in before.items():
                signal.signal(taken, handler)  # type: ignore[arg-type]
