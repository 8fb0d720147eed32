# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``compare`` and ``validate``: curves tested on data that were not used to identify them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from valveflow_ros.baselines import comparison, validation
from valveflow_ros.baselines.judged import other_data, samples_of
from valveflow_ros.baselines.truth import Truth
from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.diagnosis.extended import ExtendedModel
from valveflow_ros.errors import DataError, UsageError
from valveflow_ros.fit.result import wrong_form
from valveflow_ros.interface import SILENT, Progress, models
from valveflow_ros.interface.files import Result, as_text
from valveflow_ros.interface.logs import Log, as_log
from valveflow_ros.interface.models import Model
from valveflow_ros.interface.observation import Observed, cut_in_two, observe_log, settings_of
from valveflow_ros.parameters import PARAMETERS, Settings
from valveflow_ros.report import comparison_tables
from valveflow_ros.report import validation as validation_report
from valveflow_ros.report.comparison import comparison_page, data_words, finding_words
from valveflow_ros.report.comparison_tables import Compared
from valveflow_ros.report.page import Page
from valveflow_ros.report.validation import Validated
from valveflow_ros.report.words import held_words, percent
from valveflow_ros.signals.static_form import INTEGRATED_INPUT, OPENING


@dataclass(frozen=True, slots=True, repr=False)
class ComparisonResult(Result):
    """The proposed method and two methods of the literature; ``data`` is shown in the report."""

    verb = 'compare'
    data: Compared

    @property
    def output_unit(self) -> str:
        """Return the unit of the log's output."""
        return self.data.result.characteristic.output_unit

    @property
    def comparison(self) -> comparison.Comparison:
        """Return the curves, errors and tests."""
        return self.data.result

    def _sentence(self) -> str:
        return ' '.join((data_words(self.data), *finding_words(self.data)[:1]))

    def page(self) -> Page:
        """Return the report."""
        return comparison_page(self.data)

    def texts(self) -> dict[str, str]:
        """Return ``comparison.json`` and three tables."""
        data = self.data
        content = {
            **comparison.to_json(data.result),
            'output_unit': self.output_unit,
            'learnt_from': data.source,
            'judged_on': data.other,
            'held_out': data.held_out,
            'words': [data_words(data), *finding_words(data)],
        }
        return {
            'comparison.json': as_text(content, 1),
            'parameters.csv': comparison_tables.parameters_csv(data),
            'segments.csv': comparison_tables.segments_csv(
                data.result.judgement, data.predictions
            ),
            'curves.csv': comparison_tables.curves_csv(data),
        }


@dataclass(frozen=True, slots=True, repr=False)
class ValidationResult(Result):
    """A curve compared with a log; ``data`` is shown in the report."""

    verb = 'validate'
    data: Validated

    @property
    def output_unit(self) -> str:
        """Return the unit of the curve's output, which is also that of the log's output."""
        return self.data.result.characteristic.output_unit

    @property
    def validation(self) -> validation.Validation:
        """Return the verdict, the pieces and the errors."""
        return self.data.result

    def _sentence(self) -> str:
        return validation_report.verdict_words(self.data)[0]

    def page(self) -> Page:
        """Return the report."""
        return validation_report.validation_page(self.data)

    def texts(self) -> dict[str, str]:
        """Return ``validation.json`` and ``segments.csv``."""
        data = self.data
        content = {
            **validation.to_json(data.result),
            'output_unit': self.output_unit,
            'log': data.source,
            'model': data.model,
            'against': data.other or None,
            'held': [h.name for h in data.result.characteristic.held],
            'words': validation_report.verdict_words(data),
        }
        predictions = tuple(data.result.predictions)
        return {
            'validation.json': as_text(content, 1),
            'segments.csv': comparison_tables.segments_csv(data.result.judgement, predictions),
        }


def compare(
    log: Any,
    *,
    test: Any = None,
    truth: Truth | str | Path | None = None,
    parameters: Mapping[str, Any] | None = None,
    progress: Progress = SILENT,
) -> ComparisonResult:
    """Identify the curve with three methods and compare them on held-out data.

    Parameters
    ----------
    log : Log, str, Path or pandas.DataFrame
        The log used for fitting: the result of `open_log`, or anything that it opens.
    test : Log, str, Path or pandas.DataFrame, optional
        A log of other days for the test; without it the last third of ``log`` is held out.
    truth : Truth or path, optional
        The true curve of a simulated plant.
    parameters : mapping, optional
        Parameters of the monitor by name.
    progress : Progress

    Raises
    ------
    RecordingError, InputError, DataError
        A log cannot be read, determines no curve, or contains no data for the test.
    """
    given = {**(parameters or {}), 'axis': INTEGRATED_INPUT}
    if (parameters or {}).get('axis') == OPENING:
        raise UsageError(
            'compare uses the form F(V p^m) for all methods, as their papers do: leave the '
            'parameter axis out.'
        )
    if truth is not None and not isinstance(truth, Truth):
        truth = models.load_truth(truth)
    log = _not_empty(as_log(log, progress))
    if test is None:
        block = given.get('block', PARAMETERS['block'].default)
        first, second = cut_in_two(log, float(block))
        names = f'{log.name} (first two thirds)', f'{log.name} (last third)'
    else:
        first, second = log, _not_empty(as_log(test, progress))
        names = first.name, second.name
    learn, settings, notes = _see(first, names[0], given, progress, progress.part(0.0, 0.4))
    # A discrete model must be simulated at the step at which it was fitted.
    given['sample_period'] = settings.real('sample_period')
    judged, other, more = _see(second, names[1], given, progress, progress.part(0.2, 0.4))
    progress(0.4, 'curve of special segments')
    characteristic = learn.fit(lambda _, what: progress(0.4, what))
    result = comparison.compare(
        samples_of(learn.task.contents, settings), characteristic,
        other_data(judged.task.contents, other), truth, progress,
    )  # fmt: skip
    doubt = wrong_form(characteristic, 'is used for all three methods')
    if doubt:
        progress.warn(doubt)
    notes = tuple(n for n in dict.fromkeys((*notes, *more, doubt, *characteristic.notes)) if n)
    return ComparisonResult(
        Compared(
            log.name, second.name, test is None, result, learn.task.contents,
            judged.task.contents, notes,
        )
    )  # fmt: skip


def validate(
    log: Any,
    model: Model | str | Path,
    *,
    against: Characteristic | str | Path | None = None,
    tolerance_mw: float | None = None,
    parameters: Mapping[str, Any] | None = None,
    progress: Progress = SILENT,
) -> ValidationResult:
    """Compare a characteristic with a log that was not used to identify it.

    Parameters
    ----------
    log : Log, str, Path or pandas.DataFrame
        The result of `open_log`, or anything that it opens.
    model : Characteristic, ExtendedModel, a result that has one, or path
    against : Characteristic or path, optional
        A second curve; the result says which of the two is better.
    tolerance_mw : float, optional
        A mean difference below this is ignored; the parameter ``alarm_floor`` by default.
    parameters : mapping, optional
        Parameters of the monitor by name.
    progress : Progress

    Raises
    ------
    RecordingError, InputError, DataError
        The log cannot be read or contains no data for the test.
    """
    curve, given = models.taken_model(model, parameters, models.load_model)
    assert curve is not None
    second = models.taken_curve(against)
    if second is not None and isinstance(curve, ExtendedModel):
        raise UsageError(
            '--against takes two curves over the same rows, and those of an extended model are '
            'freed of its causes: validate each by itself and compare their errors.'
        )
    log = _not_empty(as_log(log, progress))
    models.check_output(log.output_unit, model=curve, second_curve=second)
    extended = None
    if isinstance(curve, ExtendedModel):
        extended, curve = curve, curve.characteristic()
    observed, settings, notes = _see(log, log.name, given, progress, progress, extended)
    contents = observed.task.contents
    progress(0.7, 'judging')
    tolerance = tolerance_mw or settings.real('alarm_floor')
    result = validation.validate(curve, other_data(contents, settings), tolerance, second)
    if result.outside_share > validation_report.OUTSIDE_FLAG:
        progress.warn(
            f'{percent(result.outside_share, 2)} of the special samples lie beyond the ends of '
            'the curve and were not judged.'
        )
    held = held_words(curve.held)
    if curve.held and not extended:
        held = (
            'The curve was identified with causes held '
            f'({", ".join(h.name for h in curve.held)}), which this log is not freed of: give the '
            'extended_model.json beside it as --model.'
        )
        progress.warn(held)
    names = _name(model, against), '' if against is None else _name(against, model)
    return ValidationResult(Validated(log.name, *names, result, contents, notes, held))


def _name(model: Model | str | Path, other: Model | str | Path | None) -> str:
    """Return a file's name, with its folder if a folder was given or two names would be equal."""
    if not isinstance(model, str | Path):
        curve = getattr(model, 'characteristic', model)  # of a result
        return getattr(curve, 'model_id', '') or 'the model'
    file = models.model_path(Path(model))
    alike = isinstance(other, str | Path) and models.model_path(Path(other)).name == file.name
    return str(file) if alike or file != Path(model) else file.name


def _see(
    log: Log, name: str, given: Mapping[str, Any], progress: Progress,
    shown: Callable[[float, str], None], model: ExtendedModel | None = None,
) -> tuple[Observed, Settings, tuple[str, ...]]:  # fmt: skip
    """Run the engine over a log; return the observed data, the settings, and notes on the reading.

    An error message contains the name of the log.
    """
    settings, notes = settings_of(log, given, progress, constants=False)
    try:
        observed = observe_log(log, settings, progress, model, shown)
    except DataError as error:
        raise DataError(f'{name}: {error}') from None
    told = (*log.notes, *notes)
    if observed.clock_resets:
        back = (
            f'{name}: the time stamps go back within the log. Where they did not return, the '
            'rows with the later times were left out.'
        )
        progress.warn(back)
        told = (*told, back)
    return observed, settings, told


def _not_empty(log: Log) -> Log:
    if not len(log.readings):
        raise DataError(f'{log.contents.path}: there is not one reading in it.')
    return log
