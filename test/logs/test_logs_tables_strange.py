# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Tables that would fill memory or time, and quotes that are not closed, are refused in words."""

import gzip
import io
import itertools
import subprocess
import sys
import time
import tracemalloc
import zipfile
from csv import writer
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from table_files import HEAD, ROWS, changed, csv, workbook

from valveflow_ros.errors import InputError, RecordingError, ValveflowError
from valveflow_ros.logs import open_log, read_table
from valveflow_ros.logs.tables.refusal import TableOptions
from valveflow_ros.logs.tables.text import LONGEST_CELL, LONGEST_LINE, Quotes
from valveflow_ros.records import SIGNALS

pa = pytest.importorskip('pyarrow')
parquet = pytest.importorskip('pyarrow.parquet')


@pytest.fixture(scope='module')
def book(tmp_path_factory):
    rows = [line.split(',') for line in (HEAD, *ROWS)]
    return workbook(tmp_path_factory.mktemp('book') / 'x.xlsx', rows)


# Workbooks -------------------------------------------------------------------------------------


def test_a_row_that_no_sheet_has_ends_the_reading(book, tmp_path):
    row = '<row r="{0}"><c r="A{0}" t="n"><v>1</v></c></row>'
    far = changed(book, tmp_path / 'far.xlsx', row.format(2_000_000_000).encode())
    with pytest.raises(RecordingError, match='more than the 1048576 rows'):
        read_table(far)
    # What comes after the size that the sheet tells is read as well.
    near = read_table(changed(book, tmp_path / 'near.xlsx', row.format(30_000).encode()))
    assert (len(near.time_ns), near.bad_times) == (len(ROWS), 1)


@settings(max_examples=40)
@given(st.lists(st.tuples(st.integers(0, 10**6), st.integers(32, 126)), min_size=1, max_size=6))
def test_a_damaged_workbook_is_read_or_is_one_sentence(book, tmp_path_factory, hits):
    path = tmp_path_factory.mktemp('damaged') / 'y.xlsx'
    with zipfile.ZipFile(book) as old, zipfile.ZipFile(path, 'w') as new:
        for name in old.namelist():
            data = bytearray(old.read(name))
            for place, letter in hits if name.startswith('xl/wor') else ():
                data[place % len(data)] = letter
            new.writestr(name, bytes(data))
    try:
        assert len(read_table(path).time_ns) <= len(ROWS)
    except ValveflowError as error:
        assert '\n' not in str(error)


def test_a_workbook_that_unpacks_beyond_measure_is_refused(book, tmp_path):
    cells = b'<row r="900000"><c r="XFD900000" t="n"><v>1</v></c></row>'
    with pytest.raises(RecordingError, match='900000 rows and 16384 columns, most of them empty'):
        read_table(changed(book, tmp_path / 'far.xlsx', cells))
    text = b'<is><t>' + b'x' * (80 << 20) + b'</t></is>'
    cell = b'<row r="30"><c r="A30" t="inlineStr">' + text + b'</c></row>'
    bomb = changed(book, tmp_path / 'bomb.xlsx', cell)
    assert bomb.stat().st_size < 1 << 20
    del cell, text
    tracemalloc.start()
    with pytest.raises(RecordingError, match=r'unpacks to 84 MB.*save the sheet as CSV'):
        read_table(bomb)
    assert tracemalloc.get_traced_memory()[1] < 32 << 20
    tracemalloc.stop()


SHEETS = 'http://schemas.openxmlformats.org/spreadsheetml/2006/main'
OFFICE = 'http://schemas.openxmlformats.org/officeDocument/2006/relationships'
PACKAGE = 'http://schemas.openxmlformats.org/package/2006'
RELATIONS = f'<Relationships xmlns="{PACKAGE}/relationships">{{}}</Relationships>'
TEXT_CELLS = ''.join(
    f'<row r="{k}"><c r="A{k}" t="s"><v>0</v></c></row>' for k in range(1, 150_001)
)


def relation(number, kind, target):
    return f'<Relationship Id="r{number}" Type="{OFFICE}/{kind}" Target="{target}"/>'


def parts_of(rows, texts):
    """Return the parts of a workbook, written by hand."""
    sheet, strings = relation(1, 'worksheet', 'worksheets/sheet1.xml'), 'sharedStrings'
    return {
        '[Content_Types].xml': f'<Types xmlns="{PACKAGE}/content-types">'
        '<Default Extension="xml" ContentType="application/xml"/></Types>',
        '_rels/.rels': RELATIONS.format(relation(1, 'officeDocument', 'xl/workbook.xml')),
        'xl/workbook.xml': f'<workbook xmlns="{SHEETS}" xmlns:r="{OFFICE}"><sheets>'
        '<sheet name="S" sheetId="1" r:id="r1"/></sheets></workbook>',
        'xl/_rels/workbook.xml.rels': RELATIONS.format(
            sheet + relation(2, strings, f'{strings}.xml')
        ),
        'xl/worksheets/sheet1.xml': f'<worksheet xmlns="{SHEETS}"><sheetData>{rows}</sheetData>'
        '</worksheet>',
        'xl/sharedStrings.xml': f'<sst xmlns="{SHEETS}">{texts}</sst>',
    }


@pytest.mark.parametrize(
    ('rows', 'texts', 'sentence'),
    [
        (
            f'<row r="1">{"<c/>" * 4000}</row><row r="1048576"><c/></row>', '',
            '1048576 rows and 4000 columns, most of them empty',
        ),
        (f'{"<row><c/></row>" * 3000}<row><c r="XFD1"/></row>', '', '3001 rows and 16384 columns'),
        (TEXT_CELLS[:20_000], f'<si><t>{"x" * (1 << 20)}</t></si>', 'texts too long'),
        (TEXT_CELLS, f'<si><t>{"x" * 30_000}</t></si>', 'texts too long'),
    ],
    ids=['cells without a place', 'rows without a place', 'a text too long', 'a text too often'],
)  # fmt: skip
def test_a_small_workbook_that_would_fill_the_memory_is_refused(rows, texts, sentence, tmp_path):
    pytest.importorskip('python_calamine')
    with zipfile.ZipFile(tmp_path / 'bomb.xlsx', 'w', zipfile.ZIP_DEFLATED) as archive:
        for name, content in parts_of(rows, texts).items():
            archive.writestr(name, content)
    with pytest.raises(RecordingError, match=sentence):
        open_log(tmp_path / 'bomb.xlsx')


# Parquet ---------------------------------------------------------------------------------------

WIDE = ('time', *(info.column for info in SIGNALS[:4]))
LONG = ('Tag', 'Time', 'Value', 'Quality')
# Opens a table, says why not, and how much memory that took in MB.
OPEN = """
import sys
from valveflow_ros.errors import ValveflowError
import valveflow_ros as vf
try:
    vf.open_log(sys.argv[1])
    print('read')
except ValveflowError as error:
    print(str(error).replace(chr(10), ' '))
print(next(int(line.split()[1]) // 1024 for line in open('/proc/self/status') if 'VmHWM' in line))
"""


def opened(path):
    command = [sys.executable, '-c', OPEN, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    *said, peak = done.stdout.strip().splitlines()
    return said[-1], int(peak)


@pytest.fixture(scope='module')
def usual_peak(tmp_path_factory):
    """Return what a table of few rows takes."""
    return opened(repeated(tmp_path_factory.mktemp('few') / 'few.parquet', WIDE, 100))[1]


def repeated(path, names, n):
    """Write a Parquet file in which one row stands n times; text in columns named as such."""
    texts = {'Tag': 'CV_POS', 'Quality': 'Good'}
    one = pa.table({name: [texts.get(name, 1.0)] for name in names})
    place = pa.array(np.zeros(n, dtype=np.int32))
    parquet.write_table(one.take(place), path, row_group_size=n, compression='zstd')
    return path


@pytest.mark.parametrize(
    ('names', 'n', 'why'),
    [(WIDE, 8_000_000, 'rows that unpack to 320 MB'), (LONG, 20_000_000, 'rows that unpack to')],
)
def test_a_small_parquet_of_many_rows_costs_what_one_of_few_rows_does(
    tmp_path, usual_peak, names, n, why
):
    bomb = repeated(tmp_path / 'bomb.parquet', names, n)
    assert bomb.stat().st_size < 500_000
    said, peak = opened(bomb)
    assert f'has {n} {why}' in said
    assert peak < usual_peak + 100


def test_a_parquet_of_one_page_costs_what_one_of_few_rows_does(tmp_path, usual_peak):
    bomb, names, n = tmp_path / 'bomb.parquet', ('a', 'time'), 30_000_000
    parquet.write_table(
        pa.table({name: np.zeros(n) for name in names}), bomb, row_group_size=n,
        compression='zstd', use_dictionary=False, data_page_size=1 << 30, write_batch_size=n,
        max_rows_per_page=n,
    )  # fmt: skip
    assert bomb.stat().st_size < 1_000_000
    assert opened(bomb)[1] < usual_peak + 100


def test_the_limit_of_what_is_unpacked_can_be_raised(book, tmp_path):
    path = repeated(tmp_path / 'x.parquet', WIDE, 2_000_000)
    with pytest.raises(RecordingError, match='add --max-unpacked 80') as refused:
        read_table(path)
    enough = str(refused.value).rstrip('.').rpartition(' ')[2]
    assert len(read_table(path, options=TableOptions(max_unpacked=enough)).time_ns) == 2_000_000
    with pytest.raises(RecordingError, match='add --max-unpacked 1'):
        read_table(book, options=TableOptions(max_unpacked='0.001'))
    same = read_table(book, options=TableOptions(max_unpacked='1')).time_ns
    assert same.tolist() == read_table(book).time_ns.tolist()
    for wrong in ('0', '-1', 'nan', 'inf', 'much'):
        with pytest.raises(ValveflowError, match='must be a number of megabytes'):
            TableOptions(max_unpacked=wrong)


def test_columns_of_lists_or_of_endless_texts_are_refused_only_where_they_are_needed(tmp_path):
    rows, path = 100, tmp_path / 'x.parquet'
    plain = {name: np.arange(1.0, rows + 1) for name in WIDE}
    text = pa.array(['9' * 1_000_000]).take(pa.array(np.zeros(rows, dtype=np.int32)))
    kinds = ((text, 'texts too long'), ([[1.0, 2.0]] * rows, 'list<'),
             ([{'value': 1.0}] * rows, 'struct<'))  # fmt: skip
    for strange, why in kinds:
        parquet.write_table(pa.table({**plain, 'remark': strange}), path)
        found = read_table(path).columns
        assert all((found[name] == plain[name]).all() for name in found)
        parquet.write_table(pa.table({**plain, WIDE[1]: strange}), path)
        with pytest.raises(RecordingError, match=why):
            read_table(path)


@pytest.mark.parametrize('kind', [str, 'category'])
def test_cells_of_a_parquet_mean_the_same_as_numbers_as_texts_and_as_categories(tmp_path, kind):
    frame, path = pd.DataFrame({name: np.arange(1.0, 60.0) for name in WIDE}), tmp_path / 'x.pq'
    frame.astype(dict.fromkeys(WIDE[1:], kind)).to_parquet(path)
    found = read_table(path)
    assert found.time_ns.tolist() == [k * 10**9 for k in range(1, 60)]
    assert all((found.columns[name] == frame[name]).all() for name in WIDE[1:])


@pytest.mark.parametrize('column', ['time', WIDE[1], 'date', 'valve_opening_quality'])
def test_a_needed_column_that_a_parquet_has_twice_is_named(tmp_path, column):
    names = [*WIDE, column] + [column] * (column not in WIDE)
    stamps = [f'2024-01-01 00:00:0{k}' for k in range(9)]
    arrays = [pa.array(stamps if n in ('time', 'date') else [50.0] * 9) for n in names]
    parquet.write_table(pa.Table.from_arrays(arrays, names), tmp_path / 'x.parquet')
    # A date beside a whole time is not needed.
    if column == 'date':
        assert len(read_table(tmp_path / 'x.parquet').time_ns) == 9
        arrays, names = arrays[1:], names[1:]
        parquet.write_table(pa.Table.from_arrays(arrays, names), tmp_path / 'x.parquet')
    with pytest.raises(InputError, match=f"there are several columns called '{column}'"):
        read_table(tmp_path / 'x.parquet')


# Texts -----------------------------------------------------------------------------------------

NOTED = f'{HEAD},comment'
WHERE = Path('x.csv')


def test_packed_texts_are_not_unpacked(tmp_path):
    packed = gzip.compress(csv(tmp_path).read_bytes())
    for name in ('x.csv', 'x.csv.gz', 'x.parquet', 'x.feather'):
        (tmp_path / name).write_bytes(packed)
        with pytest.raises(RecordingError, match='is neither'):
            open_log(tmp_path / name)


@pytest.mark.parametrize('encoding', ['utf-8', 'utf-16'])
def test_a_line_without_end_is_refused(tmp_path, encoding):
    def written(length):
        row = '2026-01-05 12:01:00,50,13,538,'
        rows = [*ROWS * 500, row + '6' * (length - len(row))]
        return csv(tmp_path, rows, encoding=encoding)

    assert read_table(written(LONGEST_LINE)).bad_times == 0
    for length in (LONGEST_LINE + 1, 9 * LONGEST_LINE):
        with pytest.raises(RecordingError, match='a line of more than 1048576 letters'):
            read_table(written(length))


def row(k, comment=''):
    clock = f'{12 + k // 3600:02}:{k // 60 % 60:02}:{k % 60:02}'
    return f'2026-01-05 {clock},50,13,538,{600 + k},{comment}'


def noted(folder, rows):
    return csv(folder, rows, NOTED)


@pytest.mark.parametrize(('line', 'end'), [(2, '\r\n'), (777, '\n'), (12_000, '\r\n')])
def test_the_line_of_a_quote_that_is_not_closed_is_named(tmp_path, line, end):
    rows = [row(k, '"a note, in quotes"') for k in range(line - 2)]
    rows += [row(line - 2, '"who closes this'), *(row(k) for k in range(9000))]
    path = noted(tmp_path, rows)
    path.write_text(path.read_text(), newline=end)
    with pytest.raises(RecordingError, match=f'has in line {line} a quote that is not closed'):
        open_log(path)


def test_a_quote_that_another_closes_much_later_is_refused_as_well(tmp_path):
    notes = {10: '"begin', 2500: 'end"'}
    with pytest.raises(RecordingError, match='has in line 12 '):
        read_table(noted(tmp_path, [row(k, notes.get(k, '')) for k in range(3000)]))


def test_it_costs_neither_memory_nor_time(tmp_path):
    path = noted(tmp_path, [row(k) for k in range(9)])
    read_table(path)
    with path.open('a') as file:
        file.write(row(9, '"open\n'))
        for k in range(10, 300_000):
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
    raw = read_table(noted(tmp_path, [row(k, comments[k % 4]) for k in range(9000)]))
    assert len(raw.time_ns) == 9000
    assert raw.columns['generated_power_mw'][-1] == 600 + 8999


def followed(separator, text, sizes):
    """Return quotes that followed a text, cut into pieces of these sizes."""
    quotes, sizes = Quotes(WHERE, separator), itertools.cycle(sizes)
    while text:
        size = next(sizes)
        quotes.follow(text[:size])
        text = text[size:]
    return quotes


@given(
    st.lists(
        st.lists(st.text('a" ,\n', max_size=9), min_size=2, max_size=4), min_size=1, max_size=12
    ),
    st.lists(st.integers(1, 9), min_size=1, max_size=4),
)
def test_what_a_writer_of_tables_writes_is_closed_wherever_it_is_cut(rows, sizes):
    text = io.StringIO()
    writer(text, lineterminator='\n').writerows(rows)
    quotes = followed(',', text.getvalue(), sizes)
    # One row more, left open, and more than a cell's worth behind it: found in its line.
    line = text.getvalue().count('\n') + 1
    with pytest.raises(RecordingError, match=f'in line {line} '):
        quotes.follow('1,"' + 'a' * LONGEST_CELL)


@given(st.lists(st.integers(1, 5), min_size=1, max_size=4), st.sampled_from(['\n', '\r\n', '\r']))
def test_lines_are_counted_wherever_the_text_is_cut(sizes, end):
    quotes = followed(';', f'a;b{end}1;"x"{end}{end}1;2{end}', sizes)
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
    quotes = followed(';', whole, sizes)
    try:
        quotes.follow('a' * (LONGEST_CELL + len(whole)))
        open_now = False
    except RecordingError:
        open_now = True
    assert open_now != alone
