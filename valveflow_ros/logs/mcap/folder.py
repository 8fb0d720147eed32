# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Folder of a recording: numbered splits and the `metadata.yaml` that rosbag2 needs."""

from __future__ import annotations

import json
import re
import textwrap
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from mcap.records import Channel

from valveflow_ros import __version__
from valveflow_ros.errors import RecordingError
from valveflow_ros.logs.mcap.chunk_file import ChunkFile
from valveflow_ros.logs.mcap.records import Summary, TopicTable, read_summary
from valveflow_ros.logs.part_file import PART_SUFFIX, write_whole
from valveflow_ros.logs.source import Source, os_errors

METADATA_NAME = 'metadata.yaml'
METADATA_VERSION = 9
ROS_DISTRO = 'jazzy'
LIBRARY = f'valveflow_ros {__version__}'
_NUMBERED = re.compile(r'(.*)_([0-9]{1,9})\.mcap(?:\.part)?\Z', re.DOTALL)


@dataclass(frozen=True, slots=True)
class Split:
    """A finished file of a recording; its first and last log time are 0 if it has no messages.

    ``topics`` holds type and channel, ``counts`` the number of messages, both by topic name.
    """

    name: str
    start_ns: int
    end_ns: int
    messages: int
    topics: dict[str, tuple[str, Channel]] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)

    @classmethod
    def of(cls, name: str, table: TopicTable, file: ChunkFile | Summary) -> Split:
        """Describe a file by its topics and by what was written, or by its summary."""
        topics: dict[str, tuple[str, Channel]] = {}
        by_topic: dict[str, int] = {}
        for number, channel in table.channels.items():
            topics[channel.topic] = (table.type_of(channel), channel)
            count = file.counts.get(number, 0)
            by_topic[channel.topic] = by_topic.get(channel.topic, 0) + count
        total = sum(file.counts.values())
        return cls(name, file.start_ns, file.end_ns, total, topics, by_topic)

    @classmethod
    def read(cls, path: Path) -> Split | None:
        """Describe a finished file by its summary; ``None`` if it has no valid summary."""
        try:
            with Source.open(path) as source:
                summary = read_summary(source)
        except RecordingError:
            return None
        return None if summary is None else cls.of(path.name, summary.table, summary)


def split_number(path: Path) -> int:
    """Return the number at the end of a split's name; -1 if it has none."""
    match = _NUMBERED.match(path.name)
    return -1 if match is None else int(match.group(2))


def is_split_of(name: str, recording: str) -> bool:
    """Return True if a file is named like the splits of a recording."""
    match = _NUMBERED.match(name)
    # Excludes similar names, such as those with leading zeros.
    return match is not None and name == f'{recording}_{int(match.group(2))}.mcap'


def in_order(paths: Iterable[Path]) -> list[Path]:
    """Sort files by their number, then by their name."""
    return sorted(paths, key=lambda path: (split_number(path), path.name))


def recording_files(folder: Path) -> list[Path]:
    """Return all files of a recording in their order, finished or not.

    If both a ``.part`` file and its finished file exist, as in a recovery, it is left out.
    """
    with os_errors(folder, 'cannot be read'):
        names = {entry.name for entry in folder.iterdir()}
    whole = {name for name in names if name.endswith('.mcap')}
    parts = {name for name in names if name.endswith(f'.mcap{PART_SUFFIX}')}
    kept = {name for name in parts if name.removesuffix(PART_SUFFIX) not in whole}
    return in_order(folder / name for name in whole | kept)


def finished_files(folder: Path) -> list[Path]:
    """Return the finished splits of a folder in their order."""
    return in_order(path for path in folder.glob('*.mcap') if path.is_file())


def finish_split(file: ChunkFile, name: str, table: TopicTable) -> Split:
    """Finish a file that has, or will have, this name; raises `OSError`."""
    split = Split.of(name, table, file)
    file.put_metadata('rosbag2', {'serialized_metadata': _information([split])})
    file.finish(table)
    return split


def write_metadata(folder: Path, splits: Collection[Split]) -> None:
    """Write `metadata.yaml` for these splits; raises `OSError`."""
    text = 'rosbag2_bagfile_information:\n' + textwrap.indent(_information(splits), '  ')
    write_whole(folder / METADATA_NAME, text.encode())


def finished_splits(folder: Path, known: Mapping[str, Split] = {}) -> dict[str, Split]:
    """Return the finished splits of a folder by name, in order; raises `OSError`.

    Splits in ``known`` are not read again.
    """
    found = {p.name: known.get(p.name) or Split.read(p) for p in finished_files(folder)}
    return {name: split for name, split in found.items() if split is not None}


def _information(splits: Collection[Split]) -> str:
    """Return the text under the first key of `metadata.yaml`; a split's metadata has it, too."""
    times = [time for s in splits if s.messages for time in (s.start_ns, s.end_ns)] or [0]
    start, duration = min(times), max(times) - min(times)
    lines = [
        f'version: {METADATA_VERSION}',
        'storage_identifier: mcap',
        f'duration:\n  nanoseconds: {duration}',
        f'starting_time:\n  nanoseconds_since_epoch: {start}',
        f'message_count: {sum(s.messages for s in splits)}',
        'topics_with_message_count:' + ('' if any(s.topics for s in splits) else ' []'),
        *_topic_lines(splits),
        'compression_format: ""',
        'compression_mode: ""',
        'relative_file_paths:' + ('' if splits else ' []'),
        *(f'  - {_quoted(split.name)}' for split in splits),
        'files:' + ('' if splits else ' []'),
        *(_file_lines(split) for split in splits),
        f'custom_data:\n  recorded_by: {_quoted(LIBRARY)}',
        f'ros_distro: {ROS_DISTRO}',
    ]
    return '\n'.join(lines) + '\n'


def _topic_lines(splits: Collection[Split]) -> list[str]:
    topics: dict[str, tuple[str, Channel]] = {}
    counts: Counter[str] = Counter()
    for split in splits:
        topics.update(split.topics)
        counts.update(split.counts)
    lines = []
    for topic, (kind, channel) in topics.items():
        qos = channel.metadata.get('offered_qos_profiles', '')
        told = f'\n{textwrap.indent(qos, " " * 8)}' if qos else ' []'
        lines.append(
            '  - topic_metadata:\n'
            f'      name: {_quoted(topic)}\n'
            f'      type: {_quoted(kind)}\n'
            f'      serialization_format: {_quoted(channel.message_encoding)}\n'
            f'      offered_qos_profiles:{told}\n'
            '      type_description_hash: '
            f'{_quoted(channel.metadata.get("topic_type_hash", ""))}\n'
            f'    message_count: {counts[topic]}'
        )
    return lines


def _file_lines(split: Split) -> str:
    return (
        f'  - path: {_quoted(split.name)}\n'
        f'    starting_time:\n      nanoseconds_since_epoch: {split.start_ns}\n'
        f'    duration:\n      nanoseconds: {split.end_ns - split.start_ns}\n'
        f'    message_count: {split.messages}'
    )


# A JSON string is a YAML string.
_quoted = json.dumps
