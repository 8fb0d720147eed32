# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A node that comes when everything was said: prints the diagnosis kept for it, and ends."""

from __future__ import annotations

import json
import sys

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from valveflow_msgs.msg import Diagnosis


def main(topic: str) -> None:
    """Listen once."""
    rclpy.init()
    node, heard = Node('late_listener'), list[Diagnosis]()
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node.create_subscription(Diagnosis, topic, heard.append, latched)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while not heard:
        executor.spin_once()
    said = heard[0]
    print(json.dumps({
        'verdict': said.verdict, 'sentence': said.sentence, 'tag': said.header.frame_id,
        'until': [said.header.stamp.sec, said.header.stamp.nanosec], 'model_id': said.model_id,
        'causes': [
            {'name': c.name, 'sentence': c.sentence, 'units': list(c.parameter_units),
             'values': dict(zip(c.parameter_names, c.parameter_values, strict=True))}
            for c in said.causes
        ],
        'rmse': [said.rmse_simulation, said.rmse_extended],
    }))  # fmt: skip
    executor.shutdown()
    rclpy.shutdown()


if __name__ == '__main__':
    main(sys.argv[1])
