# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The Python interface: the functions of ``import valveflow_ros as vf``, which the verbs call."""

from __future__ import annotations

from collections.abc import Callable


class Progress:
    """Receive the progress and the messages of a call; this base class ignores them.

    Pass an instance of a derived class to any function of the interface that takes
    ``progress``. Messages that matter for the result are also in the result's notes.
    """

    def __call__(self, share: float, what: str) -> None:
        """Report the completed fraction of the work, 0 to 1, and the current step."""

    def say(self, sentence: str) -> None:
        """Report information for the user."""

    def warn(self, sentence: str) -> None:
        """Report a warning."""

    def measured_in(self, unit: str) -> None:
        """Set the unit of the output; the messages passed in still speak of power in MW."""

    def part(self, start: float, width: float) -> Callable[[float, str], None]:
        """Return a callable to report a part of the work, a fraction ``width`` of the whole."""
        return lambda share, what: self(start + width * share, what)


SILENT = Progress()
