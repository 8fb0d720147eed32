"""From a log that was read to the files and the words of an identification."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from valveflow_ros.cli import engine
from valveflow_ros.cli.console import Console, Outcome
from valveflow_ros.cli.files import signed
from valveflow_ros.cli.first_run import SENTENCE, is_first_run
from valveflow_ros.cli.log_input import LogInput, steps_of
from valveflow_ros.cli.manual_test import advice_for, found_in_step_test, refusal
from valveflow_ros.cli.monitor_history import history_in
from valveflow_ros.cli.options import settings_for
from valveflow_ros.cli.report_words import columns, rejected_words
from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.characteristic_json import to_json
from valveflow_ros.curve.shift import ShiftLimits, judge_shift, shift_json
from valveflow_ros.diagnosis import result
from valveflow_ros.diagnosis.corrector import corrector_of
from valveflow_ros.diagnosis.extended import Extended, ExtendedModel
from valveflow_ros.errors import DataError
from valveflow_ros.monitoring.rows import Corrector
from valveflow_ros.parameters import Settings
from valveflow_ros.records import SIGNALS
from valveflow_ros.report.answer import doubt, explained, opening_gain, temperature_words
from valveflow_ros.report.data import rejected
from valveflow_ros.report.identified import Identified
from valveflow_ros.report.words import (
    count,
    counted,
    decimals,
    held_words,
    input_unit_plain,
    interval,
    moment,
    percent,
    plain,
    with_error,
)


def found_in(
    log: LogInput,
    given: Mapping[str, Any],
    source: Path,
    console: Console,
    step_test: bool = False,
    extended: ExtendedModel | None = None,
) -> Identified:
    """Run the engine and the fit, or identify a manual step test.

    Causes of an ``extended`` model are taken out of the rows first.

    Raises
    ------
    DataError
        The data carry no curve; the sentence says why.
    """
    times = log.readings.time_ns
    span_s = float(times.max() - times.min()) / 1e9 if len(times) else 0.0
    if step_test:
        return found_in_step_test(log, given, source, console, span_s)
    settings, notes = settings_for(steps_of(log.readings), span_s, given)
    notes += _constant_notes(log)
    for sentence in notes:
        console.say(sentence)
    if is_first_run():
        console.say(SENTENCE)
    try:
        watched = engine.watch(
            log.readings, settings, console.progress, _corrector(extended, settings)
        )
        characteristic = engine.identify(watched, console.progress)
    except DataError as error:
        raise refusal(error, log.readings, settings) from None
    if watched.clock_resets:
        told = 'The clock went back within the log; where it stayed, what it had passed is out.'
        console.warn(told)
        notes.append(told)
    if told := advice_for(watched.table, settings):
        console.warn(told)
        notes.append(told)
    return Identified(
        source=source.name, characteristic=characteristic, table=watched.table,
        segments=watched.segments, counts=watched.counts, settings=settings,
        notes=(*log.contents.warnings, *(d.sentence for d in log.doubts), *notes),
        history=history_in(log.contents),
    )  # fmt: skip


def _corrector(extended: ExtendedModel | None, settings: Settings) -> Corrector | None:
    return None if extended is None else corrector_of(extended, settings.real('sample_period'))


def _constant_notes(log: LogInput) -> list[str]:
    return [
        f'{SIGNALS[signal].topic} was not logged and is taken as {value:g} {SIGNALS[signal].unit}.'
        for signal, value in sorted(log.constants.items())
    ]


def judged(found: Identified, reference: Characteristic) -> Identified:
    """Judge the curve against a reference.

    Raises
    ------
    DataError
        The two cannot be compared.
    """
    settings = found.settings
    limits = ShiftLimits(settings.real('shift_confidence'), settings.real('shift_least'))
    shift = judge_shift(reference, found.characteristic, found.segments, limits)
    return replace(found, shift=shift, reference=reference)


def texts(found: Identified, extended: ExtendedModel | None = None) -> dict[str, str]:
    """Return the files for programs by name; an extended model gets the new curve."""
    content = json.dumps(to_json(found.characteristic), indent=2, allow_nan=False)
    files = {'characteristic.json': content + '\n'}
    if found.shift is not None:
        told = json.dumps(shift_json(found.shift), indent=2, allow_nan=False)
        files['shift.json'] = told + '\n'
    if extended is not None and found.characteristic.dynamics:
        anew = Extended(found.characteristic.model, extended.model.active)
        model = signed(result.model_to_json(replace(extended, model=anew)), 'identify')
        files['extended_model.json'] = json.dumps(model, indent=2) + '\n'
    return files


def outcome(found: Identified, written: Mapping[str, Path], log: LogInput) -> Outcome:
    """Return what is printed at the end."""
    data = {
        **to_json(found.characteristic),
        'explained': explained(found),
        'readings': found.counts,
        'sample_period_s': found.settings.real('sample_period'),
        'inputs': {SIGNALS[s].topic: name for s, name in log.contents.signals.items()},
        'constants': {SIGNALS[s].topic: value for s, value in log.constants.items()},
        'reading_notes': list(found.notes),
        **({} if found.shift is None else {'shift': shift_json(found.shift)}),
        'files': {name: str(path) for name, path in written.items()},
    }
    return Outcome(_text(found, written), data)


def _files(written: Mapping[str, Path]) -> str:
    """Name what was written, the page for people first."""
    others = [path.name for name, path in written.items() if name != 'report.html']
    *most, last = [str(written['report.html']), *others]
    return f'Wrote {", ".join(most)} and {last}.'


def _text(found: Identified, written: Mapping[str, Path]) -> str:
    c = found.characteristic
    parts = [
        f'{found.source}: {moment(c.source.window_start_ns)} to {moment(c.source.window_end_ns)}',
        f'The flow characteristic has {counted(len(c.pieces), "piece")} and explains '
        f'{percent(explained(found))} of the variance of the power.',
        doubt(found),
        _pieces(found),
        _breakpoints(c),
        _dynamics(c),
        'Behind ± stands one standard error; 95 % lie within 1.96 of them.',
        f'Found in {counted(c.source.steady, "steady-state segment")} and '
        f'{counted(c.source.slope_response, "slope-response segment")}, '
        f'{counted(c.source.samples, "sample")}. Typical difference '
        f'{plain(c.residuals.rmse_mw, 2)} MW.',
        temperature_words(c),
        held_words(c.held),
        *c.notes,
        '' if found.shift is None else f'Against the reference: {found.shift.sentence}',
        rejected_words(found.counts) if rejected(found.counts) else '',
        _files(written),
    ]
    return '\n'.join(part for part in parts if part)


def _pieces(found: Identified) -> str:
    c = found.characteristic
    rows = []
    for k, piece in enumerate(c.pieces):
        gain, pressure = opening_gain(found, piece)
        at = f'{plain(gain, 3)} at {plain(pressure, 3)} MPa' if math.isfinite(gain) else '-'
        rows.append(
            [
                str(k + 1),
                f'{decimals(piece.u_from, 1)} to {decimals(piece.u_to, 1)}',
                with_error(piece.slope, piece.slope_stderr),
                with_error(piece.intercept, piece.intercept_stderr),
                at,
                count(piece.samples),
            ]
        )
    unit = input_unit_plain(c.pressure_exponent)
    head = ['piece', f'u ({unit})', 'slope (MW per u)', 'intercept (MW)', 'MW per 1 % opening',
            'samples']  # fmt: skip
    return columns(rows, head)


def _breakpoints(c: Characteristic) -> str:
    rows = [
        [decimals(piece.u_to, 1), f'{interval(low, high)}', f'{decimals(float(value), 1)} MW']
        for piece, (low, high), value in zip(
            c.pieces[:-1], c.breakpoint_intervals, c.values()[1:-1], strict=True
        )
    ]
    return columns(rows, ['breakpoint u', '95 % interval', 'power']) if rows else ''


def _dynamics(c: Characteristic) -> str:
    rows = [
        [
            f'{decimals(d.power_from, 0)} to {decimals(d.power_to, 0)} MW',
            with_error(d.time_constant_s, d.time_constant_stderr_s, 's'),
            with_error(d.delay_s, d.delay_stderr_s, 's'),
        ]
        for d in c.dynamics
    ]
    return columns(rows, ['dynamics', 'time constant', 'delay']) if rows else ''
