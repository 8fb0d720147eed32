# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The terminal: a view that always fits, the board behind it, and a bar of progress."""

import dataclasses
import io
import math
import re
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from monitor_recording import stamp

from valveflow_ros.records import zone_of
from valveflow_ros.report.terminal import text
from valveflow_ros.report.terminal.board import AGE, HEALTH, KEPT, MonitorState
from valveflow_ros.report.terminal.frame import (
    AlarmView,
    CurveView,
    DiagnosisView,
    Frame,
    HealthView,
    SampleView,
)
from valveflow_ros.report.terminal.progress import Progress, in_words
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

# Also such as command a terminal.
texts = st.text(max_size=120) | st.text(max_size=9).map('\x1b]0;{}\x07'.format)
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


@settings(max_examples=20, deadline=None)
@given(some_frames, st.integers(1, 200), st.integers(1, 60), st.booleans(), st.booleans())
def test_whatever_is_known_it_fits_and_nothing_of_others_commands_the_terminal(
    frame, width, height, colour, unicode
):
    assert '\x1b' not in ''.join(told for _, told in changes(Frame(), frame))
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
        'o breakpoint', 'Residual', 'limits −3.0 to +3.0', 'alarm at 25 % of its limit',
        'ALARM, not acknowledged, raised 2023-11-14 22:13 UTC',
        'The unit gives 5 MW less.', 'opening 1 Hz', 'Recording.', 'cause named (stiction)',
        'It sticks.', '290 MW', '150 MW',
    ):  # fmt: skip
        assert part in text, part
    assert any(0x2800 < ord(c) < 0x2900 for c in text)
    assert '\x1b' not in text


def test_colour_and_zone_change_no_other_word():
    plain, bright = screen(FULL, 80, 24), screen(FULL, 80, 24, colour=True)
    assert [SGR.sub('', line).rstrip() for line in bright] == [line.rstrip() for line in plain]
    assert any('\x1b[1;31m' in line for line in bright)
    told = re.sub(r'\n +', ' ', '\n'.join(screen(FULL, 80, 24, zone=zone_of('+05:30'))))
    for part in ('2023-11-15 03:48:20 UTC+05:30', 'raised 2023-11-15 03:43 UTC+05:30'):
        assert part in told, part


def braille(line):
    return any(0x2800 < ord(c) < 0x2900 for c in line)


def test_more_room_gives_a_larger_curve_on_which_the_operating_point_lies():
    sizes = [sum(map(braille, screen(FULL, 80, height))) for height in (24, 40, 60)]
    assert sizes[0] < sizes[1] < sizes[2]
    on = dataclasses.replace(
        FULL, last=dataclasses.replace(sample(300), u=1500.0, measured_mw=250.0)
    )
    (row,) = [line[8:] for line in screen(on, 80, 30) if '●' in line and 'now' not in line]
    assert braille(row[row.index('●') - 1] + row[row.index('●') + 1])


@given(st.integers(1, 40), st.integers(1, 20), st.floats(0, 1), st.floats(0, 1))
def test_a_dot_stands_where_its_numbers_say(width, height, x, y):
    canvas = Canvas(width, height, (0.0, 0.0), (1.0, 1.0))
    canvas.dot(x, y)
    rows = enumerate(canvas.rows())
    found = [(r, c) for r, line in rows for c, letter in enumerate(line) if letter != ' ']
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


# The board keeps what it is told, of one unit, within bounds.


def test_memory_is_bounded():
    board = MonitorState()
    for k in range(3 * KEPT):
        board.take('valveflow_msgs/msg/Prediction', {
            'header': {'stamp': stamp(START + k * SECOND), 'frame_id': 'U1'}, 'state': 2,
            'integrated_input': 1.0, 'measured_mw': 2.0, 'residual_mw': 0.0, 'average_mw': 0.0,
            'limit_low_mw': 1.0, 'limit_high_mw': 3.0,
        })  # fmt: skip
    assert len(board.frame('x').samples) == KEPT


@pytest.mark.parametrize('early', [False, True])
@pytest.mark.parametrize(('tag', 'prefix'), [
    ('U1', 'unit_1/valveflow_monitor: '), ('', 'unit_1/valveflow_monitor: '),
    ('U1', 'valveflow: {} '),  # as earlier versions wrote it
])  # fmt: skip
def test_the_health_of_another_unit_is_not_taken_for_this_ones(tag, early, prefix):
    def health(of, level, sentence):
        board.take(HEALTH, {'header': {'frame_id': of}, 'status': [
            {'name': f'{prefix.format(of)}{name}', 'hardware_id': of, 'level': level,
             'message': sentence} for name in ('input valve_opening', 'recorder')
        ]})  # fmt: skip

    def speak():
        board.take('valveflow_msgs/msg/Diagnosis', {
            'header': {'stamp': stamp(START), 'frame_id': tag}, 'verdict': 0, 'sentence': '',
            'causes': [],
        })  # fmt: skip

    board = MonitorState()
    if early:
        # Which monitor of several it is, is not known yet.
        health('U2', 3, 'silent')
        speak()
        assert (board.frame('x').inputs, board.frame('x').recorder) == ((), None)
    speak()
    health(tag, 0, 'fine')
    health('U2', 3, 'silent')
    frame = board.frame('x')
    assert [(i.name, i.sentence) for i in frame.inputs] == [('valve_opening', 'fine')]
    assert frame.recorder.sentence == 'fine'


@pytest.mark.parametrize(
    ('tag', 'names'),
    [('', ['pump: state']),
     ('U1', ['pump_node: temperature', 'pump_node: recorders', 'recorder of the pump'])],
)  # fmt: skip
def test_what_others_say_and_what_bears_no_tag_is_left_alone(tag, names):
    board = MonitorState()
    status = [{'name': n, 'hardware_id': tag, 'level': 2, 'message': 'Hot.'} for n in names]
    board.take(HEALTH, {'header': {'frame_id': tag}, 'status': status})
    assert board.items == ()
    assert board.frame('x').recorder is None


@pytest.mark.parametrize(('age', 'later_s'), [('431.5', 431.5), ('unknown', 0.0), ('nan', 0.0)])
def test_without_a_sample_the_health_tells_how_old_the_curve_is(age, later_s):
    board = MonitorState()
    board.take('valveflow_msgs/msg/FlowCharacteristic', {
        'header': {'stamp': stamp(START), 'frame_id': 'U1'}, 'breakpoints': [1.0, 2.0],
        'values': [1.0, 2.0], 'status': 1, 'cause': '', 'model_id': 'a', 'samples': 9,
        'window_start': stamp(START - 9), 'window_end': stamp(START), 'rmse_mw': 0.1,
    })  # fmt: skip
    board.take(HEALTH, {'header': {'frame_id': 'U1'}, 'status': [{
        'name': 'valveflow_monitor: fit', 'hardware_id': 'U1', 'level': 0, 'message': '',
        'values': [{'key': AGE, 'value': age}],
    }]})  # fmt: skip
    assert board.frame('x').now_ns == START + round(later_s * SECOND)


# Progress: even, with the time that is left, and quiet where there is no terminal.


class Shown:
    """A progress whose time is ours, its stream and its clock."""

    def __init__(self, bar=True, err=None):
        self.err, self.now = err or io.StringIO(), 100.0
        self.progress = Progress(self.err, bar, clock=lambda: self.now)
        self.progress._start = lambda: None

    def at(self, share, pause_s=0.0):
        self.progress.at(share, 'working')
        self.now += pause_s

    @property
    def last(self):
        return self.err.getvalue().split('\x1b[K')[-1]


def test_the_time_left_follows_from_the_share():
    shown = Shown()
    shown.at(0.0, 10.0)
    assert 'left' not in shown.err.getvalue()
    shown.at(0.25, 20.0)
    assert shown.last.endswith(' 25 %  about 30 s left  working')
    shown.progress.tick()
    assert shown.last.endswith('about 10 s left  working')
    shown.now += 20.0
    shown.progress.tick()
    assert shown.last.endswith('50 s so far  working')


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=20))
def test_a_bar_never_goes_back(shares):
    shown = Shown()
    for share in shares:
        shown.at(share, 1.0)
    percent = [int(found) for found in re.findall(r'(\d+) %', shown.err.getvalue())]
    assert percent == sorted(percent)
    assert abs(percent[-1] - 100 * max(shares)) <= 0.5


def test_where_there_is_no_terminal_few_lines_come_and_only_late():
    shown = Shown(bar=False)
    for second in range(600):
        shown.at(second / 600.0, 1.0)
        if second < 15:
            assert shown.err.getvalue() == ''
    lines = shown.err.getvalue().splitlines()
    assert 4 <= len(lines) <= 10
    assert re.fullmatch(r'\d+ %  .* so far  about .* left  working', lines[1])
    assert '\x1b' not in shown.err.getvalue()


def test_a_bar_suits_its_terminal_and_nothing_is_drawn_after_the_end(monkeypatch):
    monkeypatch.setenv('COLUMNS', '40')
    shown = Shown()
    shown.progress.at(0.5, 'a piece of work with a very long name indeed')
    assert len(shown.last) < 40
    shown.progress.end()
    told = shown.err.getvalue()
    shown.now += 10.0
    shown.at(0.6)
    shown.progress.tick()
    assert shown.err.getvalue() == told
    plain = Shown(err=io.TextIOWrapper(io.BytesIO(), encoding='ascii'))
    plain.at(0.5)
    plain.err.seek(0)
    assert '##########..........' in plain.err.read()


def test_time_goes_on_by_itself():
    err = io.StringIO()
    progress = Progress(err, True)
    progress.at(0.5, 'working')
    drawn = err.getvalue().count('\r')
    end_s = time.monotonic() + 30.0
    while err.getvalue().count('\r') == drawn:
        assert time.monotonic() < end_s
        time.sleep(0.02)
    progress.end()
    assert err.getvalue().endswith('\r\x1b[K')


def test_lengths_of_time():
    for seconds, words in (
        (0.4, '0 s'), (59.4, '59 s'), (61.0, '1 min'), (131.0, '2 min 10 s'), (3600.0, '1 h'),
        (3900.0, '1 h 5 min'),
    ):  # fmt: skip
        assert in_words(seconds) == words
