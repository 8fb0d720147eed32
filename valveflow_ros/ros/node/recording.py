# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The recording of a run: its folder, its attachments and its errors."""

from __future__ import annotations

import json
import os
import queue
import re
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from rclpy.qos import QoSProfile

from valveflow_ros.errors import RecordingError, ValveflowError, counted
from valveflow_ros.logs import (
    Qos,
    Recorder,
    RecorderSettings,
    RecorderState,
    RecorderStatus,
    recover_leftovers,
)
from valveflow_ros.logs.names import TOPICS
from valveflow_ros.logs.part_file import PART_SUFFIX, make_folder
from valveflow_ros.logs.source import os_errors
from valveflow_ros.parameters import Settings
from valveflow_ros.ros.node.diagnostics import Level

DEFAULT_FOLDER = 'valveflow_recordings'
PARAMETERS = 'parameters.json'
_CLOSE_S = 1.2
_MOST_NAMES = 1000


def tag_of(settings: Settings) -> str:
    """Return the unit's tag in a form that is valid in folder names."""
    return re.sub(r'[^A-Za-z0-9_-]+', '-', settings.text('unit_tag'))[:60] or 'unit'


def expand_home(name: str) -> Path:
    """Return an absolute path, with ``~`` expanded.

    Raises `RecordingError` if the user after ``~`` is unknown.
    """
    try:
        return Path(name).expanduser().absolute()
    except RuntimeError:
        raise RecordingError(name, 'names the home of a user that is not there') from None


def parent_of(settings: Settings) -> Path:
    """Return the folder with all recordings; raises `RecordingError` as `expand_home`."""
    return expand_home(settings.text('record_directory') or DEFAULT_FOLDER)


def new_folder(settings: Settings, at_s: float) -> Path:
    """Create a new folder for this run; raises `RecordingError` if this fails."""
    parent = parent_of(settings)
    stem = time.strftime('valveflow_%Y%m%dT%H%M%SZ', time.gmtime(at_s)) + f'_{tag_of(settings)}'
    with os_errors(parent, 'cannot be made'):
        make_folder(parent)
        for k in range(1, _MOST_NAMES):
            folder = parent / (stem if k == 1 else f'{stem}_{k}')
            with suppress(FileExistsError):
                folder.mkdir(mode=0o700)
                return folder
    raise RecordingError(parent, f"holds {_MOST_NAMES} folders called '{stem}' already")


def check_record_directory(settings: Settings) -> None:
    """Check that ``record_directory`` can be created and written to; create nothing.

    Raises `RecordingError` if not, with the reason and advice.
    """
    if not settings.flag('record'):
        return
    folder = parent_of(settings)
    advice = 'set record_directory to a folder this user may write into, or record to false'
    place = folder
    while not place.exists() and place != place.parent:
        place = place.parent
    if not place.is_dir():
        raise RecordingError(folder, f"cannot be made: '{place}' is not a folder; {advice}")
    if not os.access(place, os.W_OK | os.X_OK):
        raise RecordingError(
            folder, f"cannot be made: '{place}' may not be written into; {advice}"
        )


def recorded_qos(profile: QoSProfile) -> Qos:
    """Convert a QoS profile to the form used in recordings."""
    return Qos(
        reliability=profile.reliability.name.lower(), durability=profile.durability.name.lower(),
        history=profile.history.name.lower(), depth=profile.depth,
    )  # fmt: skip


class Recording:
    """Records inputs and outputs; an error is reported and never stops the monitor.

    Parameters
    ----------
    settings : Settings
    topics : mapping
        Content of the attachment `TOPICS`: the full topic names of the inputs and
        outputs in this run.
    at_s : float
        Start time in s since the epoch.
    more : mapping, optional
        Other attachments by name.
    folder, began : Path and mapping, optional
        A recording to continue, and the parameters that it began with; its journal has the
        changes. By default a new one is begun.
    """

    def __init__(
        self,
        settings: Settings,
        topics: Mapping[str, Any],
        at_s: float,
        more: Mapping[str, bytes] | None = None,
        folder: Path | None = None,
        began: Mapping[str, Any] | None = None,
    ) -> None:
        self.problem = ''
        self.folder: Path | None = None
        self._recorder: Recorder | None = None
        self._offered: dict[str, tuple[str, Callable[[], Sequence[Qos]], bool]] = {}
        self.began = dict(settings if began is None else began)
        if not settings.flag('record'):
            self.problem = 'Recording is switched off (parameter record).'
            return
        limits = RecorderSettings(
            queue_limit=settings.whole('record_queue'),
            flush_period_s=settings.real('record_flush'),
            rotate_s=settings.real('record_rotation'),
            keep_files=settings.whole('record_keep') or None,
        )
        attachments = {PARAMETERS: _json(self.began), TOPICS: _json(topics), **(more or {})}
        try:
            self.folder = folder or new_folder(settings, at_s)
            self._recorder = Recorder(self.folder, limits, attachments=attachments)
        except ValveflowError as error:
            self.problem = str(error)

    @property
    def on(self) -> bool:
        """Return True if a recorder is running."""
        return self._recorder is not None

    @property
    def whole(self) -> bool:
        """Return True if the recorder works and has lost or dropped no message."""
        status = self.status()
        if status is None or status.state != RecorderState.RECORDING:
            return False
        return not (status.lost or any(status.dropped.values()))

    def offer(
        self,
        topic: str,
        type_name: str,
        qos: Callable[[], Sequence[Qos]],
        *,
        latched: bool = False,
    ) -> None:
        """Describe a topic; it is added to the file with its first message.

        ``qos`` returns the QoS of each publisher, and is called with the first message. The last
        message of a ``latched`` topic is repeated in later files.
        """
        self._offered[topic] = (type_name, qos, latched)

    def write(self, topic: str, data: bytes, log_ns: int, time_ns: int) -> None:
        """Queue a message; never waits and never raises."""
        if self._recorder is None:
            return
        try:
            if topic in self._offered:
                type_name, qos, latched = self._offered.pop(topic)
                self._recorder.add_topic(topic, type_name, qos=qos(), latched=latched)
            self._recorder.record(topic, data, log_ns, time_ns)
        except ValveflowError as error:
            # An incomplete recording would be misleading.
            self.close()
            self.problem = str(error)

    def status(self) -> RecorderStatus | None:
        """Return the recorder's status, None without a recorder."""
        return None if self._recorder is None else self._recorder.status()

    def settled(self) -> Callable[[], bool]:
        """Return a function that returns True when all messages so far are on disk or lost."""
        recorder = self._recorder
        if recorder is None:
            return lambda: True
        received = recorder.status().received

        def ready() -> bool:
            status = recorder.status()
            return status.received - status.queued >= received

        return ready

    def flush(self, longest_s: float) -> bool:
        """Write all messages so far to disk; return False if this takes too long."""
        return self._recorder is not None and self._recorder.flush(longest_s)

    def close(self) -> RecorderStatus | None:
        """Finish the file; return the final status."""
        recorder, self._recorder = self._recorder, None
        if recorder is None:
            return None
        status = recorder.close(_CLOSE_S)
        missing = status.lost + sum(status.dropped.values())
        if status.state != RecorderState.STOPPED or status.queued:
            self.problem = status.reason or (
                f'The last file was not finished in time, {status.queued} messages were not '
                'written; the next start finishes it.'
            )
        elif missing or status.loss or status.reason:
            told = f'{counted(missing, "message is", "messages are")} missing from the recording.'
            said = (told if missing else '', status.loss, status.reason)
            self.problem = ' '.join(filter(None, said))
        return status


def _json(content: Mapping[str, Any]) -> bytes:
    return json.dumps(content, indent=2, sort_keys=True).encode()


class BackgroundRecovery:
    """Recovers unfinished recordings of this unit once, in a thread, unless they are in use.

    ``own`` is the recording of this run. ``tag`` is the unit's part of the folder names; folders
    of other units are not changed.
    """

    def __init__(self, own: Path, tag: str) -> None:
        self._own = own
        self._mine = re.compile(rf'valveflow_\d{{8}}T\d{{6}}Z_{re.escape(tag)}(_\d+)?')
        self._reports: queue.SimpleQueue[tuple[Level, str]] = queue.SimpleQueue()
        threading.Thread(target=self._run, name='recovery', daemon=True).start()

    def reports(self) -> list[tuple[Level, str]]:
        """Return level and sentence of each recovery since the last call."""
        found: list[tuple[Level, str]] = []
        while not self._reports.empty():
            found.append(self._reports.get())
        return found

    def _run(self) -> None:
        own = self._own.resolve()
        try:
            parts = own.parent.glob(f'valveflow_*/*.mcap{PART_SUFFIX}')
            found = {part.parent for part in parts} - {own}
        except OSError:
            return
        for folder in sorted(f for f in found if self._mine.fullmatch(f.name)):
            try:
                reports = recover_leftovers(folder)
            except ValveflowError as error:
                self._reports.put((Level.WARN, str(error)))
                continue
            for report in reports:
                sentence = (
                    f'{report.out} was left unfinished by an earlier run and is whole now: '
                    f'{report.messages} messages.'
                )
                self._reports.put((Level.OK, sentence))
