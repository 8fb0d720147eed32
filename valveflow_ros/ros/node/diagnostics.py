# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Health items, their diagnostics message (REP 107), and lines of the log."""

from __future__ import annotations

import enum
import json
import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from valveflow_ros.errors import counted
from valveflow_ros.monitoring.alarms import AlarmChange, AlarmState
from valveflow_ros.monitoring.diagnosis_requests import FITS_AGAIN
from valveflow_ros.monitoring.events import (
    CurveAdopted,
    Diagnosed,
    Event,
    JournalEntry,
    JournalKind,
    ReferenceSet,
)
from valveflow_ros.ros.encoding import header


class Level(enum.IntEnum):
    """Level of a health item; the numbers are those of DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True, slots=True)
class Item:
    """A health item: name, level, sentence and values.

    The key of a value contains its unit.
    """

    name: str
    level: Level
    sentence: str
    values: dict[str, object] = field(default_factory=dict)


def diagnostics_message(
    items: Iterable[Item], node: str, tag: str, now_ns: int
) -> DiagnosticArray:
    """Return all items as a message; each name begins with the name of the node."""
    status = [
        DiagnosticStatus(
            level=bytes([item.level]),
            name=f'{node}: {item.name}',
            message=item.sentence,
            hardware_id=tag,
            values=[KeyValue(key=key, value=_text(value)) for key, value in item.values.items()],
        )
        for item in items
    ]
    return DiagnosticArray(header=header(now_ns, tag), status=status)


def _text(value: object) -> str:
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return 'unknown'
    if isinstance(value, bool):
        return 'yes' if value else 'no'
    return f'{value:.6g}' if isinstance(value, float) else str(value)


def log_at(logger: Any, level: Level, text: str) -> None:
    """Log a text; separate calls, because rclpy allows only one severity per line of code."""
    if level == Level.OK:
        logger.info(text)
    elif level == Level.ERROR:
        logger.error(text)
    else:
        logger.warning(text)


class Changes:
    """Selects the items to log: those whose level has changed.

    An item is logged again after ``quiet_s`` seconds at the earliest, unless it becomes an error.
    """

    def __init__(self, quiet_s: float = 30.0) -> None:
        self._quiet_s = quiet_s
        self._levels: dict[str, Level] = {}
        self._said_s: dict[str, float] = {}

    def pick(self, items: Iterable[Item], now_s: float) -> list[Item]:
        """Return the items whose level differs from the last one logged."""
        picked = []
        for item in items:
            before = self._levels.get(item.name, Level.OK)
            recent = now_s - self._said_s.get(item.name, -self._quiet_s) < self._quiet_s
            # An error is logged at once; other changes are not logged within the quiet time.
            worse = item.level == Level.ERROR
            if item.level == before or (recent and not worse):
                continue
            self._levels[item.name] = item.level
            self._said_s[item.name] = now_s
            picked.append(item)
        return picked


_STANDING = (AlarmState.UNACKNOWLEDGED, AlarmState.RETURNED_UNACKNOWLEDGED)


def line_of(event: Event) -> tuple[Level, str] | None:
    """Return the line of the log for an event; None for an event that is not logged."""
    if isinstance(event, AlarmChange):
        words = event.state.name.lower().replace('_', ' ')
        level = Level.WARN if event.state in _STANDING else Level.OK
        return level, f'alarm {event.name}, {words}: {event.sentence}'
    if isinstance(event, CurveAdopted):
        curve = event.characteristic
        knees = ', '.join(f'{u:.0f}' for u in curve.breakpoints[1:-1])
        return Level.OK, (
            f'new curve {curve.model_id}: {counted(len(curve.pieces), "piece")}, '
            f'{f"breakpoints at u = {knees}" if knees else "no breakpoint"}, '
            f'{counted(curve.source.samples, "special sample")}'
        )
    if isinstance(event, ReferenceSet):
        return Level.OK, f'the reference is now curve {event.characteristic.model_id}'
    if isinstance(event, Diagnosed):
        if not event.content:
            return Level.WARN, f'no diagnosis: {event.reason}'
        content = json.loads(event.content)
        level = Level.OK if content['verdict'] == 'nothing' else Level.WARN
        return level, f'diagnosis: {content["sentence"]}'
    if not isinstance(event, JournalEntry):
        return None
    fits = event.text == FITS_AGAIN
    lines = {
        JournalKind.FIT_REFUSED: (Level.WARN, f'no new curve: {event.text}'),
        JournalKind.RESET: (Level.WARN, event.text),
        JournalKind.MISMATCH: (Level.OK if fits else Level.WARN, event.text),
        JournalKind.DIAGNOSE: (Level.OK, f'diagnosis started: {event.text}'),
    }
    return lines.get(event.kind)
