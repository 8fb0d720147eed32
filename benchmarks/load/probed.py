# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The monitor itself, with a stop-watch on the door of its engine.

    python -m benchmarks.load.probed FILE [--ros-args ...]

From the publisher's stamp of a value to the moment at which the engine has taken it: every value
counts, in bins, so that the watch holds no more after an hour than after a second. SIGUSR1 sets it
to zero; at the end it is written to FILE.
"""

from __future__ import annotations

import json
import signal
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from valveflow_ros.monitoring.events import Event
from valveflow_ros.records import N_SIGNALS, SIGNALS
from valveflow_ros.ros.decoding import Row
from valveflow_ros.ros.monitor_main import main as monitor
from valveflow_ros.ros.node.engine import LiveEngine

_BIN_NS = 100_000
_BINS = 50_000


class StopWatch:
    """Counts how late values were, by signal."""

    def __init__(self) -> None:
        self.clear()

    def clear(self, *_: object) -> None:
        """Begin anew."""
        self._counts = np.zeros((N_SIGNALS, _BINS), dtype=np.int64)
        self._worst_ns = [0] * N_SIGNALS
        self._last_ns = 0
        self._pause_ns = 0

    def note(self, rows: list[Row], now_ns: int) -> None:
        """Take what the engine has just taken."""
        if self._last_ns:
            self._pause_ns = max(self._pause_ns, now_ns - self._last_ns)
        self._last_ns = now_ns
        for time_ns, number, _, _ in rows:
            late_ns = max(0, now_ns - time_ns)
            self._counts[number, min(late_ns // _BIN_NS, _BINS - 1)] += 1
            if late_ns > self._worst_ns[number]:
                self._worst_ns[number] = late_ns

    def content(self) -> dict[str, Any]:
        """Return what there is to say, times in ms."""
        return {
            'longest_pause_ms': self._pause_ns / 1e6,
            'topics': {
                info.topic: {**_quantiles(counts), 'max': self._worst_ns[info.signal] / 1e6}
                for info in SIGNALS
                if (counts := self._counts[info.signal]).any()
            },
        }


def _quantiles(counts: Any) -> dict[str, float]:
    reached = np.cumsum(counts)
    places = np.searchsorted(reached, [0.5 * reached[-1], 0.99 * reached[-1]])
    # The upper edge of the bin: a value is not later than that.
    median, p99 = ((places + 1) * _BIN_NS / 1e6).tolist()
    return {'values': int(reached[-1]), 'p50': median, 'p99': p99}


def main(arguments: list[str]) -> int:
    """Run the monitor with the watch on."""
    watch, plain = StopWatch(), LiveEngine.feed

    def feed(engine: LiveEngine, rows: list[Row]) -> list[Event]:
        events = plain(engine, rows)
        watch.note(rows, time.time_ns())
        return events

    LiveEngine.feed = feed  # type: ignore[method-assign]
    signal.signal(signal.SIGUSR1, watch.clear)
    status = monitor(['monitor', *arguments[1:]])
    Path(arguments[0]).write_text(json.dumps(watch.content()), 'utf-8')
    return status


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
