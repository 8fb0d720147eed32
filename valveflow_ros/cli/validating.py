"""From a log and a characteristic to the files and the words of a validation."""

from __future__ import annotations

import json
from argparse import Namespace
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from valveflow_ros.baselines.judged import other_data
from valveflow_ros.baselines.validation import to_json, validate
from valveflow_ros.cli.console import Console, Outcome
from valveflow_ros.cli.model_file import model_path
from valveflow_ros.cli.options import LogMapping as Columns
from valveflow_ros.cli.report_words import columns
from valveflow_ros.cli.usage import UsageError
from valveflow_ros.cli.watching import read, see
from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.diagnosis.extended import ExtendedModel
from valveflow_ros.records import SegmentKind
from valveflow_ros.report.comparison_tables import segments_csv
from valveflow_ros.report.validation import LABELS, OUTSIDE_FLAG, Validated, verdict_words
from valveflow_ros.report.words import (
    decimals,
    held_words,
    input_unit_plain,
    interval,
    percent,
    plain,
)


def refuse_two(model: Characteristic | ExtendedModel, against: Characteristic | None) -> None:
    """Refuse to hold an extended model against another curve.

    Raises
    ------
    UsageError
        An extended model judges rows freed of its causes, which the other curve is not made for.
    """
    if against is not None and isinstance(model, ExtendedModel):
        raise UsageError(
            '--against takes two curves over the same rows, and those of an extended model are '
            'freed of its causes: validate each by itself and compare their errors.'
        )


def validated(
    options: Namespace,
    model: Characteristic | ExtendedModel,
    against: Characteristic | None,
    mapping: Columns,
    given: Mapping[str, Any],
    console: Console,
) -> Validated:
    """Read the log, find its special segments, judge.

    Raises
    ------
    RecordingError, InputError, DataError
        The log cannot be read or holds nothing to judge by.
    """
    console.progress(0.02, 'reading')
    log = read(options.log, mapping, console)
    settings = {**given, 'pressure_exponent': model.pressure_exponent}
    extended = model if isinstance(model, ExtendedModel) else None
    curve: Characteristic = model.characteristic() if isinstance(model, ExtendedModel) else model
    seen = see(log, options.log.name, settings, console, console.progress, extended)
    console.progress(0.7, 'judging')
    tolerance = options.tolerance or seen.settings.real('alarm_floor')
    other = other_data(seen.contents, seen.settings)
    result = validate(curve, other, tolerance, against)
    if result.outside_share > OUTSIDE_FLAG:
        console.warn(
            f'{percent(result.outside_share, 2)} of the special samples lie beyond the ends of '
            'the curve and were not judged.'
        )
    held = _held(curve, extended is not None, console)
    second = '' if options.against is None else _name(options.against, options.model)
    return Validated(
        options.log.name, _name(options.model, options.against), second, result, seen.contents,
        seen.notes, held,
    )  # fmt: skip


def _held(curve: Characteristic, taken_out: bool, console: Console) -> str:
    """Say which causes were taken out of the rows, or that they should have been."""
    if taken_out or not curve.held:
        return held_words(curve.held)
    told = (
        'The curve was identified with causes held '
        f'({", ".join(h.name for h in curve.held)}), which this log is not freed of: give the '
        'extended_model.json beside it as --model.'
    )
    console.warn(told)
    return told


def _name(path: Path, other: Path | None) -> str:
    """Return a file's name, with its folder where that was named or two would read alike."""
    file = model_path(path)
    alike = other is not None and model_path(other).name == file.name
    return str(file) if alike or file != path else file.name


def texts(data: Validated) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the content of the JSON, and the files for programs by name."""
    content = {
        **to_json(data.result),
        'log': data.source,
        'model': data.model,
        'against': data.other or None,
        'held': [h.name for h in data.result.characteristic.held],
        'words': verdict_words(data),
    }
    return content, {
        'validation.json': json.dumps(content, indent=1, allow_nan=False) + '\n',
        'segments.csv': segments_csv(data.result.judgement, tuple(data.result.predictions)),
    }


def outcome(data: Validated, content: Mapping[str, Any], written: Mapping[str, Path]) -> Outcome:
    """Return what is printed at the end; the segments stand in the file only."""
    brief = {k: v for k, v in content.items() if k != 'segments'}
    files = {name: str(path) for name, path in written.items()}
    return Outcome(_text(data, written), {**brief, 'files': files})


def _text(data: Validated, written: Mapping[str, Path]) -> str:
    parts = [
        f'{data.model}, held against {data.source}:',
        *verdict_words(data),
        data.held,
        _pieces(data),
        _errors(data),
        f'Wrote {written["report.html"]}, {written["validation.json"].name} and segments.csv.',
    ]
    return '\n'.join(part for part in parts if part)


def _pieces(data: Validated) -> str:
    v = data.result
    rows = [
        [
            'all' if k == 0 else str(k),
            f'{decimals(c.u_from, 1)} to {decimals(c.u_to, 1)}',
            str(c.segments),
            decimals(c.test.mean, 2),
            interval(c.low_mw, c.high_mw),
        ]
        for k, c in enumerate((v.overall, *v.pieces))
    ]
    unit = input_unit_plain(v.characteristic.pressure_exponent)
    head = ['piece', f'u ({unit})', 'segments', 'measured - predicted (MW)', '95 % (MW)']
    return columns(rows, head)


def _errors(data: Validated) -> str:
    j = data.result.judgement
    kinds = (None, SegmentKind.STEADY, SegmentKind.SLOPE)
    rows = [
        [LABELS[name], *(plain(j.mse(name, k)) if j.kinds(k) else '-' for k in kinds)]
        for name in data.result.predictions
    ]
    return columns(rows, ['mean squared error (MW^2)', 'segments', 'steady', 'slope'])
