"""The topics a writer knows: fixed channel ids, complete definitions, repeated where it helps."""

from __future__ import annotations

from dataclasses import dataclass, field

from valveflow_ros.errors import InputError
from valveflow_ros.logs.mcap.definitions import Definitions
from valveflow_ros.logs.mcap.layout import Channel, LayoutError, Schema
from valveflow_ros.logs.mcap.msgdef import parse_all
from valveflow_ros.logs.mcap.qos import Qos
from valveflow_ros.logs.mcap.topic_table import TopicTable
from valveflow_ros.logs.mcap.type_hash import type_hash

# A chunk may be lost, and with it the only mention of a topic; so the table stands in the
# first two chunks that could hold it and then in every so-manieth.
REPEAT_CHUNKS = 256


@dataclass(slots=True)
class TopicBook:
    """Assigns ids to topics and types in the order in which they are added."""

    definitions: Definitions
    table: TopicTable = field(default_factory=TopicTable)
    ids: dict[str, int] = field(default_factory=dict)
    _schema_ids: dict[str, int] = field(default_factory=dict)
    _packed: bytes = b''

    def add(
        self,
        topic: str,
        type_name: str,
        qos: Qos | None = None,
        hash_text: str | None = None,
        definition: str | None = None,
    ) -> int:
        """Add a topic and return its channel id; adding it again changes nothing.

        Raises
        ------
        InputError
            If the topic was added before with another type.
        RecordingError
            If the definition of the type is not found.
        """
        if topic in self.ids:
            channel = self.table.channels[self.ids[topic]]
            if self.table.type_of(channel) != type_name:
                have = self.table.type_of(channel)
                raise InputError(f"Topic '{topic}' is recorded as {have}, not as {type_name}.")
            return self.ids[topic]
        if type_name not in self._schema_ids:
            text = self.definitions.text(type_name) if definition is None else definition
            schema = Schema(len(self._schema_ids) + 1, type_name, 'ros2msg', text.encode())
            self._schema_ids[type_name] = schema.id
            self.table.schemas[schema.id] = schema
        if hash_text is None:
            hash_text = self._hash(type_name, definition)
        metadata = {'offered_qos_profiles': (qos or Qos()).text(), 'topic_type_hash': hash_text}
        number = len(self.ids) + 1
        channel = Channel(number, self._schema_ids[type_name], topic, 'cdr', metadata)
        self.table.channels[number] = channel
        self.ids[topic] = number
        self._packed = b''
        return number

    def _hash(self, type_name: str, definition: str | None) -> str:
        if definition is None:
            return self.definitions.type_hash(type_name)
        try:
            return type_hash(type_name, parse_all(type_name, definition))
        except LayoutError:
            # Without a hash a recording is as readable as with one.
            return ''

    def packed(self) -> bytes:
        """Return the records of all topics."""
        if not self._packed:
            schemas = [schema.pack() for schema in self.table.schemas.values()]
            channels = [channel.pack() for channel in self.table.channels.values()]
            self._packed = b''.join(schemas + channels)
        return self._packed


class TableSchedule:
    """Says for each chunk of a file whether the table of topics stands in it."""

    def __init__(self) -> None:
        self._known = 0
        self._since = 0

    def due(self, topics: int) -> bool:
        """Tell whether the next chunk needs the table of so many topics."""
        return topics > self._known or self._since in (0, REPEAT_CHUNKS)

    def done(self, topics: int, with_table: bool) -> None:
        """Take note of a chunk that was written."""
        if topics > self._known:
            # The next chunk repeats what is new.
            self._known, self._since = topics, 0
        elif with_table:
            self._since = 1
        else:
            self._since += 1
