"""The node under load: what is lost, what it costs, how late it is.

    source env.sh; python benchmarks/node_load.py [--rate 100] [--seconds 60] [--json]

A history of the simulated plant is played first, as fast as the monitor takes
it, so that there is something to fit. Then four plain topics are published at
the rate asked for while refits run one after the other in the worker process
and everything is recorded. Sent, recorded and fed are counted apart: by the
sender, in the file, and by the engine.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import Float64
from std_srvs.srv import Trigger
from valveflow_msgs.msg import Prediction

from valveflow_ros.logs import open_log
from valveflow_ros.plant.simulator import simulate
from valveflow_ros.records import NS_PER_S, SIGNALS, SampleTable
from valveflow_ros.ros.demo_processes import ros_arguments
from valveflow_ros.ros.inputs import header_time_ns
from valveflow_ros.ros.playing import Player
from valveflow_ros.ros.simulator_steps import stamped_steps
from valveflow_ros.ros.taking import Taker
from valveflow_ros.ros.wire import float64_bytes

MONITOR = '/valveflow_monitor'
REQUIRED = [info for info in SIGNALS if info.required]
HISTORY_DAYS = 0.3
REFIT_EVERY_S = 5.0


class Ears:
    """Hears the monitor's health and predictions, and asks for refits."""

    def __init__(self) -> None:
        self.node = Node('node_load')
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._health: dict[str, dict[str, str]] = {}
        self.looks = 0
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._on_health, 10)
        self._refit = self.node.create_client(Trigger, f'{MONITOR}/refit')
        self.predictions = Taker(self.node, Prediction, f'{MONITOR}/prediction')

    def spin(self, seconds: float = 0.0) -> None:
        """Let a callback run, if one is due within the time."""
        self._executor.spin_once(timeout_sec=seconds)

    def ask_for_refit(self) -> None:
        """Ask, without waiting for the answer."""
        if self._refit.service_is_ready():
            self._refit.call_async(Trigger.Request())

    def number(self, item: str, key: str) -> int:
        """Return a whole number of the newest health, 0 while there is none."""
        return int(self._health.get(item, {}).get(key, '0'))

    def settle(self, what: Callable[[], Any], patience_s: float = 300.0) -> None:
        """Wait until a number has not changed for three looks at the health."""
        end_s, same, last, looks = time.monotonic() + patience_s, 0, None, self.looks
        while same < 3:
            if time.monotonic() > end_s:
                raise TimeoutError('the monitor does not come to rest')
            self.spin(0.1)
            if self.looks > looks:
                looks = self.looks
                same = same + 1 if what() == last and last is not None else 0
                last = what()

    def _on_health(self, message: DiagnosticArray) -> None:
        self.looks += 1
        for status in message.status:
            name = status.name.split(' ', 2)[2]
            self._health[name] = {entry.key: entry.value for entry in status.values}


def fed(ears: Ears) -> dict[str, int]:
    """Return how many readings of each signal the engine has accepted."""
    return {i.topic: ears.number(f'input {i.topic}', 'Readings accepted') for i in REQUIRED}


def play_history(ears: Ears, table: SampleTable) -> None:
    player = Player(ears.node, ['plant_sample'], 0.0, use_clock=False, stop=lambda: False)
    player.wait_for_listeners(300.0)
    player.play(stamped_steps([table], False, 'load'))
    ears.settle(lambda: ears.number('fit', 'Samples taken') or None)


def send(ears: Ears, table: SampleTable, rate: float, seconds: float) -> dict[str, Any]:
    """Publish four topics at a steady rate; return what was sent and how late answers were."""
    qos = QoSProfile(depth=1000)
    topics = [(i, ears.node.create_publisher(Float64, i.topic, qos)) for i in REQUIRED]
    while any(publisher.get_subscription_count() == 0 for _, publisher in topics):
        ears.spin(0.05)
    time.sleep(1.0)
    ears.predictions.take()
    ticks = round(rate * seconds)
    columns = {i.topic: table.column(i.signal) for i in REQUIRED}
    late_ms: list[float] = []
    begun_s = next_refit_s = time.monotonic()
    first_ns = time.time_ns()
    for k in range(ticks):
        due_s = begun_s + k / rate
        while (left := due_s - time.monotonic()) > 0:
            time.sleep(min(left, 0.002))
        row = int(k / rate) % len(table)
        for info, publisher in topics:
            publisher.publish(float64_bytes(float(columns[info.topic][row])))
        if k % 20 == 0:
            for taken in ears.predictions.take():
                stamp_ns = header_time_ns(taken.data)
                if stamp_ns > first_ns:
                    late_ms.append((taken.source_ns - stamp_ns) / 1e6)
        if time.monotonic() > next_refit_s:
            next_refit_s += REFIT_EVERY_S
            ears.ask_for_refit()
            ears.spin()
    took_s = time.monotonic() - begun_s
    return {'sent': ticks, 'took_s': took_s, 'late_ms': late_ms, 'first_ns': first_ns}


def recorded(folder: Path, first_ns: int) -> tuple[dict[str, int], int]:
    """Return the values of each topic in the file, and the refits that were adopted."""
    (path,) = folder.iterdir()
    log = open_log(path)
    counts = {i.topic: sum(1 for m in log.iter_messages([f'/{i.topic}'])) for i in REQUIRED}
    curves = sum(
        m.log_time_ns > first_ns for m in log.iter_messages([f'{MONITOR}/characteristic'])
    )
    return counts, curves


def run(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    table = simulate(HISTORY_DAYS, 7, start_ns=0).table
    parameters = {
        'record_directory': folder / 'recordings', 'refit_period': 0.0,
        'sample_period': options.sample_period,
    }  # fmt: skip
    command = [sys.executable, '-m', 'valveflow_ros.ros.monitor_main']
    with (folder / 'monitor.log').open('wb') as log:
        monitor = subprocess.Popen(
            [*command, *ros_arguments(parameters)], stdout=log, stderr=subprocess.STDOUT
        )
    try:
        ears = Ears()
        # The history ends when the live part begins, give or take the time to play it.
        shift_ns = time.time_ns() // NS_PER_S * NS_PER_S - int(table.time_ns[-1])
        play_history(ears, SampleTable(table.time_ns + shift_ns, table.values, table.quality))
        before = fed(ears)
        process = psutil.Process(monitor.pid)
        cpu_before = process.cpu_times()
        found = send(ears, table, options.rate, options.seconds)
        cpu = process.cpu_times()
        ears.settle(lambda: tuple(fed(ears).values()))
        after = fed(ears)
        lost = {
            i.topic: ears.number(f'input {i.topic}', 'Messages lost on the way') for i in REQUIRED
        }
        memory = process.memory_info().rss / 2**20
    finally:
        monitor.terminate()
        status = monitor.wait(30.0)
    counts, curves = recorded(folder / 'recordings', found['first_ns'])
    used_s = cpu.user + cpu.system - cpu_before.user - cpu_before.system
    late = found['late_ms']
    return {
        'sent': found['sent'],
        'recorded': counts,
        'fed': {topic: after[topic] - before[topic] for topic in after},
        'lost': lost,
        'seconds': found['took_s'],
        'cpu_share': used_s / found['took_s'],
        'memory_mib': memory,
        'curves': curves,
        'latency_ms': {
            'median': float(np.median(late)), 'p99': float(np.quantile(late, 0.99)),
            'max': float(np.max(late)), 'rows': len(late),
        },
        'monitor_status': status,
    }  # fmt: skip


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--rate', type=float, default=100.0, help='Hz of each of four topics')
    parser.add_argument('--seconds', type=float, default=60.0)
    parser.add_argument('--sample-period', type=float, default=1.0, help='step of the table, s')
    parser.add_argument('--json', action='store_true')
    return parser.parse_args()


def main() -> int:
    options = arguments()
    os.environ['ROS_DOMAIN_ID'] = str(os.getpid() % 101 + 1)
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    rclpy.init(args=[])
    with tempfile.TemporaryDirectory(prefix='node_load') as name:
        result = run(options, Path(name))
    rclpy.try_shutdown()
    about = {
        'rate_hz': options.rate, 'load_average': os.getloadavg()[0], 'cpus': os.cpu_count(),
        'python': platform.python_version(),
    }  # fmt: skip
    if options.json:
        json.dump({**about, **result}, sys.stdout, indent=2)
        sys.stdout.write('\n')
        return 0
    print(
        f'4 x {options.rate:g} Hz for {result["seconds"]:.0f} s, {about["cpus"]} CPUs '
        f'(load {about["load_average"]:.1f}), Python {about["python"]}'
    )
    for topic, count in result['recorded'].items():
        print(
            f'  {topic}: sent {result["sent"]}, recorded {count}, fed {result["fed"][topic]}, '
            f'lost on the way {result["lost"][topic]}'
        )
    late = result['latency_ms']
    print(f'  {100 * result["cpu_share"]:.1f} % of a core, {result["memory_mib"]:.0f} MiB')
    print(
        f'  prediction after its sample: median {late["median"]:.1f} ms, '
        f'p99 {late["p99"]:.1f} ms, worst {late["max"]:.1f} ms of {late["rows"]}'
    )
    print(f'  {result["curves"]} refits adopted meanwhile')
    return 0


if __name__ == '__main__':
    sys.exit(main())
