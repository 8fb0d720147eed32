"""What changed between two frames, a sentence each: the view of whoever has no terminal."""

from __future__ import annotations

from collections.abc import Iterator

from valveflow_ros.report.numbers import moment
from valveflow_ros.report.terminal.terminal_frame import Frame, HealthView
from valveflow_ros.report.terminal.terminal_text import clean
from valveflow_ros.report.terminal.terminal_words import (
    alarm_words,
    curve_words,
    diagnosis_words,
    health_words,
)


def changes(before: Frame, now: Frame) -> list[tuple[str, str]]:
    """Return what changed: curve, alarm, input, recorder, diagnosis or note, and a sentence.

    Values that move all the time are no changes.
    """
    return [(what, clean(told)) for what, told in _changes(before, now)]


def line(now_ns: int, what: str, told: str) -> str:
    """Return a change as one line."""
    when = moment(now_ns) if now_ns else 'no data yet'
    return f'{when}  {what}: {told}'


def _changes(before: Frame, now: Frame) -> Iterator[tuple[str, str]]:
    if now.note and now.note != before.note:
        yield 'note', now.note
    if now.curve is not None and now.curve != before.curve:
        # Its age is not news.
        yield 'curve', curve_words(now.curve, 0)[0]
    old = {alarm.name: alarm for alarm in before.alarms}
    for alarm in now.alarms:
        if old.get(alarm.name) != alarm:
            yield 'alarm', alarm_words(alarm)[0]
    levels = {item.name: item.level for item in before.inputs}
    for item in now.inputs:
        if levels.get(item.name) != item.level:
            yield 'input', health_words(item)[0]
    if now.recorder is not None and _differs(before.recorder, now.recorder):
        yield 'recorder', now.recorder.sentence
    if now.diagnosis is not None and now.diagnosis != before.diagnosis:
        yield 'diagnosis', diagnosis_words(now.diagnosis)[0]


def _differs(before: HealthView | None, now: HealthView) -> bool:
    return before is None or before.level != now.level
