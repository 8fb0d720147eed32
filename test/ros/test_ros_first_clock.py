"""Values that come before the first /clock: none is lost, and none stands at 1970."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from ros_helpers import Processes, wait_until
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64

from valveflow_ros.cli.main import main
from valveflow_ros.logs import open_log
from valveflow_ros.plant.simulator import DEFAULT_START_NS
from valveflow_ros.records import NS_PER_S, SIGNALS
from valveflow_ros.ros.demo import ros_arguments
from valveflow_ros.ros.encoding import to_time
from valveflow_ros.ros.verify import verify

STATE = {'valve_opening': 50.0, 'main_steam_pressure': 13.0, 'main_steam_temperature': 538.0,
         'generated_power': 200.0}  # fmt: skip
EARLY, LATE = 20, 30


class Plant:
    """Four plain topics and a clock; hears how the monitor's first input is."""

    def __init__(self, context: Any) -> None:
        self._node = Node('plant', context=context, start_parameter_services=False)
        self._publishers = {n: self._node.create_publisher(Float64, n, 1000) for n in STATE}
        self._clock = self._node.create_publisher(Clock, '/clock', 1000)
        self._node.create_subscription(DiagnosticArray, '/diagnostics', self._hear, 10)
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self._node)
        self.sent = 0
        self.health: dict[str, str] = {}

    def _hear(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.endswith('input valve_opening'):
                self.health = {item.key: item.value for item in status.values}

    def until(self, condition: Any, what: str) -> None:
        wait_until(lambda: self._executor.spin_once(timeout_sec=0.02) or condition(), what)

    def connected(self) -> bool:
        return all(p.get_subscription_count() for p in (*self._publishers.values(), self._clock))

    def tick(self, time_ns: int) -> None:
        self._clock.publish(Clock(clock=to_time(time_ns)))

    def send(self) -> None:
        for name, publisher in self._publishers.items():
            publisher.publish(Float64(data=STATE[name] + self.sent / 100))
        self.sent += 1

    def close(self) -> None:
        self._executor.shutdown()
        self._node.destroy_node()


@pytest.mark.ros
@pytest.mark.slow
def test_what_comes_before_the_first_clock_is_recorded_before_its_time(
    processes: Processes, context: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    parameters = {
        'record_directory': f'"{tmp_path / "recordings"}"', 'input_reliability': 'reliable',
        'use_sim_time': True, 'keep_state': False,
    }  # fmt: skip
    monitor = processes.start('valveflow_ros.ros.monitor_main', *ros_arguments(parameters))
    plant = Plant(context)
    plant.until(plant.connected, 'the monitor')
    for _ in range(EARLY):
        plant.send()
        time.sleep(0.02)
    waiting = 'Messages that wait for the first /clock'
    plant.until(lambda: plant.health.get(waiting) == str(EARLY), 'the wait')
    for k in range(LATE):
        plant.tick(DEFAULT_START_NS + k * NS_PER_S)
        plant.send()
        time.sleep(0.02)
    plant.tick(DEFAULT_START_NS + LATE * NS_PER_S)
    wanted = {
        'Messages sent before the first /clock': str(EARLY),
        'Messages received': str(EARLY + LATE),
    }
    plant.until(lambda: wanted.items() <= plant.health.items(), 'all values')
    monitor.terminate()
    assert monitor.wait(20.0) == 0, processes.output(monitor)
    plant.close()
    (folder,) = (tmp_path / 'recordings').glob('valveflow_*')
    readings = open_log(folder).readings
    for info in SIGNALS[:4]:
        mine = readings.signal == info.signal
        value, time_ns = readings.value[mine], readings.time_ns[mine]
        assert value.tolist() == [STATE[info.topic] + k / 100 for k in range(EARLY + LATE)]
        assert (np.diff(time_ns) > 0).all()
        since = time_ns - DEFAULT_START_NS
        assert (since[:EARLY] > -60 * NS_PER_S).all()
        assert (since[:EARLY] < 0).all()
        assert since[EARLY:].tolist() == [k * NS_PER_S for k in range(LATE)]
    result = verify(folder)
    assert result.identical, result.difference
    assert main(['info', str(folder)]) == 0
    assert '1970' not in capsys.readouterr().out
