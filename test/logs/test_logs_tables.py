# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from log_files import START_NS, same_readings, same_tables, wander

from valveflow_ros.errors import InputError, RecordingError
from valveflow_ros.logs import open_log, read_table, write_table
from valveflow_ros.logs.tables.refusal import RefusedError, Remedy
from valveflow_ros.records import SIGNALS, Quality, SampleTable, Signal, table_to_readings

HEADER = ','.join(['time', *(info.column for info in SIGNALS[:4])])
NOON = 1_704_110_400_000_000_000


def csv(folder, *lines, header=HEADER, name='table.csv', encoding='utf-8'):
    path = folder / name
    path.write_text('\n'.join([header, *lines]) + '\n', encoding=encoding)
    return path


def rows(*times):
    return [f'{time},50,16.5,538,{600 + k}' for k, time in enumerate(times)]


def table_of(raw):
    """Rebuild the table a file was written from."""
    columns = {
        info.signal: raw.columns[info.column] for info in SIGNALS if info.column in raw.columns
    }
    quality = {
        info.signal: raw.quality[info.column] for info in SIGNALS if info.column in raw.quality
    }
    return SampleTable.from_columns(raw.time_ns, columns, quality)


@st.composite
def tables(draw):
    n = draw(st.integers(1, 30))
    steps = draw(st.lists(st.integers(1, 10**11), min_size=n, max_size=n))
    start = draw(st.integers(-(10**18), 8 * 10**18))
    unit = draw(st.sampled_from([1, 1000, 10**6, 10**9]))
    time_ns = (start // unit + np.cumsum(np.array(steps, dtype=np.int64) // unit + 1)) * unit
    number = st.floats(width=64, allow_infinity=False)
    columns, quality = {}, {}
    for signal in Signal:
        columns[signal] = np.array(draw(st.lists(number, min_size=n, max_size=n)))
        codes = draw(st.lists(st.integers(0, 2), min_size=n, max_size=n))
        quality[signal] = np.array(codes, dtype=np.uint8)
    return SampleTable.from_columns(time_ns, columns, quality)


@pytest.mark.parametrize('suffix', ['.csv', '.parquet'])
def test_what_is_written_reads_back_to_the_same_bits(tmp_path_factory, suffix):
    @settings(max_examples=60, deadline=None)
    @given(table=tables())
    def check(table):
        path = tmp_path_factory.mktemp('table') / f'table{suffix}'
        write_table(table, path)
        raw = read_table(path)
        assert same_tables(table_of(raw), table)
        assert np.array_equal(np.signbit(table_of(raw).values), np.signbit(table.values))
        assert raw.notes == ()

    check()


@pytest.mark.parametrize('suffix', ['.csv', '.parquet'])
def test_a_negative_zero_among_whole_numbers_keeps_its_sign(tmp_path, suffix):
    values = {signal: np.array([0.0, -0.0, 7.0]) for signal in Signal}
    table = SampleTable.from_columns(START_NS + np.arange(3), values)
    write_table(table, tmp_path / f'table{suffix}')
    found = table_of(read_table(tmp_path / f'table{suffix}')).values
    assert np.array_equal(np.signbit(found), np.signbit(table.values))


@pytest.mark.parametrize('suffix', ['.csv', '.parquet'])
def test_a_table_opens_as_readings(tmp_path, suffix):
    table = wander(200, seed=3, command=True)
    path = tmp_path / f'table{suffix}'
    write_table(table, path)
    contents = open_log(path)
    assert same_readings(contents.readings, table_to_readings(table))
    assert np.array_equal(contents.log_time_ns, contents.readings.time_ns)
    assert contents.signals == {info.signal: info.column for info in SIGNALS}
    assert (contents.start_ns, contents.end_ns) == (table.time_ns[0], table.time_ns[-1])
    assert list(contents.iter_messages()) == []


def test_the_written_csv_is_plain(tmp_path):
    columns = {Signal(k): np.array([0.1, np.nan]) for k in range(4)}
    table = SampleTable.from_columns(np.array([START_NS, START_NS + 10**9]), columns)
    write_table(table, tmp_path / 'table.csv')
    first, second, third = (tmp_path / 'table.csv').read_text().splitlines()
    assert first == HEADER
    assert second == '2023-11-14T22:13:20Z,0.1,0.1,0.1,0.1'
    assert third == '2023-11-14T22:13:21Z,,,,'


def test_a_table_is_written_as_csv_or_parquet(tmp_path):
    with pytest.raises(InputError, match=r"not as 'table\.xlsx'"):
        write_table(wander(3, seed=1), tmp_path / 'table.xlsx')
    (tmp_path / 'file').write_text('')
    with pytest.raises(RecordingError, match='cannot be written'):
        write_table(wander(3, seed=1), tmp_path / 'file' / 'table.csv')


# Times -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ('text', 'offset_ns'),
    [
        ('2024-01-01T12:00:00Z', 0),
        ('2024-01-01T13:00:00+01:00', 0),
        ('2024-01-01 12:00:00', 0),
        ('2024-01-01T12:00:00.123456789Z', 123_456_789),
        ('1704110400', 0),
        ('1704110400.25', 250_000_000),
        ('1704110400500', 500_000_000),
        ('1704110400000250', 250_000),
        ('1704110400000000001', 1),
    ],
)
def test_times_are_understood_to_the_nanosecond(tmp_path, text, offset_ns):
    raw = read_table(csv(tmp_path, *rows(text)))
    assert raw.time_ns.tolist() == [NOON + offset_ns]


@pytest.mark.parametrize(('factor', 'unit'), [(10**3, 'ms'), (10**6, 'us'), (10**9, 'ns')])
def test_a_guess_about_the_unit_of_time_is_told(tmp_path, factor, unit):
    raw = read_table(csv(tmp_path, *rows(NOON // 10**9 * factor)))
    assert raw.notes == (
        f'The numbers in the time column are too large for seconds and were taken as {unit}.',
    )


def test_parquet_stamps_of_any_kind(tmp_path):
    stamps = pd.to_datetime([NOON, NOON + 1], unit='ns')
    for times in (stamps, stamps.tz_localize('Europe/Berlin').tz_convert('UTC'), [0.5, 1.5]):
        frame = pd.DataFrame({'time': times, **{info.column: [1.0, 2.0] for info in SIGNALS[:4]}})
        frame.to_parquet(tmp_path / 'table.parquet')
        raw = read_table(tmp_path / 'table.parquet')
        expected = [5 * 10**8, 15 * 10**8] if isinstance(times, list) else times.astype('int64')
        assert raw.time_ns.tolist() == list(expected)
    frame.set_index('time').to_parquet(tmp_path / 'table.parquet')
    assert read_table(tmp_path / 'table.parquet').time_ns.tolist() == [5 * 10**8, 15 * 10**8]


def test_rows_without_a_time_are_left_out_and_counted(tmp_path):
    times = ['2024-01-01T12:00:00Z', 'soon', '', '9999-12-31T00:00:00Z', '2024-01-01T12:00:01Z']
    raw = read_table(csv(tmp_path, *rows(*times)))
    assert raw.time_ns.tolist() == [NOON, NOON + 10**9]
    assert raw.columns['generated_power_mw'].tolist() == [600.0, 604.0]
    assert raw.bad_times == 3
    assert raw.notes == ('3 rows have no readable time and were left out, the first is row 2.',)


@pytest.mark.parametrize('text', ['never', ''])
def test_a_time_that_could_be_anything_is_not_guessed(tmp_path, text):
    with pytest.raises(InputError, match=r"'time' holds no time; .*--column time=THEIRS"):
        read_table(csv(tmp_path, *rows(text)))


def test_the_order_of_rows(tmp_path):
    newest_first = read_table(csv(tmp_path, *rows(3, 2, 2, 1)))
    assert newest_first.time_ns.tolist() == [10**9, 2 * 10**9, 2 * 10**9, 3 * 10**9]
    assert newest_first.columns['generated_power_mw'].tolist() == [603, 602, 601, 600]
    assert newest_first.notes == ('The rows were newest first; they were sorted.',)
    mixed = read_table(csv(tmp_path, *rows(3, 1, 2, 1)))
    assert mixed.columns['generated_power_mw'].tolist() == [601, 603, 602, 600]
    assert mixed.notes == ('The rows were not in the order of time; they were sorted.',)
    repeated = read_table(csv(tmp_path, *rows(1, 1, 2)))
    assert repeated.columns['generated_power_mw'].tolist() == [600, 601, 602]
    assert repeated.notes == ()


def test_date_and_time_in_two_columns(tmp_path):
    lines = ['2024-01-01,12:00:00,50,16,538,600', '2024-01-01,12:00:01,50,16,538,601']
    header = f'date,{HEADER}'
    raw = read_table(csv(tmp_path, *lines, header=header))
    assert raw.time_ns.tolist() == [NOON, NOON + 10**9]
    header = header.replace('date', 'Day').replace('time', 'Clock')
    raw = read_table(csv(tmp_path, *lines, header=header), {'time': 'Clock', 'date': 'Day'})
    assert raw.time_ns.tolist() == [NOON, NOON + 10**9]


# Cells -----------------------------------------------------------------------------------------


@pytest.mark.parametrize('separator', [',', ';', '\t'])
def test_separators_and_a_mark_of_the_encoding(tmp_path, separator):
    lines = [line.replace(',', separator) for line in rows(1, 2)]
    header = HEADER.replace(',', separator)
    raw = read_table(csv(tmp_path, *lines, header=header, encoding='utf-8-sig'))
    assert raw.columns['main_steam_pressure_mpa'].tolist() == [16.5, 16.5]


def test_a_decimal_comma_beside_semicolons(tmp_path):
    lines = ['1;50,5;16,25;538;600', '2;50.5;"16,25";;-1,5e2', '3;x;1.234,5;538;600']
    raw = read_table(csv(tmp_path, *lines, header=HEADER.replace(',', ';')))
    assert raw.columns['valve_opening_percent'][:2].tolist() == [50.5, 50.5]
    assert raw.columns['generated_power_mw'].tolist() == [600, -150, 600]
    assert np.isnan(raw.columns['main_steam_temperature_degc'][1])
    assert raw.columns['main_steam_pressure_mpa'].tolist() == [16.25, 16.25, 1234.5]
    assert raw.bad_cells == {'valve_opening_percent': 1}


def test_cells_that_are_no_numbers_are_missing_and_told(tmp_path):
    lines = [
        '1,50,16,538,600',
        '2,Bad Input,16,538,600',
        '3,,NaN,n/a,null',
        '4,I/O Timeout,16,538,1e3',
    ]
    raw = read_table(csv(tmp_path, *lines))
    assert np.isnan(raw.columns['valve_opening_percent']).tolist() == [False, True, True, True]
    assert raw.columns['generated_power_mw'][[0, 1, 3]].tolist() == [600, 600, 1000]
    assert raw.bad_cells == {'valve_opening_percent': 2}
    assert raw.notes == (
        "2 cells of 'valve_opening_percent' are no numbers and count as missing; "
        "the first is 'Bad Input' in row 2.",
    )


def test_digits_are_read_to_the_nearest_double(tmp_path):
    generator = np.random.default_rng(5)
    values = generator.normal(size=2000) * 10.0 ** generator.integers(-20, 20, 2000)
    raw = read_table(csv(tmp_path, *(f'{k},{v!r},1,1,1' for k, v in enumerate(values.tolist()))))
    assert np.array_equal(raw.columns['valve_opening_percent'], values)


def test_doubtful_values_keep_their_quality(tmp_path):
    header = f'{HEADER},generated_power_mw_quality'
    lines = [
        f'{line},{code}' for line, code in zip(rows(1, 2, 3, 4), ['0', '1', '2', '7'], strict=True)
    ]
    contents = open_log(csv(tmp_path, *lines, header=header))
    power = contents.readings.signal == Signal.GENERATED_POWER
    assert contents.readings.quality[power].tolist() == [0, 1, Quality.BAD, Quality.BAD]


def test_more_cells_than_columns_are_told(tmp_path):
    raw = read_table(csv(tmp_path, *(line + ',,x' for line in rows(1, 2))))
    assert raw.columns['valve_opening_percent'].tolist() == [50, 50]
    assert 'more cells than the header' in raw.notes[0]


# Columns ---------------------------------------------------------------------------------------


def test_columns_by_other_names(tmp_path):
    path = csv(tmp_path, '1,2,3', header='Zeit,LV_106,FT 115')
    raw = read_table(
        path,
        {'time': 'Zeit', 'valve_opening': 'LV_106', 'generated_power_mw': 'FT 115'},
        absent=['main_steam_pressure', 'main_steam_temperature_degc'],
    )
    assert {name: column.tolist() for name, column in raw.columns.items()} == {
        'valve_opening_percent': [2.0],
        'generated_power_mw': [3.0],
    }
    assert raw.names == {'valve_opening_percent': 'LV_106', 'generated_power_mw': 'FT 115'}


@pytest.mark.parametrize(
    ('columns', 'match'),
    [
        (
            {},
            r'recognised as main_steam_pressure or .*the columns are: time, valve_opening_percent',
        ),
        ({'generated_power': 'P'}, r"no column 'P', no column was recognised as main_steam"),
        ({'time': 'Zeit'}, r'no column|--column time=THEIRS'),
        ({'pressure': 'p'}, r"no signal 'pressure'; there are valve_opening_percent, main"),
    ],
)
def test_a_missing_column_is_one_sentence_with_the_cure(tmp_path, columns, match):
    path = csv(tmp_path, '1,2,3', header='time,valve_opening_percent,power')
    with pytest.raises(InputError, match=match) as caught:
        read_table(path, columns)
    assert '--column' in str(caught.value) or 'there are' in str(caught.value)


def test_the_only_column_in_a_unit_of_a_missing_signal_is_proposed(tmp_path):
    header = 'TIME,10LBA_PT01 [bar],10MAX_ZT01 [%],10LBA_TT01 [C],10MKA_P [MW]'
    path = csv(tmp_path, '2026-01-01 00:00:00,160,80,538,290', header=header)
    with pytest.raises(RefusedError) as caught:
        read_table(path, {})
    assert caught.value.remedies == (Remedy('column', 'generated_power=10MKA_P [MW]'),)
    assert "'10MKA_P [MW]' alone" in str(caught.value)
    # Of two nothing is proposed; what the others were taken for is told.
    path = csv(tmp_path, '2026-01-01 00:00:00,160,80,538,290,3', header=f'{header},20MKA_P [MW]')
    with pytest.raises(InputError, match=r'10LBA_PT01 \[bar\] \(main_steam_pressure\).*THEIRS'):
        read_table(path, {})


def test_the_time_may_be_missing_too(tmp_path):
    path = csv(tmp_path, '1,2,3,4', header=HEADER.partition(',')[2])
    with pytest.raises(
        InputError,
        match=r'no column was recognised as time; .*--column time=THEIRS, or say with --period ',
    ):
        read_table(path)


def test_a_column_that_stands_there_twice_is_not_guessed(tmp_path):
    frame = csv(tmp_path, '1,2', header='time,"a "').read_text().replace('"a "', 'a,a ')
    path = tmp_path / 'twice.csv'
    path.write_text(frame.replace('1,2', '1,2,3'))
    with pytest.raises(InputError, match="several columns called 'a'"):
        read_table(path, {'valve_opening': 'a'}, absent=[i.column for i in SIGNALS[1:]])


def test_every_bad_table_is_one_sentence(tmp_path):
    (tmp_path / 'empty.csv').write_bytes(b'')
    (tmp_path / 'blank.csv').write_bytes(b'\n\n')
    (tmp_path / 'header.csv').write_text(HEADER + '\n')
    (tmp_path / 'binary.csv').write_bytes(bytes(range(256)))
    (tmp_path / 'quote.csv').write_text(f'{HEADER}\n1,"2,3')
    (tmp_path / 'wrong.parquet').write_text('PAR1 and nothing else')
    (tmp_path / 'cut.parquet').write_bytes(b'PAR1' + bytes(100))
    (tmp_path / 'folder.csv').mkdir()
    for path in sorted(tmp_path.iterdir()):
        with pytest.raises((RecordingError, InputError)) as caught:
            open_log(path)
        assert str(caught.value).startswith(str(path))
        assert str(caught.value).endswith('.')
        assert '\n' not in str(caught.value)


def test_pandas_is_loaded_only_for_a_table():
    code = (
        'import sys, json, valveflow_ros.logs; '
        'print(json.dumps([name in sys.modules for name in sys.argv[1:]]))'
    )
    home = str(Path(__file__).parents[2])
    found = subprocess.run(
        [sys.executable, '-c', code, 'pandas', 'pyarrow', 'numba'],
        check=True,
        capture_output=True,
        cwd=home,
    )
    assert json.loads(found.stdout) == [False, False, False]
