"""Refuses a quote that is not closed, before it swallows the rows below it."""

from __future__ import annotations

import re
from pathlib import Path

from valveflow_ros.errors import RecordingError

# What a cell of Excel holds at most, in letters and in line breaks; a comment has far fewer.
LONGEST_CELL = 32_767
_MOST_BREAKS = 253


class Quotes:
    """Follows a text that passes by in pieces.

    A quote opens a cell only where the cell begins, and a doubled one within it
    stands for itself: so do pandas and most programs that write tables.

    Parameters
    ----------
    path : Path
        The file, for the sentence.
    separator : str
        What parts its cells.
    """

    def __init__(self, path: Path, separator: str) -> None:
        self._path = path
        ends = f'{re.escape(separator)}\r\n'
        # Group 1: from a quote on that is not closed in what has passed.
        self._cell = re.compile(
            rf'(?:\A|[{ends}]) *"(?:[^"]*(?:""[^"]*)*"(?!")|(.*\Z))', re.DOTALL
        )
        # A cell that is closed in its own line: nearly all are, and this is quick.
        self._closed = re.compile(rf'(?:\A|(?<=[{ends}])) *"[^"\r\n]*(?:""[^"\r\n]*)*"(?!")')
        self._rest = ''
        self._line = 1  # of the first letter of the rest

    def follow(self, text: str) -> None:
        """Look at the next piece.

        Raises
        ------
        RecordingError
            If a cell in quotes is longer than any cell is.
        """
        text = self._rest + text
        end = _last_line(text, [])
        lines, rest = text[:end], text[end:]
        long = len(rest) > LONGEST_CELL and '"' in rest
        if long or ('"' in lines and '"' in self._closed.sub('', lines)):
            end = self._looked_at(text)
        self._line += _breaks(text[:end])
        self._rest = text[end:]

    def _looked_at(self, text: str) -> int:
        """Judge cell by cell; return where the last line begins."""
        begun, cells = len(text), []
        for cell in self._cell.finditer(text):
            opened = cell.start() + cell[0].index('"')
            self._judge(text, opened, cell.end())
            # A quote that ends the piece may be the first of two.
            if cell.start(1) >= 0 or cell.end() == len(text):
                begun = opened
            else:
                cells.append((opened, cell.end()))
        # What is kept begins with a line, so that it is known where its cells begin.
        return _last_line(text[:begun], cells)

    def _judge(self, text: str, opened: int, end: int) -> None:
        breaks = _breaks(text[opened:end]) if end - opened > _MOST_BREAKS else 0
        if end - opened <= LONGEST_CELL and breaks <= _MOST_BREAKS:
            return
        line = self._line + _breaks(text[:opened])
        raise RecordingError(
            self._path,
            f'has in line {line} a quote that is not closed within {LONGEST_CELL} letters or '
            f'{_MOST_BREAKS} lines, as the text of a cell would be; close it there, or take it '
            'away',
        )


def _breaks(text: str) -> int:
    """Return how many lines end in a text; what is left of Windows' two letters counts once."""
    return text.count('\n') or text.count('\r')


def _last_line(text: str, cells: list[tuple[int, int]]) -> int:
    """Return where the last line of a text begins; breaks within cells begin none."""
    # The first of Windows' two letters waits for the second.
    end = len(text) - text.endswith('\r')
    for opened, closed in [*reversed(cells), (0, 0)]:
        found = max(text.rfind('\n', closed, end), text.rfind('\r', closed, end)) + 1
        if found:
            return found
        end = opened
    return 0
