# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The only package that imports ROS: node, replay, simulated plant, conversions."""

import sys
from functools import partial
from importlib import import_module
from importlib.util import find_spec

from valveflow_ros.errors import ValveflowError

# `colcon build` without these options finds no msg/ and succeeds, but the nodes cannot run.
_NOT_BUILT = (
    'The message package valveflow_msgs is not found. In the workspace: colcon build --base-paths '
    'src src/valveflow_ros/msg, then source install/setup.bash.'
)


def _start(executable: str, module: str) -> int:
    """Run the executable of a ``ros2 run`` command; return the exit status."""
    try:
        if find_spec('valveflow_msgs') is None:
            raise ValveflowError(_NOT_BUILT)
        return int(import_module(f'{__name__}.{module}').main())
    except ValveflowError as error:
        print(f'valveflow {executable}: {error}', file=sys.stderr)
        return 1


monitor = partial(_start, 'monitor', 'monitor_main')
opcua_gateway = partial(_start, 'opcua_gateway', 'gateway_main')
page = partial(_start, 'page', 'page_main')
plant_simulator = partial(_start, 'plant_simulator', 'simulator_main')
replay = partial(_start, 'replay', 'replay_main')
watch = partial(_start, 'watch', 'watch_main')
