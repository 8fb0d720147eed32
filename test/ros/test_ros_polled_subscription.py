# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
import time

import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_helpers import wait_until
from std_msgs.msg import Float64

from valveflow_ros.ros.encoding import encode, float64_bytes
from valveflow_ros.ros.node.polled_subscription import DEPTH, PolledSubscription

pytestmark = pytest.mark.ros


@pytest.fixture
def node(context):
    made = Node('polling', context=context)
    yield made
    made.destroy_node()


def publisher_for(node, source, reliable=True):
    kind = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    profile = QoSProfile(depth=DEPTH, reliability=kind)
    return node.create_publisher(Float64, source.topic, profile)


def matched(node, source):
    publisher = publisher_for(node, source)
    wait_until(lambda: publisher.get_subscription_count() == 1, 'the match')
    # Both sides have matched once a value has come through.
    wait_until(lambda: publisher.publish(Float64(data=-1.0)) or source.take(), 'the first value')
    time.sleep(0.05)
    source.take()
    return publisher


def collect(source, count, executor=None):
    found = []

    def enough():
        if executor is not None:
            executor.spin_once(timeout_sec=0.01)
        found.extend(source.take())
        return len(found) >= count

    wait_until(enough, f'{count} messages', 20.0)
    return found


def test_bytes_stamps_and_numbers_come_in_order(node):
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    source = PolledSubscription(node, Float64, 'value', reliable=True)
    publisher = publisher_for(node, source)
    wait_until(lambda: publisher.get_subscription_count() == 1, 'the match')
    before_ns = time.time_ns()
    values = [0.5 * k for k in range(100)]
    for value in values:
        publisher.publish(Float64(data=value))
    found = collect(source, len(values), executor)
    after_ns = time.time_ns()
    assert [taken.data for taken in found] == [float64_bytes(value) for value in values]
    numbers = [taken.sequence for taken in found]
    assert numbers == list(range(numbers[0], numbers[0] + len(values)))
    assert before_ns <= found[0].source_ns <= found[-1].source_ns <= after_ns
    assert all(taken.received_ns >= taken.source_ns for taken in found)
    executor.shutdown()


def test_the_executor_leaves_messages_to_who_takes_them_as_many_as_asked_for(node):
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    source = PolledSubscription(node, Float64, 'value')
    publisher = matched(node, source)
    for k in range(30):
        publisher.publish(Float64(data=float(k)))
    for _ in range(50):
        executor.spin_once(timeout_sec=0.0)
    found = []
    wait_until(lambda: found.extend(source.take(7)) or len(found) >= 7, 'seven')
    assert len(found) <= 13
    assert len(found) + len(collect(source, 30 - len(found))) == 30
    executor.shutdown()
    source.close()
    wait_until(lambda: publisher.get_subscription_count() == 0, 'the end', 20.0)


def test_best_effort_and_reliable_publishers_are_both_heard(node):
    source = PolledSubscription(node, Float64, 'value')
    for reliable in (True, False):
        publisher = publisher_for(node, source, reliable)
        wait_until(lambda p=publisher: p.publish(Float64()) or source.take(), 'a value', 20.0)
        node.destroy_publisher(publisher)


def test_names_are_resolved_and_remapped(context):
    options = ['--ros-args', '-r', 'value:=/plant/other']
    node = Node('remapped', context=context, namespace='unit1', cli_args=options)
    assert PolledSubscription(node, Float64, 'value').topic == '/plant/other'
    assert PolledSubscription(node, Float64, 'second').topic == '/unit1/second'
    assert encode(Float64()) == float64_bytes(0.0)
    node.destroy_node()
