# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the ROS tests share: a context of their own and processes that are ended."""

import importlib.util
import os
from pathlib import Path

import pytest
from ros_helpers import Processes

HERE = Path(__file__).resolve().parent
# Without rclpy nothing here can even be imported. `make test` promises it and then fails loudly.
if importlib.util.find_spec('rclpy') is None and not os.environ.get('VALVEFLOW_REQUIRE_ROS'):
    collect_ignore_glob = ['test_*.py']


@pytest.fixture
def context(ros_environment):
    """Give a ROS context in the test's own domain."""
    import rclpy
    from rclpy.context import Context

    made = Context()
    rclpy.init(context=made, domain_id=int(ros_environment['ROS_DOMAIN_ID']))
    yield made
    rclpy.shutdown(context=made)


@pytest.fixture
def listener(context):
    """Give a node that hears the monitor."""
    from listener import Listener

    made = Listener(context)
    yield made
    made.close()


@pytest.fixture
def speaker(context):
    """Give a node that says what a monitor says."""
    from test_ros_watch import Speaker

    made = Speaker(context)
    yield made
    made.destroy_node()


@pytest.fixture
def processes(ros_environment, tmp_path):
    """Give a way to start processes in the test's own domain."""
    made = Processes(ros_environment, tmp_path)
    yield made
    made.end_all()


@pytest.fixture
def jobs_on_path(monkeypatch):
    """Let child processes import the module `hurt_jobs` beside this file."""
    before = os.environ.get('PYTHONPATH', '')
    monkeypatch.setenv('PYTHONPATH', f'{HERE}{os.pathsep}{before}')
