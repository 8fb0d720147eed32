"""Signals become a flag: what runs is finished, then the process ends in order."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_ASKED_TO_STOP = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Stopped(BaseException):
    """A signal came where it may cut what runs."""


class StopFlag:
    """Set by SIGINT, SIGTERM or SIGHUP; asking twice changes nothing."""

    def __init__(self) -> None:
        self._by: int | None = None
        self._cuts = False

    def install(self) -> StopFlag:
        """Take over the signals of this process."""
        for number in _ASKED_TO_STOP:
            signal.signal(number, self._note)
        return self

    @contextmanager
    def cutting(self) -> Iterator[None]:
        """Let signals raise `Stopped` inside: for work that leaves nothing to be finished.

        Raises
        ------
        Stopped
            One came, or had come before.
        """
        if self:
            raise Stopped
        self._cuts = True
        try:
            yield
        finally:
            self._cuts = False

    def last(self) -> None:
        """Hear nothing more: the process ends already, and its last steps are not to be cut."""
        for number in _ASKED_TO_STOP:
            signal.signal(number, signal.SIG_IGN)

    def __bool__(self) -> bool:
        """Tell whether to stop."""
        return self._by is not None

    @property
    def name(self) -> str:
        """Return the name of the signal, empty before one came."""
        return '' if self._by is None else signal.Signals(self._by).name

    def set(self) -> None:
        """Ask to stop from inside."""
        self._by = self._by or signal.SIGTERM

    def _note(self, number: int, _frame: FrameType | None) -> None:
        self._by = number
        if self._cuts:
            self._cuts = False
            raise Stopped
