"""What a monitor published, read from its own recording by the recording's own schemas."""

from __future__ import annotations

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import LogContents
from valveflow_ros.report.history import History, Moment, history_of, moment_of
from valveflow_ros.report.terminal.board import ALARM, CURVE, DIAGNOSIS


def history_in(log: LogContents) -> History | None:
    """Return what a monitor published; None if the log is no monitor's recording.

    Topics are taken by their type: the node may have any name. What cannot be decoded
    becomes a sentence among the notes.
    """
    notes: list[str] = []
    told = [m for kind in (CURVE, ALARM, DIAGNOSIS) for m in _all(log, kind, notes)]
    readings = log.readings.time_ns
    ends = [int(readings.min()), int(readings.max())] if len(log.readings) else []
    return history_of(told, ends, notes)


def _all(log: LogContents, kind: str, notes: list[str]) -> list[Moment]:
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
        decoder = log.decoder(topics[0])
        told = (
            moment_of(kind, decoder.decode(message.data))
            for message in log.iter_messages([topics[0]])
        )
        return [moment for moment in told if moment is not None]
    except (RecordingError, KeyError, TypeError, ValueError) as error:
        lacks = f'it lacks {error}.' if isinstance(error, KeyError) else str(error)
        notes.append(f'What the monitor published on {topics[0]} cannot be shown: {lacks}')
        return []
