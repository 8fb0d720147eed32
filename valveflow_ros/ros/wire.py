"""Small messages as the bytes that go over the wire, made without a message object."""

from __future__ import annotations

import struct

from valveflow_ros.records import NS_PER_S

_LITTLE_ENDIAN = b'\x00\x01\x00\x00'
_FLOAT64 = struct.Struct('<d')
_TIME = struct.Struct('<iI')
_LAST_S = (1 << 31) - 1


def float64_bytes(value: float) -> bytes:
    """Return a std_msgs/Float64."""
    return _LITTLE_ENDIAN + _FLOAT64.pack(value)


def clock_bytes(time_ns: int) -> bytes:
    """Return a rosgraph_msgs/Clock; times before 1970 or after 2038 become the nearest one."""
    seconds, nanoseconds = divmod(max(time_ns, 0), NS_PER_S)
    return _LITTLE_ENDIAN + _TIME.pack(min(seconds, _LAST_S), nanoseconds)
