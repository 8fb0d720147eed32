"""The beginning of the monitor: seen by the domain at once, sentences instead of traces."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence

from valveflow_ros.errors import ValveflowError
from valveflow_ros.parameters import TABLE
from valveflow_ros.ros.domain import Presence, choose_transport
from valveflow_ros.ros.process import (
    StopFlag,
    Stopped,
    one_line,
    show,
    usage,
    wants_help,
    with_place,
)
from valveflow_ros.ros.secure_start import check_security

_ABOUT = """usage: monitor [--ros-args ...]

Watches valve opening, main steam pressure and temperature and generated power, and keeps the
flow characteristic of the main steam valve. It runs until it is asked to end (Ctrl-C)."""
_EXAMPLE = (
    'ros2 run valveflow_ros monitor --ros-args -p unit_tag:=U1 -p main_steam_pressure_unit:=bar'
)


def run(stop: StopFlag, args: Sequence[str] | None) -> int:
    """Run the monitor until it is asked to stop; return the exit status."""
    if wants_help(args):
        show(usage(_ABOUT, _EXAMPLE, TABLE))
        return 0
    try:
        choose_transport()
        check_security(args)
        presence = Presence(args)
    except ValveflowError as error:
        return _complain(str(error))
    except Exception as error:  # noqa: BLE001 - rclpy raises what its C++ gave it
        return _complain(f'ROS could not be started: {one_line(error)}')
    try:
        # Compiler and libraries take a second, in which the others of the domain get to know
        # this process. A signal need not wait for them: nothing has been begun.
        with stop.cutting():
            work = importlib.import_module('valveflow_ros.ros.node.monitor_loop')
        return int(work.run(stop, presence))
    except Stopped:
        return 0
    except ValveflowError as error:
        return _complain(str(error))
    except Exception as error:  # noqa: BLE001 - a person is owed a sentence, not a trace
        return _complain(f'The monitor failed unexpectedly: {with_place(error)}')
    finally:
        stop.last()
        presence.close()


def _complain(sentence: str) -> int:
    print(f'valveflow monitor: {sentence}', file=sys.stderr)
    return 1
