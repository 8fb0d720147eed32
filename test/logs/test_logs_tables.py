# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Tables of our own and of historians: what is written is read, what is unclear is refused."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from log_files import START_NS, same_arrays, wander
from table_files import csv, timed

from valveflow_ros.errors import InputError, RecordingError
from valveflow_ros.logs import open_log, read_table, write_table
from valveflow_ros.logs.tables.refusal import RefusedError, Remedy
from valveflow_ros.logs.tables.words import of_gauge, spelling
from valveflow_ros.records import SIGNALS, Quality, SampleTable, Signal, table_to_readings

COLUMNS = [info.column for info in SIGNALS[:4]]
HEADER = ','.join(['time', *COLUMNS])
OPENING, PRESSURE, TEMPERATURE, POWER = COLUMNS
NOON = 1_704_110_400_000_000_000
SECOND = 10**9


def read(folder, *rows, head=HEADER, **more):
    return read_table(csv(folder, rows, head), **more)


def table_of(raw):
    """Rebuild the table a file was written from."""
    parts = [
        {info.signal: found[info.column] for info in SIGNALS if info.column in found}
        for found in (raw.columns, raw.quality)
    ]
    return SampleTable.from_columns(raw.time_ns, *parts)


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
def test_what_is_written_reads_back_to_the_same_bits(tmp_path, suffix):
    path = tmp_path / f'table{suffix}'

    def check(table):
        write_table(table, path)
        raw = read_table(path)
        assert same_arrays(table_of(raw), table)
        assert np.array_equal(np.signbit(table_of(raw).values), np.signbit(table.values))
        assert raw.notes == ()

    settings(max_examples=30)(given(table=tables())(check))()
    zeros = np.array([0.0, -0.0, 7.0])
    check(SampleTable.from_columns(START_NS + np.arange(3), dict.fromkeys(Signal, zeros)))


@pytest.mark.parametrize('suffix', ['.csv', '.parquet'])
def test_a_table_opens_as_readings(tmp_path, suffix):
    table, path = wander(200, seed=3, command=True), tmp_path / f'table{suffix}'
    write_table(table, path)
    contents = open_log(path)
    assert same_arrays(contents.readings, table_to_readings(table))
    assert np.array_equal(contents.log_time_ns, contents.readings.time_ns)
    assert contents.signals == {info.signal: info.column for info in SIGNALS}
    assert (contents.start_ns, contents.end_ns) == (table.time_ns[0], table.time_ns[-1])
    assert list(contents.iter_messages()) == []


def test_the_written_csv_is_plain(tmp_path):
    columns = {Signal(k): np.array([0.1, np.nan]) for k in range(4)}
    table = SampleTable.from_columns(np.array([START_NS, START_NS + SECOND]), columns)
    write_table(table, tmp_path / 'table.csv')
    lines = (tmp_path / 'table.csv').read_text().splitlines()
    rows = ['2023-11-14T22:13:20Z,0.1,0.1,0.1,0.1', '2023-11-14T22:13:21Z,,,,']
    assert lines == [HEADER, *rows]


def test_a_table_is_written_as_csv_or_parquet(tmp_path):
    with pytest.raises(InputError, match=r"not as 'table\.xlsx'"):
        write_table(wander(3, seed=1), tmp_path / 'table.xlsx')
    (tmp_path / 'file').write_text('')
    with pytest.raises(RecordingError, match='cannot be written'):
        write_table(wander(3, seed=1), tmp_path / 'file' / 'table.csv')


# Times -----------------------------------------------------------------------------------------

LARGE = 'The numbers in the time column are too large for seconds and were taken as {}.'


def test_times_are_understood_to_the_nanosecond(tmp_path):
    for text, offset_ns, unit in (
        ('2024-01-01T12:00:00Z', 0, ''),
        ('2024-01-01T13:00:00+01:00', 0, ''),
        ('2024-01-01 12:00:00', 0, ''),
        ('2024-01-01T12:00:00.123456789Z', 123_456_789, ''),
        ('1704110400', 0, ''),
        ('1704110400.25', 250_000_000, ''),
        ('1704110400500', 500_000_000, 'ms'),
        ('1704110400000250', 250_000, 'us'),
        ('1704110400000000001', 1, 'ns'),
    ):
        raw = read(tmp_path, *timed(text))
        assert raw.time_ns.tolist() == [NOON + offset_ns], text
        assert raw.notes == ((LARGE.format(unit),) if unit else ()), text


def test_parquet_stamps_of_any_kind(tmp_path):
    stamps = pd.to_datetime([NOON, NOON + 1], unit='ns')
    for times in (stamps, stamps.tz_localize('Europe/Berlin').tz_convert('UTC'), [0.5, 1.5]):
        frame = pd.DataFrame({'time': times, **{column: [1.0, 2.0] for column in COLUMNS}})
        frame.to_parquet(tmp_path / 'table.parquet')
        raw = read_table(tmp_path / 'table.parquet')
        expected = [5 * 10**8, 15 * 10**8] if isinstance(times, list) else times.astype('int64')
        assert raw.time_ns.tolist() == list(expected)
    frame.set_index('time').to_parquet(tmp_path / 'table.parquet')
    assert read_table(tmp_path / 'table.parquet').time_ns.tolist() == [5 * 10**8, 15 * 10**8]


def test_rows_without_a_time_are_left_out_and_counted(tmp_path):
    times = ['2024-01-01T12:00:00Z', 'soon', '', '9999-12-31T00:00:00Z', '2024-01-01T12:00:01Z']
    raw = read(tmp_path, *timed(*times))
    assert raw.time_ns.tolist() == [NOON, NOON + SECOND]
    assert raw.columns[POWER].tolist() == [600.0, 604.0]
    assert raw.bad_times == 3
    assert raw.notes == ('3 rows have no readable time and were left out, the first is row 2.',)


def test_a_time_that_could_be_anything_is_not_guessed(tmp_path):
    for text in ('never', ''):
        with pytest.raises(InputError, match=r"'time' holds no time; .*--column time=THEIRS"):
            read(tmp_path, *timed(text))


def test_rows_are_sorted_by_time_and_that_is_said(tmp_path):
    for times, powers, kind in (
        ((3, 2, 2, 1), [603, 602, 601, 600], 'newest first'),
        ((3, 1, 2, 1), [601, 603, 602, 600], 'not in the order of time'),
        ((1, 1, 2), [600, 601, 602], ''),
    ):
        raw = read(tmp_path, *timed(*times))
        assert raw.time_ns.tolist() == [SECOND * time for time in sorted(times)]
        assert raw.columns[POWER].tolist() == powers
        assert raw.notes == ((f'The rows were {kind}; they were sorted.',) if kind else ())


def test_date_and_time_in_two_columns(tmp_path):
    lines = ['2024-01-01,12:00:00,50,16,538,600', '2024-01-01,12:00:01,50,16,538,601']
    own, theirs = f'date,{HEADER}', f'Day,{HEADER.replace("time", "Clock")}'
    for head, named in ((own, {}), (theirs, {'time': 'Clock', 'date': 'Day'})):
        found = read(tmp_path, *lines, head=head, columns=named)
        assert found.time_ns.tolist() == [NOON, NOON + SECOND]


# Cells -----------------------------------------------------------------------------------------


def test_a_decimal_comma_beside_semicolons(tmp_path):
    lines = ['1;50,5;16,25;538;600', '2;50.5;"16,25";;-1,5e2', '3;x;1.234,5;538;600']
    raw = read(tmp_path, *lines, head=HEADER.replace(',', ';'))
    assert raw.columns[OPENING][:2].tolist() == [50.5, 50.5]
    assert raw.columns[POWER].tolist() == [600, -150, 600]
    assert np.isnan(raw.columns[TEMPERATURE][1])
    assert raw.columns[PRESSURE].tolist() == [16.25, 16.25, 1234.5]
    assert raw.bad_cells == {OPENING: 1}


def test_cells_that_are_no_numbers_are_missing_and_told(tmp_path):
    lines = ['1,50,16,538,600', '2,Bad Input,16,538,600', '3,,NaN,n/a,null',
             '4,I/O Timeout,16,538,1e3']  # fmt: skip
    raw = read(tmp_path, *lines)
    assert np.isnan(raw.columns[OPENING]).tolist() == [False, True, True, True]
    assert raw.columns[POWER][[0, 1, 3]].tolist() == [600, 600, 1000]
    assert raw.bad_cells == {OPENING: 2}
    assert raw.notes == (
        "2 cells of 'valve_opening_percent' are no numbers and count as missing; "
        "the first is 'Bad Input' in row 2.",
    )


def test_doubtful_values_keep_their_quality(tmp_path):
    lines = [f'{line},{code}' for line, code in zip(timed(1, 2, 3, 4), '0127', strict=True)]
    contents = open_log(csv(tmp_path, lines, f'{HEADER},generated_power_mw_quality'))
    power = contents.readings.signal == Signal.GENERATED_POWER
    assert contents.readings.quality[power].tolist() == [0, 1, Quality.BAD, Quality.BAD]


def test_more_cells_than_columns_are_told(tmp_path):
    raw = read(tmp_path, *(line + ',,x' for line in timed(1, 2)))
    assert raw.columns[OPENING].tolist() == [50, 50]
    assert 'more cells than the header' in raw.notes[0]


# Columns ---------------------------------------------------------------------------------------


def test_columns_by_other_names(tmp_path):
    named = {'time': 'Zeit', 'valve_opening': 'LV_106', 'generated_power_mw': 'FT 115'}
    spared = ['main_steam_pressure', 'main_steam_temperature_degc']
    raw = read(tmp_path, '1,2,3', head='Zeit,LV_106,FT 115', columns=named, absent=spared)
    found = {name: column.tolist() for name, column in raw.columns.items()}
    assert found == {OPENING: [2.0], POWER: [3.0]}
    assert raw.names == {OPENING: 'LV_106', POWER: 'FT 115'}


def test_a_missing_or_ambiguous_column_is_one_sentence_with_the_cure(tmp_path):
    few = 'time,valve_opening_percent,power'
    for head, columns, said in (
        (few, {}, r'recognised as main_steam_pressure.* or .*the columns are: time, '
                  r'valve_opening_percent.* --column'),
        (few, {'generated_power': 'P'},
         r"no column 'P', no column was recognised as main_steam.* --column"),
        (few, {'time': 'Zeit'}, r"no column 'Zeit'.*--column time=THEIRS"),
        (few, {'pressure': 'p'}, r"no signal 'pressure'; there are valve_opening_percent, main"),
        (HEADER.partition(',')[2], {},
         'no column was recognised as time; .*--column time=THEIRS, or say with --period '),
        ('time,a,a ', {'valve_opening': 'a'}, "several columns called 'a'"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=said):
            read(tmp_path, '1,2,3,4'[: head.count(',') * 2 + 1], head=head, columns=columns)


def test_the_only_column_in_a_unit_of_a_missing_signal_is_proposed(tmp_path):
    head = 'TIME,10LBA_PT01 [bar],10MAX_ZT01 [%],10LBA_TT01 [C],10MKA_P [MW]'
    with pytest.raises(RefusedError) as caught:
        read(tmp_path, '2026-01-01 00:00:00,160,80,538,290', head=head)
    assert caught.value.remedies == (Remedy('column', 'generated_power=10MKA_P [MW]'),)
    assert "'10MKA_P [MW]' alone" in str(caught.value)
    # Of two nothing is proposed; what the others were taken for is told.
    with pytest.raises(InputError, match=r'10LBA_PT01 \[bar\] \(main_steam_pressure\).*THEIRS'):
        read(tmp_path, '2026-01-01 00:00:00,160,80,538,290,3', head=f'{head},20MKA_P [MW]')


def test_a_gauge_is_known_by_the_words_beside_its_unit():
    for told, unit, expected in (
        ('Frischdampfdruck (Überdruck)', 'bar', 'barg'),
        ('Main steam pressure gauge', 'MPa', 'MPag'),
        ('main_steam_pressure_gauge_bar', 'bar', 'barg'),
        ('Druck rel.', 'kPa', 'kPag'),
        ('Frischdampfdruck (Ü)', 'bar', 'barg'),
        ('steam gage pressure', 'psi', 'psig'),
        ('Frischdampfdruck', 'bar', 'bar'),
        ('Frischdampfdruck relativ', 'bara', 'bar'),
        ('pressure, gauge range, absolute', 'bar', 'bar'),
        ('Brennstoffdruck Brüden', 'bar', 'bar'),
        ('Dampfdruck Ü', 'barg', 'barg'),
        ('Temperatur rel.', '°C', 'degC'),
    ):
        found = of_gauge(spelling(unit), told)
        assert (found.unit, found.written) == (expected, unit), told


def test_every_bad_table_is_one_sentence(tmp_path):
    (tmp_path / 'folder.csv').mkdir()
    for name, content in {
        'empty.csv': b'',
        'blank.csv': b'\n\n',
        'header.csv': HEADER.encode() + b'\n',
        'binary.csv': bytes(range(256)),
        'quote.csv': f'{HEADER}\n1,"2,3'.encode(),
        'wrong.parquet': b'PAR1 and nothing else',
        'cut.parquet': b'PAR1' + bytes(100),
    }.items():
        (tmp_path / name).write_bytes(content)
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
    command = [sys.executable, '-c', code, 'pandas', 'pyarrow', 'numba']
    home = Path(__file__).parents[2]
    found = subprocess.run(command, check=True, capture_output=True, cwd=home)
    assert json.loads(found.stdout) == [False, False, False]
