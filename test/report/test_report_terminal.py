# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The drawing of the terminal view: a pure function that always fits the terminal."""

from __future__ import annotations

import dataclasses
import math
import re

from hypothesis import given, settings
from hypothesis import strategies as st

from valveflow_ros.records import zone_of
from valveflow_ros.report.terminal import text
from valveflow_ros.report.terminal.frame import (
    AlarmView,
    CurveView,
    DiagnosisView,
    Frame,
    HealthView,
    SampleView,
)
from valveflow_ros.report.terminal.screen import DOTS_X, DOTS_Y, Canvas, changes, screen
from valveflow_ros.report.terminal.text import cells, clean, cut, painted, wrapped

SECOND = 10**9
START = 1_700_000_000 * SECOND
SGR = re.compile(r'\x1b\[[0-9;]*m')


def sample(k: int, residual: float = 0.5, state: int = 2) -> SampleView:
    return SampleView(
        START + k * SECOND, state, 1450.0, 240.0, residual, residual / 2.0, -3.0, 3.0, 0.25
    )


CURVE = CurveView(
    (1000.0, 1500.0, 2200.0), (150.0, 250.0, 290.0), 1, '', 'abc',
    (START - 86400 * SECOND, START), 1234, 1.25, '',
)  # fmt: skip
FULL = Frame(
    'U1', 'recording', START + 300 * SECOND, '', CURVE, sample(300),
    tuple(sample(k, math.sin(k)) for k in range(301)),
    (AlarmView('residual', 1, 'The unit gives 5 MW less.', START),),
    tuple(HealthView(n, 0, '1 Hz.') for n in ('valve_opening', 'generated_power')),
    HealthView('recorder', 0, 'Recording.'),
    DiagnosisView(2, 'It sticks.', ('stiction',), START),
)  # fmt: skip

texts = st.text(max_size=120)
numbers = st.one_of(st.floats(-1e4, 1e4), st.sampled_from([math.nan, math.inf, -math.inf]))
some_numbers = st.lists(numbers, max_size=8).map(tuple)
some_samples = st.builds(
    SampleView, st.integers(0, 2**62), st.integers(0, 9), numbers, numbers, numbers, numbers,
    numbers, numbers, numbers,
)  # fmt: skip
some_frames = st.builds(
    Frame, texts, texts, st.integers(0, 2**62), texts,
    st.none() | st.builds(
        CurveView, some_numbers, some_numbers,
        st.integers(0, 9), texts, texts, st.tuples(st.integers(0, 2**62), st.integers(0, 2**62)),
        st.integers(0, 10**7), numbers, texts,
    ),
    st.none() | some_samples, st.lists(some_samples, max_size=20).map(tuple),
    st.lists(st.builds(AlarmView, texts, st.integers(0, 9), texts, st.integers(0, 2**62)),
             max_size=3).map(tuple),
    st.lists(st.builds(HealthView, texts, st.integers(0, 9), texts), max_size=6).map(tuple),
    st.none() | st.builds(HealthView, texts, st.integers(0, 9), texts),
    st.none() | st.builds(DiagnosisView, st.integers(0, 9), texts,
                          st.lists(texts, max_size=3).map(tuple), st.integers(0, 2**62)),
)  # fmt: skip


@settings(max_examples=40, deadline=None)
@given(some_frames, st.integers(1, 200), st.integers(1, 60), st.booleans(), st.booleans())
def test_whatever_is_known_it_fits_and_nothing_of_others_commands_the_terminal(
    frame, width, height, colour, unicode
):
    lines = screen(frame, width, height, colour=colour, unicode=unicode)
    assert 1 <= len(lines) <= height
    for line in lines:
        bare = SGR.sub('', line) if colour else line
        assert cells(bare) <= width
        assert all(c.isprintable() or c == '\u202f' for c in bare)
        if not unicode:
            assert bare.isascii()


def test_everything_is_on_a_usual_terminal():
    text = re.sub(r'\n +', ' ', '\n'.join(screen(FULL, 80, 24)))
    for part in (
        'U1', '2023-11-14 22:18:20', 'fresh, 2 pieces', '1\u202f234 samples', '5 min old', '●',
        'o breakpoint', 'Residual', 'limits −3.0 to +3.0', '25 % of the way',
        'ALARM, not acknowledged, raised 2023-11-14 22:13 UTC',
        'The unit gives 5 MW less.', 'opening 1 Hz', 'Recording.', 'cause named (stiction)',
        'It sticks.', '290 MW', '150 MW',
    ):  # fmt: skip
        assert part in text, part
    assert any(0x2800 < ord(c) < 0x2900 for c in text)
    assert '\x1b' not in text


def test_times_are_told_in_a_zone():
    text = re.sub(r'\n +', ' ', '\n'.join(screen(FULL, 80, 24, zone=zone_of('+05:30'))))
    for part in ('2023-11-15 03:48:20 UTC+05:30', 'raised 2023-11-15 03:43 UTC+05:30'):
        assert part in text, part


def test_without_colour_the_words_are_the_same():
    plain, bright = screen(FULL, 80, 24), screen(FULL, 80, 24, colour=True)
    assert [SGR.sub('', line).rstrip() for line in bright] == [line.rstrip() for line in plain]
    assert any('\x1b[1;31m' in line for line in bright)


def test_more_room_gives_a_larger_curve():
    def rows(height):
        return sum(
            any(0x2800 < ord(c) < 0x2900 for c in line) for line in screen(FULL, 80, height)
        )

    assert rows(24) < rows(40) < rows(60)


def test_the_operating_point_lies_on_a_curve_that_goes_through_it():
    on = dataclasses.replace(
        FULL, last=dataclasses.replace(sample(300), u=1500.0, measured_mw=250.0)
    )
    canvas = [line[8:] for line in screen(on, 80, 30) if '●' in line and 'now' not in line]
    assert len(canvas) == 1
    row = canvas[0]
    beside = row[row.index('●') - 1], row[row.index('●') + 1]
    assert any(0x2800 < ord(c) < 0x2900 for c in beside)


@given(st.integers(1, 40), st.integers(1, 20), st.floats(0, 1), st.floats(0, 1))
def test_a_dot_stands_where_its_numbers_say(width, height, x, y):
    canvas = Canvas(width, height, (0.0, 0.0), (1.0, 1.0))
    canvas.dot(x, y)
    rows = canvas.rows()
    found = [
        (r, c) for r, line in enumerate(rows) for c, letter in enumerate(line) if letter != ' '
    ]
    across = round(x * (width * DOTS_X - 1))
    down = height * DOTS_Y - 1 - round(y * (height * DOTS_Y - 1))
    assert found == [(down // DOTS_Y, across // DOTS_X)]


def test_a_line_reaches_from_end_to_end_without_a_gap():
    canvas = Canvas(30, 8, (0.0, 0.0), (1.0, 1.0))
    canvas.line([(0.0, 0.0), (1.0, 1.0)])
    rows = canvas.rows()
    assert all(any(row[c] != ' ' for row in rows) for c in range(30))
    assert rows[-1][0] != ' '
    assert rows[0][-1] != ' '


@given(texts)
def test_clean_text_is_one_printable_line(text):
    assert all(c.isprintable() or c == '\u202f' for c in clean(text))
    assert clean(clean(text)) == clean(text)


def test_a_sentence_cannot_command_the_terminal():
    hostile = dataclasses.replace(FULL, alarms=(AlarmView('x', 1, '\x1b]0;own\x07\x1b[2J', 0),))
    assert '\x1b' not in '\n'.join(screen(hostile, 80, 24))
    assert '\x1b' not in ''.join(told for _, told in changes(Frame(), hostile))


@given(texts.map(clean), st.integers(1, 60), st.integers(1, 5))
def test_wrapping_keeps_the_words_or_says_that_some_are_left_out(text, width, most):
    lines = wrapped(text, width, most)
    assert len(lines) <= most
    assert all(cells(line) <= width for line in lines)
    if not any('…' in line for line in lines):
        assert ' '.join(lines).split() == text.split()


@given(st.text('a\u0301漢\u202f …', max_size=30), st.integers(0, 12))
def test_what_is_cut_is_as_long_as_it_may_be(text, width):
    """Slow truth: letter after letter is taken away until it fits."""
    left = text
    while left and cells(left) > width - 1:
        left = left[:-1]
    short = f'{left.rstrip()}…' if width else ''
    assert cut(text, width) == (text if cells(text) <= width else short)
    assert cells(painted(((text, 'bad'),), width, colour=False)) <= width


def test_the_length_of_a_word_of_others_costs_nothing(monkeypatch):
    looked = []
    count = text.cells
    monkeypatch.setattr(text, 'cells', lambda text: looked.append(len(text)) or count(text))
    assert cut('x' * 100_000, 60) == 'x' * 59 + '…'
    assert sum(looked) < 100
    assert len(clean('y ' * 100_000)) < 5000


def test_changes_tell_each_thing_once():
    told = changes(Frame(), FULL)
    kinds = [what for what, _ in told]
    assert kinds == ['curve', 'alarm', 'input', 'input', 'recorder', 'diagnosis']
    assert changes(FULL, FULL) == []
    later = dataclasses.replace(FULL, now_ns=FULL.now_ns + SECOND, last=sample(301, 2.0))
    assert changes(FULL, later) == []
    gone = dataclasses.replace(FULL, alarms=(dataclasses.replace(FULL.alarms[0], state=0),))
    assert [what for what, _ in changes(FULL, gone)] == ['alarm']
    silent = dataclasses.replace(FULL.inputs[0], level=3, sentence='silent for 9 s.')
    stale = dataclasses.replace(FULL, inputs=(silent, FULL.inputs[1]))
    assert changes(FULL, stale) == [('input', 'opening: silent for 9 s.')]
    longer = dataclasses.replace(stale, inputs=(dataclasses.replace(silent, sentence='10 s'),))
    assert changes(stale, longer) == []
