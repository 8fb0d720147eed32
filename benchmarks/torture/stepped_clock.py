# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Runs the monitor under a host clock that another process steps: a file holds seconds to add.

python -m benchmarks.torture.stepped_clock FILE [--ros-args ...]
"""

from __future__ import annotations

import mmap
import struct
import sys
import time
from pathlib import Path

SECONDS = struct.Struct('d')


def step_clock(file: Path) -> None:
    """Let `time.time` and `time.time_ns` follow the number in a file from now on."""
    real_s, real_ns = time.time, time.time_ns
    with file.open('r+b') as stream:
        shared = mmap.mmap(stream.fileno(), SECONDS.size)
    time.time = lambda: real_s() + SECONDS.unpack(shared[:])[0]
    time.time_ns = lambda: real_ns() + round(1e9 * SECONDS.unpack(shared[:])[0])


if __name__ == '__main__':
    step_clock(Path(sys.argv[1]))
    from valveflow_ros.ros.monitor_main import main

    sys.exit(main([sys.argv[0], *sys.argv[2:]]))
