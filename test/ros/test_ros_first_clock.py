# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Values that come before the first /clock: none is lost, and none stands at 1970."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from listener import Listener, start_monitor
from ros_helpers import Processes
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64

from valveflow_ros.cli.main import main
from valveflow_ros.logs import open_log
from valveflow_ros.plant.simulator import DEFAULT_START_NS
from valveflow_ros.records import NS_PER_S, SIGNALS
from valveflow_ros.ros.encoding import to_time
from valveflow_ros.ros.verify import verify

STATE = {'valve_opening': 50.0, 'main_steam_pressure': 13.0, 'main_steam_temperature': 538.0,
         'generated_power': 200.0}  # fmt: skip
EARLY, LATE = 20, 30


class Plant(Listener):
    """Four plain topics and a clock; hears how the monitor's first input is."""

    def __init__(self, context: Any) -> None:
        super().__init__(context, 'plant')
        self._publishers = {n: self.node.create_publisher(Float64, n, 1000) for n in STATE}
        self._clock = self.node.create_publisher(Clock, '/clock', 1000)
        self.sent = 0

    @property
    def first_input(self) -> dict[str, str]:
        return self.item('input valve_opening')

    def connected(self) -> bool:
        return all(p.get_subscription_count() for p in (*self._publishers.values(), self._clock))

    def tick(self, time_ns: int) -> None:
        self._clock.publish(Clock(clock=to_time(time_ns)))

    def send(self) -> None:
        for name, publisher in self._publishers.items():
            publisher.publish(Float64(data=STATE[name] + self.sent / 100))
        self.sent += 1


@pytest.mark.ros
@pytest.mark.slow
def test_what_comes_before_the_first_clock_is_recorded_before_its_time(
    processes: Processes, context: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monitor = start_monitor(
        processes, tmp_path / 'recordings', use_sim_time=True, keep_state=False
    )
    plant = Plant(context)
    plant.until(plant.connected, 'the monitor')
    for _ in range(EARLY):
        plant.send()
        time.sleep(0.02)
    waiting = 'Messages that wait for the first /clock'
    plant.until(lambda: plant.first_input.get(waiting) == str(EARLY), 'the wait')
    for k in range(LATE):
        plant.tick(DEFAULT_START_NS + k * NS_PER_S)
        plant.send()
        time.sleep(0.02)
    plant.tick(DEFAULT_START_NS + LATE * NS_PER_S)
    wanted = {
        'Messages sent before the first /clock': str(EARLY),
        'Messages received': str(EARLY + LATE),
    }
    plant.until(lambda: wanted.items() <= plant.first_input.items(), 'all values')
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
