"""The topics of a file: channels and the definitions of their types."""

from __future__ import annotations

from dataclasses import dataclass, field

from valveflow_ros.logs.limits import DEFAULT_LIMITS, Limits
from valveflow_ros.logs.mcap.layout import Channel, LayoutError, Op, Schema


@dataclass(slots=True)
class TopicTable:
    """Schemas and channels as they are met; the same id never means two things."""

    limits: Limits = DEFAULT_LIMITS
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    definition_bytes: int = 0

    def add(self, op: Op, content: bytes) -> None:
        """Take a schema or a channel record.

        Raises
        ------
        LayoutError
            If it is malformed, contradicts an earlier one, or is one too many.
        """
        if op == Op.SCHEMA:
            self._add_schema(Schema.unpack(content))
        elif op == Op.CHANNEL:
            self._add_channel(Channel.unpack(content))

    def take_over(self, other: TopicTable) -> None:
        """Add all that another table knows; raises `LayoutError` like `add`."""
        for schema in other.schemas.values():
            self._add_schema(schema)
        for channel in other.channels.values():
            self._add_channel(channel)

    def type_of(self, channel: Channel) -> str:
        """Return the type of a channel, empty if the file does not say."""
        schema = self.schemas.get(channel.schema_id)
        return '' if schema is None else schema.name

    def definition_of(self, channel: Channel) -> str:
        """Return the text of a channel's ros2msg definition, empty if there is none."""
        schema = self.schemas.get(channel.schema_id)
        if schema is None or schema.encoding != 'ros2msg':
            return ''
        return schema.data.decode(errors='replace')

    def _add_schema(self, schema: Schema) -> None:
        known = self.schemas.get(schema.id)
        if known is not None:
            if known != schema:
                raise LayoutError(f'it defines schema {schema.id} twice, differently')
            return
        self.definition_bytes += len(schema.data)
        if self.definition_bytes > self.limits.definition_bytes:
            raise LayoutError('its definitions of messages are larger than can be read')
        self._check_count(len(self.schemas))
        self.schemas[schema.id] = schema

    def _add_channel(self, channel: Channel) -> None:
        known = self.channels.get(channel.id)
        if known is not None:
            if known != channel:
                raise LayoutError(f'it defines channel {channel.id} twice, differently')
            return
        self._check_count(len(self.channels))
        self.channels[channel.id] = channel

    def _check_count(self, count: int) -> None:
        if count >= self.limits.channels:
            raise LayoutError(f'it has more than {self.limits.channels} topics')
