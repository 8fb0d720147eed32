# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What records until it is killed, and the memory that outlives it and says what was handed in."""

from __future__ import annotations

import mmap
import os
import time
from pathlib import Path

import numpy as np
from log_files import FLOAT64, STOCK, float64

from valveflow_ros.logs import Recorder, RecorderSettings

TOPICS = ('/valve_opening', '/main_steam_pressure', '/main_steam_temperature', '/generated_power')
ROOM = 1 << 20


class Account:
    """Stamps of all messages handed in, in memory that parent and child share.

    Attributes
    ----------
    stamps : int64 (ROOM,)
        Log time of each message.
    """

    def __init__(self) -> None:
        self._memory = mmap.mmap(-1, 8 * (ROOM + 1))
        cells = np.frombuffer(self._memory, dtype=np.int64)
        self._count, self.stamps = cells[:1], cells[1:]

    @property
    def sent(self) -> int:
        """Return the number of messages handed in."""
        return int(self._count[0])

    def note(self, number: int, stamp_ns: int) -> None:
        """Note a message before it is handed in."""
        self.stamps[number] = stamp_ns
        self._count[0] = number + 1


def record_until_killed(folder: Path, rate: float, account: Account) -> None:
    """Record numbered messages on four topics in turn, as many in a second as ``rate``.

    The settings are those of the node.
    """
    recorder = Recorder(
        folder, RecorderSettings(free_floor_bytes=0), name='log', definitions=STOCK
    )
    for topic in TOPICS:
        recorder.add_topic(topic, FLOAT64)
    begun_s, number = time.monotonic(), 0
    while number < ROOM:
        due_s = begun_s + number / rate
        if (left_s := due_s - time.monotonic()) > 0:
            time.sleep(left_s)
        stamp_ns = time.time_ns()
        account.note(number, stamp_ns)
        recorder.record(TOPICS[number % 4], float64(number), stamp_ns, stamp_ns)
        number += 1


def start(folder: Path, rate: float, account: Account) -> int:
    """Start a recording process by a fork; return its id."""
    child = os.fork()
    if child == 0:
        try:
            record_until_killed(folder, rate, account)
        finally:
            os._exit(1)
    return child
