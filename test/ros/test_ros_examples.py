# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The example in the --help of each executable works as it stands there."""

from __future__ import annotations

import importlib.util
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from ros_helpers import Processes, wait_until
from std_msgs.msg import Float64
from valveflow_msgs.msg import PlantSample

from valveflow_ros.cli.main import main
from valveflow_ros.records import SIGNALS

pytestmark = pytest.mark.ros
# Executable: its module, what it says once it works, and what it needs.
EXECUTABLES = {
    'monitor': ('monitor_main', r'U1: listening to .*; recording to /', ''),
    'page': ('page_main', 'The page is at', 'dash'),
    'watch': ('watch_main', 'Waiting for /unit1/valveflow_monitor', ''),
    'replay': ('replay_main', 'Playing plant.mcap', ''),
    'plant_simulator': ('simulator_main', 'wrong with it: gain_step', ''),
    'opcua_gateway': ('gateway_main', 'opc.tcp://127.0.0.1:9', 'asyncua'),
}  # fmt: skip
# A server that is not there: the gateway says so and goes on trying.
MAPPING = """\
endpoint: opc.tcp://127.0.0.1:9
security: {policy: None, allow_unencrypted: true}
units:
  - namespace: /u1
    tag: U1
    signals:
      valve_opening: {node: 'ns=2;s=V', unit: '%'}
      main_steam_pressure: {node: 'ns=2;s=P', unit: bar}
      main_steam_temperature: {node: 'ns=2;s=T', unit: degC}
      generated_power: {node: 'ns=2;s=N', unit: MW}
"""


@pytest.fixture
def heard(context: Any) -> Iterator[None]:
    """Subscribe to every input, for a player begins once somebody listens."""
    node = Node('ears', context=context)
    for topic, kind in (*((s.topic, Float64) for s in SIGNALS), ('plant_sample', PlantSample)):
        node.create_subscription(kind, topic, lambda _: None, qos_profile_sensor_data)
    yield
    node.destroy_node()


@pytest.mark.parametrize('name', EXECUTABLES)
def test_the_example_of_an_executable_works(
    name: str, tmp_path: Path, processes: Processes, heard: None
) -> None:
    module, said, need = EXECUTABLES[name]
    if need and importlib.util.find_spec(need) is None:
        pytest.skip(f'{need} is not installed')
    page = subprocess.run(
        [sys.executable, '-m', f'valveflow_ros.ros.{module}', '--help'],
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    found = re.search(rf'^examples?:\n  ros2 run valveflow_ros {name}(.*)$', page, re.M)
    assert found, page
    (tmp_path / 'opcua.yaml').write_text(MAPPING)
    if name == 'replay':
        words = ['simulate', '-o', str(tmp_path / 'plant.mcap'), '--days', '0.1', '--quiet']
        assert main(words) == 0
    process = processes.start(f'valveflow_ros.ros.{module}', *shlex.split(found[1]))

    def works() -> bool:
        assert process.poll() is None, processes.output(process)
        return re.search(said, processes.output(process)) is not None

    wait_until(works, f'"{said}" of {name}')
    process.terminate()
    assert process.wait(60) == 0, processes.output(process)
    assert 'Traceback' not in processes.output(process)
