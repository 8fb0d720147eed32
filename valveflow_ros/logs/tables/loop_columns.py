# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Reads the columns of one control loop from a table: command, position, process value, set point.

Columns are recognised by names of control systems, such as MV, OP, PV, SP or SV after a tag, or by
words. Units are not used, because a loop is judged by how its columns change together.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from valveflow_ros.errors import DataError, InputError
from valveflow_ros.logs.tables.cells import Marks, to_numbers
from valveflow_ros.logs.tables.file import TableFile, look_at
from valveflow_ros.logs.tables.match import TIME, Matcher, stamps_in, time_columns, zone_in
from valveflow_ros.logs.tables.reader import cells_of, time_cells, time_samples
from valveflow_ros.logs.tables.refusal import AS_SEEN, THEIRS, RefusedError, Remedy, TableOptions
from valveflow_ros.logs.tables.times import NEVER, RowClock, TimeReader
from valveflow_ros.logs.tables.words import folded, split_unit
from valveflow_ros.records import FloatArray, IntArray

COMMAND, POSITION, PROCESS, SET_POINT = ROLES = ('command', 'position', 'process', 'set_point')
_SHORT = {
    COMMAND: 'mv|op|out|co|cmd|dmd',
    POSITION: 'pos|zt|zi|fbk|fb',
    PROCESS: 'pv|meas',
    SET_POINT: 'sp|sv|spt',
}
_LONG = {
    COMMAND: r'command|demand|output|control(?:ler)? signal|stellgroesse|stellbefehl|manipulated',
    POSITION: r'position|travel|stem|stellung|opening|feedback|rueckmeldung|\bhub\b|\blift\b',
    PROCESS: r'process ?(?:value|variable)|\bprocess$|actual value|measure|istwert|'
    r'\bflow\b|\blevel\b',
    SET_POINT: r'set ?point|set value|sollwert|target|reference',
}
_TAG = {
    COMMAND: r'(?:^| )[flptx]?c?v ?\d+$',
    POSITION: r'(?:^| )z[ti] ?\d+$',
    PROCESS: r'(?:^| )[flpt][it] ?\d+$|\bpressure\b|\btemperature\b',
    SET_POINT: r'^\b$',
}


@dataclass(frozen=True, slots=True)
class LoopColumns:
    """Columns of a loop in a table, with rows in time order.

    ``time_ns`` is int64 (n,) in ns since 1970, strictly increasing. ``columns`` gives the values
    by role, float64 (n,), NaN for cells without a number, ``names`` the names in the table.
    """

    time_ns: IntArray
    columns: dict[str, FloatArray]
    names: dict[str, str]


def read_loop_columns(
    path: Path, named: Mapping[str, str], options: TableOptions = AS_SEEN
) -> LoopColumns:
    """Return the columns of a loop from a table.

    Raises `RecordingError` if the file cannot be read as a table. Raises `InputError` if a column
    is missing or ambiguous.

    Parameters
    ----------
    path : Path
        Text with any common separator, ``.xlsx`` or ``.parquet``, with one column per signal.
    named : mapping of str to str
        Columns named by the user, by role or ``time``; the others are recognised by their names.
    options : TableOptions
        What the user says about the table.
    """
    import pandas as pd

    file = look_at(path, options)
    matcher = Matcher(path, file.heading)
    places = {role: _found(matcher, path, theirs) for role, theirs in named.items() if theirs}
    time, date = _time_places(file, places.pop(TIME, None), options)
    taken = {*places.values(), time, date}
    chosen = {**_recognised(path, file, places, taken), **places}
    wanted = [k for k in (*chosen.values(), time, date) if k is not None]
    frame = pd.concat(list(file.blocks(wanted)), ignore_index=True)
    if time is None:
        time_ns = RowClock(options).at(0, len(frame))
    else:
        name = file.names[time]
        samples = time_samples(file, time, date)
        reader = TimeReader(samples, str(path), name, options, zone_in(name))
        time_ns = reader.read(time_cells(frame, time, date))
        reader.finish()
    values = {r: to_numbers(frame[k], file.marks or Marks()).values for r, k in chosen.items()}
    return ordered(time_ns, values, {r: file.names[k] for r, k in chosen.items()})


def ordered(
    time_ns: IntArray, values: Mapping[str, FloatArray], names: Mapping[str, str]
) -> LoopColumns:
    """Return columns in time order, with the first row of each time.

    Raises `DataError` if no row has a time.
    """
    rows = np.flatnonzero(time_ns != NEVER)
    if not len(rows):
        raise DataError('The table has no row with a time.')
    times, first = np.unique(time_ns[rows], return_index=True)
    return LoopColumns(times, {r: v[rows[first]] for r, v in values.items()}, dict(names))


def roles_of(names: list[str], about: list[str]) -> dict[str, list[int]]:
    """Return the columns that may have each role, found by the most specific rule that matches."""
    # MV may also be the unit millivolt, so names are tried with and without a possible unit.
    plain = [f'{folded(name)}\n{folded(split_unit(name)[0])}' for name in names]
    told = [folded(text) for text in about]
    found: dict[str, list[int]] = {}
    for role in reversed(ROLES):
        # Set points are excluded from the other roles: 'flow_setpoint' is not a flow.
        wanted = set(found.get(SET_POINT, ()))
        grounds = (
            (plain, rf'(?:^| )(?:{_SHORT[role]})$'),
            (plain, rf'^(?:{_SHORT[role]}) '),
            (plain, _LONG[role]),
            (plain, _TAG[role]),
            (told, rf'(?:^| )(?:{_SHORT[role]})$|{_LONG[role]}'),
        )
        for texts, pattern in grounds:
            if places := [
                k
                for k, text in enumerate(texts)
                if k not in wanted and re.search(pattern, text, re.MULTILINE)
            ]:
                found[role] = places
                break
    return found


def _recognised(
    path: Path, file: TableFile, places: Mapping[str, int], taken: set[int | None]
) -> dict[str, int]:
    """Return the columns by role that the user did not name."""
    heading = file.heading
    found = roles_of(list(heading.names), list(heading.about))
    chosen: dict[str, int] = {}
    behind = POSITION in places or PROCESS in places
    for role in ROLES:
        free = [k for k in found.get(role, []) if k not in taken]
        if role in places or (role in (POSITION, PROCESS) and behind):
            continue
        if len(free) > 1 and role in (COMMAND, PROCESS) and POSITION not in chosen:
            listed = ' and '.join(f"'{file.names[k]}'" for k in free[:6])
            raise RefusedError(
                path, f'{listed} could each be the {role}: name one with --{role}',
                [Remedy(role, file.names[free[0]])],
            )  # fmt: skip
        if len(free) == 1:
            chosen[role] = free[0]
            taken = {*taken, free[0]}
    have = {*chosen, *places}
    missing = [COMMAND] if COMMAND not in have else []
    if not have & {POSITION, PROCESS}:
        missing.append(PROCESS)
    if missing:
        listed = ', '.join(name for name in file.names[:40] if name)
        told = ' and '.join(f'--{role} COLUMN' for role in missing)
        raise RefusedError(
            path,
            f'no column is named like the {" and the ".join(missing)} of a loop; the columns are: '
            f'{listed}. Name yours with {told}',
            [Remedy(role, THEIRS) for role in missing],
        )
    return chosen


def _found(matcher: Matcher, path: Path, theirs: str) -> int:
    place = matcher.find(theirs)
    if place is None:
        listed = ', '.join(name for name in matcher.names[:40] if name)
        raise InputError(f"{path}: there is no column '{theirs}'; the columns are: {listed}.")
    return place


def _time_places(
    file: TableFile, named: int | None, options: TableOptions
) -> tuple[int | None, int | None]:
    """Return the indices of the time and of a separate date; None without a time column."""
    time, date = time_columns(file.heading)
    if named is not None:
        return named, None
    if time is None and date is not None:
        return date, None
    if time is None:
        time = next((k for k in range(len(file.names)) if stamps_in(cells_of(file, k))), None)
    if time is None and not options.period:
        raise RefusedError(
            file.path,
            'no column holds times: name it with --time, or say how far apart the rows are with '
            '--period, such as --period 10s',
            [Remedy('period', '10s')],
        )
    cells = cells_of(file, time) if time is not None else []
    apart = date != time and any(':' in cell and len(cell) <= 15 for cell in cells)
    return time, (date if apart else None)
