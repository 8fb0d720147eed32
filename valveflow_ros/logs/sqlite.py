# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Reads bags that rosbag2 wrote with sqlite3 (``.db3``) through a temporary MCAP file."""

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

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs.contents import LogContents, LoggedMessage, Messages
from valveflow_ros.logs.mcap.reading import read_recording
from valveflow_ros.logs.mcap.writer import RecordingWriter
from valveflow_ros.logs.source import Source

_NO_SEND_TIME = 'A bag in sqlite3 has no times of sending: values stand when they were received.'


class _Copy:
    """The messages of a temporary copy, which is removed together with this object."""

    def __init__(self, folder: str, messages: Messages) -> None:
        self._messages = messages
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)

    def __call__(self, topics: Collection[str] | None) -> Iterator[LoggedMessage]:
        yield from self._messages(topics)


def read_bag(paths: list[Path], name: str, columns: Mapping[str, str]) -> LogContents:
    """Return the contents of ``.db3`` files, which are the splits of one bag.

    They are copied to a temporary MCAP file, which is read like any other recording and removed
    together with the result.

    Raises
    ------
    RecordingError
        If a file is not a complete bag, or there is no message in any of them.
    InputError
        If it is unclear which topic holds a signal.
    """
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
