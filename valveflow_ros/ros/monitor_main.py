"""The executable `monitor`: its signals are its own before anything else is loaded."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence

from valveflow_ros.ros.process import StopFlag, Stopped


def main(args: Sequence[str] | None = None) -> int:
    """Run the monitor until it is asked to stop; return the exit status."""
    stop = StopFlag().install()
    # Recordings, logs and compiled code are nobody else's business, whatever the shell allowed.
    before = os.umask(0o077)
    try:
        with stop.cutting():
            begin = importlib.import_module('valveflow_ros.ros.monitor_begin')
        return int(begin.run(stop, args))
    except Stopped:
        return 0
    finally:
        os.umask(before)


if __name__ == '__main__':
    sys.exit(main())
