# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A quote that is not closed is refused with its line, and every quote that is closed is read."""

from __future__ import annotations

import csv
import io
import time
import tracemalloc
from pathlib import Path

import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import open_log, read_table
from valveflow_ros.logs.tables.text import LONGEST_CELL, Quotes

HEAD = 'time,valve position,ms pressure [MPa],ms temperature,MW,comment'
WHERE = Path('x.csv')


def row(k, comment=''):
    clock = f'{12 + k // 3600:02}:{k // 60 % 60:02}:{k % 60:02}'
    return f'2026-01-05 {clock},50,13,538,{600 + k},{comment}'


def written(path, rows, end='\n'):
    path.write_bytes(end.join([HEAD, *rows, '']).encode())
    return path


def pieces(text, sizes):
    while text:
        size = next(sizes)
        yield text[:size]
        text = text[size:]


@pytest.mark.parametrize('end', ['\n', '\r\n'])
@pytest.mark.parametrize('line', [2, 777, 12_000])
def test_the_line_of_a_quote_that_is_not_closed_is_named(tmp_path, line, end):
    rows = [row(k, '"a note, in quotes"') for k in range(14_000)]
    rows[line - 2] = row(line - 2, '"who closes this')
    path = written(tmp_path / 'x.csv', [*rows[: line - 1], *(row(k) for k in range(9000))], end)
    with pytest.raises(RecordingError, match=f'has in line {line} a quote that is not closed'):
        open_log(path)


def test_a_quote_that_another_closes_much_later_is_refused_as_well(tmp_path):
    rows = [row(k) for k in range(3000)]
    rows[10] = row(10, '"begin')
    rows[2500] = row(2500, 'end"')
    with pytest.raises(RecordingError, match='has in line 12 '):
        read_table(written(tmp_path / 'x.csv', rows))


def test_it_costs_neither_memory_nor_time(tmp_path):
    path = tmp_path / 'x.csv'
    read_table(written(path, [row(k) for k in range(9)]))
    with path.open('a') as file:
        file.write(row(9, '"open\n'))
        for k in range(10, 500_000):
            file.write(row(k % 3600) + '\n')
    begun = time.process_time()
    tracemalloc.start()
    with pytest.raises(RecordingError, match='has in line 11 '):
        read_table(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 0.3 * path.stat().st_size
    assert time.process_time() - begun < 5.0


def test_comments_of_several_lines_and_stray_quotes_are_no_harm(tmp_path):
    comments = '"two\nlines, ""so"" to say"', 'a 5" pipe', '""', ''
    rows = [row(k, comments[k % 4]) for k in range(9000)]
    raw = read_table(written(tmp_path / 'x.csv', rows))
    assert len(raw.time_ns) == 9000
    assert raw.columns['generated_power_mw'][-1] == 600 + 8999


@given(
    st.lists(
        st.lists(st.text('a" ,\n', max_size=9), min_size=2, max_size=4), min_size=1, max_size=12
    ),
    st.lists(st.integers(1, 9), min_size=1, max_size=4),
)
def test_what_a_writer_of_tables_writes_is_closed_wherever_it_is_cut(rows, sizes):
    text = io.StringIO()
    csv.writer(text, lineterminator='\n').writerows(rows)
    quotes = Quotes(WHERE, ',')
    steps = iter(sizes * len(text.getvalue()))
    for piece in pieces(text.getvalue(), steps):
        quotes.follow(piece)
    # One row more, left open, and more than a cell's worth behind it: found in its line.
    line = text.getvalue().count('\n') + 1
    with pytest.raises(RecordingError, match=f'in line {line} '):
        quotes.follow('1,"' + 'a' * LONGEST_CELL)


@given(st.lists(st.integers(1, 5), min_size=1, max_size=4), st.sampled_from(['\n', '\r\n', '\r']))
def test_lines_are_counted_wherever_the_text_is_cut(sizes, end):
    quotes = Quotes(WHERE, ';')
    text = f'a;b{end}1;"x"{end}{end}1;2{end}'
    for piece in pieces(text, iter(sizes * len(text))):
        quotes.follow(piece)
    with pytest.raises(RecordingError, match='in line 5 '):
        quotes.follow('"' + 'a' * LONGEST_CELL)


@settings(max_examples=60)
@given(st.text('a";\n ', max_size=40), st.lists(st.integers(1, 7), min_size=1, max_size=4))
def test_cells_open_and_close_where_pandas_opens_and_closes_them(text, sizes):
    """Whatever stands before: a row after it is a row of its own, or part of an open cell."""
    mark = 'zzz'
    whole = f'h;i;j;k;l;m;n;o;p;q;r;s;t;u;v;w\n{text}\n{mark}\n'
    try:
        frame = pd.read_csv(io.StringIO(whole), sep=';', skipinitialspace=True, index_col=False,
                            header=None, names=range(45), keep_default_na=False)  # fmt: skip
        alone = bool((frame[0] == mark).any())
    except pd.errors.ParserError:  # the end of the file stands in an open cell
        alone = False
    quotes = Quotes(WHERE, ';')
    for piece in pieces(whole, iter(sizes * len(whole))):
        quotes.follow(piece)
    try:
        quotes.follow('a' * (LONGEST_CELL + len(whole)))
        open_now = False
    except RecordingError:
        open_now = True
    assert open_now != alone
