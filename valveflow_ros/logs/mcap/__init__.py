# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Recordings in MCAP: reading, writing, following and repairing them."""

from importlib.util import find_spec

from valveflow_ros.errors import ValveflowError

# No rosdep key brings it, so a ROS installation may be without.
if find_spec('mcap') is None:
    raise ValveflowError(
        "Logs need the Python package 'mcap', which is not installed: pip install mcap."
    )
