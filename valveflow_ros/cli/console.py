"""What a person sees: results on stdout, everything else on stderr."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TextIO

_BAR = 24
_REDRAW_S = 0.1


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
    """

    def __init__(
        self, out: TextIO, err: TextIO, *, as_json: bool = False, quiet: bool = False
    ) -> None:
        self._out = out
        self._err = err
        self._as_json = as_json
        self._quiet = quiet
        self._bar = not quiet and err.isatty() and os.environ.get('TERM') != 'dumb'
        self._shown = False
        self._last_s = -math.inf
        self._last_what = ''

    def say(self, sentence: str) -> None:
        """Tell something that is good to know."""
        if not self._quiet:
            self._write(sentence)

    def warn(self, sentence: str) -> None:
        """Tell something that must not be overlooked."""
        self._write(f'Warning: {sentence}')

    def fail(self, sentence: str) -> None:
        """Tell why it could not be done."""
        self._write(f'valveflow: {sentence}')

    def progress(self, share: float, what: str) -> None:
        """Show how far a long piece of work has come; only on a terminal."""
        now = time.monotonic()
        if not self._bar or (what == self._last_what and now - self._last_s < _REDRAW_S):
            return
        self._last_s, self._last_what = now, what
        full = round(_BAR * min(max(share, 0.0), 1.0))
        bar = '█' * full + '░' * (_BAR - full)
        self._err.write(f'\r\x1b[K{bar} {100.0 * share:3.0f} %  {what}')
        self._err.flush()
        self._shown = True

    def clear(self) -> None:
        """Take the progress bar away."""
        if self._shown:
            self._err.write('\r\x1b[K')
            self._err.flush()
            self._shown = False

    def finish(self, outcome: Outcome) -> None:
        """Print the result."""
        self.clear()
        if self._as_json:
            text = json.dumps(_finite(outcome.data), indent=2, allow_nan=False, ensure_ascii=False)
            self._out.write(text + '\n')
        elif outcome.text:
            self._out.write(outcome.text.rstrip('\n') + '\n')
        self._out.flush()

    def _write(self, line: str) -> None:
        self.clear()
        self._err.write(line + '\n')
        self._err.flush()


def _finite(value: Any) -> Any:
    """Replace what JSON does not know."""
    if isinstance(value, Mapping):
        return {str(k): _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
