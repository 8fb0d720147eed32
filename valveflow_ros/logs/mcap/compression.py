"""Decompression that believes no claim: bounded by the claim and by the limit."""

from __future__ import annotations

import lz4.frame
import zstandard

from valveflow_ros.logs.mcap.layout import LayoutError

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
