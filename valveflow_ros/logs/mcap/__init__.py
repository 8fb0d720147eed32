# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Reads, writes, follows and recovers recordings in MCAP."""

from importlib.util import find_spec

from valveflow_ros.errors import ValveflowError

# It has no rosdep key, so a ROS installation may lack it.
if find_spec('mcap') is None:
    raise ValveflowError(
        "Logs need the Python package 'mcap', which is not installed: pip install mcap."
    )
