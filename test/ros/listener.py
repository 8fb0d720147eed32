# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A node that hears a running monitor, and the processes of monitor and plant."""

import time

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from ros_helpers import PATIENCE_S, spin_until
from std_srvs.srv import Trigger
from valveflow_msgs.msg import Alarm, FlowCharacteristic

from valveflow_ros.ros.demo import ros_arguments

MONITOR = '/valveflow_monitor'
LATCHED = QoSProfile(depth=50, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Listener:
    """Hears curves, alarms and health, and talks to the services."""

    def __init__(self, context, name='listener'):
        self.node = Node(name, context=context)
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.node)
        self.alarms = self.latched(Alarm, 'alarms')
        self.curves = self.latched(FlowCharacteristic, 'characteristic')
        self.health = []
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self.health.append, 10)

    def latched(self, kind, name):
        """Return the list into which a latched topic is heard from now on."""
        heard = []
        self.node.create_subscription(kind, f'{MONITOR}/{name}', heard.append, LATCHED)
        return heard

    def late(self, kind, name):
        """Come late to a latched topic; return its first message."""
        heard = self.latched(kind, name)
        return self.until(lambda: heard and heard[0], name)

    def until(self, condition, what, patience_s=PATIENCE_S):
        """Listen until something holds; return it."""
        return spin_until(self.executor, condition, what, patience_s)

    def quiet(self, seconds):
        until_s = time.monotonic() + seconds
        self.until(lambda: time.monotonic() > until_s, 'the end of a while')

    def call(self, kind, name, request):
        client = self.node.create_client(kind, f'{MONITOR}/{name}')
        self.until(client.service_is_ready, name)
        future = client.call_async(request)
        return self.until(lambda: future.done() and future.result(), name)

    def trigger(self, name):
        answer = self.call(Trigger, name, Trigger.Request())
        return answer.success, answer.message

    def status(self, item):
        """Return an item of the newest health, None if there is none."""
        newest = self.health[-1].status if self.health else []
        return next((status for status in newest if status.name.endswith(item)), None)

    def value(self, item, key):
        """Return a number of the newest health."""
        found = self.status(item)
        return {v.key: v.value for v in found.values}.get(key, '') if found else ''

    def close(self):
        self.executor.shutdown()
        self.node.destroy_node()


def start_monitor(processes, folder, **more):
    """Start a monitor that fits each hour and records into a folder."""
    parameters = {
        'record_directory': str(folder), 'input_reliability': 'reliable', 'refit_period': 3600.0,
        'refit_segments': 0, **more,
    }  # fmt: skip
    # Quotes, so that a text with a blank or of digits stays a text.
    given = {k: f'"{v}"' if isinstance(v, str) else v for k, v in parameters.items()}
    return processes.start('valveflow_ros.ros.monitor_main', *ros_arguments(given))


def start_plant(processes, **parameters):
    """Start a plant that runs as fast as the monitor takes it."""
    given = {'seed': 7, 'rate': 0.0, 'wait': PATIENCE_S, **parameters}
    return processes.start('valveflow_ros.ros.simulator_main', *ros_arguments(given))


def ended(processes, monitor, limit_s=20.0):
    """End a monitor in order; return what it said."""
    monitor.terminate()
    said = processes.output
    assert monitor.wait(limit_s) == 0, said(monitor)
    assert 'Traceback' not in said(monitor)
    return said(monitor)
