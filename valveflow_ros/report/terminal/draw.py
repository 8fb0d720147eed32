"""Draws a frame of the terminal view: a pure function from what is known to lines."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

from valveflow_ros.records import NS_PER_S
from valveflow_ros.report.terminal.frame import (
    CurveView,
    Frame,
    SampleView,
    alarms_words,
    curve_words,
    diagnosis_words,
    inputs_words,
    recorder_words,
    sample_words,
    signed,
)
from valveflow_ros.report.terminal.text import Line, cells, clean, cut, labelled, painted
from valveflow_ros.report.words import duration, input_unit_plain, moment

# Drawing with characters: a grid of dots, eight to a character in braille.

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


_MARGIN = 8  # left of the pictures: a number and its tick
_LEAST_CURVE, _LEAST_RESIDUAL = 4, 3
_MOST_RESIDUAL = 9
_LONGEST_TEXT = 3


def screen(
    frame: Frame, width: int, height: int, *, colour: bool = False, unicode: bool = True
) -> list[str]:
    """Return a frame as the lines that a terminal is sent.

    Parameters
    ----------
    frame : Frame
    width, height : int
        The terminal's size; there are never more lines, nor longer ones.
    colour, unicode : bool
        What the terminal can do.
    """
    lines = _lines(frame, max(20, width), max(5, height), unicode)
    return [painted(line, width, colour, unicode) for line in lines[: max(1, height)]]


def _lines(frame: Frame, width: int, height: int, unicode: bool) -> list[Line]:
    head = [_title(frame, width)]
    if frame.note:
        head += labelled('         ', frame.note, 'warn', width, 2)
    head += labelled('Curve    ', *curve_words(frame.curve, frame.now_ns), width, 2)
    text = _text(frame, width, 1)
    residual = list(labelled('Residual ', *sample_words(frame.last), width, 2))
    left = height - len(head) - len(residual) - len(text)
    curve_rows, residual_rows = _shares(left, frame)
    spare = left - (curve_rows + 1 if curve_rows else 0) - residual_rows
    if spare > 0:
        longer = _text(frame, width, _LONGEST_TEXT)
        text = longer if len(longer) <= len(text) + spare else text
    curve = _curve(frame, width, curve_rows, unicode) if curve_rows else []
    strip = _strip(frame.samples, width, residual_rows, unicode) if residual_rows else []
    return [*head, *curve, *residual, *strip, *text]


def _shares(left: int, frame: Frame) -> tuple[int, int]:
    """Return how many rows the curve and the residuals get, without the axis of the curve."""
    # Room for sentences that need more than one line comes first.
    left -= 3 if left > _LEAST_CURVE + _LEAST_RESIDUAL + 4 else 0
    if frame.curve is None or not frame.curve.breakpoints:
        return 0, min(left, _MOST_RESIDUAL) if left >= _LEAST_RESIDUAL and frame.samples else 0
    if left < _LEAST_CURVE + 1:
        return 0, 0
    residual = min(_MOST_RESIDUAL, max(_LEAST_RESIDUAL, (left - 1) // 3))
    if left - 1 - residual < _LEAST_CURVE or not frame.samples:
        residual = 0
    return left - 1 - residual, residual


def _title(frame: Frame, width: int) -> Line:
    unit = clean(frame.unit) or 'valveflow'
    when = moment(frame.now_ns) if frame.now_ns else 'no data yet'
    left = f'{unit}   {when}'
    source = cut(clean(frame.source), max(0, width - cells(left) - 3))
    gap = ' ' * max(1, width - cells(left) - cells(source))
    return ((left, 'strong'), (gap, ''), (source, 'dim'))


def _text(frame: Frame, width: int, most: int) -> list[Line]:
    """Return alarms, inputs, recorder and diagnosis, each in at most so many lines."""
    lines: list[Line] = []
    for label, told in (
        ('Alarms   ', alarms_words(frame)),
        ('Inputs   ', inputs_words(frame)),
        ('Recorder ', [recorder_words(frame)]),
        ('Diagnosis', [diagnosis_words(frame.diagnosis)]),
    ):
        for k, (text, tone) in enumerate(told):
            lines += labelled(label if k == 0 else ' ' * len(label), text, tone, width, most)
    return lines


def _curve(frame: Frame, width: int, rows: int, unicode: bool) -> list[Line]:
    """Return the curve with its breakpoints and the operating point, and the axis below."""
    curve = frame.curve
    points = [] if curve is None else _points(curve)
    if curve is None or not points:
        return []
    now = _operating_point(frame.last)
    us = [u for u, _ in points] + ([now[0]] if now else [])
    mws = [p for _, p in points] + ([now[1]] if now else [])
    low, high = (min(us), min(mws)), (max(us), max(mws))
    canvas = Canvas(width - _MARGIN, rows, low, high, unicode)
    canvas.line(points)
    for u, power in points[1:-1]:
        canvas.mark(u, power, 'o')
    if now is not None:
        canvas.mark(*now, '●')
    marks = {0: f'{high[1]:.0f} MW', rows - 1: f'{low[1]:.0f} MW'}
    legend = f'u ({input_unit_plain(curve.exponent)})   o knee' + ('   ● now' if now else '')
    ends = f'{low[0]:.0f}', f'{high[0]:.0f}'
    middle = cut(legend, max(0, width - _MARGIN - len(ends[0]) - len(ends[1]) - 4))
    axis = f'{ends[0]}{middle:^{max(0, width - _MARGIN - len(ends[0]) - len(ends[1]))}}{ends[1]}'
    return [*_picture(canvas, marks, 'curve'), ((' ' * _MARGIN + axis, 'dim'),)]


def _strip(samples: Sequence[SampleView], width: int, rows: int, unicode: bool) -> list[Line]:
    """Return the last residuals over time with their limits."""
    known = [s for s in samples if math.isfinite(s.residual_mw)]
    if not known:
        return []
    ends = [known[-1].low_mw, known[-1].high_mw]
    reach = max(abs(v) for v in [*(s.residual_mw for s in known), *ends] if math.isfinite(v))
    reach = 1.08 * reach or 1.0
    first, last = samples[0].time_ns / NS_PER_S, samples[-1].time_ns / NS_PER_S
    canvas = Canvas(width - _MARGIN, rows, (0.0, -reach), (last - first, reach), unicode)
    for sample in known:
        canvas.dot(sample.time_ns / NS_PER_S - first, sample.residual_mw)
    for level in ends:
        if math.isfinite(level):
            canvas.level(level, '┄')
    canvas.level(0.0, '·')
    places = 0 if reach >= 10.0 else 1
    marks = {0: f'{signed(reach, places)} MW', rows - 1: signed(-reach, places)}
    if rows >= _LEAST_RESIDUAL:
        span = duration(round(last - first)).split(' ')
        marks[rows // 2] = ' '.join(span[:2]) if last > first else ''
    return _picture(canvas, marks, '')


def _picture(canvas: Canvas, marks: dict[int, str], tone: str) -> list[Line]:
    return [
        ((f'{cut(marks.get(k, ""), _MARGIN - 1):>{_MARGIN - 1}} ', 'dim'), (row, tone))
        for k, row in enumerate(canvas.rows())
    ]


def _points(curve: CurveView) -> list[tuple[float, float]]:
    points = zip(curve.breakpoints, curve.values, strict=False)
    return [(u, p) for u, p in points if math.isfinite(u) and math.isfinite(p)]


def _operating_point(sample: SampleView | None) -> tuple[float, float] | None:
    if sample is None or not (math.isfinite(sample.u) and math.isfinite(sample.measured_mw)):
        return None
    return sample.u, sample.measured_mw
