"""The end of a recording: what was logged after a moment, without reading all before it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs.contents import LogContents, LoggedMessage
from valveflow_ros.logs.mcap.folder import Split, in_order
from valveflow_ros.logs.mcap.mcap_log import read_recording
from valveflow_ros.logs.part_file import PART_SUFFIX
from valveflow_ros.records import Readings

_TRIES = 3


def messages_since(folder: str | Path, after_ns: int) -> Iterator[LoggedMessage]:
    """Yield the messages of a recording's folder logged after ``after_ns``, in order.

    Parameters
    ----------
    folder : str or Path
    after_ns : int
        Log time.

    Raises
    ------
    RecordingError
        The files cannot be read; a folder without any gives nothing.
    """
    for message in _read(Path(folder), after_ns).iter_messages():
        if message.log_time_ns > after_ns:
            yield message


def _read(home: Path, after_ns: int) -> LogContents:
    """Return what the last files hold; one that is made whole meanwhile has another name then."""
    for left in reversed(range(_TRIES)):
        wanted = _wanted(home, after_ns)
        if not wanted:
            break
        try:
            found = read_recording(wanted, str(home), {})
        except RecordingError:
            if not left or all(path.exists() for path in wanted):
                raise
            continue
        # Of several files one that is gone is passed over, with a warning only.
        if not left or all(path.exists() for path in wanted):
            return found
    return LogContents(str(home), Readings.of([]), np.empty(0, dtype=np.int64))


def _wanted(home: Path, after_ns: int) -> list[Path]:
    wanted: list[Path] = []
    for path in reversed(in_order(_files(home))):
        wanted.insert(0, path)
        split = Split.read(path) if path.suffix == '.mcap' else None
        # Splits follow each other in time; one that begins before the moment is the first needed.
        if split is not None and split.messages and split.start_ns <= after_ns:
            break
    return wanted


def _files(home: Path) -> list[Path]:
    try:
        names = {entry.name for entry in home.iterdir() if entry.is_file()}
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise RecordingError(home, f'cannot be read ({reason})') from None
    whole = {name for name in names if name.endswith('.mcap')}
    parts = {
        name
        for name in names
        if name.endswith(f'.mcap{PART_SUFFIX}') and name[: -len(PART_SUFFIX)] not in whole
    }
    return [home / name for name in whole | parts]
