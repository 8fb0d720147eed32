# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Read a historian directly, part by part, into a log; a stopped import can be continued."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol
from zipfile import BadZipFile

import numpy as np

from valveflow_ros.errors import DataError, RecordingError, counted
from valveflow_ros.interface import SILENT, Progress
from valveflow_ros.interface.files import reason
from valveflow_ros.interface.plausibility import joined
from valveflow_ros.logs.mcap.importing import WrittenLog, write_readings
from valveflow_ros.records import NS_PER_S, SIGNALS, Readings, Signal

# Length of a part; after a stop at most one part is read again.
_PART_NS = 4 * 3600 * NS_PER_S
_SUFFIX = '.parts'
_COLUMNS = ('time_ns', 'signal', 'value', 'quality')


class HistorySource(Protocol):
    """A source of history; support for a new historian only needs these members.

    A stopped import is continued only if ``name`` and ``columns`` have not changed.
    """

    @property
    def name(self) -> str:
        """Return its name in messages and in the log: an address without a password."""

    @property
    def columns(self) -> Mapping[Signal, str]:
        """Return the available signals with their name and unit in the historian."""

    def read(self, start_ns: int, end_ns: int) -> list[Readings]:
        """Return the readings of ``[start_ns, end_ns)`` in chronological order, in engine units.

        Raises `DataError` if it cannot be reached, or has no such signal or no history.
        """


def import_history(
    source: HistorySource,
    start_ns: int,
    end_ns: int,
    path: str | Path,
    *,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> WrittenLog:
    """Read a period of history and write it as a recording.

    The parts are kept in the folder ``NAME.parts`` beside the recording. The same call
    continues an import that was stopped.

    Parameters
    ----------
    start_ns, end_ns : int
        The period, ns since 1970; the end is excluded.
    path : str or Path
        The recording, as in `write_readings`.

    Raises
    ------
    DataError
        As in `HistorySource.read`; or there is no value in the period.
    RecordingError
        The recording exists or cannot be written, or the folder belongs to another import.
    """
    path = Path(path)
    folder = path.with_name(path.name + _SUFFIX)
    columns = {SIGNALS[signal].topic: name for signal, name in source.columns.items()}
    asked = json.dumps(
        {'source': source.name, 'columns': columns, 'start_ns': start_ns, 'end_ns': end_ns}
    )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        told = folder / 'import.json'
        if told.exists() and told.read_text() != asked:
            raise RecordingError(
                folder, 'is of an import of something else that was stopped; remove it'
            )
        told.write_text(asked)
        starts = range(start_ns, end_ns, _PART_NS)
        files = [folder / f'{k:06d}.npz' for k in range(len(starts))]
        if there := sum(file.exists() for file in files):
            progress.say(f'{there} of {counted(len(files), "part")} had been read before.')
        for k, (begin_ns, file) in enumerate(zip(starts, files, strict=True)):
            progress(0.05 + 0.85 * k / len(files), 'reading')
            if not file.exists():
                _save(file, source.read(begin_ns, min(begin_ns + _PART_NS, end_ns)))
        progress(0.9, 'writing')
        infos = [SIGNALS[signal] for signal in sorted(source.columns)]
        units = [{'topic': info.topic, 'unit': info.unit} for info in infos]
        if not any(len(_load(file)) for file in files):
            shutil.rmtree(folder, ignore_errors=True)  # a later call may find values
            raise DataError(f'{source.name} has no value in this period.')
        written = write_readings(
            map(_load, files), list(source.columns), path, overwrite=overwrite,
            attachments={'import.json': json.dumps(
                {**json.loads(asked), 'signals': units}, indent=2
            ).encode()},
        )  # fmt: skip
    except OSError as error:
        raise RecordingError(folder, f'cannot be used for the work ({reason(error)})') from None
    shutil.rmtree(folder, ignore_errors=True)
    return written


def _save(file: Path, parts: list[Readings]) -> None:
    """Write a part and give it its final name when it is complete."""
    part, whole = file.with_suffix('.tmp'), joined(parts)
    with part.open('wb') as out:
        np.savez(out, **{name: getattr(whole, name) for name in _COLUMNS})
    part.replace(file)


def _load(file: Path) -> Readings:
    try:
        with np.load(file, allow_pickle=False) as columns:
            return Readings(*(columns[name] for name in _COLUMNS))
    except (ValueError, KeyError, EOFError, BadZipFile):
        raise RecordingError(file, 'is damaged; remove it, and it is read again') from None
