# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Diagnose the window of the running monitor: a pure function of a snapshot."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np

from valveflow_ros.curve.characteristic import HeldCause
from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.diagnosis.cause import Stage
from valveflow_ros.diagnosis.causes import catalogue
from valveflow_ros.diagnosis.diagnose import Record, diagnose, quiet
from valveflow_ros.diagnosis.extended import ExtendedModel
from valveflow_ros.diagnosis.grids import LEAST_COVERED, CovariateRows
from valveflow_ros.diagnosis.result import Diagnosis, to_json
from valveflow_ros.diagnosis.search import Progress
from valveflow_ros.errors import DataError
from valveflow_ros.fit.problem import Samples
from valveflow_ros.fit.refine import refine
from valveflow_ros.monitoring.events import DiagnosisContent, DiagnosisTask
from valveflow_ros.records import FloatArray, IntArray, Quality, SampleTable, Signal
from valveflow_ros.segments.window import WindowContents
from valveflow_ros.signals.covariates import parts
from valveflow_ros.signals.static_form import StaticForm, pressure_of

# An initial model if the special segments give none.

_PIECES, _MOST = 4, 6
_LEAST_ROWS = 1000
_LEAST_SPREAD = 0.02


def first_model(
    table: SampleTable, step_s: float, form: StaticForm, settle_s: float
) -> RegionalModel:
    """Fit curve and dynamics to all rows, starting from a regression on hat functions of u.

    Raises
    ------
    DataError
        The valve hardly moves, or there is too little data.
    """
    u, scale = form.of_rows(
        table.column(Signal.VALVE_OPENING), table.column(Signal.MAIN_STEAM_PRESSURE)
    )
    power = table.column(Signal.GENERATED_POWER)
    usable = np.isfinite(u) & np.isfinite(power)
    if usable.sum() < _LEAST_ROWS:
        raise DataError(
            f'{usable.sum()} rows have opening, pressure and power together; a diagnosis needs '
            f'{_LEAST_ROWS} or more.'
        )
    knots = np.quantile(u[usable], np.linspace(0.0, 1.0, _PIECES + 1))
    if knots[-1] - knots[0] < _LEAST_SPREAD * abs(knots[-1]):
        raise DataError('The valve hardly moves in this record: there is nothing to compare.')
    values, offset = _hats(
        u[usable], knots, power[usable], None if scale is None else scale[usable]
    )
    start = RegionalModel(
        knots, values[:-1].copy(), values[1:].copy(), np.empty(0), np.ones(1), np.zeros(1), offset
    )
    flags = usable.astype(np.uint8)
    flags[1:][np.diff(table.time_ns) > 1.5e9 * step_s] = 0
    samples = Samples(
        np.where(usable, u, 0.0), np.where(usable, power, 0.0), flags, step_s, settle_s,
        max(1, round(10.0 / step_s)), None if scale is None else np.where(usable, scale, 1.0),
    )  # fmt: skip
    return refine(samples, start, _MOST).model


def _hats(
    u: FloatArray, knots: FloatArray, power: FloatArray, scale: FloatArray | None
) -> tuple[FloatArray, float | None]:
    """Return the least-squares values at the breakpoints, and c if the form has one."""
    knots += np.arange(len(knots)) * 1e-6 * (knots[-1] - knots[0])
    table = np.column_stack([np.interp(u, knots, row) for row in np.eye(len(knots))])
    if scale is not None:
        table = np.column_stack([scale[:, None] * table, np.ones(len(u))])
    found = np.asarray(np.linalg.lstsq(table, power, rcond=None)[0])
    return (found, None) if scale is None else (found[:-1], float(found[-1]))


# A record without the causes of an earlier model, for a diagnosis on top of that model.


def on_top(record: Record, earlier: ExtendedModel, measured: SampleTable) -> Record:
    """Return the record for a diagnosis on top of an earlier model.

    Parameters
    ----------
    record : Record
        Its table has the causes of ``earlier`` removed.
    measured : SampleTable
        The rows of the record before the removal.

    Notes
    -----
    If the opening was changed, it no longer follows from the command. So the command is left
    out: otherwise the diagnosis would find the earlier cause again.
    """
    rows = record.table
    if _changes_opening(earlier):
        values, quality = rows.values.copy(), rows.quality.copy()
        values[:, Signal.VALVE_COMMAND] = np.nan
        quality[:, Signal.VALVE_COMMAND] = Quality.BAD
        rows = SampleTable(rows.time_ns, values, quality)
    return replace(record, table=rows, measured=measured)


def without_causes(record: Record, held: tuple[HeldCause, ...]) -> Record:
    """Return a record with removed causes whose measured rows are not available.

    A corrected opening may be constant for hours at a stop or inside a backlash; this is not a
    transmitter fault. So faults of the opening are not searched for in that case.
    """
    if not any(catalogue()[h.name].stage == Stage.OPENING for h in held):
        return record
    values, quality = record.table.values.copy(), record.table.quality.copy()
    values[:, Signal.VALVE_OPENING] = np.nan
    quality[:, Signal.VALVE_OPENING] = Quality.BAD
    return replace(record, measured=SampleTable(record.table.time_ns, values, quality))


def _changes_opening(model: ExtendedModel | None) -> bool:
    return model is not None and (
        any(a.cause.stage in (Stage.OPENING, Stage.INPUT) for a in model.model.active)
        or _changes_opening(model.on_top_of)
    )


def diagnose_own(
    record: Record, model: RegionalModel, progress: Progress = quiet
) -> tuple[Diagnosis, Record]:
    """Diagnose a record with a model that was found from it; return also the record used.

    The exponent of the pressure was fitted too, without the causes, which may have bent it. If
    another one is found beside them, the diagnosis is repeated with that exponent.
    """
    found = diagnose(record, model, progress=progress)
    further = [c.parameters['dm'].value for c in found.causes if c.name == 'exponent']
    if not further:
        return found, record
    form = replace(record.form, exponent=record.form.exponent + further[0])
    record = replace(record, form=form)
    model = first_model(record.table, record.step_s, form, record.settle_s)
    return diagnose(record, model, progress=progress), record


# Computing u from a pressure and the pressure from u changes its last digits, which would hide
# that the pressure was constant.
_DECIMALS = 9


def diagnose_window(task: DiagnosisTask) -> DiagnosisContent:
    """Diagnose the window in a task.

    Raises
    ------
    DataError
        The window is not sufficient for a diagnosis; the message says why.

    Notes
    -----
    The diagnosis starts from the current curve. The dynamics and the number of pieces are fitted
    to the window, as in `valveflow diagnose` without a model. A covariate with values for less
    than half of the rows is left out, which a note says.
    """
    settings, contents = task.settings, task.contents
    form, step_s = task.curve.static_form, settings.real('sample_period')
    table = table_of(contents, settings.real('pressure_exponent'))
    model: RegionalModel = task.curve.model
    if not task.curve.dynamics:
        model = first_model(table, step_s, form, settings.settle_s)
    beside = [CovariateRows(*parts(entry), rows) for entry, rows in contents.covariates.items()]
    short = {c.name: c for c in beside if c.covered < LEAST_COVERED}
    record = Record(
        table, step_s, form, settings.settle_s, _spans_ns(contents),
        covariates=tuple(c for c in beside if c.name not in short),
    )  # fmt: skip
    record = without_causes(record, task.curve.held)
    found, _ = diagnose_own(record, model)
    left_out = (f'{c.few} {c.name} was left out.' for c in short.values())
    found = replace(found, notes=(*found.notes, *left_out))
    text = json.dumps(to_json(found), allow_nan=False)
    return DiagnosisContent(task.window_end_ns, text)


def table_of(contents: WindowContents, exponent: float) -> SampleTable:
    """Return the rows of a window as a table, with the pressure used in u = V p^m."""
    opening = contents.opening_percent
    columns = {
        Signal.VALVE_OPENING: opening,
        Signal.MAIN_STEAM_PRESSURE: np.round(
            pressure_of(contents.u, opening, exponent), _DECIMALS
        ),
        Signal.MAIN_STEAM_TEMPERATURE: contents.temperature_degc,
        Signal.GENERATED_POWER: contents.power_mw,
    }
    if len(contents.command_percent):
        columns[Signal.VALVE_COMMAND] = contents.command_percent
    return SampleTable.from_columns(contents.time_ns, columns)


def _spans_ns(contents: WindowContents) -> IntArray:
    """Return the first and last time of the special segments, shape (k, 2)."""
    spans = contents.spans
    if not len(spans):
        return np.empty((0, 2), dtype=np.int64)
    return np.column_stack([contents.time_ns[spans[:, 0]], contents.time_ns[spans[:, 1] - 1]])
