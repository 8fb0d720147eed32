# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``diagnose``: the difference between simulation and measurement, and its cause."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.diagnosis import diagnose as search
from valveflow_ros.diagnosis.corrector import covariates_of
from valveflow_ros.diagnosis.extended import ExtendedModel
from valveflow_ros.diagnosis.from_window import diagnose_own, first_model, on_top
from valveflow_ros.diagnosis.grids import LEAST_COVERED, CovariateRows
from valveflow_ros.diagnosis.result import NAMED, Diagnosis, model_to_json, to_json
from valveflow_ros.diagnosis.signature import views
from valveflow_ros.errors import DataError, InputError
from valveflow_ros.interface import SILENT, Progress
from valveflow_ros.interface.files import Result, as_text, signed
from valveflow_ros.interface.logs import Log, as_log, read_covariate
from valveflow_ros.interface.models import Model, check_output, load_model, taken_model
from valveflow_ros.interface.monitor import recorded_history
from valveflow_ros.interface.observation import (
    Covariates,
    Observed,
    corrected,
    observe_log,
    settings_of,
    taken_covariates,
)
from valveflow_ros.parameters import Settings
from valveflow_ros.records import SIGNALS, IntArray, SampleTable, Signal
from valveflow_ros.report.diagnosis import Diagnosed, diagnosis_page
from valveflow_ros.report.page import Page
from valveflow_ros.report.words import held_words
from valveflow_ros.signals.align import Aligner, align_whole, aligned_blocks, gathered
from valveflow_ros.signals.static_form import StaticForm

_TRY_A_COLUMN = (
    'A further signal of the table may explain the slow variation, such as the condenser '
    'pressure: try --covariate NAME=COLUMN[:UNIT] (a recording has it as a topic if import had '
    'this option too).'
)
_FITTED_EXPONENT = (
    'The exponent m of the pressure was fitted to this log: {:.3f}. To have another one checked, '
    'give it with --set pressure_exponent=..., or a model with --model.'
)
_TAKE_IT_OUT = (
    'Curve and alarms can leave out {}: give the extended_model.json of this diagnosis to '
    'identify --model and monitor --model, or to the node as model_file.'
)


@dataclass(frozen=True, slots=True, repr=False)
class DiagnosisResult(Result):
    """A diagnosis.

    Attributes
    ----------
    data : Diagnosed
        All data of the report.
    form : StaticForm
        Form of the model.
    on_top_of : ExtendedModel or None
        The model whose causes were removed from the rows first.
    """

    verb = 'diagnose'
    data: Diagnosed
    form: StaticForm
    on_top_of: ExtendedModel | None = None

    @property
    def diagnosis(self) -> Diagnosis:
        """Return the verdict, the causes and the gain."""
        return self.data.diagnosis

    @property
    def extended_model(self) -> ExtendedModel:
        """Return the model with the named causes added."""
        d = self.diagnosis
        return ExtendedModel(
            d.final, self.form, self.data.start_ns, d.reference, self.on_top_of, self.output_unit
        )

    @property
    def output_unit(self) -> str:
        """Return the unit of the log's output."""
        return self.data.output_unit

    def _sentence(self) -> str:
        return self.diagnosis.sentence

    def page(self) -> Page:
        """Return the report."""
        return diagnosis_page(self.data)

    def texts(self) -> dict[str, str]:
        """Return ``diagnosis.json`` and ``extended_model.json``."""
        diagnosis = {**to_json(self.diagnosis), 'output_unit': self.output_unit}
        model = signed(model_to_json(self.extended_model), self.verb)
        return {'diagnosis.json': as_text(diagnosis), 'extended_model.json': as_text(model)}


@dataclass(frozen=True, slots=True)
class _Rows:
    """Aligned rows, special segments, and the model if one was found.

    ``places`` are the indices of the rows among all rows of the log; None means all rows.
    """

    table: SampleTable
    spans_ns: IntArray
    model: RegionalModel | None
    form: StaticForm
    why: str = ''
    places: IntArray | None = None
    observed: Observed | None = None

    def asked(self, given: StaticForm) -> tuple[StaticForm, RegionalModel] | None:
        """Return the form that the data require instead of the given one, and a model of it.

        None if the given form fits, or if no model can be found.
        """
        if self.observed is None or not self.observed.contradicts(given):
            return None
        try:
            model, form = self.observed.outline()
        except DataError:
            return None
        return None if form.axis == given.axis else (form, model)


def _load_diagnosable(path: str | Path) -> Model:
    model = load_model(path)
    if isinstance(model, Characteristic) and not model.dynamics:
        raise DataError(
            f'{path}: this curve has no dynamics, and without them every ramp would look like a '
            'fault; identify it from a longer record, or leave out --model.'
        )
    return model


def diagnose(
    log: Any,
    *,
    parameters: Mapping[str, Any] | None = None,
    model: Model | str | Path | None = None,
    covariates: Mapping[str, str] | None = None,
    progress: Progress = SILENT,
) -> DiagnosisResult:
    """Compare the simulation with the measured power and name the cause of the difference.

    Parameters
    ----------
    log : Log, str, Path or pandas.DataFrame
        The result of `open_log`, or anything that it opens.
    parameters : mapping, optional
        Parameters of the monitor by name. Another exponent of the pressure than a given
        ``pressure_exponent`` is a cause; without it the model has the exponent that fits the log.
    model : Characteristic, ExtendedModel or path, optional
        The log is compared with this model; by default a model is found in the log itself.
        The causes of an extended model are removed from the rows before the comparison.
    covariates : mapping of str to str, optional
        Further columns (of a recording: topics) that may influence the power, given as
        ``COLUMN`` or ``COLUMN:unit`` by name: ``{'vacuum':
        'condenser_pressure_kpa'}``. Each is tested like a cause of the catalogue. By default the
        topics in the parameter ``covariates``.
    progress : Progress

    Raises
    ------
    DataError
        The record does not permit a diagnosis; the message gives the reason.
    RecordingError, InputError
        A file cannot be read, or a parameter is wrong.
    """
    model, given = taken_model(model, parameters, _load_diagnosable)
    covariates = taken_covariates(covariates, given)
    log = as_log(log, progress)
    check_output(log.output_unit, model=model)
    settings, notes = settings_of(log, given, progress)
    earlier = model if isinstance(model, ExtendedModel) and model.held else None
    own = {n: said for n, said in covariates.items() if n in covariates_of(earlier)}
    rows = _rows(
        log, settings, model is None, progress, earlier, own, 'pressure_exponent' in given
    )
    if rows.why:
        progress.warn(rows.why)
    step, settle = settings.real('sample_period'), settings.settle_s
    form, regional = rows.form, rows.model
    if model is not None:
        form = model.form if isinstance(model, ExtendedModel) else model.static_form
        regional = model.model.base if isinstance(model, ExtendedModel) else model.model
    if regional is None:
        regional = first_model(rows.table, step, form, settle)
    beside = _covariate_rows(log, covariates, rows.table)
    record = search.Record(
        rows.table, step, form, settle, rows.spans_ns, compression=log.compression,
        covariates=beside,
    )  # fmt: skip
    if earlier is not None:
        measured = align_whole(log.readings, settings)[0]
        record = on_top(
            record, earlier, measured if rows.places is None else measured.take(rows.places)
        )
        notes.append(held_words(earlier.held))
    found, record = _diagnosis(
        record, regional, model, rows, 'pressure_exponent' in given, progress.part(0.3, 0.65)
    )
    form = record.form
    usual = StaticForm(exponent=settings.real('pressure_exponent'))
    if model is None and not form.scaled and form != usual:
        notes.append(_FITTED_EXPONENT.format(form.exponent))
    kept = () if log.compression is None else (log.compression.sentence,)
    if found.disturbance is not None and not beside:
        notes.append(_TRY_A_COLUMN)
    if followed := [c.name for c in beside if c.name in {n.name for n in found.causes}]:
        notes.append(_TAKE_IT_OUT.format(' and '.join(followed)))
    signatures, answers, maps = views(record, found)
    if rows.why and found.verdict == NAMED:
        notes.append(rows.why)
    elif rows.why:  # more important than that no cause was found
        found = replace(found, sentence=f'{rows.why} {found.sentence}')
    found = replace(found, notes=(*log.contents.warnings, *kept, *notes, *found.notes))
    found = found.measured_in(settings.output_unit)
    times = rows.table.time_ns
    data = Diagnosed(
        log.name, int(times[0]), int(times[-1]), found, signatures, answers, maps,
        recorded_history(log.contents), _exponent_shown(rows.table, form), settings.output_unit,
    )  # fmt: skip
    return DiagnosisResult(data, form, earlier)


def _diagnosis(
    record: search.Record, regional: RegionalModel, model: Characteristic | ExtendedModel | None,
    rows: _Rows, exponent_given: bool, progress: Callable[[float, str], None],
) -> tuple[Diagnosis, search.Record]:  # fmt: skip
    """Diagnose a record by where its model comes from; return also the record in its last form."""
    if model is None and not exponent_given:
        return diagnose_own(record, regional, progress)
    held = isinstance(model, ExtendedModel) and model.held
    asked = None if model is None or held else rows.asked(record.form)
    if asked is None:
        return search.diagnose(record, regional, model is not None, progress), record
    form, there = asked
    other = replace(record, form=form)
    return search.diagnose_form(record, regional, other, there, progress), other


def _exponent_shown(table: SampleTable, form: StaticForm) -> float:
    """Return the exponent of u; 0 if u is the opening because the pressure is always 1 MPa."""
    pressure = table.column(Signal.MAIN_STEAM_PRESSURE)
    is_one = bool(np.all(pressure[np.isfinite(pressure)] == 1.0))
    return 0.0 if is_one else form.input_exponent


def _covariate_rows(
    log: Log, said: Mapping[str, str], table: SampleTable
) -> tuple[CovariateRows, ...]:
    """Return the covariates at the rows of a table; a column must cover half of them."""
    found = []
    for name, theirs in said.items():
        series = read_covariate(log, name, theirs)
        rows = CovariateRows(name, series.column, series.unit, series.at(table.time_ns))
        if rows.covered < LEAST_COVERED:
            raise InputError(f'--covariate {name}: {rows.few}')
        found.append(rows)
    return tuple(found)


def _rows(
    log: Log, settings: Settings, wanted: bool, progress: Progress,
    earlier: ExtendedModel | None, said: Mapping[str, str], exponent_given: bool,
) -> _Rows:  # fmt: skip
    """Align the log and find special segments; continue without them if all signals are there."""
    try:
        observed = observe_log(
            log, settings, progress, earlier, progress.part(0.0, 0.35), said
        )  # fmt: skip
    except DataError as error:
        columns = Covariates.of(log, earlier, said)
        corrector = columns.corrector_of(earlier, settings)
        blocks = columns.beside(aligned_blocks(Aligner(settings), log.readings, None, ''))
        table = gathered(corrected(blocks, corrector)).table
        needed = [info.signal for info in SIGNALS if info.required]
        if not len(table) or not all(np.isfinite(table.column(s)).any() for s in needed):
            raise
        why = f'{error} The model is found from all rows instead, without special segments.'
        form = StaticForm(exponent=settings.real('pressure_exponent'))
        return _Rows(table, np.empty((0, 2), dtype=np.int64), None, form, why)
    spans = np.array([(s.start_ns, s.end_ns) for s in observed.segments], dtype=np.int64)
    rows = _Rows(
        observed.table, spans.reshape(-1, 2), None, observed.paper_form, places=observed.rows,
        observed=observed,
    )  # fmt: skip
    if not wanted:
        return rows
    try:
        model, form = observed.outline(progress.part(0.0, 0.4), exponent_given)
        return replace(rows, model=model, form=form)
    except DataError as error:
        return replace(rows, why=f'{error} All rows are used instead.')
