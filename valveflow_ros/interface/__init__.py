# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The Python interface: what ``import valveflow_ros as vf`` offers, and what the verbs call."""

from __future__ import annotations

from collections.abc import Callable


class Progress:
    """Receives the progress and the messages of a call; this one ignores them.

    Derive a class from it and give that to any function of the interface that takes
    ``progress``. What matters for the result also stands in the result's notes.
    """

    def __call__(self, share: float, what: str) -> None:
        """Report that a share of the work, 0 to 1, is done, and what is done now."""

    def say(self, sentence: str) -> None:
        """Report something that is good to know."""

    def warn(self, sentence: str) -> None:
        """Report something that must not be overlooked."""

    def measured_in(self, unit: str) -> None:
        """Be told that the output is in this unit; sentences speak of power in MW all the same."""

    def part(self, start: float, width: float) -> Callable[[float, str], None]:
        """Return a callable for a part of the work that is ``width`` of the whole."""
        return lambda share, what: self(start + width * share, what)


SILENT = Progress()
