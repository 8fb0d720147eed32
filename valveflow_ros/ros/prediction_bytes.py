"""Predictions as bytes, made without a message object.

There is one for every sample, and with a plant running thousands of times
faster than real time a message object a row would be the monitor's largest
cost. What comes out equals `encoding.encode` of the message; a test holds the
two, and the order of the fields in Prediction.msg, together.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Iterator

from valveflow_ros.monitoring.prediction import PredictionBlock
from valveflow_ros.records import NS_PER_S
from valveflow_ros.ros.conversions import LAST_NS

_HEAD = b'\x00\x01\x00\x00'  # plain CDR, little endian


@functools.lru_cache(maxsize=16)
def _layout(tag_bytes: int, model_bytes: int) -> struct.Struct:
    """Return the layout of a row's message for texts of these lengths, zero bytes included."""
    size = 12 + tag_bytes + 1
    before_model = -size % 4
    size += before_model + 4 + model_bytes
    before_numbers = -size % 8
    return struct.Struct(f'<4siII{tag_bytes}sB{before_model}xI{model_bytes}s{before_numbers}x10d')


def prediction_bytes(block: PredictionBlock, tag: str) -> Iterator[tuple[int, bytes]]:
    """Yield the message of each row with the row's time in ns."""
    frame, model = tag.encode() + b'\x00', block.model_id.encode() + b'\x00'
    pack = _layout(len(frame), len(model)).pack
    expected = block.measured_mw - block.residual_mw
    columns = (
        block.time_ns, block.state, block.u, block.measured_mw, block.static_mw,
        block.dynamic_mw, block.residual_mw, block.average_mw, expected - block.width_mw,
        expected + block.width_mw, block.evidence, block.shift_mw,
    )  # fmt: skip
    for row in zip(*(column.tolist() for column in columns), strict=True):
        time_ns, state, *numbers = row
        sec, nanosec = divmod(min(max(time_ns, 0), LAST_NS), NS_PER_S)
        yield (
            time_ns,
            pack(
                _HEAD,
                sec,
                nanosec,
                len(frame),
                frame,
                state,
                len(model),
                model,
                *numbers,
            ),
        )
