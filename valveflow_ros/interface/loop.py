# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``loop``: test the valve of one control loop from its command and its position or process."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from valveflow_ros.diagnosis.loop.judge import LoopJudgement, judge_position, judge_response
from valveflow_ros.errors import InputError
from valveflow_ros.interface import SILENT, Progress
from valveflow_ros.interface.files import as_text, write_texts
from valveflow_ros.interface.logs import nanoseconds
from valveflow_ros.logs.tables import loop_columns
from valveflow_ros.logs.tables.loop_columns import COMMAND, POSITION, PROCESS, SET_POINT
from valveflow_ros.logs.tables.refusal import TableOptions
from valveflow_ros.logs.tables.times import NEVER
from valveflow_ros.records import FloatArray

FILE = 'loop.json'
# Largest ratio of grid rows to table rows; above it long gaps are shortened.
_MOST_GRID = 4


# The verdict and how sure it is, without and with a measured position; the counts are rounded
# from the study of simulated loops in docs/method.md.
HEADLINES = {
    'stiction': (
        'stiction or slack, probable: 3 of 100 sound valves in simulated loops are called so',
        'stiction, measured',
    ),
    'backlash': ('slack, probable', 'slack, measured'),
    'healthy': (
        'no fault found, not certain: 4 of 10 faults in simulated loops are not seen',
        'no fault found, by the measured position',
    ),
    'oscillating': ('the loop oscillates, and no fault of the valve is found',) * 2,
    'not_judged': ('not judged: this record cannot tell',) * 2,
}
_TO_DO = {
    'stiction': (
        'Put the controller in manual and make small steps in both directions: with a sound valve '
        'the process value follows each of them.',
        'Have packing, positioner and air supply of the valve checked.',
    ),
    'backlash': ('', 'Have the linkage between actuator, stem and position feedback checked.'),
    'oscillating': (
        'Put the controller in manual. If the swing goes on, look for its source outside this '
        'loop; if it stops, tune the controller.',
    )
    * 2,
}


@dataclass(frozen=True, slots=True, repr=False)
class LoopResult:
    """The result for the valve of a control loop.

    Attributes
    ----------
    judgement : LoopJudgement
        Verdict, reason, sizes, and the result of each test.
    names : dict of str to str
        The columns by role: command, position or process, set_point.
    time_s : float64 (n,)
        Time since the first row, equally spaced.
    columns : dict of str to float64 (n,)
        Values by role; NaN if a row is missing.
    """

    judgement: LoopJudgement
    names: dict[str, str]
    time_s: FloatArray
    columns: dict[str, FloatArray]

    def __repr__(self) -> str:
        """Return the verdict and its reason; all the data would fill pages of a notebook."""
        return f'<LoopResult: {self.headline}. {self.judgement.reason}>'

    @property
    def headline(self) -> str:
        """Return the verdict and how sure it is, in words without a full stop."""
        return HEADLINES[self.judgement.verdict][POSITION in self.names]

    @property
    def to_do(self) -> str:
        """Return what to do next; empty if the reason says it, or nothing need be done."""
        return _TO_DO.get(self.judgement.verdict, ('', ''))[POSITION in self.names]

    def to_json(self) -> dict[str, Any]:
        """Return the content of ``loop.json``."""
        found = self.judgement
        return {
            'format': 'valveflow/loop',
            'version': 1,
            'verdict': found.verdict,
            'reason': found.reason,
            'sizes': found.sizes,
            'columns': self.names,
            'rows': found.rows,
            'step_s': float(self.time_s[1] - self.time_s[0]) if len(self.time_s) > 1 else None,
            'period_s': _known(found.period_s),
            'evidence': {'gain': _known(found.gain), 'travel': _known(found.travel)},
            'tests': {
                name: {'answer': one.answer, 'index': _known(one.index)}
                for name, one in found.detections.items()
            },
        }

    def write(self, folder: str | Path) -> Path:
        """Write ``loop.json`` into a folder, created if absent; return its path.

        Raises
        ------
        RecordingError
            It cannot be written.
        """
        return write_texts(Path(folder), {FILE: as_text(self.to_json(), 1)})[FILE]

    def plot(self) -> Any:
        """Return the command and the position or process value as a plotly figure.

        Raises
        ------
        InputError
            plotly is not installed.
        """
        from valveflow_ros.report.page import plotly_script

        plotly_script()  # raises a clear message if plotly is missing
        import plotly.graph_objects as go

        figure = go.Figure(layout={'title': self.judgement.reason, 'template': 'plotly_white'})
        for role, values in self.columns.items():
            axis = 'y2' if role in (PROCESS, SET_POINT) else 'y'
            figure.add_scatter(x=self.time_s, y=values, name=self.names[role], yaxis=axis)
        figure.update_layout(yaxis2={'overlaying': 'y', 'side': 'right'}, xaxis_title='s')
        return figure


def judge_loop(
    table: Any,
    *,
    command: str = '',
    position: str = '',
    process: str = '',
    set_point: str = '',
    time: str = '',
    options: TableOptions | None = None,
    progress: Progress = SILENT,
) -> LoopResult:
    """Test the valve of one control loop: stiction, backlash, sound, or not known.

    Parameters
    ----------
    table : str, Path or pandas.DataFrame
        A ``.csv`` or other text, ``.xlsx`` or ``.parquet`` table, or a DataFrame with a column
        ``time`` or times in its index.
    command : str
        Column of the controller's output in %.
    position : str
        Column of the measured position in %; with it the sizes of the faults are estimated.
    process : str
        Column of the process variable, in any unit; needed without a position.
    set_point, time : str
        Columns. Columns that are not given are found by their names: MV or OP, PV, SP or SV.
    options : TableOptions, optional
        Format of a table, if it cannot be recognised from the table itself.
    progress : Progress

    Raises
    ------
    RecordingError, InputError, DataError
        The table cannot be read, or a column is missing.
    """
    if position and process:
        raise InputError('Give the position or the process value, not both.')
    named = {COMMAND: command, POSITION: position, PROCESS: process, SET_POINT: set_point}
    progress(0.05, 'reading')
    if hasattr(table, 'columns'):
        read = _from_dataframe(table, named, time)
    else:
        read = loop_columns.read_loop_columns(
            Path(table), {**named, 'time': time}, options or TableOptions()
        )
    step_s, values = _gridded(read)
    progress(0.3, 'judging')
    used = (COMMAND, POSITION) if POSITION in values else (COMMAND, PROCESS, SET_POINT)
    values = {role: values[role] for role in used if role in values}
    if POSITION in values:
        found = judge_position(values[COMMAND], values[POSITION], step_s)
    else:
        found = judge_response(values[COMMAND], values[PROCESS], step_s, values.get(SET_POINT))
    seconds = step_s * np.arange(len(values[COMMAND]), dtype=np.float64)
    return LoopResult(found, {role: read.names[role] for role in values}, seconds, values)


def _known(value: float) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None


def _gridded(read: loop_columns.LoopColumns) -> tuple[float, dict[str, FloatArray]]:
    """Return the median step in s and the columns on a grid of that step, NaN in missing rows."""
    times = read.time_ns
    if len(times) < 2:
        return 1.0, read.columns
    step = float(np.median(np.diff(times)))
    rows = np.rint((times - times[0]) / step).astype(np.int64)
    if rows[-1] > _MOST_GRID * len(rows):
        # Shorten long gaps; a gap of any length ends a stretch of data.
        rows = np.concatenate(([0], np.cumsum(np.minimum(np.diff(rows), 10))))
    rows, first = np.unique(rows, return_index=True)
    out = {}
    for role, values in read.columns.items():
        out[role] = np.full(int(rows[-1]) + 1, np.nan)
        out[role][rows] = values[first]
    return step / 1e9, out


def _from_dataframe(frame: Any, named: dict[str, str], time: str) -> loop_columns.LoopColumns:
    import pandas as pd

    names = [str(c) for c in frame.columns]
    if absent := [c for c in (*named.values(), time) if c and c not in names]:
        raise InputError(f"The DataFrame has no column '{absent[0]}'.")
    guessed = loop_columns.roles_of(names, [''] * len(names))
    chosen = {role: theirs for role, theirs in named.items() if theirs}
    for role in loop_columns.ROLES:
        behind = role in (POSITION, PROCESS) and {POSITION, PROCESS} & set(chosen)
        free = [names[k] for k in guessed.get(role, []) if names[k] not in chosen.values()]
        if role not in chosen and not behind and len(free) == 1:
            chosen[role] = free[0]
    if COMMAND not in chosen or not {POSITION, PROCESS} & set(chosen):
        raise InputError(
            'The DataFrame has no columns that are clearly the command and what follows it; name '
            'them with command= and process= or position=.'
        )
    clock = time or ('time' if 'time' in names else '')
    column = frame[clock] if clock else frame.index
    if not clock and not isinstance(frame.index, pd.DatetimeIndex):
        raise InputError("The DataFrame has no column 'time', and its index holds no times.")
    time_ns, there = nanoseconds(column)
    values = {
        role: pd.to_numeric(frame[theirs], errors='coerce').to_numpy(np.float64)
        for role, theirs in chosen.items()
    }
    return loop_columns.ordered(np.where(there, time_ns, NEVER), values, chosen)
