"""What is worth a line in the log: alarms, new curves, diagnoses, refusals."""

from __future__ import annotations

import json

from valveflow_ros.errors import counted
from valveflow_ros.monitoring.alarms import AlarmChange, AlarmState
from valveflow_ros.monitoring.diagnosing import FITS_AGAIN
from valveflow_ros.monitoring.events import (
    CurveAdopted,
    Diagnosed,
    Event,
    JournalEntry,
    JournalKind,
    ReferenceSet,
)
from valveflow_ros.ros.diagnostics import Level

_STANDING = (AlarmState.UNACKNOWLEDGED, AlarmState.RETURNED_UNACKNOWLEDGED)


def line_of(event: Event) -> tuple[Level, str] | None:
    """Return how grave an event is and a sentence about it; None for the many others."""
    if isinstance(event, AlarmChange):
        words = event.state.name.lower().replace('_', ' ')
        level = Level.WARN if event.state in _STANDING else Level.OK
        return level, f'alarm {event.name}, {words}: {event.sentence}'
    if isinstance(event, CurveAdopted):
        curve = event.characteristic
        knees = ', '.join(f'{u:.0f}' for u in curve.breakpoints[1:-1])
        knees = f'knees at u = {knees}' if knees else 'no knee'
        return Level.OK, (
            f'new curve {curve.model_id}: {counted(len(curve.pieces), "piece")}, '
            f'{knees}, '
            f'{counted(curve.source.samples, "special sample")}'
        )
    if isinstance(event, ReferenceSet):
        return Level.OK, f'the reference is now curve {event.characteristic.model_id}'
    if isinstance(event, Diagnosed):
        return _diagnosis_line(event)
    if isinstance(event, JournalEntry):
        return _journal_line(event)
    return None


def _diagnosis_line(event: Diagnosed) -> tuple[Level, str]:
    if not event.content:
        return Level.WARN, f'no diagnosis: {event.reason}'
    content = json.loads(event.content)
    level = Level.OK if content['verdict'] == 'nothing' else Level.WARN
    return level, f'diagnosis: {content["sentence"]}'


def _journal_line(event: JournalEntry) -> tuple[Level, str] | None:
    if event.kind == JournalKind.FIT_REFUSED:
        return Level.WARN, f'no new curve: {event.text}'
    if event.kind == JournalKind.RESET:
        return Level.WARN, event.text
    if event.kind == JournalKind.MISMATCH:
        return Level.OK if event.text == FITS_AGAIN else Level.WARN, event.text
    if event.kind == JournalKind.DIAGNOSE:
        return Level.OK, f'diagnosis started: {event.text}'
    return None
