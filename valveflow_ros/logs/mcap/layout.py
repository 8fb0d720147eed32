"""The bytes of an MCAP file: which records there are, how they are packed and unpacked.

Nothing here opens a file or judges one; `Cursor` refuses to read past the end
of the bytes it was given, so a hostile length never allocates anything.
"""

from __future__ import annotations

import enum
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import PurePath

import lz4.frame
import zstandard

MAGIC = b'\x89MCAP0\r\n'
PROFILE = 'ros2'

RECORD_HEAD = struct.Struct('<BQ')
MESSAGE_HEAD = struct.Struct('<HIQQ')
CHUNK_HEAD = struct.Struct('<QQQI')
FOOTER = struct.Struct('<QQI')
_U16 = struct.Struct('<H')
_U32 = struct.Struct('<I')
_U64 = struct.Struct('<Q')
FOOTER_RECORD_SIZE = RECORD_HEAD.size + FOOTER.size


class Op(enum.IntEnum):
    """Kinds of records."""

    HEADER = 1
    FOOTER = 2
    SCHEMA = 3
    CHANNEL = 4
    MESSAGE = 5
    CHUNK = 6
    MESSAGE_INDEX = 7
    CHUNK_INDEX = 8
    ATTACHMENT = 9
    ATTACHMENT_INDEX = 10
    STATISTICS = 11
    METADATA = 12
    METADATA_INDEX = 13
    SUMMARY_OFFSET = 14
    DATA_END = 15


class LayoutError(ValueError):
    """Bytes do not have the layout they claim; never leaves the package."""


def record(op: Op, content: bytes) -> bytes:
    """Return a whole record: kind, length, content."""
    return RECORD_HEAD.pack(op, len(content)) + content


def pack_text(text: str) -> bytes:
    """Return a string with its length before it."""
    raw = text.encode()
    return _U32.pack(len(raw)) + raw


def pack_map(items: Mapping[str, str]) -> bytes:
    """Return a map of strings with its size in bytes before it."""
    raw = b''.join(pack_text(key) + pack_text(value) for key, value in items.items())
    return _U32.pack(len(raw)) + raw


class Cursor:
    """Reads packed values one after the other and refuses to go past the end."""

    __slots__ = ('data', 'position')

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.position = 0

    def take(self, size: int) -> bytes:
        """Return the next ``size`` bytes."""
        end = self.position + size
        if end > len(self.data):
            raise LayoutError('a record is shorter than what it says it holds')
        raw = self.data[self.position : end]
        self.position = end
        return raw

    def u16(self) -> int:
        """Return the next two bytes as an unsigned number."""
        return int(_U16.unpack(self.take(2))[0])

    def u32(self) -> int:
        """Return the next four bytes as an unsigned number."""
        return int(_U32.unpack(self.take(4))[0])

    def u64(self) -> int:
        """Return the next eight bytes as an unsigned number."""
        return int(_U64.unpack(self.take(8))[0])

    def text(self) -> str:
        """Return the next string."""
        raw = self.take(self.u32())
        try:
            return raw.decode()
        except UnicodeDecodeError:
            raise LayoutError('a name is not UTF-8') from None

    def text_map(self) -> dict[str, str]:
        """Return the next map of strings."""
        inner = Cursor(self.take(self.u32()))
        items: dict[str, str] = {}
        while inner.position < len(inner.data):
            key = inner.text()
            items[key] = inner.text()
        return items


@dataclass(frozen=True, slots=True)
class Schema:
    """What a message type looks like."""

    id: int
    name: str
    encoding: str
    data: bytes

    def pack(self) -> bytes:
        """Return the whole record."""
        head = _U16.pack(self.id) + pack_text(self.name) + pack_text(self.encoding)
        return record(Op.SCHEMA, head + _U32.pack(len(self.data)) + self.data)

    @classmethod
    def unpack(cls, content: bytes) -> Schema:
        """Read the content of a record; raises `LayoutError`."""
        cursor = Cursor(content)
        return cls(cursor.u16(), cursor.text(), cursor.text(), cursor.take(cursor.u32()))


@dataclass(frozen=True, slots=True)
class Channel:
    """A topic in a file."""

    id: int
    schema_id: int
    topic: str
    encoding: str
    metadata: dict[str, str] = field(default_factory=dict)

    def pack(self) -> bytes:
        """Return the whole record."""
        head = _U16.pack(self.id) + _U16.pack(self.schema_id)
        names = pack_text(self.topic) + pack_text(self.encoding)
        return record(Op.CHANNEL, head + names + pack_map(self.metadata))

    @classmethod
    def unpack(cls, content: bytes) -> Channel:
        """Read the content of a record; raises `LayoutError`."""
        cursor = Cursor(content)
        return cls(cursor.u16(), cursor.u16(), cursor.text(), cursor.text(), cursor.text_map())


@dataclass(frozen=True, slots=True)
class Attachment:
    """A file inside the file."""

    name: str
    media_type: str
    data: bytes
    log_time_ns: int = 0

    def pack(self) -> bytes:
        """Return the whole record, its checksum at the end."""
        content = (
            _U64.pack(self.log_time_ns)
            + _U64.pack(0)
            + pack_text(self.name)
            + pack_text(self.media_type)
            + _U64.pack(len(self.data))
            + self.data
        )
        return record(Op.ATTACHMENT, content + _U32.pack(zlib.crc32(content)))

    @classmethod
    def unpack(cls, content: bytes) -> Attachment:
        """Read the content of a record; raises `LayoutError`, also if the checksum is wrong."""
        cursor = Cursor(content)
        log_time_ns = cursor.u64()
        cursor.u64()
        name, media_type = cursor.text(), cursor.text()
        data = cursor.take(cursor.u64())
        body = content[: cursor.position]
        if cursor.u32() != zlib.crc32(body) or cursor.position != len(content):
            raise LayoutError(f"the checksum of the attachment '{name}' is wrong")
        return cls(name, media_type, data, log_time_ns)


def pack_header(library: str) -> bytes:
    """Return the first record of a file."""
    return record(Op.HEADER, pack_text(PROFILE) + pack_text(library))


def pack_metadata(name: str, items: Mapping[str, str]) -> bytes:
    """Return a metadata record."""
    return record(Op.METADATA, pack_text(name) + pack_map(items))


def pack_chunk(start: int, end: int, content: bytes, compression: str, packed: bytes) -> bytes:
    """Return a chunk record around compressed records, with the checksum of ``content``."""
    head = CHUNK_HEAD.pack(start, end, len(content), zlib.crc32(content))
    body = head + pack_text(compression) + _U64.pack(len(packed)) + packed
    return record(Op.CHUNK, body)


def pack_footer(summary_start: int, offsets_start: int, summary_crc: int) -> bytes:
    """Return the footer record and the closing magic."""
    crc_input = RECORD_HEAD.pack(Op.FOOTER, FOOTER.size) + FOOTER.pack(
        summary_start, offsets_start, 0
    )
    crc = zlib.crc32(crc_input[:-4], summary_crc)
    return record(Op.FOOTER, FOOTER.pack(summary_start, offsets_start, crc)) + MAGIC


def media_type(name: str) -> str:
    """Return the media type of an attachment by its suffix."""
    kinds = {'.json': 'application/json', '.yaml': 'application/yaml'}
    return kinds.get(PurePath(name).suffix, 'application/octet-stream')


# Decompression that believes no claim: bounded by the claim and by the limit.

ZSTD = 'zstd'
LZ4 = 'lz4'
NONE = ''


class Packer:
    """Compresses chunks; one for each thread, because its library keeps state."""

    def __init__(self, level: int = 3) -> None:
        self._compressor = zstandard.ZstdCompressor(level=level)

    def pack(self, content: bytes) -> bytes:
        """Return ``content`` compressed with zstd."""
        return bytes(self._compressor.compress(content))


class Unpacker:
    """Decompresses chunks; one for each thread."""

    def __init__(self) -> None:
        self._decompressor = zstandard.ZstdDecompressor()

    def unpack(self, compression: str, packed: bytes, size: int) -> bytes:
        """Return exactly ``size`` bytes or raise `LayoutError`.

        ``size`` is the chunk's claim, already checked against the limit; no
        more than that is ever allocated for the result.
        """
        if compression == ZSTD:
            return self._unzstd(packed, size)
        if compression == LZ4:
            return _unlz4(packed, size)
        if compression != NONE:
            raise LayoutError(f"unknown compression '{compression[:16]}'")
        if len(packed) != size:
            raise LayoutError('an uncompressed chunk differs from the size it claims')
        return packed

    def _unzstd(self, packed: bytes, size: int) -> bytes:
        # A frame that states its size makes the library allocate that much at
        # once, so the statement is compared with the chunk's claim first.
        try:
            stated = zstandard.frame_content_size(packed)
            if stated not in (-1, size):
                raise LayoutError('a chunk unpacks to another size than it claims')
            if size == 0:
                return b''
            content = bytes(self._decompressor.decompress(packed, max_output_size=size))
        except zstandard.ZstdError as error:
            raise LayoutError(f'a chunk cannot be unpacked ({error})') from None
        if len(content) != size:
            raise LayoutError('a chunk unpacks to another size than it claims')
        return content


def _unlz4(packed: bytes, size: int) -> bytes:
    unpacker = lz4.frame.LZ4FrameDecompressor()
    try:
        content = bytes(unpacker.decompress(packed, max_length=size + 1))
    except (RuntimeError, EOFError, ValueError) as error:
        raise LayoutError(f'a chunk cannot be unpacked ({error})') from None
    if len(content) != size:
        raise LayoutError('a chunk unpacks to another size than it claims')
    return content
