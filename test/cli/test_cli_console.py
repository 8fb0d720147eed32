# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Messages, progress and results go where they belong."""

import io
import json
import unicodedata
import zoneinfo

import pytest
from hypothesis import given
from hypothesis import strategies as st

from valveflow_ros.cli.command import Console, VerbResult, table


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self):
        return True


def shown(text):
    """Return what stays on a terminal's lines after all returns and erasures."""
    return [line.split('\r')[-1].replace('\x1b[K', '') for line in text.split('\n')]


@pytest.fixture(autouse=True)
def usual_terminal(monkeypatch):
    monkeypatch.setenv('TERM', 'xterm')


def console_on(err, **more):
    return Console(io.StringIO(), err, **more)


@pytest.mark.parametrize(('kind', 'term', 'quiet', 'bar'), [
    (Terminal, 'xterm', False, True), (Terminal, 'xterm', True, False),
    (Terminal, 'dumb', False, False), (io.StringIO, 'xterm', False, False),
])  # fmt: skip
def test_progress_is_for_terminals_only_and_can_be_silenced(monkeypatch, kind, term, quiet, bar):
    monkeypatch.setenv('TERM', term)
    err = kind()
    console_on(err, quiet=quiet)(0.5, 'working')
    assert ('50 %  working' in err.getvalue()) == bar
    assert bar or err.getvalue() == ''


def test_a_message_takes_the_place_of_the_bar():
    err = Terminal()
    console = console_on(err)
    console(0.1, 'first')
    console.say('Found something.')
    console(0.2, 'second')
    console.warn('Look here.')
    console(0.3, 'third')
    console.finish(VerbResult('done', {}))
    assert shown(err.getvalue()) == ['Found something.', 'Warning: Look here.', '']


def test_a_bar_of_one_piece_of_work_is_not_redrawn_all_the_time():
    err = Terminal()
    console = console_on(err)
    for k in range(10_000):
        console(k / 10_000, 'working')
    assert err.getvalue().count('\r') < 100


def test_quiet_keeps_warnings():
    err = io.StringIO()
    console = console_on(err, quiet=True)
    console.say('Nice to know.')
    console.warn('Need to know.')
    assert err.getvalue() == 'Warning: Need to know.\n'


def test_results_go_to_stdout_as_text_or_json():
    outcome = VerbResult(
        'A text.', {'a': [1.5, float('nan'), (float('inf'), 'ü')], 'b': {'c': None}}
    )
    out, err = io.StringIO(), io.StringIO()
    Console(out, err).finish(outcome)
    assert (out.getvalue(), err.getvalue()) == ('A text.\n', '')
    out = io.StringIO()
    Console(out, err, as_json=True).finish(outcome)
    assert json.loads(out.getvalue()) == {'a': [1.5, None, [None, 'ü']], 'b': {'c': None}}
    assert err.getvalue() == ''


@given(st.text(st.characters(categories=['Cc', 'Cf', 'L', 'Zl', 'Zp']), max_size=30))
def test_nothing_of_others_commands_the_terminal(word):
    for as_json in (False, True):
        out, err = io.StringIO(), io.StringIO()
        console = Console(out, err, as_json=as_json)
        for tell in (console.say, console.warn, console.fail):
            tell(f'Column {word}.')
        console.finish(VerbResult(f'Column {word}.', {word: [word]}))
        told = out.getvalue() + err.getvalue()
        assert all(c in '\n\t' or unicodedata.category(c) != 'Cc' for c in told)
        assert not set(told) & set('\u2028\u2029\u202a\u202e\u2066\u2069')
        if as_json:
            assert json.loads(out.getvalue()) == {word: [word]}


def test_times_are_told_in_the_zone_and_json_keeps_utc():
    said = 'Since 2024-01-02 00:30 UTC.'
    for as_json, told in ((False, 'Since 2024-01-02 01:30 CET.'), (True, said)):
        out, err = io.StringIO(), Terminal()
        console = Console(out, err, as_json=as_json)
        console.times_in(zoneinfo.ZoneInfo('Europe/Berlin'))
        console(0.5, said)
        for tell in (console.say, console.warn, console.fail):
            tell(said)
        console.finish(VerbResult(said, {'since': said}))
        assert told in out.getvalue()
        assert 'UTC' not in err.getvalue()
        assert err.getvalue().count('01:30 CET') >= 4


def test_a_picture_keeps_its_colours():
    out = io.StringIO()
    Console(out, io.StringIO()).finish(VerbResult('\x1b[1mAlarms\x1b[0m', {}, drawn=True))
    assert out.getvalue() == '\x1b[1mAlarms\x1b[0m\n'


@given(st.lists(st.lists(st.text('abc 12', max_size=9), min_size=3, max_size=3), max_size=6))
def test_columns_line_up(rows):
    told = table(['one', 'two', 'three'], rows)
    lines = [line.removeprefix('  ') for line in told.split('\n')]
    assert len(lines) == len(rows) + 1
    width = max(map(len, lines))
    for line, row in zip(lines[1:], rows, strict=True):
        assert line.ljust(width).endswith(row[2].rjust(5)) or row[2] != row[2].rstrip()
        assert line.startswith(row[0].rstrip())
