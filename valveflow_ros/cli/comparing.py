"""From two logs to the files and the words of a comparison."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from valveflow_ros.baselines.comparison import compare, to_json
from valveflow_ros.baselines.judged import other_data, samples_of
from valveflow_ros.baselines.truth import Truth
from valveflow_ros.cli import engine
from valveflow_ros.cli.console import Console, Outcome
from valveflow_ros.cli.options import LogMapping as Columns
from valveflow_ros.cli.report_words import columns
from valveflow_ros.cli.watching import Seen, cut_in_two, read, see
from valveflow_ros.parameters import PARAMETERS
from valveflow_ros.records import SegmentKind
from valveflow_ros.report.comparison import data_words, finding_words
from valveflow_ros.report.comparison_tables import (
    LABELS,
    METHODS,
    PREDICTIONS,
    Compared,
    curves_csv,
    mse_cell,
    parameters_csv,
    segments_csv,
)
from valveflow_ros.report.words import decimals, input_unit_plain, plain


def compared(
    log: Path,
    test: Path | None,
    truth: Truth | None,
    mapping: Columns,
    given: Mapping[str, Any],
    console: Console,
) -> Compared:
    """Read, identify in three ways, judge.

    Raises
    ------
    RecordingError, InputError, DataError
        A log cannot be read, carries no curve, or holds nothing to judge by.
    """
    learn, judged = _two(log, test, mapping, given, console)
    console.progress(0.4, 'curve of special segments')
    characteristic = engine.identify(learn.watched, lambda _, what: console.progress(0.4, what))
    result = compare(
        samples_of(learn.contents, learn.settings),
        characteristic,
        other_data(judged.contents, judged.settings),
        truth,
        console.progress,
    )
    notes = tuple(dict.fromkeys((*learn.notes, *judged.notes, *characteristic.notes)))
    other = log if test is None else test
    return Compared(
        log.name, other.name, test is None, result, learn.contents, judged.contents, notes
    )


def _two(
    log: Path, test: Path | None, mapping: Columns, given: Mapping[str, Any], console: Console
) -> tuple[Seen, Seen]:
    """Return the data to learn from and those to judge by."""
    console.progress(0.02, 'reading')
    whole = read(log, mapping, console)
    if test is None:
        block = given.get('block', PARAMETERS['block'].default)
        first, second = cut_in_two(whole, float(block))
        names = f'{log.name} (first two thirds)', f'{log.name} (last third)'
    else:
        first, second = whole, read(test, mapping, console)
        names = log.name, test.name
    learn = see(first, names[0], given, console, lambda s, w: console.progress(0.4 * s, w))
    # A discrete model runs at the step it was learnt at.
    step = {'sample_period': learn.settings.real('sample_period')}
    judged = see(
        second, names[1], {**given, **step}, console,
        lambda s, w: console.progress(0.2 + 0.4 * s, w),
    )  # fmt: skip
    return learn, judged


def texts(data: Compared) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the content of the JSON, and the files for programs by name."""
    content = {
        **to_json(data.result),
        'learnt_from': data.source,
        'judged_on': data.other,
        'held_out': data.held_out,
        'words': [data_words(data), *finding_words(data)],
    }
    return content, {
        'comparison.json': json.dumps(content, indent=1, allow_nan=False) + '\n',
        'parameters.csv': parameters_csv(data),
        'segments.csv': segments_csv(data.result.judgement, data.predictions),
        'curves.csv': curves_csv(data),
    }


def outcome(data: Compared, content: Mapping[str, Any], written: Mapping[str, Path]) -> Outcome:
    """Return what is printed at the end; the segments stand in the file only."""
    brief = {k: v for k, v in content.items() if k != 'segments'}
    files = {name: str(path) for name, path in written.items()}
    return Outcome(_text(data, written), {**brief, 'files': files})


def _text(data: Compared, written: Mapping[str, Path]) -> str:
    parts = [
        data_words(data),
        *finding_words(data),
        _parameters(data),
        _errors(data),
        f'Wrote {written["report.html"]}, {written["comparison.json"].name}, '
        'parameters.csv, segments.csv and curves.csv.',
    ]
    return '\n'.join(part for part in parts if part)


def _parameters(data: Compared) -> str:
    rows = []
    for method in METHODS:
        line = data.result.lines.get(method)
        for j in range(0 if line is None else len(line.slopes)):
            assert line is not None
            rows.append(
                [
                    LABELS[method] if j == 0 else '',
                    f'{decimals(float(line.knots[j]), 1)} to '
                    f'{decimals(float(line.knots[j + 1]), 1)}',
                    plain(float(line.slopes[j])),
                    decimals(float(line.intercepts[j]), 2),
                ]
            )
    unit = input_unit_plain(data.result.characteristic.pressure_exponent)
    return columns(rows, ['curve', f'u ({unit})', 'slope (MW per u)', 'intercept (MW)'])


def _errors(data: Compared) -> str:
    r = data.result
    rows = [
        [
            PREDICTIONS[name],
            *(
                mse_cell(r.judgement.mse(name, k)) if r.judgement.kinds(k) else '–'
                for k in (None, SegmentKind.STEADY, SegmentKind.SLOPE)
            ),
            mse_cell(r.all_rows[name]) if name in r.all_rows else '–',
        ]
        for name in data.predictions
    ]
    head = ['mean squared error (MW^2)', 'segments', 'steady', 'slope', 'all rows']
    return columns(rows, head)
