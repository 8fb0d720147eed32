"""The end of a recording: what was logged after a moment, without reading all before it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs.contents import LoggedMessage
from valveflow_ros.logs.folder import Split, in_order
from valveflow_ros.logs.mcap_log import read_recording
from valveflow_ros.logs.part_file import PART_SUFFIX


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
    home = Path(folder)
    wanted: list[Path] = []
    for path in reversed(in_order(_files(home))):
        wanted.insert(0, path)
        split = Split.read(path) if path.suffix == '.mcap' else None
        # Splits follow each other in time; one that begins before the moment is the first needed.
        if split is not None and split.messages and split.start_ns <= after_ns:
            break
    if not wanted:
        return
    log = read_recording(wanted, str(folder), {})
    for message in log.iter_messages():
        if message.log_time_ns > after_ns:
            yield message


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
