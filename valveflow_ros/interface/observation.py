# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Run the engine over a finished log: align, find special segments, request one fit."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.diagnosis.causes import check_covariates
from valveflow_ros.diagnosis.corrector import corrector_of, covariates_of
from valveflow_ros.diagnosis.extended import ExtendedModel
from valveflow_ros.errors import (
    WORKING_BYTES,
    DataError,
    InputError,
    check_address_space,
    counted,
)
from valveflow_ros.fit.fit import fit, form_contradicted, form_of_data, outline
from valveflow_ros.fit.task import FitTask
from valveflow_ros.interface import SILENT, Progress
from valveflow_ros.interface.logs import Log, Series, read_covariate
from valveflow_ros.interface.plausibility import selected
from valveflow_ros.interface.settings import settings_for
from valveflow_ros.monitoring.events import FitRequested
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.offline import feed_aligned
from valveflow_ros.monitoring.rows import Corrector
from valveflow_ros.numerics import read_ahead
from valveflow_ros.parameters import Settings, covariate_columns
from valveflow_ros.records import (
    COARSE_STEP_S,
    NS_PER_S,
    SIGNALS,
    IntArray,
    Readings,
    SampleTable,
    Signal,
    SpecialSegment,
)
from valveflow_ros.report.data import reason_words
from valveflow_ros.report.first_run import SENTENCE, compile_beside, is_first_run
from valveflow_ros.report.words import duration, moment
from valveflow_ros.segments.kernel import WARM_UP, WINDOW
from valveflow_ros.signals.align import Aligned, Aligner, aligned_blocks
from valveflow_ros.signals.covariates import entry, held
from valveflow_ros.signals.static_form import StaticForm

_NEEDED = tuple(i for i in SIGNALS if i.required and i.topic != 'main_steam_temperature')
LEARN_SHARE = 2.0 / 3.0


@dataclass(frozen=True, slots=True)
class Observed:
    """A log processed by the engine, and the inputs of a fit."""

    # The rows in the engine's window; if the clock was set back, without the rows before that.
    table: SampleTable
    rows: IntArray  # int64 (n,), their indices among all rows of the log
    segments: tuple[SpecialSegment, ...]
    counts: dict[str, dict[str, int]]  # ``{topic: {reason: readings}}``
    task: FitTask
    clock_resets: int  # number of times the clock was set back

    def fit(self, progress: Callable[[float, str], None] = SILENT) -> Characteristic:
        """Return the curve; raise `DataError` with the reason if the data determine none."""
        return fit(self.task, lambda what: progress(0.6, what))

    @property
    def paper_form(self) -> StaticForm:
        """Return the paper's form with the exponent of the settings."""
        return StaticForm(exponent=self.task.settings.real('pressure_exponent'))

    def contradicts(self, given: StaticForm) -> bool:
        """Return True if the data show that the static power has another form."""
        return form_contradicted(self.task, given)

    def outline(
        self, progress: Callable[[float, str], None] = SILENT, exponent_given: bool = False
    ) -> tuple[RegionalModel, StaticForm]:
        """Return curve, dynamics and form as start of a diagnosis; raises `DataError` like `fit`.

        With ``exponent_given`` the paper's form keeps the exponent of the settings: another one is
        then a cause, which the diagnosis must name. Breakpoints at fixed openings are used if the
        data require them.
        """
        task = self.task
        if exponent_given and not form_of_data(task).scaled:
            task = replace(task, form=self.paper_form)
        return outline(task, lambda what: progress(0.6, what))


def settings_of(
    log: Log, given: Mapping[str, Any], progress: Progress, constants: bool = True
) -> tuple[Settings, list[str]]:
    """Return the settings for a log, and report what was adapted; raises `ParameterError`."""
    given, told = log.parameters(given)
    settings, notes = settings_for(log.steps(), log.span_s, given, held=log.updates is not None)
    notes = [*told, *notes]
    if constants:
        notes += [
            f'{SIGNALS[s].topic} was not logged and is taken as {value:g} {SIGNALS[s].unit}.'
            for s, value in sorted(log.constants.items())
        ]
    for sentence in notes:
        progress.say(sentence)
    return settings, notes


def observe(
    readings: Readings,
    settings: Settings,
    progress: Callable[[float, str], None] = SILENT,
    corrector: Corrector | None = None,
    covariates: Covariates | None = None,
) -> Observed:
    """Feed readings to a monitor and request a fit.

    With a ``corrector`` its causes are removed from the rows before all other steps; it may need
    ``covariates``. Raises `DataError`, which says what is missing for a fit.
    """
    aligner, monitor = Aligner(settings), Monitor(settings)
    tables: list[SampleTable] = []
    resets = 0
    blocks = aligned_blocks(aligner, readings, progress, 'finding segments')
    blocks = blocks if covariates is None else covariates.beside(blocks)
    for aligned in read_ahead(corrected(blocks, corrector)):
        resets += len(aligned.resets)
        tables.append(aligned.table)
        feed_aligned(monitor, aligned)
    table, counts = SampleTable.concatenate(tables), aligner.counts()
    check_signals(table, counts)
    if not monitor.segments:
        raise DataError(_no_segment(table, settings, monitor.noise().learnt))
    task = next(e.task for e in monitor.request_fit() if isinstance(e, FitRequested))
    # Rows that have left the window are not a part of the fit.
    rows = monitor.numbers()
    if corrector is not None:
        task = replace(task, held=corrector.held)
    return Observed(table.take(rows), rows, monitor.special_segments(), counts, task, resets)


def corrected(blocks: Iterator[Aligned], corrector: Corrector | None) -> Iterator[Aligned]:
    """Yield blocks after removing the causes of a corrector, if there is one, from their rows."""
    if corrector is None:
        yield from blocks
        return
    for block in blocks:
        tables, start = [], 0
        for reset in block.resets.tolist():
            tables.append(corrector.correct(block.table.part(start, reset)))
            corrector.restart()
            start = reset
        tables.append(corrector.correct(block.table.part(start, len(block.table))))
        yield Aligned(SampleTable.concatenate(tables), block.resets)


def observe_log(
    log: Log, settings: Settings, progress: Progress, model: ExtendedModel | None = None,
    shown: Callable[[float, str], None] | None = None,
    said: Mapping[str, str] | None = None,
) -> Observed:  # fmt: skip
    """Observe a log as `observe` does; with a ``model`` its causes are removed from the rows.

    ``said`` are the columns of covariates of the model that the log calls otherwise.
    """
    check_address_space(WORKING_BYTES)
    if is_first_run():
        progress.say(SENTENCE)
        compile_beside()
    covariates = Covariates.of(log, model, said)
    corrector = covariates.corrector_of(model, settings)
    return observe(log.readings, settings, shown or progress, corrector, covariates)


class Covariates:
    """The further columns of a log that the rows need, by the name of the covariate."""

    def __init__(self, series: dict[str, Series]) -> None:
        self._series = series
        self.entries = tuple(entry(name, s.column, s.unit) for name, s in series.items())

    @classmethod
    def of(
        cls, log: Log, model: ExtendedModel | None, said: Mapping[str, str] | None = None
    ) -> Covariates:
        """Read the columns that a user names, and those that causes of a model follow."""
        own = {n: f'{c.column}:{c.unit}' for n, c in covariates_of(model).items()}
        said = said or {}
        try:
            found = {n: read_covariate(log, n, own[n]) for n in own if n not in said}
        except InputError as error:
            raise InputError(f'The model follows a further column. {error}') from None
        return cls({**found, **{n: read_covariate(log, n, theirs) for n, theirs in said.items()}})

    def corrector_of(self, model: ExtendedModel | None, settings: Settings) -> Corrector | None:
        """Return the corrector of a model for rows with these columns; None without a model."""
        if model is None:
            return None
        return corrector_of(model, settings.real('sample_period'), self.entries)

    def beside(self, blocks: Iterator[Aligned]) -> Iterator[Aligned]:
        """Yield the blocks with the values of the columns at their rows."""
        for block in blocks:
            rows_ns = block.table.time_ns
            columns = [held(s.time_ns, s.values, rows_ns) for s in self._series.values()]
            values = np.column_stack(columns) if columns else None
            yield replace(block, table=replace(block.table, covariates=values))


def cut_in_two(log: Log, block_s: float) -> tuple[Log, ...]:
    """Return the first two thirds of a log and the last third, cut at the end of a block."""
    r = log.readings
    first, last = int(r.time_ns.min()), int(r.time_ns.max())
    block = max(1, round(block_s * NS_PER_S))
    cut = first + int(LEARN_SHARE * (last - first)) // block * block
    early = r.time_ns < cut
    return tuple(
        replace(log, readings=selected(r, rows), updates=None) for rows in (early, ~early)
    )


def taken_covariates(
    said: Mapping[str, str] | None, given: Mapping[str, Any]
) -> Mapping[str, str]:
    """Return the columns to try as causes; by default those of the parameter ``covariates``."""
    if said is None:
        said = covariate_columns(str(given.get('covariates', '')).split())
    check_covariates(said)
    return said


def check_signals(table: SampleTable, counts: dict[str, dict[str, int]]) -> None:
    """Raise `DataError` if a required signal has no usable value; the message gives the reason."""
    for info in _NEEDED:
        if len(table) and np.isfinite(table.column(info.signal)).any():
            continue
        refused = {r: n for r, n in counts[info.topic].items() if n and r != 'accepted'}
        if not refused:
            steam = info.signal == Signal.MAIN_STEAM_PRESSURE
            constant = f', or give --constant {info.topic}=VALUE if it hardly changes'
            raise DataError(
                f'The log has no {info.topic}; name yours with --column {info.topic}=THEIRS'
                f'{constant if steam else ""}.'
            )
        raise DataError(
            f'{info.topic} has no usable value: {reason_words(refused)}. Is it the right column, '
            'in its unit?'
        )


def _no_segment(table: SampleTable, settings: Settings, learnt: bool) -> str:
    needed = [info.signal for info in _NEEDED]
    good = np.isfinite(table.values[:, needed]).all(axis=1)
    if good.sum() == 1:
        return (
            f'Only one time, {moment(int(table.time_ns[good][0]))}, has opening, pressure and '
            'power: is it the right column of times?'
        )
    step_s = settings.real('sample_period')
    coarse = step_s >= COARSE_STEP_S
    for signal in (Signal.VALVE_OPENING, Signal.GENERATED_POWER):
        values = table.column(signal)[good]
        # Of a short log the length is to be told.
        if (learnt or coarse) and len(values) and np.ptp(values) == 0.0:
            return (
                f'{SIGNALS[signal].topic} is {values[0]:g} {SIGNALS[signal].unit} in all rows: a '
                'curve needs several openings and the power at each.'
            )
    usable, longest = int(good.sum()), _longest_run(table.time_ns[good], settings)
    span = duration(usable * step_s)
    if not learnt:
        stretch_s = WINDOW * settings.real('block')
        have = (
            f'{counted(usable, "usable row")}, one every {duration(step_s)}'
            if coarse
            else f'{span} of usable data'
        )
        if longest < usable:
            most = longest if coarse else duration(longest * step_s)
            have += f', at most {most} without a gap'
        each = f'{math.ceil(stretch_s / step_s)} rows ' if coarse else ''
        each += f'({duration(stretch_s)})' if coarse else duration(stretch_s)
        return (
            f'The log holds {have}. To learn the noise of the signals it takes {WARM_UP} '
            f'stretches of {each} without a gap, and special segments after that to find the '
            'curve.'
        )
    least = settings.settle_s + min(settings.real('steady_min'), settings.real('slope_min'))
    return (
        f'No steady-state or slope-response segment was found in {span} of data: the valve must '
        f'rest, or move along a straight ramp, for {duration(least)} or longer at a time. '
        'A longer log, or shorter times by --set time_constant, delay, steady_min and slope_min, '
        'may help.'
    )


def _longest_run(time_ns: IntArray, settings: Settings) -> int:
    """Return the largest number of rows without a gap between."""
    gaps = np.flatnonzero(np.diff(time_ns) > 1.5e9 * settings.real('sample_period'))
    return int(np.diff(np.r_[-1, gaps, len(time_ns) - 1]).max())
