"""Diagnose what the running monitor holds: a pure function of a snapshot."""

from __future__ import annotations

import json

import numpy as np

from valveflow_ros.curve.model import RegionalModel
from valveflow_ros.diagnosis.diagnose import Record, diagnose
from valveflow_ros.diagnosis.diagnosis_json import to_json
from valveflow_ros.diagnosis.first_model import first_model
from valveflow_ros.diagnosis.on_top import freed
from valveflow_ros.monitoring.diagnosis_task import DiagnosisContent, DiagnosisTask
from valveflow_ros.records import FloatArray, IntArray, SampleTable, Signal
from valveflow_ros.segments.window import WindowContents

# A pressure that u was made of and that is made of u again differs in its last bits, which would
# hide that it stood still.
_DECIMALS = 9


def diagnose_window(task: DiagnosisTask) -> DiagnosisContent:
    """Diagnose the window in a task.

    Raises
    ------
    DataError
        The window cannot carry a diagnosis; the sentence says why.

    Notes
    -----
    The curve in force is where the diagnosis begins; its dynamics and the number of its pieces
    follow the window, as those of `valveflow diagnose` without a model do.
    """
    settings, contents = task.settings, task.contents
    exponent, step_s = task.curve.pressure_exponent, settings.real('sample_period')
    table = table_of(contents, exponent)
    model: RegionalModel = task.curve.model
    if not task.curve.dynamics:
        model = first_model(table, step_s, exponent, settings.settle_s)
    record = Record(table, step_s, exponent, settings.settle_s, _spans_ns(contents))
    record = freed(record, task.curve.held)
    text = json.dumps(to_json(diagnose(record, model)), allow_nan=False)
    return DiagnosisContent(task.window_end_ns, text)


def table_of(contents: WindowContents, exponent: float) -> SampleTable:
    """Return the rows of a window as a table; the pressure is the one u = V p^m was made with."""
    opening = contents.opening_percent
    columns = {
        Signal.VALVE_OPENING: opening,
        Signal.MAIN_STEAM_PRESSURE: _pressure(contents.u, opening, exponent),
        Signal.MAIN_STEAM_TEMPERATURE: contents.temperature_degc,
        Signal.GENERATED_POWER: contents.power_mw,
    }
    if len(contents.command_percent):
        columns[Signal.VALVE_COMMAND] = contents.command_percent
    return SampleTable.from_columns(contents.time_ns, columns)


def _pressure(u: FloatArray, opening: FloatArray, exponent: float) -> FloatArray:
    """Return p of u = V p^m; NaN where V or u is not positive."""
    open_ = (opening > 0.0) & (u > 0.0)
    ratio = np.divide(u, opening, out=np.full(len(u), np.nan), where=open_)
    return np.asarray(np.round(ratio ** (1.0 / exponent), _DECIMALS))


def _spans_ns(contents: WindowContents) -> IntArray:
    """Return first and last time of the special segments, shape (k, 2)."""
    spans = contents.spans
    if not len(spans):
        return np.empty((0, 2), dtype=np.int64)
    return np.column_stack([contents.time_ns[spans[:, 0]], contents.time_ns[spans[:, 1] - 1]])
