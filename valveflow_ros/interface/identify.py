# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``identify``: the flow characteristic of a log."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.characteristic_json import to_json
from valveflow_ros.curve.compensation import openings_seen
from valveflow_ros.curve.shift import ShiftLimits, judge_shift, mixture_sentence, shift_json
from valveflow_ros.diagnosis.corrector import covariates_of
from valveflow_ros.diagnosis.extended import Extended, ExtendedModel
from valveflow_ros.diagnosis.result import model_to_json
from valveflow_ros.errors import DataError, UsageError, listed
from valveflow_ros.fit.model_form import find_misfit
from valveflow_ros.fit.result import EXPONENT_NOTES
from valveflow_ros.fit.static_test import find_static_test, may_be_static_test
from valveflow_ros.fit.step_levels import looks_like_step_test
from valveflow_ros.fit.step_test import identify_step_test
from valveflow_ros.interface import SILENT, Progress
from valveflow_ros.interface.files import Result, as_text, signed, writer
from valveflow_ros.interface.logs import Log, as_log
from valveflow_ros.interface.models import check_output, load_extended, taken_curve, taken_model
from valveflow_ros.interface.monitor import recorded_history
from valveflow_ros.interface.observation import check_signals, observe_log, settings_of
from valveflow_ros.parameters import Settings
from valveflow_ros.records import (
    N_SIGNALS,
    SIGNALS,
    FloatArray,
    Quality,
    Readings,
    SampleTable,
    Signal,
    SpecialSegment,
)
from valveflow_ros.report.answer import doubt, range_words
from valveflow_ros.report.identification import identification_page
from valveflow_ros.report.identified import Identified
from valveflow_ros.report.page import Page
from valveflow_ros.report.words import period
from valveflow_ros.signals.align import align_whole, plausible_ranges
from valveflow_ros.signals.units import in_unit

CURVE = 'characteristic.json'
STEP_TEST_ADVICE = (
    'This looks like a manual step test (few openings, each held). If the load controller was in '
    'manual, --step-test identifies it from its steady states; for data of a closed loop do not '
    'use it.'
)


STATIC_ADVICE = (
    'A static test needs fewer rows, at least 12: steady rows at one pressure and several '
    'openings, on a rising curve.'
)


@dataclass(frozen=True, slots=True, repr=False)
class Identification(Result):
    """An identified flow characteristic.

    Attributes
    ----------
    data : Identified
        All data of the report.
    log : Log
    model : ExtendedModel or None
        The model whose causes were kept fixed.
    """

    verb = 'identify'
    data: Identified
    log: Log
    model: ExtendedModel | None = None

    @property
    def characteristic(self) -> Characteristic:
        """Return the curve; its notes begin with the reasons not to rely on it."""
        c, doubts = self.data.characteristic, (self.data.mixture, doubt(self.data))
        return replace(c, notes=(*filter(None, doubts), *c.notes))

    @property
    def table(self) -> SampleTable:
        """Return the aligned rows that the engine saw."""
        return self.data.table

    @property
    def segments(self) -> tuple[SpecialSegment, ...]:
        """Return the special segments from which the curve was found."""
        return self.data.segments

    @property
    def notes(self) -> tuple[str, ...]:
        """Return notes on how the data were read, and on the curve."""
        return (*self.data.notes, *self.data.characteristic.notes)

    @property
    def output_unit(self) -> str:
        """Return the unit of the curve's output."""
        return self.data.characteristic.output_unit

    def _sentence(self) -> str:
        told = (f'{self.data.source}:', doubt(self.data), range_words(self.data))
        return ' '.join(filter(None, told))

    def page(self) -> Page:
        """Return the report."""
        return identification_page(self.data)

    def _replaced(self, folder: Path) -> str:
        path = folder / CURVE
        if writer(path) != self.verb:  # then it is kept
            return ''
        try:
            content = json.loads(path.read_text(encoding='utf-8'))
            model, window = str(content['model_id']), content['window']
            when = period(int(window['start_ns']), int(window['end_ns']))
        except (OSError, ValueError, KeyError, TypeError, OverflowError):
            return f'An earlier {CURVE} that was there was replaced.'
        if model == self.characteristic.model_id:
            return ''
        return f'The curve of {when} (model {model}) that was in {CURVE} was replaced.'

    def texts(self) -> dict[str, str]:
        """Return ``characteristic.json``; with a reference also ``shift.json``.

        With a model also the extended model with the new curve.
        """
        c = self.characteristic
        files = {CURVE: as_text(to_json(c))}
        if self.data.shift is not None:
            files['shift.json'] = as_text(shift_json(self.data.shift))
        if self.model is not None and c.dynamics:
            anew = Extended(c.model, self.model.model.active)
            model = model_to_json(replace(self.model, model=anew))
            files['extended_model.json'] = as_text(signed(model, self.verb))
        return files


def identify(
    log: Any,
    *,
    parameters: Mapping[str, Any] | None = None,
    model: ExtendedModel | str | Path | None = None,
    covariates: Mapping[str, str] | None = None,
    reference: Characteristic | str | Path | None = None,
    step_test: bool = False,
    progress: Progress = SILENT,
) -> Identification:
    """Find the flow characteristic of the valve in a log of ordinary operation.

    Parameters
    ----------
    log : Log, str, Path or pandas.DataFrame
        The result of `open_log`, or anything that it opens.
    parameters : mapping, optional
        Parameters of the monitor by name, such as ``{'time_constant': 120}``.
    model : ExtendedModel or path, optional
        An ``extended_model.json`` of a diagnosis: its causes are kept fixed, curve and dynamics
        are identified again.
    covariates : mapping of str to str, optional
        Columns of the covariates of ``model`` that this log calls otherwise, given as ``COLUMN``
        or ``COLUMN:unit`` by name.
    reference : Characteristic or path, optional
        A curve with which the new one is compared.
    step_test : bool
        The log is a manual test: constant pressure, and the opening changed in steps and held.
    progress : Progress

    Raises
    ------
    DataError
        The data determine no curve, or none that can be compared with the reference.
    RecordingError, InputError
        A file cannot be read, or a parameter is wrong.
    """
    if model is not None and step_test:
        raise UsageError('--step-test and --model do not go together.')
    model, given = taken_model(model, parameters, load_extended)
    if unknown := (covariates or {}).keys() - covariates_of(model).keys():
        raise UsageError(
            f'--covariate {min(unknown)}: identify needs a column only for a covariate of its '
            f'--model, which has {listed(list(covariates_of(model))) or "none"}.'
        )
    reference = taken_curve(reference)
    log = as_log(log, progress)
    check_output(log.output_unit, model=model, reference=reference)
    found = (
        _step_test(log, given, progress) if step_test
        else _identified(log, given, model, covariates, reference, progress)
    )  # fmt: skip
    seen = openings_seen(*_inputs(found.table))
    found = replace(found, characteristic=replace(found.characteristic, openings_seen=seen))
    if reference is not None:
        settings = found.settings
        limits = ShiftLimits(settings.real('shift_confidence'), settings.real('shift_least'))
        # Held values differ from segment to segment by more than the noise within one: they gave
        # dates to changes that were older than the log.
        segments = () if log.compression else found.segments
        shift = judge_shift(reference, found.characteristic, segments, limits)
        found = replace(found, shift=shift, reference=reference)
    return Identification(found, log, model)


def _identified(
    log: Log, given: Mapping[str, Any], model: ExtendedModel | None,
    covariates: Mapping[str, str] | None, reference: Characteristic | None, progress: Progress,
) -> Identified:  # fmt: skip
    settings, notes = settings_of(log, given, progress)
    try:
        observed = observe_log(log, settings, progress, model, said=covariates)
        # The form is kept: another one is not comparable with the reference, nor fits the causes.
        form = None if reference is None else reference.static_form
        form = form if model is None else model.form
        observed = replace(observed, task=replace(observed.task, form=form))
        characteristic = _of_compressed(observed.fit(progress), log)
    except DataError as error:
        table, _, counts = align_whole(log.readings, settings)
        read = _rows_as_read(log.readings, settings)
        test = None if model is not None else find_static_test(read, settings)
        if test is not None:
            for sentence in test.characteristic.notes:
                progress.say(sentence)
            return Identified(
                source=log.name, characteristic=test.characteristic, table=read,
                segments=test.segments, counts=counts, settings=settings,
                notes=(*log.notes, *notes), one_pressure=_one_pressure(log),
            )  # fmt: skip
        if looks_like_step_test(table, settings):
            raise DataError(f'{error} {STEP_TEST_ADVICE}') from None
        few = 'learn the noise' in str(error)
        if few and model is None and may_be_static_test(read, settings):
            raise DataError(f'{error} {STATIC_ADVICE}') from None
        raise
    told = []
    if observed.clock_resets:
        told.append(
            'The time stamps go back within the log. Where they did not return, the rows with '
            'the later times were left out.'
        )
    if looks_like_step_test(observed.table, settings):
        told.append(STEP_TEST_ADVICE)
    mixture = mixture_sentence(characteristic, observed.segments)
    told += [mixture] if mixture else []
    for sentence in told:
        progress.warn(in_unit(sentence, settings.output_unit))
    found = Identified(
        source=log.name, characteristic=characteristic, table=observed.table,
        segments=observed.segments, counts=observed.counts, settings=settings,
        notes=(*log.notes, *notes, *told), mixture=mixture,
        history=recorded_history(log.contents), one_pressure=_one_pressure(log),
    )  # fmt: skip
    misfit = find_misfit(
        *_inputs(found.table), found.power - found.static_mw, found.power, found.rows,
        settings.real('sample_period'),
    )  # fmt: skip
    return replace(found, misfit=misfit)


def _of_compressed(c: Characteristic, log: Log) -> Characteristic:
    """Return the curve without what the updates of a compressed log hide: short times and m."""
    updates = {} if log.compression is None else log.compression.updates
    if power := updates.get(Signal.GENERATED_POWER):
        dynamics = tuple(
            replace(
                region,
                time_constant_stderr_s=max(region.time_constant_stderr_s, power.interval_s),
                delay_stderr_s=max(region.delay_stderr_s, power.interval_s),
            )
            if region.time_constant_s < power.interval_s
            else region
            for region in c.dynamics
        )
        c = replace(c, dynamics=dynamics)
    pressure = updates.get(Signal.MAIN_STEAM_PRESSURE)
    if pressure is None or not (said := [n for n in c.notes if n.startswith(EXPONENT_NOTES)]):
        return c
    # After the correction of held values, m was off by up to 0.07 on 20 units of
    # `benchmarks.thermal_study` (1101 to 1110, dead band 0.13 MPa).
    hidden = (
        'The exponent m of the pressure and the power without flow cannot be judged in this log: '
        f'the historian keeps a pressure until it has changed by {pressure.dead_band:.2g} MPa. '
        f'The curve was found with m = {c.static_form.exponent:.2f}, which may be off by some '
        'hundredths.'
    )
    return replace(c, notes=(*(n for n in c.notes if n not in said), hidden))


def _one_pressure(log: Log) -> bool:
    """Return True if the pressure is one value throughout, as a constant given by the user."""
    r = log.readings
    pressure = r.value[(r.signal == Signal.MAIN_STEAM_PRESSURE) & np.isfinite(r.value)]
    return bool(len(pressure)) and float(np.ptp(pressure)) == 0.0


def _inputs(table: SampleTable) -> tuple[FloatArray, FloatArray]:
    """Return opening and pressure."""
    return table.column(Signal.VALVE_OPENING), table.column(Signal.MAIN_STEAM_PRESSURE)


def _rows_as_read(readings: Readings, settings: Settings) -> SampleTable:
    """Return a row for each time with any reading; values are neither held nor shifted.

    Impossible values are left out, as in any other row.
    """
    times, row = np.unique(readings.time_ns, return_inverse=True)
    values = np.full((N_SIGNALS, len(times)), np.nan)
    low, high = plausible_ranges(settings)[readings.signal].T
    good = (readings.quality < Quality.BAD) & (readings.value >= low) & (readings.value <= high)
    values[readings.signal[good], row[good]] = readings.value[good]
    return SampleTable.from_columns(times, {info.signal: values[info.signal] for info in SIGNALS})


def _step_test(log: Log, given: Mapping[str, Any], progress: Progress) -> Identified:
    settings, notes = settings_of(log, given, progress, constants=False)
    table, resets, counts = align_whole(log.readings, settings, progress)
    if len(resets):
        raise DataError(
            'The clock goes back within the log; a step test must be one stretch of time.'
        )
    check_signals(table, counts)
    progress(0.6, 'levels')
    test = identify_step_test(table, settings)
    return Identified(
        source=log.name, characteristic=test.characteristic, table=table,
        segments=test.segments, counts=counts, settings=settings, notes=(*log.notes, *notes),
        one_pressure=_one_pressure(log),
    )  # fmt: skip
