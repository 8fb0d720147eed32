# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A monitor is killed and started again beside a gateway of others; it must hear it again."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from benchmarks.torture.trial import Options, Outcome
from valveflow_ros.ros.demo import ros_arguments

KILLS = 50
SOON_S = 3.0
PATIENCE_S = 60.0
MOST_GROWTH = 5e6
SHARED = Path('/dev/shm')
# With the transports that Fast DDS takes by itself, shared memory first.
GATEWAY = """
import time
import rclpy
from rclpy.qos import qos_profile_sensor_data
from std_msgs.msg import Float64
rclpy.init()
node = rclpy.create_node('gateway')
publisher = node.create_publisher(Float64, 'valve_opening', qos_profile_sensor_data)
while rclpy.ok():
    publisher.publish(Float64(data=50.0))
    time.sleep(0.005)
"""


def rehearing(options: Options) -> Outcome:
    """Kill -9 and start again; count how often the gateway is heard, and how soon."""
    outcome = Outcome()
    os.environ['ROS_DOMAIN_ID'] = str(os.getpid() % 101 + 1)
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    rclpy.init(args=[])
    node = Node('torture_listener')
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    received = [0]

    def note(health: DiagnosticArray) -> None:
        for status in health.status:
            if 'valve_opening' in status.name:
                values = {entry.key: entry.value for entry in status.values}
                received[0] = int(values.get('Messages received', '0'))

    node.create_subscription(DiagnosticArray, '/diagnostics', note, 10)
    gateway = subprocess.Popen([sys.executable, '-c', GATEWAY])

    def heard() -> float | None:
        """Return after how many seconds something was heard, None if nothing was."""
        received[0] = 0
        begun_s = time.monotonic()
        while not received[0]:
            executor.spin_once(timeout_sec=0.02)
            if time.monotonic() - begun_s > PATIENCE_S:
                return None
        return time.monotonic() - begun_s

    try:
        monitor = _started(options.folder)
        # The first start may have to compile.
        while heard() is None:
            if monitor.poll() is not None:
                raise RuntimeError('the monitor does not start')
        before = _shared_bytes()
        for number in range(options.many(KILLS, 2)):
            monitor.kill()
            monitor.wait()
            monitor = _started(options.folder)
            took_s = heard()
            outcome.count('kills')
            outcome.count('heard', int(took_s is not None))
            outcome.expect(took_s is not None, f'kill {number}: nothing heard')
            if took_s is not None:
                outcome.count('within_3_s', int(took_s <= SOON_S))
                outcome.worst('longest_s', round(took_s, 2))
        growth = _shared_bytes() - before
        monitor.terminate()
        outcome.expect(monitor.wait(10.0) == 0, 'the last run did not end with status 0')
    finally:
        gateway.kill()
        gateway.wait()
        node.destroy_node()
        rclpy.shutdown()
    outcome.measured['shared_memory_growth_bytes'] = growth
    outcome.expect(growth <= MOST_GROWTH, f'shared memory grew by {growth} bytes')
    counts = outcome.counts
    soon = counts.get('within_3_s', 0)
    outcome.wish(soon == counts['kills'], f'{soon} of {counts["kills"]} heard again within 3 s')
    outcome.sentence = (
        f'{counts["kills"]} kills: heard again {counts["heard"]} times, '
        f'{soon} within 3 s, {outcome.measured.get("longest_s", 0):.1f} s '
        f'at most; /dev/shm grew by {growth} bytes'
    )
    return outcome


def _started(folder: Path) -> subprocess.Popen[bytes]:
    given = {'record_directory': folder / 'recordings', 'diagnostics_period': 0.2}
    with (folder / 'monitor.log').open('ab') as log:
        return subprocess.Popen(
            [sys.executable, '-m', 'valveflow_ros.ros.monitor_main', *ros_arguments(given)],
            stdout=log, stderr=subprocess.STDOUT,
        )  # fmt: skip


def _shared_bytes() -> int:
    total = 0
    for entry in SHARED.glob('fastrtps*'):
        try:
            total += entry.stat().st_size
        except FileNotFoundError:
            continue
    return total
