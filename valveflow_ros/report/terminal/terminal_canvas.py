"""Drawing with characters: a grid of dots, eight to a character in braille."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

_BRAILLE = 0x2800
# Which bit of a braille character each of its dots is, by row and column.
_BITS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
DOTS_X, DOTS_Y = 2, 4


class Canvas:
    """A rectangle of characters that lines and marks are put on.

    Parameters
    ----------
    width, height : int
        In characters, at least 1 each.
    low, high : tuple of float
        The lower left and the upper right corner, in the drawing's own units.
    unicode : bool
        Whether braille may be used; without it a dot is an asterisk.
    """

    def __init__(
        self, width: int, height: int, low: tuple[float, float], high: tuple[float, float],
        unicode: bool = True,
    ) -> None:  # fmt: skip
        self.width, self.height, self._unicode = width, height, unicode
        self._low = low
        self._scale = (
            (width * DOTS_X - 1) / ((high[0] - low[0]) or 1.0),
            (height * DOTS_Y - 1) / ((high[1] - low[1]) or 1.0),
        )
        self._bits = [[0] * width for _ in range(height)]
        self._marks: dict[tuple[int, int], str] = {}

    def place(self, x: float, y: float) -> tuple[int, int]:
        """Return the dot of a point, counted from the upper left; it may lie outside."""
        across = round((x - self._low[0]) * self._scale[0])
        up = round((y - self._low[1]) * self._scale[1])
        return across, self.height * DOTS_Y - 1 - up

    def dot(self, x: float, y: float) -> None:
        """Put a dot; one outside the rectangle is left out."""
        self._put(*self.place(x, y))

    def line(self, points: Sequence[tuple[float, float]]) -> None:
        """Put straight lines from point to point."""
        for (x0, y0), (x1, y1) in pairwise(points):
            a, b = self.place(x0, y0), self.place(x1, y1)
            steps = min(max(abs(b[0] - a[0]), abs(b[1] - a[1]), 1), 10_000)
            for k in range(steps + 1):
                self._put(
                    round(a[0] + (b[0] - a[0]) * k / steps),
                    round(a[1] + (b[1] - a[1]) * k / steps),
                )

    def level(self, y: float, letter: str) -> None:
        """Put a letter along a level wherever nothing else is drawn."""
        row = self.place(0.0, y)[1] // DOTS_Y
        if 0 <= row < self.height:
            for column in range(self.width):
                self._marks.setdefault((row, -1 - column), letter)

    def mark(self, x: float, y: float, letter: str) -> None:
        """Put a letter over everything; outside, it stands at the border."""
        across, down = self.place(x, y)
        column = min(max(across // DOTS_X, 0), self.width - 1)
        row = min(max(down // DOTS_Y, 0), self.height - 1)
        self._marks[row, column] = letter

    def rows(self) -> list[str]:
        """Return the lines of characters, from above, each as long as the canvas is wide."""
        return [
            ''.join(self._letter(row, column) for column in range(self.width))
            for row in range(self.height)
        ]

    def _put(self, across: int, down: int) -> None:
        column, row = across // DOTS_X, down // DOTS_Y
        if 0 <= column < self.width and 0 <= row < self.height:
            self._bits[row][column] |= _BITS[down % DOTS_Y][across % DOTS_X]

    def _letter(self, row: int, column: int) -> str:
        if (row, column) in self._marks:
            return self._marks[row, column]
        bits = self._bits[row][column]
        if bits:
            return chr(_BRAILLE + bits) if self._unicode else '*'
        return self._marks.get((row, -1 - column), ' ')
