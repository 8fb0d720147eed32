"""What a person sees: results on stdout, everything else on stderr."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TextIO

from valveflow_ros.cli.pace import pace_of
from valveflow_ros.report.terminal.terminal_progress import Progress

# What commands a terminal, or turns the order of what it shows: all but tabs and line feeds.
_COMMANDS = re.compile('[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]')


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a verb has to say at its end.

    Attributes
    ----------
    text : str
        For a person.
    data : mapping
        The same for a program; what is not finite becomes null.
    drawn : bool
        The text is a picture that was made for this terminal, colours and all, of words that were
        made harmless. Any other text is printed without what commands a terminal.
    """

    text: str
    data: Mapping[str, Any]
    drawn: bool = False


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
            self._progress.at(share, _harmless(what))

    def clear(self) -> None:
        """Take the progress bar away."""
        self._progress.clear()

    def finish(self, outcome: Outcome) -> None:
        """Print the result."""
        self._progress.end()
        if self._as_json:
            text = json.dumps(_finite(outcome.data), indent=2, allow_nan=False, ensure_ascii=False)
            self._out.write(_COMMANDS.sub(lambda c: f'\\u{ord(c[0]):04x}', text) + '\n')
        elif outcome.text:
            text = outcome.text if outcome.drawn else _harmless(outcome.text)
            self._out.write(text.rstrip('\n') + '\n')
        self._out.flush()

    def _write(self, line: str) -> None:
        self._progress.write(_harmless(line))


def _harmless(text: str) -> str:
    """Return a text as it may go to a terminal: names and cells of others may stand in it."""
    return _COMMANDS.sub('?', text)


def _finite(value: Any) -> Any:
    """Replace what JSON does not know."""
    if isinstance(value, Mapping):
        return {str(k): _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
