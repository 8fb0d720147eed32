# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the reader that others use finds in a file, with every checksum verified."""

from __future__ import annotations

from pathlib import Path

from mcap.reader import make_reader


def stock_count(path: Path) -> int:
    """Return the number of messages."""
    with path.open('rb') as stream:
        return sum(1 for _ in make_reader(stream, validate_crcs=True).iter_messages())


def stock_messages(path: Path) -> list[tuple[str, int, int, bytes]]:
    """Return topic, sequence number, log time and content of each message, in log-time order."""
    with path.open('rb') as stream:
        return [
            (channel.topic, message.sequence, message.log_time, message.data)
            for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages()
        ]
