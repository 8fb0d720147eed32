# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a log holds, from whatever kind of file it came."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

from valveflow_ros.errors import InputError
from valveflow_ros.logs.mcap.cdr import Decoder
from valveflow_ros.records import IntArray, Readings, Signal


class LoggedMessage(NamedTuple):
    """A message as it stands in a recording."""

    topic: str
    type: str
    log_time_ns: int
    publish_time_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """A topic of a recording.

    Attributes
    ----------
    name, type : str
        Its name and ``package/msg/Type``.
    count : int
        Intact messages.
    signal : Signal or None
        What it stands for, if it is read as an input.
    definition : str
        The ros2msg text of its type, empty if the file has none.
    type_hash : str
        RIHS01 hash, empty if the file has none.
    """

    name: str
    type: str
    count: int
    signal: Signal | None = None
    definition: str = ''
    type_hash: str = ''


Messages = Callable[[Collection[str] | None], Iterator[LoggedMessage]]


def no_messages(topics: Collection[str] | None) -> Iterator[LoggedMessage]:
    """Yield nothing: a table has no raw messages."""
    return iter(())


@dataclass(frozen=True, slots=True)
class LogContents:
    """What a log holds.

    Attributes
    ----------
    path : str
        Where it was read.
    readings : Readings
        The five inputs in the order of their log times, those of equal time in
        the order of the file, in the units of the file.
    log_time_ns : int64 (n,)
        When each reading was received; for tables its own time.
    topics : dict[str, TopicInfo]
        Every topic; empty for tables.
    signals : dict[Signal, str]
        Which topic or column each signal comes from.
    warnings : tuple of str
        Sentences a user should see.
    attachments : dict[str, bytes]
        Files inside the file.
    metadata : dict[str, dict[str, str]]
        Named notes inside the file.
    start_ns, end_ns : int or None
        First and last log time of any message.
    damaged_chunks : int
        Places where something was lost.
    messages : callable
        Gives the raw messages of some or of all topics in the order of their log times; see
        `iter_messages`.
    units : dict[Signal, str]
        The unit the log names for a signal, as a table's column does.
    grounds : dict[Signal, str]
        Why a column was taken for a signal, where that had to be found out.
    understood : list of str
        Sentences about what had to be found out.
    """

    path: str
    readings: Readings
    log_time_ns: IntArray
    topics: dict[str, TopicInfo] = field(default_factory=dict)
    signals: dict[Signal, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    attachments: dict[str, bytes] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    start_ns: int | None = None
    end_ns: int | None = None
    damaged_chunks: int = 0
    messages: Messages = no_messages
    units: dict[Signal, str] = field(default_factory=dict)
    grounds: dict[Signal, str] = field(default_factory=dict)
    understood: list[str] = field(default_factory=list)

    def iter_messages(self, topics: Collection[str] | None = None) -> Iterator[LoggedMessage]:
        """Yield raw messages in the order of their log times, read anew from the file.

        Latched messages that a recorder repeated at the head of a later split
        come once.

        Parameters
        ----------
        topics : collection of str, optional
            Full names; all topics by default.

        Raises
        ------
        InputError
            If a topic is not in the log.
        RecordingError
            If the file cannot be read any more.
        """
        for topic in topics or ():
            self._topic(topic)
        return self.messages(topics)

    def decoder(self, topic: str) -> Decoder:
        """Return a decoder for a topic by the definition in the file itself.

        Raises
        ------
        InputError
            If the topic is not in the log.
        RecordingError
            If its definition is missing or not understood.
        """
        info = self._topic(topic)
        return Decoder(info.type, info.definition)

    def _topic(self, topic: str) -> TopicInfo:
        if topic not in self.topics:
            have = ', '.join(sorted(self.topics)) or 'none'
            raise InputError(f"{self.path} has no topic '{topic}'; it has: {have}.")
        return self.topics[topic]
