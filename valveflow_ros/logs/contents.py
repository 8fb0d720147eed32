# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Contents of a log, in the same form for every kind of file."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

from valveflow_ros.errors import InputError
from valveflow_ros.logs.mcap.cdr import Decoder
from valveflow_ros.records import IntArray, Readings, Signal


class LoggedMessage(NamedTuple):
    """A raw message of a recording."""

    topic: str
    type: str
    log_time_ns: int
    publish_time_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """A topic of a recording.

    ``type`` is ``package/msg/Type``, ``count`` the number of intact messages. ``signal`` is the
    input that it carries, None if it is not read as an input. ``definition`` is the ros2msg text
    of its type and ``type_hash`` its RIHS01 hash; empty if the file has none.
    """

    name: str
    type: str
    count: int
    signal: Signal | None = None
    definition: str = ''
    type_hash: str = ''


Messages = Callable[[Collection[str] | None], Iterator[LoggedMessage]]


@dataclass(frozen=True, slots=True)
class LogContents:
    """Contents of a log."""

    path: str  # the file or folder that was read
    # The five inputs in the order of their log times, in the units of the file; readings of equal
    # log time keep the order of the file.
    readings: Readings
    # Time at which each reading was received, (n,); for tables the time of the reading.
    log_time_ns: IntArray
    topics: dict[str, TopicInfo] = field(default_factory=dict)  # every topic; empty for tables
    # Which topic or column each signal comes from.
    signals: dict[Signal, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()  # sentences to show to the user
    attachments: dict[str, bytes] = field(default_factory=dict)  # attached files by name
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)  # metadata records by name
    # start_ns, end_ns: first and last log time of any message
    start_ns: int | None = None
    end_ns: int | None = None
    damaged_chunks: int = 0  # number of places where data were lost
    # Yields the raw messages of the given topics (None for all) in the order of their log times;
    # see `iter_messages`. A table has none.
    messages: Messages = lambda topics: iter(())
    # The unit that the log states for a signal, for example in the head of a column.
    units: dict[Signal, str] = field(default_factory=dict)
    # Why a column was assigned to a signal, if the names alone did not decide it.
    grounds: dict[Signal, str] = field(default_factory=dict)
    # Sentences about what was inferred from the data.
    understood: list[str] = field(default_factory=list)

    def iter_messages(self, topics: Collection[str] | None = None) -> Iterator[LoggedMessage]:
        """Yield raw messages in the order of their log times, reading the file again.

        A latched message that a recorder repeated at the start of a later split is yielded once.
        Raises `InputError` if a topic is not in the log. Raises `RecordingError` if the file can
        no longer be read.

        Parameters
        ----------
        topics : collection of str, optional
            Full names; all topics by default.
        """
        for topic in topics or ():
            self._topic(topic)
        return self.messages(topics)

    def decoder(self, topic: str) -> Decoder:
        """Return a decoder for a topic that uses the definition stored in the file.

        Raises `InputError` if the topic is not in the log. Raises `RecordingError` if its
        definition is missing or cannot be parsed.
        """
        info = self._topic(topic)
        return Decoder(info.type, info.definition)

    def _topic(self, topic: str) -> TopicInfo:
        if topic not in self.topics:
            have = ', '.join(sorted(self.topics)) or 'none'
            raise InputError(f"{self.path} has no topic '{topic}'; it has: {have}.")
        return self.topics[topic]
