"""The summary at the end of a finished file, believed only if its checksum is right."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field

from valveflow_ros.logs.mcap.layout import (
    FOOTER,
    FOOTER_RECORD_SIZE,
    MAGIC,
    RECORD_HEAD,
    Channel,
    Cursor,
    LayoutError,
    Op,
    Schema,
)
from valveflow_ros.logs.mcap.scan import ends_well
from valveflow_ros.logs.source import DEFAULT_LIMITS, Limits, Source

# The topics of a file: channels and the definitions of their types.


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


@dataclass(slots=True)
class Summary:
    """What a finished file says about itself."""

    table: TopicTable = field(default_factory=TopicTable)
    messages: int = 0
    start_ns: int = 0
    end_ns: int = 0
    counts: dict[int, int] = field(default_factory=dict)


def read_summary(source: Source) -> Summary | None:
    """Return the summary, or ``None`` if there is none whose checksum is right."""
    if not ends_well(source):
        return None
    footer_at = source.size - len(MAGIC) - FOOTER_RECORD_SIZE
    footer = source.read(footer_at, FOOTER_RECORD_SIZE)
    start, _, crc = FOOTER.unpack_from(footer, RECORD_HEAD.size)
    size = footer_at - start
    if start == 0 or not 0 < size <= DEFAULT_LIMITS.record_bytes:
        return None
    raw = source.read(start, size)
    if zlib.crc32(footer[:-4], zlib.crc32(raw)) != crc:
        return None
    try:
        return _parse(raw)
    except LayoutError:
        return None


def _parse(raw: bytes) -> Summary:
    summary = Summary()
    cursor = Cursor(raw)
    while cursor.position < len(raw):
        op, length = RECORD_HEAD.unpack(cursor.take(RECORD_HEAD.size))
        content = cursor.take(length)
        if op in (Op.SCHEMA, Op.CHANNEL):
            summary.table.add(Op(op), content)
        elif op == Op.STATISTICS:
            _statistics(summary, content)
    return summary


def _statistics(summary: Summary, content: bytes) -> None:
    cursor = Cursor(content)
    summary.messages = cursor.u64()
    cursor.take(2 + 4 * 4)
    summary.start_ns, summary.end_ns = cursor.u64(), cursor.u64()
    inner = Cursor(cursor.take(cursor.u32()))
    while inner.position < len(inner.data):
        channel = inner.u16()
        summary.counts[channel] = inner.u64()
