"""From a log that was read to the files and the words of a diagnosis."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from valveflow_ros.cli import engine
from valveflow_ros.cli.console import Console, Outcome
from valveflow_ros.cli.files import signed
from valveflow_ros.cli.first_run import SENTENCE, is_first_run
from valveflow_ros.cli.log_input import LogInput, steps_of
from valveflow_ros.cli.model_file import read_either
from valveflow_ros.cli.monitor_history import history_in
from valveflow_ros.cli.options import settings_for
from valveflow_ros.cli.report_words import columns
from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.diagnosis.corrector import corrector_of
from valveflow_ros.diagnosis.diagnose import Record, diagnose
from valveflow_ros.diagnosis.extended import ExtendedModel
from valveflow_ros.diagnosis.from_window import first_model, on_top
from valveflow_ros.diagnosis.result import (
    NAMED,
    NOTHING,
    UNEXPLAINED,
    Diagnosis,
    model_to_json,
    to_json,
)
from valveflow_ros.diagnosis.signature import Views, views
from valveflow_ros.errors import DataError
from valveflow_ros.monitoring.rows import Corrector
from valveflow_ros.parameters import Settings
from valveflow_ros.records import SIGNALS, IntArray, SampleTable
from valveflow_ros.report.diagnosis import Diagnosed, cells
from valveflow_ros.report.words import decimals, held_words

_BLIND = 'cannot be judged'
_VERDICTS = {
    NAMED: 'cause found', NOTHING: 'nothing is wrong', UNEXPLAINED: 'something is unexplained',
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Result:
    """A diagnosis, what it was made from, and the exponent of its u."""

    page: Diagnosed
    exponent: float
    on_top_of: ExtendedModel | None = None


@dataclass(frozen=True, slots=True)
class _Rows:
    """Aligned rows, special segments, and the model where one was found.

    The places are those of the rows among all of the log; None: they are all.
    """

    table: SampleTable
    spans_ns: IntArray
    model: RegionalModel | None
    why: str = ''
    places: IntArray | None = None


def read_model(path: Path) -> Characteristic | ExtendedModel:
    """Read ``characteristic.json`` or ``extended_model.json``.

    Raises
    ------
    RecordingError, DataError
    """
    model = read_either(path)
    if isinstance(model, ExtendedModel):
        return model
    if not model.dynamics:
        raise DataError(
            f'{path}: this curve has no dynamics, and without them every ramp would look like a '
            'fault; identify it from a longer record, or leave out --model.'
        )
    return model


def diagnosed_in(
    log: LogInput, model: Characteristic | ExtendedModel | None, given: Mapping[str, Any],
    source: Path, console: Console,
) -> Result:  # fmt: skip
    """Align, identify if there is no model, diagnose.

    Where the model is an extended one, it is what the log is held against: its causes are
    taken out of the rows, and what differs after that is a finding.

    Raises
    ------
    DataError
        The record cannot carry a diagnosis; the sentence says why.
    """
    times = log.readings.time_ns
    span_s = float(times.max() - times.min()) / 1e9 if len(times) else 0.0
    settings, notes = settings_for(steps_of(log.readings), span_s, given)
    notes += [
        f'{SIGNALS[s].topic} was not logged and is taken as {value:g} {SIGNALS[s].unit}.'
        for s, value in sorted(log.constants.items())
    ]
    for sentence in notes:
        console.say(sentence)
    if is_first_run():
        console.say(SENTENCE)
    earlier = model if isinstance(model, ExtendedModel) and model.held else None
    rows = _rows(log, settings, model is None, console, earlier)
    if rows.why:
        console.warn(rows.why)
        notes.append(rows.why)
    step, settle = settings.real('sample_period'), settings.settle_s
    exponent = model.pressure_exponent if model else settings.real('pressure_exponent')
    regional = rows.model if model is None else _regional(model)
    if regional is None:
        regional = first_model(rows.table, step, exponent, settle)
    record = Record(rows.table, step, exponent, settle, rows.spans_ns)
    if earlier is not None:
        measured = engine_align(log, settings)[0]
        record = on_top(
            record, earlier, measured if rows.places is None else measured.take(rows.places)
        )
        notes.append(held_words(earlier.held))
    found, (signatures, answers, maps) = diagnose_with_views(
        record, regional, model is not None, console
    )
    found = replace(found, notes=(*log.contents.warnings, *notes, *found.notes))
    ends = int(rows.table.time_ns[0]), int(rows.table.time_ns[-1])
    return Result(
        Diagnosed(
            source.name,
            *ends,
            found,
            signatures,
            answers,
            maps,
            history_in(log.contents),
            exponent,
        ),
        exponent,
        earlier,
    )


def diagnose_with_views(
    record: Record, model: RegionalModel, given: bool, console: Console
) -> tuple[Diagnosis, Views]:
    """Diagnose, and draw up what the pictures show."""
    found = diagnose(
        record, model, given, lambda share, what: console.progress(0.4 + 0.5 * share, what)
    )
    return found, views(record, found)


def _regional(model: Characteristic | ExtendedModel) -> RegionalModel:
    return model.model.base if isinstance(model, ExtendedModel) else model.model


def _rows(
    log: LogInput, settings: Settings, wanted: bool, console: Console,
    earlier: ExtendedModel | None = None,
) -> _Rows:  # fmt: skip
    """Align the log and find special segments; without any of them say so and go on."""
    step_s = settings.real('sample_period')
    corrector = None if earlier is None else corrector_of(earlier, step_s)
    try:
        watched = engine.watch(log.readings, settings, console.progress, corrector)
    except DataError as error:
        if corrector is not None:
            corrector.restart()
        table, _, _ = engine_align(log, settings, corrector)
        if not _complete(table):
            raise
        why = f'{error} The model is found from all rows instead, without special segments.'
        return _Rows(table, np.empty((0, 2), dtype=np.int64), None, why)
    spans = np.array([(s.start_ns, s.end_ns) for s in watched.segments], dtype=np.int64)
    spans = spans.reshape(-1, 2)
    if not wanted:
        return _Rows(watched.table, spans, None, places=watched.rows)
    try:
        model = engine.outlined(watched, console.progress)
    except DataError as error:
        why = f'{error} All rows are used instead.'
        return _Rows(watched.table, spans, None, why, watched.rows)
    return _Rows(watched.table, spans, model, places=watched.rows)


def engine_align(
    log: LogInput, settings: Settings, corrector: Corrector | None = None
) -> tuple[SampleTable, Any, Any]:
    """Put readings into rows."""
    from valveflow_ros.cli.alignment import align, quiet

    return align(log.readings, settings, quiet, corrector)


def _complete(table: SampleTable) -> bool:
    """Tell whether every needed signal has values."""
    return len(table) > 0 and all(
        bool(np.isfinite(table.column(info.signal)).any()) for info in SIGNALS if info.required
    )


def texts(found: Result) -> dict[str, str]:
    """Return the files for programs by name."""
    d, page = found.page.diagnosis, found.page
    model = ExtendedModel(d.final, found.exponent, page.start_ns, d.reference, found.on_top_of)
    extended = signed(model_to_json(model), 'diagnose')
    return {
        'diagnosis.json': json.dumps(to_json(d), indent=2, allow_nan=False) + '\n',
        'extended_model.json': json.dumps(extended, indent=2, allow_nan=False) + '\n',
    }


def outcome(found: Result, written: Mapping[str, Path]) -> Outcome:
    """Return what is printed at the end."""
    data = {
        **to_json(found.page.diagnosis),
        'files': {name: str(path) for name, path in written.items()},
    }
    return Outcome(_text(found, written), data)


def _text(found: Result, written: Mapping[str, Path]) -> str:
    d = found.page.diagnosis
    rows = [
        [c.name, key, *cells(e, found.exponent)]
        for c in d.causes
        for key, e in c.parameters.items()
    ]
    judged = [
        f'  {name}: {why.removeprefix(_BLIND).removeprefix(": ").strip()}'
        for name, why in d.rejected
        if why.startswith(_BLIND)
    ]
    parts = [
        f'{found.page.source}: {_VERDICTS[d.verdict]}. {d.sentence}',
        columns(rows, ['cause', 'parameter', 'value', '95 % interval']) if rows else '',
        f'Not told apart: {", ".join(d.not_told_apart)}.' if d.not_told_apart else '',
        *(f'What would tell them apart: {e}' for e in d.experiments),
        'Error (RMSE) on blocks of time that nothing was fitted to: simulation '
        f'{decimals(d.rmse_simulation, 3)} MW, extended model {decimals(d.rmse_extended, 3)} MW, '
        f'noise alone about {decimals(d.rmse_noise_floor, 3)} MW.',
        '\n'.join(['Not judged:', *judged]) if judged else '',
        *d.notes,
        f'Wrote {written["report.html"]}, diagnosis.json and extended_model.json.',
    ]
    return '\n'.join(part for part in parts if part)
