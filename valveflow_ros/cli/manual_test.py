"""A manual step test from a log to a result."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from valveflow_ros.cli import engine
from valveflow_ros.cli.alignment import align, quiet
from valveflow_ros.cli.console import Console
from valveflow_ros.cli.log_input import LogInput, steps_of
from valveflow_ros.cli.options import settings_for
from valveflow_ros.errors import DataError
from valveflow_ros.fit.step_levels import looks_like_step_test
from valveflow_ros.fit.step_test import identify_step_test
from valveflow_ros.parameters import Settings
from valveflow_ros.records import Readings, SampleTable
from valveflow_ros.report.identified import Identified

ADVICE = (
    'This looks like a manual step test (few openings, each held): --step-test identifies it '
    'from its steady states.'
)


def found_in_step_test(
    log: LogInput, given: Mapping[str, Any], source: Path, console: Console, span_s: float
) -> Identified:
    """Align the log and identify its levels.

    Raises
    ------
    DataError
        It is no step test that could be used; the sentence says why.
    """
    settings, notes = settings_for(steps_of(log.readings), span_s, given)
    for sentence in notes:
        console.say(sentence)
    table, resets, counts = align(log.readings, settings, console.progress)
    if len(resets):
        raise DataError(
            'The clock goes back within the log; a step test must be one stretch of time.'
        )
    engine.check_signals(table, counts)
    console.progress(0.6, 'levels')
    test = identify_step_test(table, settings)
    return Identified(
        source=source.name, characteristic=test.characteristic, table=table,
        segments=test.segments, counts=counts, settings=settings,
        notes=(*log.contents.warnings, *(d.sentence for d in log.doubts), *notes),
    )  # fmt: skip


def advice_for(table: SampleTable, settings: Settings) -> str:
    """Return the hint for a log that looks like a step test; empty for any other."""
    return ADVICE if looks_like_step_test(table, settings) else ''


def refusal(error: DataError, readings: Readings, settings: Settings) -> DataError:
    """Return a refusal with the hint where the log looks like a step test."""
    table, _, _ = align(readings, settings, quiet)
    told = advice_for(table, settings)
    return DataError(f'{error} {told}') if told else error
