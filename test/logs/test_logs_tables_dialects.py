# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""One plant, exported in every way: the same values must come of it."""

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
from table_files import HEAD, ROWS, csv, ns, timed, workbook

from valveflow_ros.errors import InputError, RecordingError
from valveflow_ros.logs import open_log, read_table, write_table
from valveflow_ros.logs.tables import file
from valveflow_ros.logs.tables.cells import foreign_quality
from valveflow_ros.logs.tables.refusal import TableOptions
from valveflow_ros.records import SIGNALS, Quality, Signal

N = 40
STAMPS = [dt.datetime(2026, 11, 22, 14, 5) + dt.timedelta(seconds=10 * k) for k in range(N)]
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
DATES = (
    '%Y-%m-%d %H:%M:%S', '%Y-%m-%dT%H:%M:%SZ', '%d.%m.%Y %H:%M:%S', '%m/%d/%Y %I:%M:%S %p',
    '%Y/%m/%d %H:%M:%S', '%d-%b-%y %H:%M:%S', '%d.%m.%y %H:%M:%S',
)  # fmt: skip
# Separator, decimal and thousands mark.
STYLES = ((',', '.', ''), (';', ',', ''), ('\t', ',', ''), ('\t', '.', ''), (',', '.', ','),
          (';', ',', '.'), ('|', '.', ''), (';', '.', ''))  # fmt: skip


def cell(value, decimal, thousands=''):
    text = f'{value:,.3f}'.replace(',', '\0').replace('.', decimal).replace('\0', thousands)
    return f'"{text}"' if ',' in text and thousands == ',' else text


def write(path, names='english', units='header', date=DATES[0], style=STYLES[0], encoding='utf-8',
          preamble=0, reverse=False):  # fmt: skip
    separator, *marks = style
    head = list(NAMES[names])
    if units == 'header':
        head[1:] = [f'{name} [{unit}]' for name, unit in zip(head[1:], UNITS, strict=True)]
    lines = [f'Export {k} of unit 3' for k in range(preamble)] + [separator.join(head)]
    if units == 'row':
        lines.append(separator.join(['', *UNITS]))
    rows = [
        separator.join([t.strftime(date), *(cell(v[k], *marks) for v in VALUES.values())])
        for k, t in enumerate(STAMPS)
    ]
    text = '\r\n'.join([*lines, *(reversed(rows) if reverse else rows)]) + '\r\n'
    path.write_bytes(text.encode(encoding))
    return path


def check(raw):
    assert raw.time_ns.tolist() == ns(STAMPS)
    for info in SIGNALS[:4]:
        assert np.allclose(raw.columns[info.column], VALUES[info.signal], rtol=0, atol=6e-4)
    assert (raw.bad_cells, raw.bad_times) == ({}, 0)


@settings(max_examples=60)
@given(
    st.tuples(
        st.sampled_from(list(NAMES)),
        st.sampled_from(['header', 'row', 'none']),
        st.sampled_from(DATES),
        st.sampled_from(STYLES),
        st.sampled_from(['utf-8', 'utf-8-sig', 'utf-16', 'cp1252']),
        st.integers(0, 3),
        st.booleans(),
    )
)
def test_any_dialect_gives_the_same_values(tmp_path_factory, dialect):
    check(read_table(write(tmp_path_factory.mktemp('t') / 'x.csv', *dialect)))


@pytest.mark.parametrize('block', [1, 7, 39])
def test_the_size_of_the_blocks_changes_nothing(tmp_path, monkeypatch, block):
    path = write(tmp_path / 'x.csv', 'german', date=DATES[2], style=STYLES[1])
    path.write_text(path.read_text().replace('538,', 'Bad', 3))
    whole = read_table(path)
    monkeypatch.setattr(file, 'BLOCK_ROWS', block)
    parts = read_table(path)
    assert (parts.notes, parts.bad_cells) == (whole.notes, whole.bad_cells)
    assert np.array_equal(parts.time_ns, whole.time_ns)
    for name, column in whole.columns.items():
        assert np.array_equal(column, parts.columns[name], equal_nan=True)


def test_a_workbook_and_a_parquet_file_give_the_same_values(tmp_path):
    pytest.importorskip('pyarrow')
    columns = [STAMPS, *(v.tolist() for v in VALUES.values())]
    rows = [['Export of unit 3'], [], NAMES['german'], [None, *UNITS], *zip(*columns, strict=True)]
    check(read_table(workbook(tmp_path / 'x.xlsx', rows)))
    two = workbook(tmp_path / 'two.xlsx', rows, [[1, 2], [3, 4]])
    with pytest.raises(InputError, match=r"'Sheet' and 'Sheet1'; choose with --sheet Sheet"):
        read_table(two)
    check(read_table(two, options=TableOptions(sheet='Sheet')))
    with pytest.raises(InputError, match="no sheet 'None'"):
        read_table(two, options=TableOptions(sheet='None'))
    frame = pd.DataFrame(dict(zip(NAMES['english'], columns, strict=True)))
    frame.to_parquet(tmp_path / 'x.parquet')
    check(read_table(tmp_path / 'x.parquet'))


def test_without_the_library_of_a_format_it_says_what_to_install(tmp_path, monkeypatch):
    for library in ('python_calamine', 'pyarrow'):
        monkeypatch.setitem(sys.modules, library, None)
    for name, library in (('x.xlsx', 'python-calamine'), ('x.parquet', 'pyarrow')):
        (tmp_path / name).write_bytes(b'PK\x03\x04' if name == 'x.xlsx' else b'PAR1')
        with pytest.raises(RecordingError, match=f'pip install {library}'):
            read_table(tmp_path / name)
    with pytest.raises(RecordingError, match='pip install pyarrow'):
        write_table(wander(9, seed=1), tmp_path / 'y.parquet')
    assert not (tmp_path / 'y.parquet').exists()
    # As 26 does beside the NumPy 1.26 of Ubuntu 24.04.
    (tmp_path / 'pyarrow.py').write_text('raise ImportError("pyarrow requires NumPy 2.0")\n')
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, 'pyarrow')
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
    lines = []
    for tag, unit, about, values in zip(tags, UNITS, abouts, VALUES.values(), strict=True):
        for k, time in enumerate(STAMPS):
            text = 'No Data' if (tag, k) == ('U3:JT1', 5) else f'{values[k]:.3f}'
            mark = 'Bad' if (tag, k) == ('U3:PT100', 6) else 'Good'
            lines.append(f'{tag},{time:%d-%b-%y %H:%M:%S},{text},{unit},{about},{mark}')
    lines.append('U3:SPARE,22-Nov-26 14:05:00,1,,,Good')
    path = csv(tmp_path, lines, 'Tag,Time,Value,Unit,Description,Quality')
    raw = read_table(path)
    assert raw.ignored == ('U3:SPARE',)
    assert raw.bad_cells == {'generated_power_mw': 1}
    readings = open_log(path).readings
    assert len(readings) == 4 * N
    assert (np.diff(readings.time_ns) >= 0).all()
    for signal, values in VALUES.items():
        mine = readings.signal == signal
        assert readings.time_ns[mine].tolist() == ns(STAMPS)
        found, good = readings.value[mine], np.ones(N, bool)
        good[[k for s, k in ((3, 5), (1, 6)) if s == signal]] = False
        assert np.allclose(found[good], values[good], rtol=0, atol=6e-4)
        assert np.isnan(found[~good]).all()


# Dates -----------------------------------------------------------------------------------------


def times_in(folder, rows, head=HEAD, **options):
    return read_table(csv(folder, rows, head), options=TableOptions(**options)).time_ns.tolist()


def test_day_and_month_are_told_apart_or_asked_for(tmp_path):
    rows = timed(*(f'{day:02}/03/2026 12:00' for day in (1, 2, 3)))
    with pytest.raises(InputError, match=r'--date-order dmy .* --date-order mdy'):
        times_in(tmp_path, rows)
    by_day = ns(['2026-03-01 12:00', '2026-03-02 12:00', '2026-03-03 12:00'])
    assert times_in(tmp_path, rows, date_order='dmy') == by_day
    by_month = ns(['2026-01-03 12:00', '2026-02-03 12:00', '2026-03-03 12:00'])
    assert times_in(tmp_path, rows, date_order='mdy') == by_month
    assert times_in(tmp_path, [*rows, *timed('13/03/2026 12:00')])[:3] == by_day


def test_only_the_end_of_a_long_file_tells_day_from_month(tmp_path):
    times = pd.date_range('2026-03-01', '2026-03-20', freq='1min')
    assert times_in(tmp_path, timed(*times.strftime('%d/%m/%Y %H:%M:%S'))) == ns(times)


@pytest.mark.parametrize(
    ('zone', 'block', 'newest_first'),
    [('Europe/Berlin', 17, False), ('America/New_York', 17, True),
     ('Europe/Berlin', 100_000, True)],
)  # fmt: skip
def test_the_hour_that_comes_twice(tmp_path, monkeypatch, zone, block, newest_first):
    place = zoneinfo.ZoneInfo(zone)
    day = '2026-10-24 22:00' if zone == 'Europe/Berlin' else '2026-10-31 22:00'
    truth = pd.date_range(day, periods=12 * 60, freq='1min', tz='UTC')
    rows = timed(*truth.tz_convert(place).strftime('%d.%m.%Y %H:%M:%S'))
    path = csv(tmp_path, rows[::-1] if newest_first else rows)
    monkeypatch.setattr(file, 'BLOCK_ROWS', block)
    raw = read_table(path, options=TableOptions(time_zone=zone))
    assert raw.time_ns.tolist() == ns(truth.tz_localize(None))
    power = raw.columns['generated_power_mw']
    assert power.tolist() == [600.0 + k for k in range(len(truth))], 'each row keeps its values'
    assert any('120 rows are in the hour that comes twice' in note for note in raw.notes)
    if not newest_first:
        with pytest.raises(InputError, match=r'go back by an hour .* --time-zone'):
            read_table(path)
    assert len(read_table(path, options=TableOptions(time_zone='UTC')).time_ns) == len(truth)


def test_a_clock_that_is_not_set_forward_is_told(tmp_path):
    times = pd.date_range('2026-03-29 00:00', periods=300, freq='1min')
    rows = timed(*times.strftime('%Y-%m-%d %H:%M:%S'))
    with pytest.raises(InputError, match=r'does not exist in Europe/Berlin.* --time-zone \+01:00'):
        times_in(tmp_path, rows, time_zone='Europe/Berlin')
    found = times_in(tmp_path, rows, time_zone='+01:00')
    assert found == ns(times - pd.Timedelta(hours=1))


def test_the_zone_may_stand_in_the_header(tmp_path):
    rows = timed('2026-01-05 12:00:00')
    for name, offset_h in (
        ('Time (UTC)', 0), ('Zeit [Europe/Berlin]', 1), ('Time (Europe/Berlin)', 1),
        ('Timestamp +02:00', 2),
        # Date and time parted by a slash are no zone.
        ('Sample Date/Time', 0), ('PI Date/Time', 0), ('Date/Time', 0),
    ):  # fmt: skip
        found = times_in(tmp_path, rows, HEAD.replace('time', name, 1))
        assert found == ns([f'2026-01-05 {12 - offset_h}:00']), name
    with pytest.raises(InputError, match=r'MEZ does not say .* --time-zone'):
        times_in(tmp_path, rows, HEAD.replace('time', 'Zeit [MEZ]', 1))


def test_german_times_tell_summer_from_winter_themselves(tmp_path):
    clocks = ('02:30:00 MESZ', '02:30:00 MEZ', '03:30:00 CET', '03:31:00+01:00', '02:32:00Z')
    truth = ns([f'2026-10-25 {t}' for t in ('00:30', '01:30', '02:30', '02:31', '02:32')])
    for day in ('2026-10-25', '25.10.2026', '25-Oct-26'):
        assert times_in(tmp_path, timed(*(f'{day} {clock}' for clock in clocks))) == truth, day


def test_an_offset_of_whole_hours_is_one_and_the_end_of_a_date_is_none(tmp_path):
    noons = pd.date_range('2026-01-05 12:00', periods=20, freq='h')
    for date in ('%Y-%m-%d %H:%M:%S', '%Y-%m-%dT%H:%M', '%d.%m.%Y %H:%M:%S'):
        for offset, hours in (('+01', 1), ('-05', -5), ('+0530', 5.5)):
            found = times_in(tmp_path, timed(*(noons.strftime(date) + offset)))
            assert found == ns(noons - pd.Timedelta(hours=hours)), (date, offset)
    days = pd.date_range('2026-01-05', periods=20, freq='D')
    for date in ('%Y-%m-%d', '%d-%m-%Y', '%Y-%m-%d %H:%M'):
        assert times_in(tmp_path, timed(*days.strftime(date))) == ns(days), date


def test_days_of_a_workbook_in_a_text(tmp_path):
    days = [(t - dt.datetime(1899, 12, 30)).total_seconds() / 86400 for t in STAMPS]
    assert times_in(tmp_path, timed(*days)) == ns(STAMPS)


# Numbers and qualities -------------------------------------------------------------------------


def test_a_comma_that_may_be_either_is_asked_for(tmp_path):
    rows = [f'2026-01-05 12:00:0{k}\t50\t13\t538\t230,14{k}' for k in range(5)]
    path = csv(tmp_path, rows, HEAD.replace(',', '\t'))
    with pytest.raises(InputError, match=r'--decimal comma .* --decimal point'):
        read_table(path)
    for mark, expected in (('comma', [230.14, 230.141, 230.142, 230.143, 230.144]),
                           ('point', [230140, 230141, 230142, 230143, 230144])):  # fmt: skip
        raw = read_table(path, options=TableOptions(decimal=mark))
        assert raw.columns['generated_power_mw'].tolist() == expected


def test_quality_beside_a_column(tmp_path):
    head = 'Time,Valve position [%],Valve position Quality,MS pressure,MS pressure.Q,MS temp,MW'
    marks = [('Good', 192), ('Questionable', 64), ('Bad', 24), ('', 0)]
    rows = [
        f'2026-01-05 12:00:0{k},50,{word},13,{code},538,600'
        for k, (word, code) in enumerate(marks)
    ]
    raw = read_table(csv(tmp_path, rows, head))
    assert raw.quality['valve_opening_percent'].tolist() == [0, 1, 2, 2]
    assert raw.quality['main_steam_pressure_mpa'].tolist() == [0, 1, 2, 2]
    assert raw.ignored == ()


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
        for place, tag in enumerate(('CV_POS', 'PT100', 'TT100', 'JT1'), 1):
            cells = [row.split(',') for row in ROWS]
            rows += [f'{tag},{c[0]},{c[place]},"{m if place == 4 else "Good"}"'
                     for c, m in zip(cells, mark, strict=True)]  # fmt: skip
        said = "'JT1' is read from 'Quality', by which 2 of its values are bad."
    else:
        head = f'{HEAD},MW Quality'
        rows = [f'{row},"{m}"' for row, m in zip(ROWS, mark, strict=True)]
        said = "'MW' is read from 'MW Quality', by which 2 of its values are bad."
    path = csv(tmp_path, rows, head)
    assert any(note.endswith(said) for note in read_table(path).notes)
    readings = open_log(path).readings
    power = readings.value[readings.signal == Signal.GENERATED_POWER]
    assert np.flatnonzero(np.isnan(power)).tolist() == [3, 13]
