"""Tells before anything is loaded whether a recording can be made where it is wanted."""

from __future__ import annotations

import os

from valveflow_ros.errors import RecordingError
from valveflow_ros.parameters import Settings
from valveflow_ros.ros.node.recording import DEFAULT_FOLDER, at_home


def check_record_place(settings: Settings) -> None:
    """Refuse a ``record_directory`` that cannot be made or written into; makes nothing.

    Raises
    ------
    RecordingError
        With the reason, and what to do.
    """
    if not settings.flag('record'):
        return
    folder = at_home(settings.text('record_directory') or DEFAULT_FOLDER)
    advice = 'set record_directory to a folder this user may write into, or record to false'
    place = folder.absolute()
    while not place.exists() and place != place.parent:
        place = place.parent
    if not place.is_dir():
        raise RecordingError(folder, f"cannot be made: '{place}' is not a folder; {advice}")
    if not os.access(place, os.W_OK | os.X_OK):
        raise RecordingError(
            folder, f"cannot be made: '{place}' may not be written into; {advice}"
        )
