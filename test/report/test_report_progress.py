# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Progress: even, with the time that is left, and quiet where there is no terminal."""

from __future__ import annotations

import io
import re
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from valveflow_ros.report.terminal.progress import Progress, in_words


class Clock:
    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


@pytest.fixture
def shown(monkeypatch):
    """Give a progress whose time is ours, its stream and its clock."""
    made = []
    monkeypatch.setattr(Progress, '_start', lambda self: None)

    def make(bar=True, **more):
        err, clock = io.StringIO(), Clock()
        made.append(Progress(err, bar, clock=clock, **more))
        return made[-1], err, clock

    return make


def last(err):
    return err.getvalue().split('\x1b[K')[-1]


def test_the_time_left_follows_from_the_share(shown):
    progress, err, clock = shown()
    progress.at(0.0, 'working')
    assert 'left' not in err.getvalue()
    clock.now += 10.0
    progress.at(0.25, 'working')
    assert last(err).endswith(' 25 %  about 30 s left  working')
    clock.now += 20.0
    progress.tick()
    assert last(err).endswith('about 10 s left  working')
    clock.now += 20.0
    progress.tick()
    assert last(err).endswith('50 s so far  working')


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=20))
def test_a_bar_never_goes_back(shares):
    err, clock = io.StringIO(), Clock()
    progress = Progress(err, True, clock=clock)
    progress._start = lambda: None
    for share in shares:
        clock.now += 1.0
        progress.at(share, 'working')
    percent = [int(found) for found in re.findall(r'(\d+) %', err.getvalue())]
    assert percent == sorted(percent)
    assert percent[-1] == round(100 * max(shares)) or abs(percent[-1] - 100 * max(shares)) <= 0.5


def test_where_there_is_no_terminal_few_lines_come_and_only_late(shown):
    progress, err, clock = shown(bar=False)
    for second in range(600):
        progress.at(second / 600.0, 'working')
        if second < 15:
            assert err.getvalue() == ''
        clock.now += 1.0
    lines = err.getvalue().splitlines()
    assert 4 <= len(lines) <= 10
    assert re.fullmatch(r'\d+ %  .* so far  about .* left  working', lines[1])
    assert '\x1b' not in err.getvalue()


def test_a_bar_is_never_longer_than_the_terminal(shown, monkeypatch):
    monkeypatch.setenv('COLUMNS', '40')
    progress, err, _ = shown()
    progress.at(0.5, 'a piece of work with a very long name indeed')
    assert len(last(err)) < 40


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


def test_nothing_is_drawn_after_the_end(shown):
    progress, err, clock = shown()
    progress.at(0.5, 'working')
    progress.end()
    told = err.getvalue()
    clock.now += 10.0
    progress.at(0.6, 'more')
    progress.tick()
    assert err.getvalue() == told


def test_a_stream_without_blocks_gets_a_bar_it_can_show(shown, monkeypatch):
    err = io.TextIOWrapper(io.BytesIO(), encoding='ascii')
    monkeypatch.setattr(Progress, '_start', lambda self: None)
    Progress(err, True).at(0.5, 'working')
    err.seek(0)
    assert '##########..........' in err.read()


@pytest.mark.parametrize(('seconds', 'words'), [
    (0.4, '0 s'), (59.4, '59 s'), (61.0, '1 min'), (131.0, '2 min 10 s'), (3600.0, '1 h'),
    (3900.0, '1 h 5 min'),
])  # fmt: skip
def test_lengths_of_time(seconds, words):
    assert in_words(seconds) == words
