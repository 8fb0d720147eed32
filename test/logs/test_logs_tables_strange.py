# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Tables that say what is easily misread, and files that would fill memory or time."""

from __future__ import annotations

import subprocess
import sys
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from valveflow_ros.errors import InputError, RecordingError, ValveflowError
from valveflow_ros.logs import open_log, read_table
from valveflow_ros.logs.tables.cells import foreign_quality
from valveflow_ros.logs.tables.refusal import TableOptions
from valveflow_ros.logs.tables.text import LONGEST_LINE
from valveflow_ros.records import Quality, Signal

HEAD = 'time,valve position,ms pressure [MPa],ms temperature,MW'
ROWS = [f'2026-01-05 12:00:{k:02},50,13,538,{600 + k}' for k in range(20)]


def text_of(path, head=HEAD, rows=ROWS):
    path.write_text('\n'.join([head, *rows]) + '\n')
    return path


def book_of(path):
    openpyxl = pytest.importorskip('openpyxl')
    pytest.importorskip('python_calamine')
    book = openpyxl.Workbook()
    for line in (HEAD, *ROWS):
        book.active.append(line.split(','))
    book.save(path)
    return path


def changed(path, to, end):
    """Write a workbook again with something put at the end of its rows."""
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(to, 'w', zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            head, mark, tail = old.read(name).partition(b'</sheetData>')
            new.writestr(name, head + (end if mark else b'') + mark + tail)
    return to


def qualities(*texts):
    return [Quality(code) for code in foreign_quality(pd.Series(list(texts)))]


@given(st.permutations(['Raw', 'Good', 'Questionable', 'Bad']), st.integers(1, 4))
def test_the_gravest_word_of_quality_counts(words, n):
    alone = qualities(*words[:n])
    assert qualities(', '.join(words[:n])) == [max(alone)]
    assert qualities(' '.join(words[:n])) == [max(alone)]


def test_what_is_not_good_is_bad():
    bad = ('Not Good', 'No Good Data', 'nicht gut', 'NotGood', 'nicht mehr gültig', 'Raw, not ok')
    assert qualities(*bad) == [Quality.BAD] * len(bad)
    good = ('Good, no error', 'Good | not annotated', 'No alarm; Good', 'Good, Non-Specific')
    assert qualities(*good) == [Quality.GOOD] * len(good)


@pytest.mark.parametrize('long', [False, True])
def test_the_column_of_quality_is_named_and_what_is_bad_by_it_counted(tmp_path, long):
    mark = ['Raw, Bad' if k % 10 == 3 else 'Raw, Good' for k in range(20)]
    if long:
        head, rows = 'Tag,Time,Value,Quality', []
        for tag, place in (('CV_POS', 1), ('PT100', 2), ('TT100', 3), ('JT1', 4)):
            cells = [row.split(',') for row in ROWS]
            rows += [f'{tag},{c[0]},{c[place]},"{m if place == 4 else "Good"}"'
                     for c, m in zip(cells, mark, strict=True)]  # fmt: skip
        said = "'JT1' is read from 'Quality', by which 2 of its values are bad."
    else:
        head = f'{HEAD},MW Quality'
        rows = [f'{row},"{m}"' for row, m in zip(ROWS, mark, strict=True)]
        said = "'MW' is read from 'MW Quality', by which 2 of its values are bad."
    path = text_of(tmp_path / 'x.csv', head, rows)
    assert any(note.endswith(said) for note in read_table(path).notes)
    readings = open_log(path).readings
    power = readings.value[readings.signal == Signal.GENERATED_POWER]
    assert np.flatnonzero(np.isnan(power)).tolist() == [3, 13]


@pytest.mark.parametrize('name', ['Sample Date/Time', 'PI Date/Time', 'Date/Time'])
def test_date_and_time_parted_by_a_slash_are_no_zone(tmp_path, name):
    plain = read_table(text_of(tmp_path / 'x.csv')).time_ns
    odd = read_table(text_of(tmp_path / 'y.csv', HEAD.replace('time', name, 1))).time_ns
    assert odd.tolist() == plain.tolist()
    zoned = HEAD.replace('time', 'Time (Europe/Berlin)', 1)
    berlin = read_table(text_of(tmp_path / 'z.csv', zoned)).time_ns
    assert set((plain - berlin).tolist()) == {3600 * 10**9}


@pytest.mark.parametrize('date', ['%Y-%m-%d %H:%M:%S', '%Y-%m-%dT%H:%M', '%d.%m.%Y %H:%M:%S'])
@pytest.mark.parametrize(('offset', 'hours'), [('+01', 1), ('-05', -5), ('+0530', 5.5)])
def test_an_offset_of_whole_hours_is_one(tmp_path, date, offset, hours):
    days = pd.date_range('2026-01-05 12:00', periods=20, freq='h')
    rows = [f'{day.strftime(date)}{offset},50,13,538,600' for day in days]
    found = read_table(text_of(tmp_path / 'x.csv', rows=rows)).time_ns
    utc = days - pd.Timedelta(hours=hours)
    assert found.tolist() == utc.to_numpy().astype('datetime64[ns]').astype(int).tolist()


@pytest.mark.parametrize('date', ['%Y-%m-%d', '%d-%m-%Y', '%Y-%m-%d %H:%M'])
def test_the_end_of_a_date_is_no_offset(tmp_path, date):
    days = pd.date_range('2026-01-05', periods=20, freq='D')
    rows = [f'{day.strftime(date)},50,13,538,600' for day in days]
    found = read_table(text_of(tmp_path / 'x.csv', rows=rows)).time_ns
    assert found.tolist() == days.to_numpy().astype('datetime64[ns]').astype(int).tolist()


def test_a_row_that_no_sheet_has_ends_the_reading(tmp_path):
    path = book_of(tmp_path / 'x.xlsx')
    row = '<row r="{0}"><c r="A{0}" t="n"><v>1</v></c></row>'
    far = changed(path, tmp_path / 'far.xlsx', row.format(2_000_000_000).encode())
    with pytest.raises(RecordingError, match='more than the 1048576 rows'):
        read_table(far)
    # What comes after the size that the sheet tells is read as well.
    near = read_table(changed(path, tmp_path / 'near.xlsx', row.format(30_000).encode()))
    assert len(near.time_ns) == len(read_table(path).time_ns)
    assert near.bad_times == 1


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 10**6), st.integers(32, 126)), min_size=1, max_size=6))
def test_a_damaged_workbook_is_read_or_is_one_sentence(tmp_path_factory, hits):
    folder = tmp_path_factory.mktemp('damaged')
    with zipfile.ZipFile(book_of(folder / 'x.xlsx')) as old:
        parts = {name: bytearray(old.read(name)) for name in old.namelist()}
    with zipfile.ZipFile(folder / 'y.xlsx', 'w') as new:
        for name, data in parts.items():
            for place, letter in hits if name.startswith('xl/wor') else ():
                data[place % len(data)] = letter
            new.writestr(name, bytes(data))
    try:
        assert len(read_table(folder / 'y.xlsx').time_ns) <= len(ROWS)
    except ValveflowError as error:
        assert '\n' not in str(error)


def test_a_sheet_of_two_cells_far_apart_is_refused(tmp_path):
    path = book_of(tmp_path / 'x.xlsx')
    cells = b'<row r="900000"><c r="XFD900000" t="n"><v>1</v></c></row>'
    with pytest.raises(RecordingError, match='900000 rows and 16384 columns, most of them empty'):
        read_table(changed(path, tmp_path / 'far.xlsx', cells))


def test_a_workbook_that_unpacks_beyond_measure_is_refused(tmp_path):
    path = book_of(tmp_path / 'x.xlsx')
    cell = (
        b'<row r="30"><c r="A30" t="inlineStr"><is><t>'
        + b'x' * (80 << 20)
        + b'</t></is></c></row>'
    )
    bomb = changed(path, tmp_path / 'bomb.xlsx', cell)
    assert bomb.stat().st_size < 1 << 20
    del cell
    tracemalloc.start()
    with pytest.raises(RecordingError, match=r'unpacks to 84 MB.*save the sheet as CSV'):
        read_table(bomb)
    assert tracemalloc.get_traced_memory()[1] < 32 << 20
    tracemalloc.stop()


@pytest.mark.parametrize('encoding', ['utf-8', 'utf-16'])
def test_a_line_without_end_is_refused(tmp_path, encoding):
    def written(length):
        row = '2026-01-05 12:01:00,50,13,538,'
        path = text_of(tmp_path / 'x.csv', rows=[*ROWS * 500, row + '6' * (length - len(row))])
        path.write_bytes(path.read_text().encode(encoding))
        return path

    assert read_table(written(LONGEST_LINE)).bad_times == 0
    with pytest.raises(RecordingError, match='a line of more than 1048576 letters'):
        read_table(written(LONGEST_LINE + 1))
    with pytest.raises(RecordingError, match='a line of more than 1048576 letters'):
        read_table(written(9 * LONGEST_LINE))


_SPREADSHEET = 'http://schemas.openxmlformats.org/spreadsheetml/2006/main'
_OFFICE = 'http://schemas.openxmlformats.org/officeDocument/2006/relationships'
_PACKAGE = 'http://schemas.openxmlformats.org/package/2006'
_TEXT_CELLS = ''.join(
    f'<row r="{k}"><c r="A{k}" t="s"><v>0</v></c></row>' for k in range(1, 150_001)
)


def _workbook(path: Path, rows: str, texts: str = '') -> Path:
    """Write the parts of a workbook as they are given."""
    pytest.importorskip('python_calamine')
    sheet = f'<worksheet xmlns="{_SPREADSHEET}"><sheetData>{rows}</sheetData></worksheet>'
    parts = {
        '[Content_Types].xml': f'<Types xmlns="{_PACKAGE}/content-types">'
        '<Default Extension="xml" ContentType="application/xml"/></Types>',
        '_rels/.rels': f'<Relationships xmlns="{_PACKAGE}/relationships"><Relationship Id="r1" '
        f'Type="{_OFFICE}/officeDocument" Target="xl/workbook.xml"/></Relationships>',
        'xl/workbook.xml': f'<workbook xmlns="{_SPREADSHEET}" xmlns:r="{_OFFICE}"><sheets>'
        '<sheet name="S" sheetId="1" r:id="r1"/></sheets></workbook>',
        'xl/_rels/workbook.xml.rels': f'<Relationships xmlns="{_PACKAGE}/relationships">'
        f'<Relationship Id="r1" Type="{_OFFICE}/worksheet" Target="worksheets/sheet1.xml"/>'
        f'<Relationship Id="r2" Type="{_OFFICE}/sharedStrings" Target="sharedStrings.xml"/>'
        '</Relationships>',
        'xl/worksheets/sheet1.xml': sheet,
        'xl/sharedStrings.xml': f'<sst xmlns="{_SPREADSHEET}">{texts}</sst>',
    }
    with zipfile.ZipFile(path, 'w', zipfile.ZIP_DEFLATED) as archive:
        for name, content in parts.items():
            archive.writestr(name, content)
    return path


@pytest.mark.parametrize(
    ('rows', 'texts', 'sentence'),
    [
        (
            f'<row r="1">{"<c/>" * 4000}</row><row r="1048576"><c/></row>', '',
            '1048576 rows and 4000 columns, most of them empty',
        ),
        (f'{"<row><c/></row>" * 3000}<row><c r="XFD1"/></row>', '', '3001 rows and 16384 columns'),
        (_TEXT_CELLS[:20_000], f'<si><t>{"x" * (1 << 20)}</t></si>', 'texts too long'),
        (_TEXT_CELLS, f'<si><t>{"x" * 30_000}</t></si>', 'texts too long'),
    ],
    ids=['cells without a place', 'rows without a place', 'a text too long', 'a text too often'],
)  # fmt: skip
def test_a_small_workbook_that_would_fill_the_memory_is_refused(rows, texts, sentence, tmp_path):
    with pytest.raises(RecordingError, match=sentence):
        open_log(_workbook(tmp_path / 'bomb.xlsx', rows, texts))


WIDE = ('time', 'valve_opening_percent', 'main_steam_pressure_mpa', 'main_steam_temperature_degc',
        'generated_power_mw')  # fmt: skip
LONG = ('Tag', 'Time', 'Value', 'Quality')
# Opens a table, says why not, and how much memory that took in MB.
OPEN = """
import resource, sys
from valveflow_ros.errors import ValveflowError
import valveflow_ros as vf
try:
    vf.open_log(sys.argv[1])
    print('read')
except ValveflowError as error:
    print(str(error).replace(chr(10), ' '))
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024)
"""


def opened(path):
    done = subprocess.run(
        [sys.executable, '-c', OPEN, str(path)], capture_output=True, text=True, check=True
    )
    *said, peak = done.stdout.strip().splitlines()
    return said[-1], int(peak)


def repeated(path, names, n):
    """Write a Parquet file in which one row stands n times; text in columns named as such."""
    pa = pytest.importorskip('pyarrow')
    from pyarrow import parquet

    place = pa.array(np.zeros(n, dtype=np.int32))
    one = {name: ['CV_POS' if name == 'Tag' else 'Good' if name == 'Quality' else 1.0]
           for name in names}  # fmt: skip
    parquet.write_table(pa.table(one).take(place), path, row_group_size=n, compression='zstd')
    return path


@pytest.mark.parametrize(
    ('names', 'why'),
    [
        (('a', 'b', 'c', 'time'), 'no column was recognised as valve_opening'),
        (('a', 'b'), 'no column was recognised as valve_opening'),
        (WIDE, 'has 20000000 rows that unpack to 800 MB'),
        (LONG, 'has 20000000 rows that unpack to'),
    ],
)
def test_a_small_parquet_of_many_rows_costs_what_one_of_few_rows_does(tmp_path, names, why):
    bomb = repeated(tmp_path / 'bomb.parquet', names, 20_000_000)
    assert bomb.stat().st_size < 500_000
    said, peak = opened(bomb)
    assert why in said
    assert peak < opened(repeated(tmp_path / 'few.parquet', names, 100))[1] + 100


@pytest.mark.parametrize('names', [('a', 'time'), WIDE])
def test_a_parquet_of_one_page_costs_what_one_of_few_rows_does(tmp_path, names):
    pa = pytest.importorskip('pyarrow')
    from pyarrow import parquet

    def written(path, n):
        parquet.write_table(
            pa.table({name: np.zeros(n) for name in names}), path, row_group_size=n,
            compression='zstd', use_dictionary=False, data_page_size=1 << 30, write_batch_size=n,
            max_rows_per_page=n,
        )  # fmt: skip
        return path

    bomb = written(tmp_path / 'bomb.parquet', 30_000_000)
    assert bomb.stat().st_size < 1_000_000
    peak = opened(bomb)[1]
    assert peak < opened(written(tmp_path / 'few.parquet', 100))[1] + 100


def test_the_limit_of_what_is_unpacked_can_be_raised(tmp_path):
    path = repeated(tmp_path / 'x.parquet', WIDE, 2_000_000)
    with pytest.raises(RecordingError, match='add --max-unpacked 80') as refused:
        read_table(path)
    enough = str(refused.value).rstrip('.').rpartition(' ')[2]
    assert len(read_table(path, options=TableOptions(max_unpacked=enough)).time_ns) == 2_000_000
    book = book_of(tmp_path / 'x.xlsx')
    with pytest.raises(RecordingError, match='add --max-unpacked 1'):
        read_table(book, options=TableOptions(max_unpacked='0.001'))
    same = read_table(book, options=TableOptions(max_unpacked='1')).time_ns
    assert same.tolist() == read_table(book).time_ns.tolist()
    for wrong in ('0', '-1', 'nan', 'inf', 'much'):
        with pytest.raises(ValveflowError, match='must be a number of megabytes'):
            TableOptions(max_unpacked=wrong)


def test_columns_of_lists_or_of_endless_texts_are_refused_only_where_they_are_needed(tmp_path):
    pa = pytest.importorskip('pyarrow')
    from pyarrow import parquet

    rows, path = 100, tmp_path / 'x.parquet'
    plain = {name: np.arange(1.0, rows + 1) for name in WIDE}
    text = pa.array(['9' * 1_000_000]).take(pa.array(np.zeros(rows, dtype=np.int32)))
    lists = [[1.0, 2.0]] * rows
    structures = [{'value': 1.0}] * rows
    parquet.write_table(pa.table(plain), path)
    expected = read_table(path).columns
    for strange, why in ((text, 'texts too long'), (lists, 'list<'), (structures, 'struct<')):
        parquet.write_table(pa.table({**plain, 'remark': strange}), path)
        found = read_table(path).columns
        assert all((found[name] == expected[name]).all() for name in expected)
        parquet.write_table(pa.table({**plain, WIDE[1]: strange}), path)
        with pytest.raises(RecordingError, match=why):
            read_table(path)


def test_cells_of_a_parquet_mean_the_same_as_numbers_as_texts_and_as_categories(tmp_path):
    frame = pd.DataFrame({name: np.arange(1.0, 60.0) for name in WIDE})
    kinds = (float, str, 'category')
    found = []
    for kind in kinds:
        frame.astype(dict.fromkeys(WIDE[1:], kind)).to_parquet(tmp_path / 'x.parquet')
        found.append(read_table(tmp_path / 'x.parquet'))
    for other in found[1:]:
        assert other.time_ns.tolist() == found[0].time_ns.tolist()
        assert all((other.columns[n] == found[0].columns[n]).all() for n in found[0].columns)


@pytest.mark.parametrize('column', [*WIDE, 'date', 'valve_opening_quality'])
def test_a_needed_column_that_a_parquet_has_twice_is_named(tmp_path, column):
    pa = pytest.importorskip('pyarrow')
    from pyarrow import parquet

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


@pytest.mark.parametrize('name', ['x.csv', 'x.csv.gz', 'x.parquet', 'x.feather'])
def test_packed_texts_are_not_unpacked(tmp_path, name):
    import gzip

    (tmp_path / name).write_bytes(gzip.compress(text_of(tmp_path / 'plain.csv').read_bytes()))
    with pytest.raises(RecordingError, match='is neither'):
        open_log(tmp_path / name)
