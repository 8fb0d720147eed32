# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Small tables as historians write them, for the tests of logs."""

import zipfile

import pandas as pd
import pytest

HEAD = 'time,valve position,ms pressure [MPa],ms temperature,MW'
ROWS = [f'2026-01-05 12:00:{k:02},50,13,538,{600 + k}' for k in range(20)]


def csv(path, rows=ROWS, head=HEAD, encoding='utf-8'):
    path = path / 'table.csv' if path.is_dir() else path
    path.write_bytes('\n'.join([head, *rows, '']).encode(encoding))
    return path


def timed(*times):
    return [f'{time},50,13,538,{600 + k}' for k, time in enumerate(times)]


def ns(times):
    """Return UTC times of pandas as ns since 1970."""
    return pd.DatetimeIndex(times).astype('datetime64[ns]').astype('int64').tolist()


def workbook(path, *sheets):
    openpyxl = pytest.importorskip('openpyxl')
    pytest.importorskip('python_calamine')
    book = openpyxl.Workbook()
    for number, rows in enumerate(sheets):
        sheet = book.create_sheet() if number else book.active
        for row in rows:
            sheet.append(list(row))
    book.save(path)
    return path


def changed(path, to, end):
    """Write a workbook again with something put at the end of its rows."""
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(to, 'w', zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            head, mark, tail = old.read(name).partition(b'</sheetData>')
            new.writestr(name, head + (end if mark else b'') + mark + tail)
    return to
