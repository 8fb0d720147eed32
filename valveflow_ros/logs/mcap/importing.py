# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Converts a table of samples to a recording.

All records have the same size, so the content of a chunk is one structured
array, which is fast to build.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
import yaml
from mcap.opcode import Opcode
from numpy.typing import NDArray

from valveflow_ros.errors import DataError, RecordingError
from valveflow_ros.logs.mcap import folder
from valveflow_ros.logs.mcap.chunk_file import CHUNK_BYTES, ChunkFile, compressor, pack_content
from valveflow_ros.logs.mcap.definitions import Definitions
from valveflow_ros.logs.mcap.records import HEAD_DTYPE, RECORD_HEAD
from valveflow_ros.logs.mcap.writer import TopicRegistry
from valveflow_ros.logs.names import FLOAT64
from valveflow_ros.logs.part_file import new_file
from valveflow_ros.logs.source import os_errors
from valveflow_ros.records import SIGNALS, Readings, SampleTable, Signal, table_to_readings

_RECORD = np.dtype([*HEAD_DTYPE.descr, ('mark', '>u4'), ('value', '<f8')])
# Little-endian CDR, no options.
_MARK = 0x00010000
_PER_CHUNK = CHUNK_BYTES // _RECORD.itemsize
_BLOCK_ROWS = 100_000


@dataclass(frozen=True, slots=True)
class WrittenLog:
    """A recording that was written: its file and number of messages."""

    path: Path
    messages: int


def write_samples(
    table: SampleTable,
    path: str | Path,
    *,
    definitions: Definitions | None = None,
    overwrite: bool = False,
) -> WrittenLog:
    """Write samples as ``std_msgs/Float64`` topics named after the signals.

    The time of a sample is the publish time of its values. The log times of the
    values of one sample differ by one nanosecond, so that every reader sees them
    in the same order. NaN in a required signal is written as a value of bad quality.
    Other arguments and errors are those of `write_readings`.
    """
    optional = [i.signal for i in SIGNALS if np.isfinite(table.column(i.signal)).any()]
    starts = range(0, len(table), _BLOCK_ROWS)
    blocks = (table_to_readings(table.part(start, start + _BLOCK_ROWS)) for start in starts)
    return write_readings(blocks, optional, path, definitions=definitions, overwrite=overwrite)


def write_readings(
    blocks: Iterable[Readings],
    signals: Collection[Signal],
    path: str | Path,
    *,
    prefix: str = '',
    attachments: Mapping[str, bytes] | None = None,
    definitions: Definitions | None = None,
    overwrite: bool = False,
    further: Sequence[str] = (),
) -> WrittenLog:
    """Write readings block by block, each signal as a ``std_msgs/Float64`` topic of its name.

    Raises `DataError` if there is nothing to write. Raises `RecordingError` if the file exists or
    cannot be written.

    Parameters
    ----------
    blocks : iterable of Readings
        In time order, within and across.
    signals : collection of Signal
        Those that occur; required signals have a topic in any case.
    path : str or Path
        A file if it ends in ``.mcap``; otherwise a folder like that of rosbag2.
    prefix : str
        Namespace before the topics, such as ``/unit1``.
    attachments, definitions
        As in `RecordingWriter`.
    overwrite : bool
        Replace an existing file.
    further : sequence of str
        Topics of further columns, whose readings have the numbers after those of the signals.
    """
    place = Path(path)
    target = place if place.suffix == '.mcap' else place / f'{place.resolve().name}_0.mcap'
    if target.exists() and not overwrite:
        raise RecordingError(target, 'exists already')
    book = TopicRegistry(definitions or Definitions())
    channels = np.zeros(len(SIGNALS) + len(further), dtype=np.uint16)
    used = {i.signal: i.topic for i in SIGNALS if i.required or i.signal in signals}
    for number, topic in [*used.items(), *enumerate(further, start=len(SIGNALS))]:
        channels[number] = len(book.ids) + 1
        book.add(f'{prefix.rstrip("/")}/{topic}', FLOAT64)
    records = _Records(channels)
    parts = _parts(blocks, records)
    first = next(parts)
    with os_errors(target, 'cannot be written'):
        with new_file(target) as out:
            file = ChunkFile(out, folder.LIBRARY)
            file.put_all(attachments or {})
            packer = compressor()
            for part in chain([first], parts):
                table = book.packed() if file.table_due(len(book.ids)) else b''
                offset = len(table) + _RECORD.itemsize * np.arange(len(part), dtype=np.int64)
                columns = part['channel'], part['log_time'], offset
                file.put_chunk(pack_content(table + part.tobytes(), *columns, packer))
            split = folder.finish_split(file, target.name, book.table)
        path = target.parent / folder.METADATA_NAME
        # A single file needs no metadata.yaml, so that of another recording is kept.
        if not path.exists() or tells_of(path, target.name):
            folder.write_metadata(target.parent, [split])
    return WrittenLog(target, records.count)


class _Records:
    """Turns readings into message records, in the order of their log times."""

    def __init__(self, channels: NDArray[np.uint16]) -> None:
        self.count = 0
        self._channels = channels
        self._sequence = np.zeros(len(channels), dtype=np.int64)
        self._last_ns = -1

    def of(self, readings: Readings) -> NDArray[np.void]:
        if int(readings.time_ns[0]) < 0:
            raise DataError('The samples begin before 1970, which a recording cannot hold.')
        records: NDArray[np.void] = np.zeros(len(readings), dtype=_RECORD)
        records['op'] = int(Opcode.MESSAGE)
        records['length'] = _RECORD.itemsize - RECORD_HEAD.size
        records['channel'] = self._channels[readings.signal]
        # Delayed where needed, so that each time is at least 1 ns after the last.
        steps = np.arange(len(readings) + 1, dtype=np.int64)
        times = np.r_[self._last_ns, readings.time_ns]
        log_time = (np.maximum.accumulate(times - steps) + steps)[1:]
        records['log_time'] = log_time
        records['publish_time'] = readings.time_ns
        records['mark'] = _MARK
        records['value'] = readings.value
        for signal in np.unique(readings.signal).tolist():
            mine = readings.signal == signal
            n = int(mine.sum())
            records['sequence'][mine] = self._sequence[signal] + np.arange(1, n + 1)
            self._sequence[signal] += n
        self._last_ns = int(log_time[-1])
        self.count += len(records)
        return records


def _parts(blocks: Iterable[Readings], records: _Records) -> Iterator[NDArray[np.void]]:
    """Yield the records chunk by chunk; raises `DataError` if there are none."""
    rest: NDArray[np.void] = np.zeros(0, dtype=_RECORD)
    for readings in blocks:
        if not len(readings):
            continue
        # Without dtype, the fields would get the byte order of this machine.
        rest = np.concatenate([rest, records.of(readings)], dtype=_RECORD)
        whole = len(rest) - len(rest) % _PER_CHUNK
        for start in range(0, whole, _PER_CHUNK):
            yield rest[start : start + _PER_CHUNK]
        rest = rest[whole:]
    if len(rest):
        yield rest
    if not records.count:
        raise DataError('There are no samples to write.')


def tells_of(path: Path, name: str) -> bool:
    """Return True if a `metadata.yaml` describes this file only."""
    try:
        top = yaml.safe_load(path.read_text(encoding='utf-8'))
        return bool(top['rosbag2_bagfile_information']['relative_file_paths'] == [name])
    except (OSError, ValueError, TypeError, KeyError, yaml.YAMLError):
        return False
