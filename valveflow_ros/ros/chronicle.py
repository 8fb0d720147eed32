"""What is worth a line in the log: alarms, new curves, refusals."""

from __future__ import annotations

from valveflow_ros.core.alarms import AlarmChange, AlarmState
from valveflow_ros.core.events import (
    CurveAdopted,
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
        knees = ', '.join(f'{u:.0f}' for u in curve.breakpoints[1:-1]) or 'none'
        return Level.OK, (
            f'new curve {curve.model_id}: {len(curve.pieces)} pieces, knees at u = {knees}, '
            f'{curve.source.samples} special samples'
        )
    if isinstance(event, ReferenceSet):
        return Level.OK, f'the reference is now curve {event.characteristic.model_id}'
    if isinstance(event, JournalEntry) and event.kind == JournalKind.FIT_REFUSED:
        return Level.WARN, f'no new curve: {event.text}'
    if isinstance(event, JournalEntry) and event.kind == JournalKind.RESET:
        return Level.WARN, event.text
    return None
