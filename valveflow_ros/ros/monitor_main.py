# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The executable `monitor`, which first installs its signal handlers.

Then it joins the ROS domain, and loads compiler and libraries afterwards. This takes a second, in
which the other participants in the domain discover this process.
"""

from __future__ import annotations

import functools
import importlib
import os
import sys
from collections.abc import Sequence
from typing import Any

from valveflow_ros.errors import WORKING_BYTES, ValveflowError, check_address_space
from valveflow_ros.parameters import TABLE
from valveflow_ros.ros.process import (
    StopFlag,
    Stopped,
    answered,
    complain,
    usage,
    with_place,
)

_ABOUT = """usage: monitor [--ros-args ...]

Watches valve opening, main steam pressure and temperature and generated power, and keeps the
flow characteristic of the main steam valve. It runs until it is asked to end (Ctrl-C)."""
_EXAMPLE = (
    'ros2 run valveflow_ros monitor --ros-args -p unit_tag:=U1 -p main_steam_pressure_unit:=bar'
)


def main(args: Sequence[str] | None = None) -> int:
    """Run the monitor until it is asked to stop; return the exit status."""
    stop = StopFlag().install()
    page = functools.partial(usage, _ABOUT, _EXAMPLE, TABLE)
    if (status := answered('monitor', args, page, _EXAMPLE)) is not None:
        return status
    # Recordings, logs and compiled code are private, independent of the shell's umask.
    before = os.umask(0o077)
    presence: Any = None
    try:
        check_address_space(WORKING_BYTES)
        # A signal may interrupt the import, because nothing has begun yet.
        with stop.cutting():
            domain = importlib.import_module('valveflow_ros.ros.domain')
        domain.choose_transport()
        domain.check_security(args)
        presence = domain.Presence(args)
        with stop.cutting():
            node = importlib.import_module('valveflow_ros.ros.node.monitor_node')
        return int(node.run(stop, presence))
    except Stopped:
        return 0
    except ValveflowError as error:
        return complain('monitor', str(error))
    except Exception as error:  # noqa: BLE001 - print a sentence instead of a traceback
        return complain('monitor', f'The monitor failed unexpectedly: {with_place(error)}')
    finally:
        if presence is not None:
            stop.last()
            presence.close()
        os.umask(before)


if __name__ == '__main__':
    sys.exit(main())
