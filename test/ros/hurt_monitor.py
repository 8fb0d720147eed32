# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The monitor as a process, with places at which a test can hold it up.

A file `hold` in the working folder names the place; `held` is written when it is reached, and
it goes on when `hold` is gone.
"""

import ctypes
import sys
import threading
import time
from pathlib import Path

from valveflow_ros.logs.part_file import PartFile
from valveflow_ros.ros import monitor_main
from valveflow_ros.ros.node.monitor_node import MonitorNode
from valveflow_ros.ros.node.polled_subscription import PolledSubscription

HOLD, HELD = Path('hold'), Path('held')
# The interpreter's lock cannot be given back from outside, so this one ends by itself.
LOCKED_S = 2


def wanted(place):
    # The file may go at any moment, also between a look for it and a look into it.
    try:
        return HOLD.read_text() == place
    except FileNotFoundError:
        return False


def hold_up(place):
    if not wanted(place):
        return
    HELD.write_text(place)
    while wanted(place):
        time.sleep(0.01)


def held_at(place, work):
    def run(*args, **more):
        hold_up(place)
        return work(*args, **more)

    return run


def keep_the_lock():
    """Take the interpreter for a while and let nobody else run, as bad compiled code does."""
    while not wanted('interpreter'):
        time.sleep(0.01)
    HELD.write_text('interpreter')
    ctypes.PyDLL(None).sleep(LOCKED_S)


if __name__ == '__main__':
    MonitorNode.step = held_at('loop', MonitorNode.step)
    PolledSubscription.take = held_at('poll', PolledSubscription.take)
    PartFile.write = held_at('writer', PartFile.write)
    threading.Thread(target=keep_the_lock, daemon=True).start()
    sys.exit(monitor_main.main(sys.argv[1:]))
