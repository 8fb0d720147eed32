# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The monitor as a process, what it says of itself, and a history to fit."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import Trigger
from valveflow_msgs.msg import Alarm

from valveflow_ros.plant.simulator import simulate
from valveflow_ros.records import NS_PER_S, SampleTable
from valveflow_ros.ros.decoding import header_time_ns
from valveflow_ros.ros.demo import ros_arguments
from valveflow_ros.ros.node.polled_subscription import PolledSubscription
from valveflow_ros.ros.player import Player
from valveflow_ros.ros.simulator_main import stamped_steps

NAME = '/valveflow_monitor'
HISTORY_DAYS = 0.3
_PATIENCE_S = 300.0
_END_S = 30.0


class Ears:
    """Hears the monitor's health and alarms, and asks it for refits."""

    def __init__(self) -> None:
        self.node = Node('node_load', enable_rosout=False)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._health: dict[str, dict[str, str]] = {}
        self.looks = 0
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._on_health, 10)
        self._refit = self.node.create_client(Trigger, f'{NAME}/refit')
        self.alarms = PolledSubscription(self.node, Alarm, f'{NAME}/alarms')

    def spin(self, seconds: float = 0.0) -> None:
        """Let a callback run, if one is due within the time."""
        self._executor.spin_once(timeout_sec=seconds)

    def ask_for_refit(self) -> None:
        """Ask, without waiting for the answer."""
        if self._refit.service_is_ready():
            self._refit.call_async(Trigger.Request())

    def text(self, item: str, key: str) -> str:
        """Return what the newest health says, empty while there is none."""
        return self._health.get(item, {}).get(key, '')

    def number(self, item: str, key: str) -> int:
        """Return a whole number of the newest health, 0 while there is none."""
        return int(self.text(item, key) or 0)

    def values(self, item: str) -> Mapping[str, str]:
        """Return all that the newest health says of an item."""
        return self._health.get(item, {})

    def until(self, holds: Callable[[], Any], what: str, patience_s: float = _PATIENCE_S) -> None:
        """Listen until something holds."""
        end_s = time.monotonic() + patience_s
        while not holds():
            if time.monotonic() > end_s:
                raise TimeoutError(f'{what} did not come within {patience_s:g} s')
            self.spin(0.1)

    def rest(self, what: Callable[[], Any], looks: int = 2) -> None:
        """Wait until something has not changed for so many looks at the health."""
        same, last, seen = 0, what(), self.looks
        end_s = time.monotonic() + _PATIENCE_S
        while same < looks:
            if time.monotonic() > end_s:
                raise TimeoutError('the monitor does not come to rest')
            self.spin(0.1)
            if self.looks > seen:
                seen = self.looks
                same = same + 1 if what() == last else 0
                last = what()

    def alarm_delays_s(self) -> list[float]:
        """Return how long after its row each new alarm message was sent."""
        return [(t.source_ns - header_time_ns(t.data)) * 1e-9 for t in self.alarms.take()]

    def close(self) -> None:
        """Hear no more."""
        self.alarms.close()
        self._executor.shutdown(timeout_sec=0.5)
        self.node.destroy_node()

    def _on_health(self, message: DiagnosticArray) -> None:
        self.looks += 1
        for status in message.status:
            name = status.name.split(' ', 2)[2]
            self._health[name] = {entry.key: entry.value for entry in status.values}


class Monitor:
    """The monitor's process, with the watch of `probed`; it writes into a folder."""

    def __init__(self, folder: Path, parameters: Mapping[str, object]) -> None:
        self.recordings = folder / 'recordings'
        self._probe = folder / 'probe.json'
        self._log = folder / 'monitor.log'
        places = {'record_directory': self.recordings, 'state_directory': folder / 'state'}
        given = {**places, 'keep_state': False, **parameters}
        command = [sys.executable, '-m', 'benchmarks.load.probed', str(self._probe)]
        with self._log.open('wb') as log:
            self._process = subprocess.Popen(
                [*command, *ros_arguments(given)], stdout=log, stderr=subprocess.STDOUT
            )
        self.process = psutil.Process(self._process.pid)

    def used_s(self) -> float:
        """Return the processor time of the monitor itself, without that of its workers."""
        times = self.process.cpu_times()
        return float(times.user + times.system)

    def memory_mib(self) -> float:
        """Return its resident memory."""
        return float(self.process.memory_info().rss / 2**20)

    def workers(self) -> list[psutil.Process]:
        """Return its child processes."""
        return list(self.process.children())

    def clear(self) -> None:
        """Set the watch to zero."""
        self._process.send_signal(signal.SIGUSR1)

    def end(self) -> dict[str, Any]:
        """End it in order; return what the watch saw, or fail with its last words."""
        self._process.terminate()
        status = self._process.wait(_END_S)
        if status:
            raise RuntimeError(f'the monitor ended with status {status}: {self._log.read_text()}')
        return dict(json.loads(self._probe.read_text('utf-8')))

    def kill(self) -> None:
        """End it if it still runs."""
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()


class History:
    """A plant's past: played as fast as it is taken, and held until the live part begins."""

    def __init__(self, ears: Ears) -> None:
        self._ears = ears
        self._player = Player(ears.node, ['plant_sample'], 0.0, False, lambda: False)
        table = simulate(HISTORY_DAYS, 7, start_ns=0).table
        shift_ns = time.time_ns() // NS_PER_S * NS_PER_S - int(table.time_ns[-1])
        self._table = SampleTable(table.time_ns + shift_ns, table.values, table.quality)

    @property
    def last(self) -> Any:
        """Return the values of the last row, by signal."""
        return self._table.values[-1]

    def play(self) -> None:
        """Play it and wait for a curve."""
        ears = self._ears
        self._player.wait_for_listeners(_PATIENCE_S)
        self._play(self._table)
        ears.until(lambda: ears.number('fit', 'Samples taken in all runs'), 'the first row')
        ears.rest(lambda: ears.number('fit', 'Samples taken in all runs'))
        ears.ask_for_refit()
        ears.until(lambda: ears.text('fit', 'Model'), 'a curve')

    def hold(self) -> None:
        """Let the plant stand still from where it ended until now."""
        now_ns = time.time_ns() // NS_PER_S * NS_PER_S
        time_ns = np.arange(int(self._table.time_ns[-1]) + NS_PER_S, now_ns + 1, NS_PER_S)
        if not len(time_ns):
            return
        rows = np.full(len(time_ns), len(self._table) - 1)
        held = SampleTable(time_ns, self._table.values[rows], self._table.quality[rows])
        self._play(held)
        self._table = held

    def _play(self, table: SampleTable) -> None:
        self._player.play(stamped_steps([table], False, 'load'))
