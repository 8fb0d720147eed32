# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The terminal view: a frame drawn as lines, shown in place or as one line per change."""

from __future__ import annotations

import math
import os
import shutil
import signal
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from datetime import tzinfo
from itertools import pairwise
from types import TracebackType
from typing import TextIO

from valveflow_ros.records import NS_PER_S
from valveflow_ros.report.terminal import frame as views
from valveflow_ros.report.terminal.frame import Frame, SampleView
from valveflow_ros.report.terminal.text import Line, cells, clean, cut, labelled, painted
from valveflow_ros.report.words import duration, in_zone, input_unit_plain, moment, signed

_ENTER = '\x1b[?1049h\x1b[?25l'  # alternate screen, no cursor
_LEAVE = '\x1b[?25h\x1b[?1049l'
_USUAL = (80, 24)
# A grid of dots, eight per character in braille.
_BRAILLE = 0x2800
# Bit of each dot in a braille character, by row and column.
_BITS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
DOTS_X, DOTS_Y = 2, 4
_MARGIN = 8  # left of the plots: a number and its tick
_LEAST_CURVE, _LEAST_RESIDUAL = 4, 3
_MOST_RESIDUAL = 9
_LONGEST_TEXT = 3
_WHOLE = 100  # maximum lines of a sentence printed in full


class Canvas:
    """A rectangle of characters for lines and marks.

    ``low`` and ``high`` are its lower left and its upper right corner, in data units. With
    ``unicode`` a dot is one of eight of a braille character, otherwise an asterisk.
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
        """Return the dot of a point, counted from the upper left; it may be outside."""
        across = round((x - self._low[0]) * self._scale[0])
        up = round((y - self._low[1]) * self._scale[1])
        return across, self.height * DOTS_Y - 1 - up

    def dot(self, x: float, y: float) -> None:
        """Draw a dot; one outside the rectangle is left out."""
        self._put(*self.place(x, y))

    def line(self, points: Sequence[tuple[float, float]]) -> None:
        """Draw straight lines between points."""
        for (x0, y0), (x1, y1) in pairwise(points):
            a, b = self.place(x0, y0), self.place(x1, y1)
            steps = min(max(abs(b[0] - a[0]), abs(b[1] - a[1]), 1), 10_000)
            for k in range(steps + 1):
                self._put(
                    round(a[0] + (b[0] - a[0]) * k / steps),
                    round(a[1] + (b[1] - a[1]) * k / steps),
                )

    def level(self, y: float, character: str) -> None:
        """Draw a character along a horizontal line where nothing else is drawn."""
        row = self.place(0.0, y)[1] // DOTS_Y
        if 0 <= row < self.height:
            for column in range(self.width):
                self._marks.setdefault((row, -1 - column), character)

    def mark(self, x: float, y: float, character: str) -> None:
        """Draw a character over everything; a point outside is moved to the border."""
        across, down = self.place(x, y)
        column = min(max(across // DOTS_X, 0), self.width - 1)
        row = min(max(down // DOTS_Y, 0), self.height - 1)
        self._marks[row, column] = character

    def rows(self) -> list[str]:
        """Return the lines of characters from top to bottom, each as long as the width."""
        across = range(self.width)
        return [''.join(self._character(row, k) for k in across) for row in range(self.height)]

    def _put(self, across: int, down: int) -> None:
        column, row = across // DOTS_X, down // DOTS_Y
        if 0 <= column < self.width and 0 <= row < self.height:
            self._bits[row][column] |= _BITS[down % DOTS_Y][across % DOTS_X]

    def _character(self, row: int, column: int) -> str:
        if (row, column) in self._marks:
            return self._marks[row, column]
        bits = self._bits[row][column]
        if bits:
            return chr(_BRAILLE + bits) if self._unicode else '*'
        return self._marks.get((row, -1 - column), ' ')


def screen(
    frame: Frame, width: int, height: int, *, colour: bool = False, unicode: bool = True,
    zone: tzinfo | None = None, whole: bool = False,
) -> list[str]:  # fmt: skip
    """Return a frame as the lines for a terminal, never more or longer than its size.

    With ``whole`` every sentence is printed in full, in as many additional lines as needed.
    """
    lines = _lines(frame, max(20, width), max(5, height), unicode, zone, whole)
    shown = lines if whole else lines[: max(1, height)]
    return [painted(line, width, colour, unicode) for line in shown]


def _lines(
    frame: Frame, width: int, height: int, unicode: bool, zone: tzinfo | None, whole: bool
) -> list[Line]:
    most = _WHOLE if whole else 2
    head = [_title(frame, width, zone)]
    if frame.note:
        head += labelled('         ', in_zone(frame.note, zone), 'warn', width, most)
    curve_text, tone = views.curve_words(frame.curve, frame.now_ns)
    head += labelled('Curve    ', in_zone(curve_text, zone), tone, width, most)
    text = _text(frame, width, _WHOLE if whole else 1, zone)
    height += len(text) if whole else 0
    residual = list(labelled('Residual ', *views.sample_words(frame.last), width, 2))
    left = height - len(head) - len(residual) - len(text)
    curve_rows, residual_rows = _shares(left, frame)
    spare = left - (curve_rows + 1 if curve_rows else 0) - residual_rows
    if spare > 0 and not whole:
        longer = _text(frame, width, _LONGEST_TEXT, zone)
        text = longer if len(longer) <= len(text) + spare else text
    curve = _curve(frame, width, curve_rows, unicode) if curve_rows else []
    strip = _strip(frame.samples, width, residual_rows, unicode) if residual_rows else []
    return [*head, *curve, *residual, *strip, *text]


def _shares(left: int, frame: Frame) -> tuple[int, int]:
    """Return the numbers of rows of the curve and the residuals, without the curve's axis."""
    # First reserve space for sentences of more than one line.
    left -= 3 if left > _LEAST_CURVE + _LEAST_RESIDUAL + 4 else 0
    if frame.curve is None or not frame.curve.breakpoints:
        return 0, min(left, _MOST_RESIDUAL) if left >= _LEAST_RESIDUAL and frame.samples else 0
    if left < _LEAST_CURVE + 1:
        return 0, 0
    residual = min(_MOST_RESIDUAL, max(_LEAST_RESIDUAL, (left - 1) // 3))
    if left - 1 - residual < _LEAST_CURVE or not frame.samples:
        residual = 0
    return left - 1 - residual, residual


def _when(frame: Frame, zone: tzinfo | None) -> str:
    return in_zone(moment(frame.now_ns), zone) if frame.now_ns else 'no data yet'


def _title(frame: Frame, width: int, zone: tzinfo | None) -> Line:
    unit = clean(frame.unit) or 'valveflow'
    when = _when(frame, zone)
    left = f'{unit}   {when}'
    source = cut(clean(frame.source), max(0, width - cells(left) - 3))
    gap = ' ' * max(1, width - cells(left) - cells(source))
    return ((left, 'strong'), (gap, ''), (source, 'dim'))


def _text(frame: Frame, width: int, most: int, zone: tzinfo | None) -> list[Line]:
    lines: list[Line] = []
    for label, told in (
        ('Alarms   ', views.alarms_words(frame)),
        ('Inputs   ', views.inputs_words(frame)),
        ('Recorder ', [views.recorder_words(frame)]),
        ('Diagnosis', [views.diagnosis_words(frame.diagnosis)]),
    ):
        for k, (text, tone) in enumerate(told):
            before = label if k == 0 else ' ' * len(label)
            lines += labelled(before, in_zone(text, zone), tone, width, most)
    return lines


def _curve(frame: Frame, width: int, rows: int, unicode: bool) -> list[Line]:
    curve, last = frame.curve, frame.last
    pairs = zip(curve.breakpoints, curve.values, strict=False) if curve else ()
    points = [pair for pair in pairs if all(map(math.isfinite, pair))]
    if curve is None or not points:
        return []
    known = last is not None and math.isfinite(last.u) and math.isfinite(last.measured_mw)
    now = (last.u, last.measured_mw) if last is not None and known else None
    us, mws = zip(*points, *([now] if now else []), strict=True)
    low, high = (min(us), min(mws)), (max(us), max(mws))
    canvas = Canvas(width - _MARGIN, rows, low, high, unicode)
    canvas.line(points)
    for u, power in points[1:-1]:
        canvas.mark(u, power, 'o')
    if now is not None:
        canvas.mark(*now, '●')
    marks = {0: f'{high[1]:.0f} MW', rows - 1: f'{low[1]:.0f} MW'}
    legend = f'u ({input_unit_plain(curve.exponent)})   o breakpoint' + ('   ● now' if now else '')
    first, end = f'{low[0]:.0f}', f'{high[0]:.0f}'
    room = width - _MARGIN - len(first) - len(end)
    axis = f'{first}{cut(legend, max(0, room - 4)):^{max(0, room)}}{end}'
    return [*_picture(canvas, marks, 'curve'), ((' ' * _MARGIN + axis, 'dim'),)]


def _strip(samples: Sequence[SampleView], width: int, rows: int, unicode: bool) -> list[Line]:
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


def changes(before: Frame, now: Frame) -> list[tuple[str, str]]:
    """Return what changed: curve, alarm, input, recorder, diagnosis or note, and a sentence.

    This is the output without a terminal. Continuously varying values do not count as changes.
    """
    return [(what, clean(told)) for what, told in _changes(before, now)]


def _changes(before: Frame, now: Frame) -> Iterator[tuple[str, str]]:
    if now.note and now.note != before.note:
        yield 'note', now.note
    if now.curve is not None and now.curve != before.curve:
        # The age of the curve is not a change.
        yield 'curve', views.curve_words(now.curve, 0)[0]
    old = {alarm.name: alarm for alarm in before.alarms}
    for alarm in now.alarms:
        if old.get(alarm.name) != alarm:
            yield 'alarm', views.alarm_words(alarm)[0]
    levels = {item.name: item.level for item in before.inputs}
    for item in now.inputs:
        if levels.get(item.name) != item.level:
            yield 'input', views.health_words(item)[0]
    old_level = None if before.recorder is None else before.recorder.level
    if now.recorder is not None and now.recorder.level != old_level:
        yield 'recorder', now.recorder.sentence
    if now.diagnosis is not None and now.diagnosis != before.diagnosis:
        yield 'diagnosis', views.diagnosis_words(now.diagnosis)[0]


class Screen:
    """Show frames: in place on a terminal, otherwise as one line per change."""

    def __init__(self, out: TextIO, zone: tzinfo | None = None) -> None:
        self._out, self._zone = out, zone
        terminal = out.isatty()
        self.in_place = terminal and os.environ.get('TERM', 'dumb') not in ('dumb', '')
        self._colour = self.in_place and not os.environ.get('NO_COLOR')
        self._unicode = (out.encoding or '').lower().replace('-', '').startswith('utf')
        self._before = Frame()
        self._open = ExitStack()

    def __enter__(self) -> Screen:
        """Prepare the terminal; termination signals raise `KeyboardInterrupt` from now on."""
        self._open.enter_context(ending())
        if self.in_place:
            self._out.write(_ENTER)
            self._open.callback(self._leave)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        """Restore the terminal."""
        self._open.close()

    def _leave(self) -> None:
        with suppress(OSError):
            self._out.write(_LEAVE)
            self._out.flush()

    def show(self, frame: Frame) -> None:
        """Show a frame, or its changes since the last one."""
        if self.in_place:
            rows = self._rows(frame)
            body = '\x1b[K\r\n'.join(rows)
            self._out.write(f'\x1b[H{body}\x1b[K\x1b[J')
        else:
            when = _when(frame, self._zone)
            lines = [f'{when}  {w}: {told}\n' for w, told in changes(self._before, frame)]
            said = in_zone(''.join(lines), self._zone)
            self._out.write(said if self._unicode else said.encode('ascii', 'replace').decode())
        self._before = frame
        self._out.flush()

    def text(self, frame: Frame) -> str:
        """Return a frame as permanent text."""
        return '\n'.join(self._rows(frame, whole=True)).rstrip()

    def _rows(self, frame: Frame, whole: bool = False) -> list[str]:
        size = shutil.get_terminal_size(_USUAL)
        return screen(
            frame, size.columns, size.lines, colour=self._colour, unicode=self._unicode,
            zone=self._zone, whole=whole,
        )  # fmt: skip


@contextmanager
def ending() -> Iterator[None]:
    """Make termination signals raise `KeyboardInterrupt` inside the context."""
    before = {}
    for number in (signal.SIGTERM, signal.SIGHUP):
        with suppress(ValueError):  # not in the main thread
            before[number] = signal.signal(number, signal.default_int_handler)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
