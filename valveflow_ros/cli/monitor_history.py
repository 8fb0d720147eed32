"""What a monitor published, read from its own recording by the recording's own schemas."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import LogContents
from valveflow_ros.monitoring.alarm import AlarmState
from valveflow_ros.records import NS_PER_S
from valveflow_ros.report.history import AlarmMoment, CurveMoment, DiagnosisMoment, History

_CURVE = 'valveflow_msgs/msg/FlowCharacteristic'
_ALARM = 'valveflow_msgs/msg/Alarm'
_DIAGNOSIS = 'valveflow_msgs/msg/Diagnosis'
_UNKNOWN = 0  # verdict of a diagnosis that says nothing yet

Found = TypeVar('Found')
Item = TypeVar('Item')


@dataclass(frozen=True, slots=True)
class _Word:
    """What was said of an alarm, and whether the alarm was in that state before."""

    time_ns: int
    moment: AlarmMoment
    again: bool


def history_in(log: LogContents) -> History | None:
    """Return what a monitor published; None if the log is no monitor's recording.

    Topics are taken by their type: the node may have any name. What cannot be decoded
    becomes a sentence among the notes.
    """
    notes: list[str] = []
    curves = _all(log, _CURVE, _curve, notes)
    alarms = _all(log, _ALARM, _alarm, notes)
    diagnoses = _all(log, _DIAGNOSIS, _diagnosis, notes)
    if not (curves or alarms or diagnoses or notes):
        return None
    times = [x.time_ns for part in (curves, alarms, diagnoses) for x in part]
    if len(log.readings):
        times += [int(log.readings.time_ns.min()), int(log.readings.time_ns.max())]
    return History(
        min(times, default=0),
        max(times, default=0),
        # What is latched is published again and again, and all that stands at a new start.
        tuple(_once(sorted(curves, key=lambda c: c.time_ns), lambda c: c.model_id)),
        tuple(_changes(sorted(alarms, key=lambda a: a.time_ns))),
        tuple(_once(sorted(diagnoses, key=lambda d: d.time_ns), lambda d: d)),
        tuple(notes),
    )


def _all(
    log: LogContents,
    kind: str,
    made: Callable[[dict[str, Any]], Found | None],
    notes: list[str],
) -> list[Found]:
    """Return what the messages of one type say; of several topics only the first is taken."""
    topics = sorted(t.name for t in log.topics.values() if t.type == kind and t.count)
    if not topics:
        return []
    if len(topics) > 1:
        notes.append(
            f'The log holds {kind.rsplit("/", 1)[-1]} messages on {" and ".join(topics)}; '
            f'only {topics[0]} is shown.'
        )
    try:
        return [x for m in _decoded(log, topics[0]) if (x := made(m)) is not None]
    except (RecordingError, KeyError, TypeError, ValueError) as error:
        told = f'it lacks {error}.' if isinstance(error, KeyError) else str(error)
        notes.append(f'What the monitor published on {topics[0]} cannot be shown: {told}')
        return []


def _decoded(log: LogContents, topic: str) -> Iterator[dict[str, Any]]:
    decoder = log.decoder(topic)
    for message in log.iter_messages([topic]):
        yield decoder.decode(message.data)


def _stamp(message: dict[str, Any]) -> int:
    stamp = message['header']['stamp']
    return int(stamp['sec']) * NS_PER_S + int(stamp['nanosec'])


def _curve(message: dict[str, Any]) -> CurveMoment | None:
    """Return a curve; None while there is none to show."""
    u = np.array(message['breakpoints'], dtype=np.float64)
    power = np.array(message['values'], dtype=np.float64)
    low = np.array(message['breakpoint_low'], dtype=np.float64)
    high = np.array(message['breakpoint_high'], dtype=np.float64)
    finite = np.all(np.isfinite(u)) and np.all(np.isfinite(power))
    if len(u) < 2 or len(power) != len(u) or not finite or np.any(np.diff(u) <= 0.0):
        return None
    if len(low) != len(u) - 2 or len(high) != len(u) - 2:
        low = high = np.full(len(u) - 2, np.nan)
    return CurveMoment(
        _stamp(message), str(message['model_id']), float(message['pressure_exponent']), u, power,
        low, high, float(message['rmse_mw']),
    )  # fmt: skip


def _alarm(message: dict[str, Any]) -> _Word:
    moment = AlarmMoment(
        _stamp(message), str(message['name']), AlarmState(message['state']),
        str(message['sentence']),
    )  # fmt: skip
    return _Word(moment.time_ns, moment, message.get('previous_state') == moment.state)


def _diagnosis(message: dict[str, Any]) -> DiagnosisMoment | None:
    if message['verdict'] == _UNKNOWN or not message['sentence']:
        return None
    return DiagnosisMoment(_stamp(message), str(message['sentence']))


def _once(items: Iterable[Item], key: Callable[[Item], Hashable]) -> list[Item]:
    """Return each item when it first came."""
    first: dict[Hashable, Item] = {}
    for item in items:
        first.setdefault(key(item), item)
    return list(first.values())


def _changes(words: list[_Word]) -> list[AlarmMoment]:
    """Return the changes: that an alarm still stands, which is told every day, is none.

    The first word of a standing alarm counts even so: it stood when the recording began.
    """
    known: set[str] = set()
    found = []
    for word in _once(words, lambda w: w.moment):
        first = word.moment.name not in known and word.moment.state != AlarmState.NORMAL
        known.add(word.moment.name)
        if first or not word.again:
            found.append(word.moment)
    return found
