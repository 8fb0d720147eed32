"""The files of a recording that is followed: their names, and with which to begin."""

from __future__ import annotations

from pathlib import Path

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs.mcap.folder import Split, in_order
from valveflow_ros.logs.part_file import PART_SUFFIX
from valveflow_ros.records import NS_PER_S

# What stands is announced again within a day, so nothing older is needed to know it.
LOOK_BACK_NS = 25 * 3600 * NS_PER_S


def part_of(path: Path) -> Path:
    """Return the name of a file while it is written."""
    return path.with_name(path.name + PART_SUFFIX)


def final_of(path: Path) -> Path:
    """Return the name of a file once it is whole."""
    return path.with_suffix('') if path.suffix == PART_SUFFIX else path


def files_in(folder: Path) -> set[Path]:
    """Return the files of a folder by their final names; raises `RecordingError`."""
    try:
        names = [entry.name for entry in folder.iterdir()]
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise RecordingError(folder, f'cannot be read ({reason})') from None
    return {
        folder / name.removesuffix(PART_SUFFIX)
        for name in names
        if name.endswith(('.mcap', f'.mcap{PART_SUFFIX}'))
    }


def first_in(folder: Path) -> Path | None:
    """Return the file to begin with: the first that holds something of the last day."""
    files = in_order(files_in(folder))
    begin: Path | None = None
    newest = 0
    for path in reversed(files):
        split = Split.read(path) if path.exists() else None
        if split is not None and split.messages:
            newest = newest or split.end_ns
            if begin is not None and split.end_ns < newest - LOOK_BACK_NS:
                break
        begin = path
    return begin
