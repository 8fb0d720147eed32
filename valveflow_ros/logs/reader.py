# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Opens any log: a recording, the folder of a recording, or a table from a historian."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
import weakref
from collections.abc import Collection, Iterator, Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from urllib.parse import quote

import yaml

try:
    from yaml import CSafeLoader as SafeLoader
except ImportError:  # PyYAML was built without libyaml
    from yaml import SafeLoader  # type: ignore[assignment]

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs.contents import LogContents, LoggedMessage, Messages
from valveflow_ros.logs.mcap.folder import METADATA_NAME, recording_files
from valveflow_ros.logs.mcap.reading import read_recording
from valveflow_ros.logs.mcap.records import MAGIC
from valveflow_ros.logs.mcap.writer import RecordingWriter
from valveflow_ros.logs.part_file import PART_SUFFIX
from valveflow_ros.logs.source import Source, os_errors
from valveflow_ros.logs.tables.refusal import AS_SEEN, TableOptions
from valveflow_ros.logs.tables.table import open_table

MAX_METADATA_BYTES = 16 << 20
BAG_SUFFIX = '.db3'
# A sentence names so many recordings.
_MOST_NAMED = 10
TABLE_SUFFIXES = ('.csv', '.tsv', '.txt', '.parquet', '.pq', '.xlsx', '.xlsm')


def open_log(
    path: str | Path,
    *,
    columns: Mapping[str, str] | None = None,
    absent: Collection[str] = (),
    table: TableOptions = AS_SEEN,
) -> LogContents:
    """Return the contents of a log.

    Raises `RecordingError` if nothing can be read. Raises `InputError` if it is unclear which
    topic or column holds a signal.

    Parameters
    ----------
    path : str or Path
        An ``.mcap`` file in any state, a ``.db3`` file or folder of rosbag2, a ``.csv``,
        ``.xlsx`` or ``.parquet`` table.
    columns : mapping of str to str, optional
        The topic or column to use for a contract name.
    absent : collection of str
        Contract names that a table may lack.
    table : TableOptions
        What the user says about a table.
    """
    place = Path(path)
    names = dict(columns or {})
    try:
        is_folder = place.is_dir()
    except (OSError, ValueError):
        is_folder = False
    if is_folder:
        files, warnings = _files_of(place)
        read = _read_bag if files[0].suffix == BAG_SUFFIX else read_recording
        contents = read(files, str(path), names)
        return replace(contents, warnings=(*warnings, *contents.warnings))
    if place.suffix.lower() in TABLE_SUFFIXES:
        return open_table(place, names, absent, table)
    if place.suffix.lower() == BAG_SUFFIX:
        return _read_bag([place], str(path), names)
    if place.suffix.lower() not in ('.mcap', PART_SUFFIX):
        with Source.open(place) as source:
            if source.read(0, len(MAGIC)) != MAGIC:
                raise RecordingError(
                    path, 'is neither an .mcap file nor a .csv, .xlsx or .parquet table'
                )
    return read_recording([place], str(path), names)


def _files_of(folder: Path) -> tuple[list[Path], list[str]]:
    """Return the splits of a folder in their order, and warnings about their selection."""
    with os_errors(folder, 'cannot be opened'):
        names = {entry.name for entry in folder.iterdir()}
    found = recording_files(folder)
    whole = {path.name for path in found if path.suffix == '.mcap'}
    listed = _listed(folder) if METADATA_NAME in names else []
    if not found:
        bags = sorted(folder / name for name in names if name.endswith(BAG_SUFFIX))
        if bags:
            return bags, []
        problem = 'has no .mcap file in it, and no .db3'
        if inside := _recordings_in(folder):
            problem += f'; give one of: {inside}'
        raise RecordingError(folder, problem)
    missing = [name for name in listed if name not in whole]
    warnings = [f"'{name}' is named in {METADATA_NAME} and is not there." for name in missing]
    if not listed:
        return found, warnings
    stems = {_stem(name) for name in listed}
    own = [folder / name for name in listed if name in whole]
    own += [path for path in found if path not in own and _stem(path.name) in stems]
    others = [path.name for path in found if path not in own]
    if others and own:
        warnings.append(f'{", ".join(others)}: not named in {METADATA_NAME}, not read.')
    elif others:
        warnings.append(f'{METADATA_NAME} names none of the files that are there; all are read.')
    return own or found, warnings


def _recordings_in(folder: Path) -> str:
    """Return the folders in a folder that hold recordings, as a list for a sentence."""
    with os_errors(folder, 'cannot be read'):
        inner = [path for path in sorted(folder.iterdir()) if path.is_dir()]
        found = [str(path) for path in inner if any((*path.glob('*.mcap*'), *path.glob('*.db3')))]
    # By their names the newest of the monitor's come last.
    more = f'{len(found) - _MOST_NAMED} earlier ones, ' if len(found) > _MOST_NAMED else ''
    return more + ', '.join(found[-_MOST_NAMED:])


def _stem(name: str) -> str:
    """Return the name of a split without its suffix and its number, if it has one."""
    whole = name.split('.mcap')[0]
    stem, line, number = whole.rpartition('_')
    return stem + line if line and number.isdecimal() else whole


def _listed(folder: Path) -> list[str]:
    """Return the file names in `metadata.yaml`; its other content is in the files, too."""
    # An unreadable one is ignored, since the files themselves describe their content.
    try:
        with Source.open(folder / METADATA_NAME) as source:
            raw = source.read(0, min(source.size, MAX_METADATA_BYTES))
    except RecordingError:
        return []
    try:
        top = yaml.load(raw, Loader=SafeLoader)
        info = top['rosbag2_bagfile_information']
        names = info['relative_file_paths']
        mode = str(info.get('compression_mode') or '').lower()
    except (yaml.YAMLError, KeyError, TypeError, AttributeError, ValueError, RecursionError):
        return []
    if mode in ('file', 'message'):
        problem = f'is compressed {mode} by {mode} by rosbag2, which is not read here'
        raise RecordingError(folder, f"{problem}; rewrite it with 'ros2 bag convert'")
    # Only the file name is used, so that nothing outside of the folder is read.
    return [Path(str(name)).name for name in names if name] if isinstance(names, list) else []


# Bags that rosbag2 wrote with sqlite3, read through a temporary MCAP file.

_NO_SEND_TIME = 'A bag in sqlite3 has no times of sending: the time of reception is used.'


class _Copy:
    """The messages of a temporary copy, which is removed together with this object."""

    def __init__(self, folder: str, messages: Messages) -> None:
        self._messages = messages
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)

    def __call__(self, topics: Collection[str] | None) -> Iterator[LoggedMessage]:
        yield from self._messages(topics)


def _read_bag(paths: list[Path], name: str, columns: Mapping[str, str]) -> LogContents:
    """Return the contents of the splits of one bag; the copy goes together with the result."""
    folder = tempfile.mkdtemp(prefix='valveflow-')
    try:
        with RecordingWriter(Path(folder), name='bag') as writer:
            if not sum(_copy(path, writer) for path in paths):
                raise RecordingError(name, 'holds no messages')
        contents = read_recording(sorted(Path(folder).glob('*.mcap')), name, columns)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    told = (*contents.warnings, _NO_SEND_TIME)
    return replace(contents, warnings=told, messages=_Copy(folder, contents.messages))


def _copy(path: Path, writer: RecordingWriter) -> int:
    """Write the messages of one file in the order of their times; return their number."""
    with Source.open(path):
        pass  # raises unless it is a regular file
    count = 0
    try:
        uri = f'file:{quote(str(path.resolve()))}?mode=ro'
        with closing(sqlite3.connect(uri, uri=True)) as bag:
            topics = dict(_topics(bag, writer))
            rows = bag.execute(
                'SELECT topic_id, timestamp, data FROM messages ORDER BY timestamp, id'
            )
            for topic, time_ns, data in rows:
                if topic in topics:
                    writer.write(topics[topic], bytes(data), int(time_ns), int(time_ns))
                    count += 1
    except (sqlite3.Error, TypeError, ValueError) as error:
        raise RecordingError(path, f'is no whole bag in sqlite3 ({error})') from None
    return count


def _topics(bag: sqlite3.Connection, writer: RecordingWriter) -> Iterator[tuple[int, str]]:
    """Add the topics of a bag to a recording; yield the id and the name of each."""
    texts: dict[str, str] = {}
    if bag.execute("SELECT 1 FROM sqlite_master WHERE name = 'message_definitions'").fetchone():
        texts = dict(bag.execute(
            'SELECT topic_type, encoded_message_definition FROM message_definitions '
            "WHERE encoding = 'ros2msg'"
        ))  # fmt: skip
    for number, topic, kind, form in bag.execute(
        'SELECT id, name, type, serialization_format FROM topics'
    ).fetchall():
        if form != 'cdr':
            continue
        try:
            writer.add_topic(topic, kind, definition=texts.get(kind))
        except RecordingError:  # the type is unknown, and the bag has no definition of it
            writer.add_topic(topic, kind, definition='')
        yield number, topic
