"""Objects over a pipe between a process and its own child, with large arrays uncopied.

Each frame is a count, that many lengths, and the parts: a pickle and the
buffers it refers to. Both ends are the same program started by itself and the
pipe has no name, so nobody else can put anything in.
"""

from __future__ import annotations

import os
import pickle
import struct
from typing import Any

_LENGTH = struct.Struct('<Q')
_MOST_PARTS = 4096
_READ = 1 << 20


def send(descriptor: int, item: object) -> None:
    """Write one object; blocks while the pipe is full. Raises `OSError` if nobody reads."""
    buffers: list[pickle.PickleBuffer] = []
    body = pickle.dumps(item, protocol=5, buffer_callback=buffers.append)
    parts = [memoryview(body), *(buffer.raw() for buffer in buffers)]
    head = b''.join(_LENGTH.pack(n) for n in (len(parts), *(part.nbytes for part in parts)))
    for part in (memoryview(head), *parts):
        done = 0
        while done < part.nbytes:
            # The interpreter is free for others while the pipe takes the bytes.
            done += os.write(descriptor, part[done : done + _READ])


class FrameReader:
    """Puts frames together from whatever a pipe gives.

    Parameters
    ----------
    descriptor : int
        Of the pipe; set it non-blocking for `ready`.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._bytes = bytearray()
        self.ended = False

    def ready(self) -> list[Any]:
        """Return the objects that are there whole, without waiting."""
        while not self.ended:
            try:
                found = os.read(self._descriptor, _READ)
            except BlockingIOError:
                break
            except OSError:
                found = b''
            self.ended = not found
            self._bytes += found
        items: list[Any] = []
        while (item := self._cut()) is not None:
            items.append(item[0])
        return items

    def wait(self) -> Any:
        """Return the next object; raises `EOFError` when the other end is gone."""
        while True:
            item = self._cut()
            if item is not None:
                return item[0]
            found = os.read(self._descriptor, _READ)
            if not found:
                raise EOFError
            self._bytes += found

    def _cut(self) -> tuple[Any] | None:
        """Cut the first frame off, if it is whole."""
        size = _LENGTH.size
        if len(self._bytes) < size:
            return None
        (count,) = _LENGTH.unpack_from(self._bytes)
        if not 1 <= count <= _MOST_PARTS:
            raise ValueError('no frame')
        start = size * (1 + count)
        if len(self._bytes) < start:
            return None
        lengths = [_LENGTH.unpack_from(self._bytes, size * (1 + k))[0] for k in range(count)]
        if len(self._bytes) < start + sum(lengths):
            return None
        parts: list[bytearray] = []
        for length in lengths:
            parts.append(self._bytes[start : start + length])
            start += length
        del self._bytes[:start]
        return (pickle.loads(parts[0], buffers=parts[1:]),)
