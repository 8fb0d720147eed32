# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""One plant, exported in every way: the same values must come of it."""

from __future__ import annotations

import datetime as dt
import os
import subprocess
import sys
import zoneinfo

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from log_files import wander

from valveflow_ros.errors import InputError, RecordingError
from valveflow_ros.logs import open_log, read_table, write_table
from valveflow_ros.logs.tables import file
from valveflow_ros.logs.tables.refusal import TableOptions
from valveflow_ros.records import SIGNALS, Signal

START = dt.datetime(2026, 11, 22, 14, 5, 0)
N = 40
# As a plant would write them, in %, MPa, degC and MW.
VALUES = {
    Signal.VALVE_OPENING: np.round(60 + 20 * np.sin(np.arange(N) / 5), 2),
    Signal.MAIN_STEAM_PRESSURE: np.round(13 + np.sin(np.arange(N) / 7), 3),
    Signal.MAIN_STEAM_TEMPERATURE: np.round(538 + np.cos(np.arange(N)), 1),
    Signal.GENERATED_POWER: np.round(1230 + 300 * np.sin(np.arange(N) / 5), 1),
}
NAMES = {
    'english': ('Timestamp', 'Valve position', 'Main steam pressure', 'Main steam temperature',
                'Generator output'),
    'german': ('Zeitstempel', 'Ventilstellung', 'Frischdampfdruck', 'Frischdampftemperatur',
               'Wirkleistung'),
    'tags': ('time', 'U1.CV_POS', 'PT-100', 'TT_101', 'JT1'),
    'short': ('Zeit', 'HD Ventilhub', 'p_FD', 'T_FD', 'Leistung'),
}  # fmt: skip
UNITS = ('%', 'MPa', 'degC', 'MW')
DATES = {
    'iso': '%Y-%m-%d %H:%M:%S',
    'iso_t': '%Y-%m-%dT%H:%M:%SZ',
    'dots': '%d.%m.%Y %H:%M:%S',
    'us': '%m/%d/%Y %I:%M:%S %p',
    'slashes': '%Y/%m/%d %H:%M:%S',
    'pi': '%d-%b-%y %H:%M:%S',
    'short': '%d.%m.%y %H:%M:%S',
}


def stamps(step_s=10):
    return [START + dt.timedelta(seconds=step_s * k) for k in range(N)]


def expected_ns(step_s=10):
    first = int(START.replace(tzinfo=dt.timezone.utc).timestamp())
    return (first + step_s * np.arange(N)) * 10**9


def cell(value, decimal, thousands=''):
    text = f'{value:,.3f}'.replace(',', '\0').replace('.', decimal).replace('\0', thousands)
    return f'"{text}"' if ',' in text and thousands == ',' else text


def write(path, *, names='english', units='header', date='iso', separator=',', decimal='.',
          thousands='', encoding='utf-8', preamble=0, reverse=False):  # fmt: skip
    head = list(NAMES[names])
    if units == 'header':
        head[1:] = [f'{name} [{unit}]' for name, unit in zip(head[1:], UNITS, strict=True)]
    lines = [f'Export {k} of unit 3' for k in range(preamble)] + [separator.join(head)]
    if units == 'row':
        lines.append(separator.join(['', *UNITS]))
    rows = [
        separator.join([t.strftime(DATES[date]),
                        *(cell(v[k], decimal, thousands) for v in VALUES.values())])
        for k, t in enumerate(stamps())
    ]  # fmt: skip
    text = '\r\n'.join([*lines, *(reversed(rows) if reverse else rows)]) + '\r\n'
    path.write_bytes(text.encode(encoding))
    return path


def check(raw):
    assert raw.time_ns.tolist() == expected_ns().tolist()
    for info in SIGNALS[:4]:
        assert np.allclose(raw.columns[info.column], VALUES[info.signal], rtol=0, atol=6e-4)
    assert not raw.bad_cells
    assert raw.bad_times == 0


@settings(max_examples=60, deadline=None)
@given(
    names=st.sampled_from(list(NAMES)),
    units=st.sampled_from(['header', 'row', 'none']),
    date=st.sampled_from(list(DATES)),
    style=st.sampled_from([(',', '.', ''), (';', ',', ''), ('\t', ',', ''), ('\t', '.', ''),
                           (',', '.', ','), (';', ',', '.'), ('|', '.', ''), (';', '.', '')]),
    encoding=st.sampled_from(['utf-8', 'utf-8-sig', 'utf-16', 'cp1252']),
    preamble=st.integers(0, 3),
    reverse=st.booleans(),
)  # fmt: skip
def test_any_dialect_gives_the_same_values(tmp_path_factory, names, units, date, style, encoding,
                                           preamble, reverse):  # fmt: skip
    separator, decimal, thousands = style
    path = write(
        tmp_path_factory.mktemp('t') / 'x.csv', names=names, units=units, date=date,
        separator=separator, decimal=decimal, thousands=thousands, encoding=encoding,
        preamble=preamble, reverse=reverse,
    )  # fmt: skip
    check(read_table(path))


@pytest.mark.parametrize('block', [1, 7, 39, 40, 41])
def test_the_size_of_the_blocks_changes_nothing(tmp_path, monkeypatch, block):
    path = write(tmp_path / 'x.csv', names='german', separator=';', decimal=',', date='dots')
    path.write_text(path.read_text().replace('538,', 'Bad', 3))
    whole = read_table(path)
    monkeypatch.setattr(file, 'BLOCK_ROWS', block)
    parts = read_table(path)
    assert parts.notes == whole.notes
    assert parts.bad_cells == whole.bad_cells
    assert np.array_equal(parts.time_ns, whole.time_ns)
    for name, column in whole.columns.items():
        assert np.array_equal(column, parts.columns[name], equal_nan=True)


def test_a_workbook_and_a_parquet_file_give_the_same_values(tmp_path):
    openpyxl = pytest.importorskip('openpyxl')
    pytest.importorskip('pyarrow')
    pytest.importorskip('python_calamine')
    book = openpyxl.Workbook()
    sheet = book.active
    sheet.append(['Export of unit 3'])
    sheet.append([])
    sheet.append(list(NAMES['german']))
    sheet.append([None, *UNITS])
    columns = [v.tolist() for v in VALUES.values()]
    for time, *row in zip(stamps(), *columns, strict=True):
        sheet.append([time, *row])
    book.save(tmp_path / 'x.xlsx')
    check(read_table(tmp_path / 'x.xlsx'))
    book.create_sheet('Other').append([1, 2])
    book['Other'].append([3, 4])
    book.save(tmp_path / 'two.xlsx')
    with pytest.raises(InputError, match=r"'Sheet' and 'Other'; choose with --sheet Sheet"):
        read_table(tmp_path / 'two.xlsx')
    check(read_table(tmp_path / 'two.xlsx', options=TableOptions(sheet='Sheet')))
    with pytest.raises(InputError, match="no sheet 'None'"):
        read_table(tmp_path / 'two.xlsx', options=TableOptions(sheet='None'))
    frame = pd.DataFrame(dict(zip(NAMES['english'], [stamps(), *columns], strict=True)))
    frame.to_parquet(tmp_path / 'x.parquet')
    check(read_table(tmp_path / 'x.parquet'))


def test_without_the_library_of_a_format_it_says_what_to_install(tmp_path, monkeypatch):
    for library in ('python_calamine', 'pyarrow'):
        monkeypatch.setitem(sys.modules, library, None)
    (tmp_path / 'x.xlsx').write_bytes(b'PK\x03\x04')
    (tmp_path / 'x.parquet').write_bytes(b'PAR1')
    with pytest.raises(RecordingError, match='pip install python-calamine'):
        read_table(tmp_path / 'x.xlsx')
    with pytest.raises(RecordingError, match='pip install pyarrow'):
        read_table(tmp_path / 'x.parquet')
    with pytest.raises(RecordingError, match='pip install pyarrow'):
        write_table(wander(9, seed=1), tmp_path / 'y.parquet')
    assert not (tmp_path / 'y.parquet').exists()


def test_a_pyarrow_that_refuses_this_numpy_is_told(tmp_path, monkeypatch):
    """As 26 does beside the NumPy 1.26 of Ubuntu 24.04."""
    (tmp_path / 'pyarrow.py').write_text('raise ImportError("pyarrow requires NumPy 2.0")\n')
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, 'pyarrow', raising=False)
    (tmp_path / 'x.parquet').write_bytes(b'PAR1')
    with pytest.raises(RecordingError, match=r'requires NumPy 2\.0.*pip install "pyarrow<26"'):
        read_table(tmp_path / 'x.parquet')


def test_csv_needs_neither_library(tmp_path):
    """In a process of its own, because pandas looks for pyarrow when it is loaded."""
    path = tmp_path / 'x.csv'
    write_table(wander(50, seed=1), path)
    # Files, because compiled modules of pandas take a None in sys.modules for the library.
    for library in ('pyarrow', 'python_calamine'):
        (tmp_path / f'{library}.py').write_text('raise ModuleNotFoundError(__name__)')
    code = (
        'from valveflow_ros.logs import read_table\n'
        f'raw = read_table({str(path)!r}); print(repr([c.tolist() for c in raw.columns.values()]))'
    )
    places = os.pathsep.join([str(tmp_path), os.environ.get('PYTHONPATH', '')])
    done = subprocess.run(
        [sys.executable, '-c', code], env=os.environ | {'PYTHONPATH': places}, check=True,
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.stdout.strip() == repr([c.tolist() for c in read_table(path).columns.values()])


def test_a_row_for_each_value(tmp_path):
    tags = ('U3:CV_POS', 'U3:PT100', 'U3:TT100', 'U3:JT1')
    abouts = ('HP valve position', 'Main steam pressure', 'Main steam temperature', 'Active power')
    lines = ['Tag,Time,Value,Unit,Description,Quality']
    for tag, unit, about, values in zip(tags, UNITS, abouts, VALUES.values(), strict=True):
        for k, time in enumerate(stamps()):
            text = 'No Data' if (tag, k) == ('U3:JT1', 5) else f'{values[k]:.3f}'
            mark = 'Bad' if (tag, k) == ('U3:PT100', 6) else 'Good'
            lines.append(f'{tag},{time:%d-%b-%y %H:%M:%S},{text},{unit},{about},{mark}')
    path = tmp_path / 'pi.csv'
    path.write_text('\n'.join([*lines, 'U3:SPARE,22-Nov-26 14:05:00,1,,,Good']) + '\n')
    raw = read_table(path)
    assert raw.ignored == ('U3:SPARE',)
    assert raw.bad_cells == {'generated_power_mw': 1}
    readings = open_log(path).readings
    assert len(readings) == 4 * N
    assert (np.diff(readings.time_ns) >= 0).all()
    for signal, values in VALUES.items():
        mine = readings.signal == signal
        assert readings.time_ns[mine].tolist() == expected_ns().tolist()
        found, good = readings.value[mine], np.ones(N, bool)
        good[[k for s, k in ((3, 5), (1, 6)) if s == signal]] = False
        assert np.allclose(found[good], values[good], rtol=0, atol=6e-4)
        assert np.isnan(found[~good]).all()


def test_day_and_month_are_told_apart_or_asked_for(tmp_path):
    lines = [f'{day:02}/03/2026 12:00,50,13,538,600' for day in (1, 2, 3)]
    path = tmp_path / 'x.csv'
    path.write_text('\n'.join(['time,valve position,ms pressure,ms temperature,MW', *lines]))
    with pytest.raises(InputError, match=r'--date-order dmy .* --date-order mdy'):
        read_table(path)
    by_day = read_table(path, options=TableOptions(date_order='dmy')).time_ns
    assert np.diff(by_day).tolist() == [86400 * 10**9] * 2
    by_month = read_table(path, options=TableOptions(date_order='mdy')).time_ns
    assert np.diff(by_month).tolist() == [31 * 86400 * 10**9, 28 * 86400 * 10**9]
    path.write_text(path.read_text() + '\n13/03/2026 12:00,50,13,538,600\n')
    assert read_table(path).time_ns[:3].tolist() == by_day.tolist()


def test_only_the_end_of_a_long_file_tells_day_from_month(tmp_path):
    times = pd.date_range('2026-03-01', '2026-03-20', freq='1min')
    lines = [f'{t:%d/%m/%Y %H:%M:%S},50,13,538,600' for t in times]
    path = tmp_path / 'x.csv'
    path.write_text('\n'.join(['time,valve position,ms pressure,ms temperature,MW', *lines]))
    assert (
        read_table(path).time_ns.tolist()
        == times.astype('datetime64[ns]').astype('int64').tolist()
    )


@pytest.mark.parametrize('newest_first', [False, True])
@pytest.mark.parametrize('block', [17, 100_000])
@pytest.mark.parametrize('zone', ['Europe/Berlin', 'America/New_York'])
def test_the_hour_that_comes_twice(tmp_path, monkeypatch, zone, block, newest_first):
    place = zoneinfo.ZoneInfo(zone)
    day = dt.datetime(2026, 10, 25) if zone == 'Europe/Berlin' else dt.datetime(2026, 11, 1)
    start = day.replace(tzinfo=dt.timezone.utc) - dt.timedelta(hours=2)
    truth = [start + dt.timedelta(minutes=k) for k in range(12 * 60)]
    lines = [f'{t.astimezone(place):%d.%m.%Y %H:%M:%S},50,13,538,600' for t in truth]
    path = tmp_path / 'x.csv'
    ordered = reversed(lines) if newest_first else lines
    path.write_text('\n'.join(['time,valve position,ms pressure,ms temperature,MW', *ordered]))
    monkeypatch.setattr(file, 'BLOCK_ROWS', block)
    raw = read_table(path, options=TableOptions(time_zone=zone))
    assert raw.time_ns.tolist() == [int(t.timestamp()) * 10**9 for t in truth]
    assert any('120 rows stand in the hour that comes twice' in note for note in raw.notes)
    if not newest_first:
        with pytest.raises(InputError, match=r'go back by an hour .* --time-zone'):
            read_table(path)
    assert len(read_table(path, options=TableOptions(time_zone='UTC')).time_ns) == len(truth)


def test_a_clock_that_is_not_set_forward_is_told(tmp_path):
    times = pd.date_range('2026-03-29 00:00', periods=300, freq='1min')
    lines = [f'{t:%Y-%m-%d %H:%M:%S},50,13,538,600' for t in times]
    path = tmp_path / 'x.csv'
    path.write_text('\n'.join(['time,valve position,ms pressure,ms temperature,MW', *lines]))
    with pytest.raises(InputError, match=r'does not exist in Europe/Berlin.* --time-zone \+01:00'):
        read_table(path, options=TableOptions(time_zone='Europe/Berlin'))
    raw = read_table(path, options=TableOptions(time_zone='+01:00'))
    hour_before = times.astype('datetime64[ns]').astype('int64') - 3600 * 10**9
    assert raw.time_ns.tolist() == hour_before.tolist()


@pytest.mark.parametrize(
    ('name', 'offset_h'),
    [
        ('Time (UTC)', 0),
        ('Zeit [Europe/Berlin]', 1),
        ('Timestamp +02:00', 2),
        ('Zeit [MEZ]', None),
    ],
)
def test_the_zone_may_stand_in_the_header(tmp_path, name, offset_h):
    path = tmp_path / 'x.csv'
    path.write_text(f'{name},valve position,ms pressure,ms temperature,MW\n'
                    '2026-01-05 12:00:00,50,13,538,600\n')  # fmt: skip
    if offset_h is None:
        with pytest.raises(InputError, match=r'MEZ does not say .* --time-zone'):
            read_table(path)
        return
    noon = int(pd.Timestamp('2026-01-05 12:00').value)
    assert read_table(path).time_ns.tolist() == [noon - offset_h * 3600 * 10**9]


@pytest.mark.parametrize('day', ['2026-10-25', '25.10.2026', '25-Oct-26'])
def test_german_times_tell_summer_from_winter_themselves(tmp_path, day):
    clocks = ('02:30:00 MESZ', '02:30:00 MEZ', '03:30:00 CET', '03:31:00+01:00', '02:32:00Z')
    lines = [f'{day} {clock},50,13,538,600' for clock in clocks]
    path = tmp_path / 'x.csv'
    path.write_text('\n'.join(['time,valve position,ms pressure,ms temperature,MW', *lines]))
    first = pd.Timestamp('2026-10-25 00:30').value
    minutes = (np.array(read_table(path).time_ns) - first) // (60 * 10**9)
    assert minutes.tolist() == [0, 60, 120, 121, 122]


def test_days_of_a_workbook_in_a_text(tmp_path):
    days = [(t - dt.datetime(1899, 12, 30)).total_seconds() / 86400 for t in stamps()]
    lines = [f'{d!r},50,13,538,600' for d in days]
    path = tmp_path / 'x.csv'
    path.write_text('\n'.join(['time,valve position,ms pressure,ms temperature,MW', *lines]))
    assert read_table(path).time_ns.tolist() == expected_ns().tolist()


def test_a_comma_that_may_be_either_is_asked_for(tmp_path):
    rows = [f'2026-01-05 12:00:0{k}\t50\t13\t538\t230,14{k}' for k in range(5)]
    path = tmp_path / 'x.csv'
    path.write_text('\n'.join(['time\tvalve position\tms pressure\tms temperature\tMW', *rows]))
    with pytest.raises(InputError, match=r'--decimal comma .* --decimal point'):
        read_table(path)
    power = read_table(path, options=TableOptions(decimal='comma')).columns['generated_power_mw']
    assert power.tolist() == [230.14, 230.141, 230.142, 230.143, 230.144]
    power = read_table(path, options=TableOptions(decimal='point')).columns['generated_power_mw']
    assert power.tolist() == [230140, 230141, 230142, 230143, 230144]


def test_quality_beside_a_column(tmp_path):
    path = tmp_path / 'x.csv'
    lines = ['Time,Valve position [%],Valve position Quality,MS pressure,MS pressure.Q,MS temp,MW']
    for k, (word, code) in enumerate([('Good', 192), ('Questionable', 64), ('Bad', 24), ('', 0)]):
        lines.append(f'2026-01-05 12:00:0{k},50,{word},13,{code},538,600')
    path.write_text('\n'.join(lines))
    raw = read_table(path)
    assert raw.quality['valve_opening_percent'].tolist() == [0, 1, 2, 2]
    assert raw.quality['main_steam_pressure_mpa'].tolist() == [0, 1, 2, 2]
    assert raw.ignored == ()
