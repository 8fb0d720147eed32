# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A node that hears a running monitor, and the processes of monitor and plant."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from ros_helpers import PATIENCE_S, Processes, wait_until
from std_srvs.srv import Trigger
from valveflow_msgs.msg import Alarm, FlowCharacteristic

from valveflow_ros.ros.demo import ros_arguments

MONITOR = '/valveflow_monitor'
LATCHED = QoSProfile(depth=50, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Listener:
    """Hears curves, alarms and health, and talks to the services."""

    def __init__(self, context: Any, name: str = 'listener') -> None:
        self.node = Node(name, context=context)
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.node)
        self.alarms: list[Alarm] = []
        self.curves: list[FlowCharacteristic] = []
        self.health: list[DiagnosticArray] = []
        subscribe = self.node.create_subscription
        subscribe(Alarm, f'{MONITOR}/alarms', self.alarms.append, LATCHED)
        subscribe(FlowCharacteristic, f'{MONITOR}/characteristic', self.curves.append, LATCHED)
        subscribe(DiagnosticArray, '/diagnostics', self.health.append, 10)

    def until(self, condition: Any, what: str, patience_s: float = PATIENCE_S) -> Any:
        """Listen until something holds; return it."""
        return wait_until(
            lambda: self.executor.spin_once(timeout_sec=0.02) or condition(), what, patience_s
        )

    def call(self, kind: Any, name: str, request: Any) -> Any:
        client = self.node.create_client(kind, f'{MONITOR}/{name}')
        self.until(client.service_is_ready, name)
        future = client.call_async(request)
        return self.until(lambda: future.done() and future.result(), name)

    def trigger(self, name: str) -> Trigger.Response:
        return self.call(Trigger, name, Trigger.Request())

    def latched(self, kind: Any, name: str) -> Any:
        """Come late to a latched topic."""
        heard: list[Any] = []
        self.node.create_subscription(kind, f'{MONITOR}/{name}', heard.append, LATCHED)
        return self.until(lambda: heard and heard[0], name)

    def item(self, name: str) -> dict[str, str]:
        """Return the numbers of an item of the newest health."""
        for status in self.health[-1].status if self.health else []:
            if status.name.endswith(name):
                return {entry.key: entry.value for entry in status.values}
        return {}

    def value(self, item: str, key: str) -> str:
        """Return a number of the newest health."""
        return self.item(item).get(key, '')

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()


def start_monitor(processes: Processes, folder: Path, **more: object) -> Any:
    """Start a monitor that fits each hour and records into a folder."""
    parameters = {
        'record_directory': str(folder), 'input_reliability': 'reliable', 'refit_period': 3600.0,
        'refit_segments': 0, **more,
    }  # fmt: skip
    # Quotes, so that a text with a blank or of digits stays a text.
    given = {k: f'"{v}"' if isinstance(v, str) else v for k, v in parameters.items()}
    return processes.start('valveflow_ros.ros.monitor_main', *ros_arguments(given))


def start_plant(processes: Processes, **parameters: object) -> Any:
    """Start a plant that runs as fast as the monitor takes it."""
    given = {'seed': 7, 'rate': 0.0, 'wait': PATIENCE_S, **parameters}
    return processes.start('valveflow_ros.ros.simulator_main', *ros_arguments(given))
