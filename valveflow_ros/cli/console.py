"""What a person sees: results on stdout, everything else on stderr."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TextIO

from valveflow_ros.report.terminal.progress import Progress

# How long each part of a verb's work takes beside the others, so that a bar moves evenly.
#
# Measured with ``benchmarks/pace.py`` on logs of one and three days. A machine twice as fast
# is so in every part; it is the proportions that count.


class Part(NamedTuple):
    """A part of the work: the shares a verb tells within it, and the shares of the time."""

    told_from: float
    told_to: float
    from_: float
    to: float


@dataclass(frozen=True, slots=True)
class Pace:
    """Turns the shares that a verb tells into shares of its time.

    Attributes
    ----------
    parts : mapping of str to Part
        By how the sentences of the part begin; what is not in it stays as it is told.
    """

    parts: Mapping[str, Part] = field(default_factory=dict)

    def share(self, told: float, what: str) -> float:
        """Return the share of the time that has gone by when ``told`` of ``what`` is done."""
        part = next((p for name, p in self.parts.items() if what.startswith(name)), None)
        if part is None:
            return told
        width = part.told_to - part.told_from
        inside = min(max((told - part.told_from) / width, 0.0), 1.0) if width else 0.0
        return part.from_ + (part.to - part.from_) * inside


def pace_of(verb: str) -> Pace:
    """Return the pace of a verb; of one that is not known, the shares it tells."""
    return Pace(_PACES.get(verb, {}))


def _parts(*rows: tuple[str, float, float, float]) -> dict[str, Part]:
    """Return parts from rows of name, told shares, and where each begins in the time."""
    ends = [row[3] for row in rows[1:]] + [1.0]
    return {
        name: Part(told_from, told_to, begins, ends[k])
        for k, (name, told_from, told_to, begins) in enumerate(rows)
    }


_PACES: Mapping[str, Mapping[str, Part]] = {
    'identify': _parts(
        ('starting', 0.0, 0.0, 0.0),
        ('reading', 0.02, 0.02, 0.13),
        ('finding segments', 0.1, 0.5, 0.21),
        ('exact partition', 0.6, 0.6, 0.39),
        ('curve and dynamics together', 0.6, 0.6, 0.57),
        ('writing the report', 0.9, 0.9, 0.93),
    ),
    'diagnose': _parts(
        ('starting', 0.0, 0.0, 0.0),
        ('reading', 0.02, 0.02, 0.06),
        ('finding segments', 0.1, 0.5, 0.09),
        ('exact partition', 0.6, 0.6, 0.16),
        ('curve and dynamics together', 0.6, 0.6, 0.25),
        ('the record itself', 0.41, 0.41, 0.33),
        ('simulation fitted', 0.425, 0.425, 0.34),
        ('causes tried', 0.475, 0.475, 0.4),
        ('further causes tried', 0.475, 0.75, 0.4),
        ('the sealed blocks', 0.75, 0.75, 0.74),
        ('what is left', 0.8, 0.8, 0.75),
        ('how sure it is', 0.85, 0.85, 0.79),
        ('writing the report', 0.95, 0.95, 0.98),
    ),
    'validate': _parts(
        ('starting', 0.0, 0.0, 0.0),
        ('reading', 0.02, 0.02, 0.3),
        ('finding segments', 0.1, 0.5, 0.38),
        ('judging', 0.7, 0.7, 0.65),
        ('writing the report', 0.9, 0.9, 0.92),
    ),
    'compare': _parts(
        ('starting', 0.0, 0.0, 0.0),
        ('reading', 0.02, 0.02, 0.14),
        ('finding segments', 0.04, 0.4, 0.18),
        ('curve of special segments', 0.4, 0.4, 0.27),
        ('exact partition', 0.4, 0.4, 0.28),
        ('curve and dynamics together', 0.4, 0.4, 0.3),
        ('Hammerstein model: starts', 0.5, 0.5, 0.42),
        ('Hammerstein model: orders', 0.5, 0.5, 0.5),
        ('Hammerstein model: all data', 0.5, 0.5, 0.66),
        ('sparse model: derivative', 0.75, 0.75, 0.79),
        ('sparse model: weak', 0.75, 0.75, 0.84),
        ('sparse model: all data', 0.75, 0.75, 0.92),
        ('judging', 0.85, 0.85, 0.94),
        ('writing the report', 0.95, 0.95, 0.95),
    ),
}


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
