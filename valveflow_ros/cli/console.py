"""What a person sees: results on stdout, everything else on stderr."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TextIO

from valveflow_ros.cli.pace import pace_of
from valveflow_ros.report.terminal_progress import Progress


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a verb has to say at its end.

    Attributes
    ----------
    text : str
        For a person.
    data : mapping
        The same for a program; what is not finite becomes null.
    """

    text: str
    data: Mapping[str, Any]


class Console:
    """Messages, warnings, a progress bar where there is a terminal, and the result.

    Parameters
    ----------
    out, err : text streams
    as_json : bool
        Print the result as JSON.
    quiet : bool
        Say nothing but warnings and the result.
    verb : str
        Whose work it is.
    """

    def __init__(
        self, out: TextIO, err: TextIO, *, as_json: bool = False, quiet: bool = False,
        verb: str = '',
    ) -> None:  # fmt: skip
        self._out = out
        self._err = err
        self._as_json = as_json
        self._quiet = quiet
        bar = err.isatty() and os.environ.get('TERM') != 'dumb'
        self._progress = Progress(err, bar, pace_of(verb).share)

    def say(self, sentence: str) -> None:
        """Tell something that is good to know."""
        if not self._quiet:
            self._write(sentence)

    def warn(self, sentence: str) -> None:
        """Tell something that must not be overlooked."""
        self._write(f'Warning: {sentence}')

    def fail(self, sentence: str) -> None:
        """Tell why it could not be done."""
        self._progress.end()
        self._write(f'valveflow: {sentence}')

    def progress(self, share: float, what: str) -> None:
        """Show how far a long piece of work has come: what is done now, and the time it takes.

        A bar on a terminal; anywhere else a line now and then, once it takes long.
        """
        if not self._quiet:
            self._progress.at(share, what)

    def clear(self) -> None:
        """Take the progress bar away."""
        self._progress.clear()

    def finish(self, outcome: Outcome) -> None:
        """Print the result."""
        self._progress.end()
        if self._as_json:
            text = json.dumps(_finite(outcome.data), indent=2, allow_nan=False, ensure_ascii=False)
            self._out.write(text + '\n')
        elif outcome.text:
            self._out.write(outcome.text.rstrip('\n') + '\n')
        self._out.flush()

    def _write(self, line: str) -> None:
        self._progress.write(line)


def _finite(value: Any) -> Any:
    """Replace what JSON does not know."""
    if isinstance(value, Mapping):
        return {str(k): _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
