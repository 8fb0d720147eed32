# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Bags that rosbag2 wrote with sqlite3 (``.db3``), read as the same messages in MCAP."""

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
    """The messages of a copy, which is removed together with this."""

    def __init__(self, folder: str, messages: Messages) -> None:
        self._messages = messages
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)

    def __call__(self, topics: Collection[str] | None) -> Iterator[LoggedMessage]:
        yield from self._messages(topics)


def read_bag(paths: list[Path], name: str, columns: Mapping[str, str]) -> LogContents:
    """Return what ``.db3`` files, the splits of one bag, hold together.

    They are copied into an MCAP file below the folder for temporary files, so that everything
    else is read as it always is; it is removed with the result.

    Raises
    ------
    RecordingError
        A file is no such bag, or holds nothing that can be read.
    InputError
        The choice of topics is not clear.
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
    """Write the messages of one file in the order of their times; return how many there were."""
    with Source.open(path):
        pass  # it is a regular file
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
    """Add the topics of a bag to a recording; yield the number and the name of each."""
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
        except RecordingError:  # a type that is not known here, and not told either
            writer.add_topic(topic, kind, definition='')
        yield number, topic
