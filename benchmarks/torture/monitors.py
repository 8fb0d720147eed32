# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The running monitor is asked to end, and killed: in order, soon, heard again, nothing left."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from log_files import stock
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from std_msgs.msg import Float64

from benchmarks.torture.trial import Options, Outcome
from valveflow_ros.records import SIGNALS
from valveflow_ros.ros.demo import ros_arguments

TRIALS = 24
KINDS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
# Moments after the recording has begun; before that the monitor is still starting.
LATEST_S = 3.0
WITHIN_S = 2.0
START_S = 240.0
PERIOD_S = 0.005
MANY = QoSProfile(depth=1000)
VALUES = {'valve_opening': 50.0, 'main_steam_pressure': 12.0, 'main_steam_temperature': 530.0,
          'generated_power': 300.0}  # fmt: skip
SHARED_MEMORY = Path('/dev/shm')
Process = subprocess.Popen[bytes]


@contextlib.contextmanager
def ros_node(name: str) -> Iterator[tuple[Node, SingleThreadedExecutor]]:
    """Yield a node and its executor, in a domain of this process on this machine."""
    os.environ['ROS_DOMAIN_ID'] = str(os.getpid() % 101 + 1)
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    rclpy.init(args=[])
    node, executor = Node(name), SingleThreadedExecutor()
    executor.add_node(node)
    try:
        yield node, executor
    finally:
        node.destroy_node()
        rclpy.shutdown()


def started(folder: Path, **parameters: Any) -> Process:
    """Start a monitor that records in a folder and writes its log there."""
    given = {'record_directory': folder / 'recordings', **parameters}
    command = [sys.executable, '-m', 'valveflow_ros.ros.monitor_main', *ros_arguments(given)]
    with (folder / 'monitor.log').open('ab') as log:
        return subprocess.Popen(
            command, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
        )


def killed(process: Process | subprocess.Popen[str]) -> None:
    """Kill a process and wait for its end."""
    process.kill()
    process.wait()


class Inputs:
    """Publishes the four required signals."""

    def __init__(self, node: Node) -> None:
        self.node, self.number = node, 0
        self.publishers: list[tuple[Publisher, float]] = []
        self.renew()

    def renew(self) -> None:
        """Publish with new publishers, as a gateway that was started again."""
        for publisher, _ in self.publishers:
            self.node.destroy_publisher(publisher)
        topics = [info.topic for info in SIGNALS if info.required]
        self.publishers = [
            (self.node.create_publisher(Float64, topic, MANY), VALUES[topic]) for topic in topics
        ]

    def publish(self) -> None:
        """Publish a value of each."""
        self.number += 1
        for publisher, value in self.publishers:
            publisher.publish(Float64(data=value + 0.01 * (self.number % 100)))

    def publish_until(self, seconds: float, done: Callable[[], bool]) -> bool:
        """Publish at a steady rate until it is done, or so long; tell whether it was."""
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            self.publish()
            if self.number % 4 == 0 and done():
                return True
            time.sleep(PERIOD_S)
        return done()


def signals(options: Options) -> Outcome:
    """Send INT, TERM or HUP once or twice while four topics run at 200 Hz each."""
    outcome, generator = Outcome(), random.Random(options.seed)
    with ros_node('torture_gateway') as (node, _):
        inputs = Inputs(node)
        for number in range(options.many(TRIALS, 3)):
            kind, doubled = KINDS[number % 3], number // 3 % 2 == 1
            what = f'{kind.name}{" twice" if doubled else ""}, trial {number}'
            wait_s = generator.uniform(0.0, LATEST_S)
            gap_s = generator.uniform(0.0, 0.2) if doubled else None
            _try(options.folder / str(number), inputs, kind, wait_s, gap_s, what, outcome)
    counts = outcome.counts
    outcome.sentence = (
        f'{counts["signals"]} signals in {counts["trials"]} runs: {counts.get("clean_exits", 0)} '
        f'ended with status 0, at most {outcome.measured.get("longest_end_s", 0):.2f} s, '
        f'{counts.get("orphans", 0)} orphans, {counts.get("shared_memory_files", 0)} files left'
    )
    return outcome


def _try(
    folder: Path, inputs: Inputs, kind: signal.Signals, wait_s: float, gap_s: float | None,
    what: str, outcome: Outcome,
) -> None:  # fmt: skip
    folder.mkdir()
    monitor = started(folder, sample_period=0.1)
    outcome.count('trials')

    def ended() -> bool:
        return monitor.poll() is not None

    def records() -> bool:
        return any((folder / 'recordings').rglob('*.mcap.part'))

    inputs.publish_until(START_S, lambda: records() or ended())
    if not records() or ended():
        outcome.expect(False, f'{what}: it did not start recording')
        killed(monitor)
        return
    family = psutil.Process(monitor.pid).children(recursive=True)
    outcome.counts['workers'] = max(outcome.counts.get('workers', 0), len(family))
    inputs.publish_until(wait_s, lambda: False)
    shared = _shared_by(monitor.pid)
    sent_s = time.monotonic()
    for pause_s in (gap_s, 30.0):
        if pause_s is not None and not ended():
            monitor.send_signal(kind)
            outcome.count('signals')
            inputs.publish_until(pause_s, ended)
    took_s, status = time.monotonic() - sent_s, monitor.poll()
    if status is None:
        killed(monitor)
    what = f'{what}, after {wait_s:.2f} s'
    outcome.worst('longest_end_s', round(took_s, 2))
    outcome.expect(took_s <= WITHIN_S, f'{what}: took {took_s:.2f} s')
    outcome.expect(status == 0, f'{what}: exit status {status}')
    outcome.count('clean_exits', int(status == 0))
    _look_behind(folder, family, shared, what, outcome)


def _look_behind(
    folder: Path, family: list[psutil.Process], shared: set[str], what: str, outcome: Outcome
) -> None:
    """See what is left: files, processes, shared memory."""
    _, alive = psutil.wait_procs(family, timeout=1.0)
    orphans = [child for child in alive if child.is_running()]
    outcome.count('orphans', len(orphans))
    outcome.expect(not orphans, f'{what}: {len(orphans)} worker processes outlived it')
    for child in orphans:
        child.kill()
    # Those that the gateway holds as well are its own, or the domain's.
    shared = {path for path in shared - _shared_by(os.getpid()) if os.path.exists(path)}
    outcome.count('shared_memory_files', len(shared))
    outcome.expect(not shared, f'{what}: left in /dev/shm: {sorted(shared)}')
    parts = list((folder / 'recordings').rglob('*.part'))
    outcome.expect(not parts, f'{what}: {len(parts)} files were not finished')
    for path in (folder / 'recordings').rglob('*.mcap'):
        with outcome.surprises(f'{what}: {path.name}'):
            outcome.count('messages_recorded', len(stock(path)))
            outcome.count('files')


def _shared_by(pid: int) -> set[str]:
    """Return the files in shared memory that a process maps or holds open."""
    home = Path('/proc', str(pid))
    words = [line.split()[-1] for line in (home / 'maps').read_text().splitlines()]
    for link in (home / 'fd').iterdir():
        with contextlib.suppress(OSError):
            words.append(os.readlink(link))
    return {word for word in words if word.startswith(f'{SHARED_MEMORY}/')}


# Killed beside a gateway of others ------------------------------------------------------------

KILLS = 50
SOON_S = 3.0
PATIENCE_S = 60.0
MOST_GROWTH = 5e6
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
    with ros_node('torture_listener') as (node, executor):
        gateway = subprocess.Popen([sys.executable, '-c', GATEWAY])
        try:
            growth = _heard_again(node, executor, options, outcome)
        finally:
            killed(gateway)
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


def _heard_again(
    node: Node, executor: SingleThreadedExecutor, options: Options, outcome: Outcome
) -> int:
    """Kill and start monitors; return by how many bytes the shared memory grew."""
    received = [0]

    def note(health: DiagnosticArray) -> None:
        for status in health.status:
            if 'valve_opening' in status.name:
                values = {entry.key: entry.value for entry in status.values}
                received[0] = int(values.get('Messages received', '0'))

    node.create_subscription(DiagnosticArray, '/diagnostics', note, 10)

    def heard() -> float | None:
        """Return after how many seconds something was heard, None if nothing was."""
        received[0], begun_s = 0, time.monotonic()
        while not received[0]:
            executor.spin_once(timeout_sec=0.02)
            if time.monotonic() - begun_s > PATIENCE_S:
                return None
        return time.monotonic() - begun_s

    monitor = started(options.folder, diagnostics_period=0.2)
    # The first start may have to compile.
    while heard() is None:
        if monitor.poll() is not None:
            raise RuntimeError('the monitor does not start')
    before = _shared_bytes()
    for number in range(options.many(KILLS, 2)):
        killed(monitor)
        monitor = started(options.folder, diagnostics_period=0.2)
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
    return growth


def _shared_bytes() -> int:
    total = 0
    for entry in SHARED_MEMORY.glob('fastrtps*'):
        with contextlib.suppress(FileNotFoundError):
            total += entry.stat().st_size
    return total
