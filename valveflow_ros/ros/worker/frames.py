"""Messages over a pipe between a process and its own child.

Each frame is a length and that many bytes. They are states (`valveflow_ros.state_bytes`):
plain values and arrays with a checksum, so that nothing that a hurt process writes can be
mistaken for a result, or be executed.
"""

from __future__ import annotations

import os
import struct

from valveflow_ros.errors import DataError
from valveflow_ros.state import State
from valveflow_ros.state_bytes import from_bytes, to_bytes

_LENGTH = struct.Struct('<Q')
# A window of twenty million rows takes less.
_MOST_BYTES = 4 << 30
_READ = 1 << 20
_READS = 8  # at most in one look: whoever looks has samples to take


def send(descriptor: int, item: State) -> None:
    """Write one message; blocks while the pipe is full. Raises `OSError` if nobody reads."""
    body = to_bytes(item)
    for part in (memoryview(_LENGTH.pack(len(body))), memoryview(body)):
        done = 0
        while done < part.nbytes:
            # The interpreter is free for others while the pipe takes the bytes.
            done += os.write(descriptor, part[done : done + _READ])


class FrameReader:
    """Puts messages together from whatever a pipe gives.

    Parameters
    ----------
    descriptor : int
        Of the pipe; set it non-blocking for `ready`.
    most : int
        Bytes that a message may have.
    """

    def __init__(self, descriptor: int, most: int = _MOST_BYTES) -> None:
        self._descriptor = descriptor
        self._most = most
        self._bytes = bytearray()
        self.ended = False

    def ready(self) -> list[State]:
        """Return the messages that are there whole, without waiting.

        Raises
        ------
        DataError
            What came is no message.
        """
        for _ in range(_READS):
            if self.ended:
                break
            try:
                found = os.read(self._descriptor, _READ)
            except BlockingIOError:
                break
            except OSError:
                found = b''
            self.ended = not found
            self._bytes += found
        items: list[State] = []
        while (item := self._cut()) is not None:
            items.append(item)
        return items

    def wait(self) -> State:
        """Return the next message; raises `EOFError` when the other end is gone."""
        while True:
            item = self._cut()
            if item is not None:
                return item
            found = os.read(self._descriptor, _READ)
            if not found:
                raise EOFError
            self._bytes += found

    def _cut(self) -> State | None:
        """Cut the first frame off, if it is whole."""
        start = _LENGTH.size
        if len(self._bytes) < start:
            return None
        (length,) = _LENGTH.unpack_from(self._bytes)
        if length > self._most:
            raise DataError('What came through the pipe is no message.')
        if len(self._bytes) < start + length:
            return None
        body = bytes(memoryview(self._bytes)[start : start + length])
        del self._bytes[: start + length]
        return from_bytes(body)
