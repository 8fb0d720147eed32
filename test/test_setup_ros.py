# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The set-up carries real ROS: a message of ours over DDS, in a domain of the test's own."""

from __future__ import annotations

import fcntl
import os
import tempfile
import time
from pathlib import Path

import pytest

LIMIT_S = 30.0


@pytest.mark.parametrize('_again', [1, 2])
def test_the_domain_is_held_for_this_test(ros_environment, _again):
    domain = int(ros_environment['ROS_DOMAIN_ID'])
    assert 1 <= domain <= 101
    assert os.environ['ROS_DOMAIN_ID'] == ros_environment['ROS_DOMAIN_ID']
    assert ros_environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'LOCALHOST'
    path = Path(tempfile.gettempdir(), f'valveflow-ros-domain-{domain}.lock')
    with path.open('r+') as other, pytest.raises(BlockingIOError):
        fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)


def test_our_message_travels(ros_environment):
    """A latched characteristic reaches a subscriber that came later."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from valveflow_msgs.msg import FlowCharacteristic

    assert rclpy.get_rmw_implementation_identifier() == 'rmw_fastrtps_cpp'
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    sent = FlowCharacteristic(breakpoints=[1.0, 2.0], values=[3.0, 4.5], status=2, pieces=1)
    sent.header.frame_id = 'unit 1'
    got = []
    context = rclpy.Context()
    rclpy.init(context=context)
    try:
        assert context.get_domain_id() == int(ros_environment['ROS_DOMAIN_ID'])
        node = rclpy.create_node('traveller', context=context)
        node.create_publisher(FlowCharacteristic, '~/characteristic', latched).publish(sent)
        node.create_subscription(FlowCharacteristic, '~/characteristic', got.append, latched)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        end = time.monotonic() + LIMIT_S
        while not got and time.monotonic() < end:
            executor.spin_once(timeout_sec=0.2)
        executor.shutdown()
        node.destroy_node()
    finally:
        context.try_shutdown()
    assert got == [sent]
