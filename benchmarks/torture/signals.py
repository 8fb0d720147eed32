# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The running monitor is asked to end at random moments: in order, soon, and leaving nothing."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import rclpy
from rclpy.qos import QoSProfile
from std_msgs.msg import Float64

from benchmarks.torture.stock import stock_count
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
VALUES = {'valve_opening': 50.0, 'main_steam_pressure': 12.0, 'main_steam_temperature': 530.0,
          'generated_power': 300.0}  # fmt: skip
Gateway = list[tuple[Any, float]]
SHARED_MEMORY = Path('/dev/shm')


def signals(options: Options) -> Outcome:
    """Send INT, TERM or HUP once or twice while four topics run at 200 Hz each."""
    outcome = Outcome()
    generator = random.Random(options.seed)
    os.environ['ROS_DOMAIN_ID'] = str(os.getpid() % 101 + 1)
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    rclpy.init(args=[])
    node = rclpy.create_node('torture_gateway')
    qos = QoSProfile(depth=1000)
    gateway = [
        (node.create_publisher(Float64, info.topic, qos), VALUES[info.topic])
        for info in SIGNALS
        if info.required
    ]
    for number in range(options.many(TRIALS, 3)):
        kind, doubled = KINDS[number % 3], number // 3 % 2 == 1
        what = f'{kind.name}{" twice" if doubled else ""}, trial {number}'
        wait_s = generator.uniform(0.0, LATEST_S)
        gap_s = generator.uniform(0.0, 0.2) if doubled else None
        _try(options.folder / str(number), gateway, kind, wait_s, gap_s, what, outcome)
    node.destroy_node()
    rclpy.shutdown()
    counts = outcome.counts
    outcome.sentence = (
        f'{counts["signals"]} signals in {counts["trials"]} runs: {counts.get("clean_exits", 0)} '
        f'ended with status 0, at most {outcome.measured.get("longest_end_s", 0):.2f} s, '
        f'{counts.get("orphans", 0)} orphans, {counts.get("shared_memory_files", 0)} files left'
    )
    return outcome


def _try(
    folder: Path, gateway: Gateway, kind: signal.Signals, wait_s: float, gap_s: float | None,
    what: str, outcome: Outcome,
) -> None:  # fmt: skip
    folder.mkdir()
    monitor = _start(folder)
    outcome.count('trials')
    _publish_until(gateway, START_S, lambda: _has_part(folder) or monitor.poll() is not None)
    if not _has_part(folder) or monitor.poll() is not None:
        outcome.expect(False, f'{what}: it did not start recording')
        monitor.kill()
        monitor.wait()
        return
    family = psutil.Process(monitor.pid).children(recursive=True)
    outcome.counts['workers'] = max(outcome.counts.get('workers', 0), len(family))
    _publish_until(gateway, wait_s, lambda: False)
    shared = _shared_by(monitor.pid)
    took_s = _end(monitor, gateway, kind, gap_s, outcome)
    status = monitor.poll()
    if status is None:
        monitor.kill()
        monitor.wait()
    outcome.worst('longest_end_s', round(took_s, 2))
    outcome.expect(took_s <= WITHIN_S, f'{what}, after {wait_s:.2f} s: took {took_s:.2f} s')
    outcome.expect(status == 0, f'{what}, after {wait_s:.2f} s: exit status {status}')
    outcome.count('clean_exits', int(status == 0))
    _look_behind(folder, family, shared, what, outcome)


def _start(folder: Path) -> subprocess.Popen[bytes]:
    parameters = {'record_directory': folder / 'recordings', 'sample_period': 0.1}
    command = [sys.executable, '-m', 'valveflow_ros.ros.monitor_main']
    with (folder / 'monitor.log').open('wb') as log:
        return subprocess.Popen(
            [*command, *ros_arguments(parameters)], stdout=log, stderr=subprocess.STDOUT,
            start_new_session=True,
        )  # fmt: skip


def _end(
    monitor: subprocess.Popen[bytes], gateway: Gateway, kind: signal.Signals,
    gap_s: float | None, outcome: Outcome,
) -> float:  # fmt: skip
    """Send the signal, or two; return how long the end took."""
    sent_s = time.monotonic()
    monitor.send_signal(kind)
    outcome.count('signals')
    if gap_s is not None:
        _publish_until(gateway, gap_s, lambda: monitor.poll() is not None)
        if monitor.poll() is None:
            monitor.send_signal(kind)
            outcome.count('signals')
    _publish_until(gateway, 30.0, lambda: monitor.poll() is not None)
    return time.monotonic() - sent_s


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
        try:
            outcome.count('messages_recorded', stock_count(path))
            outcome.count('files')
        except Exception as error:  # noqa: BLE001 - readers raise what they like
            outcome.expect(False, f'{what}: {path.name}: {type(error).__name__}: {error}')


def _shared_by(pid: int) -> set[str]:
    """Return the files in shared memory that a process maps or holds open."""
    home = Path('/proc', str(pid))
    words = [line.split()[-1] for line in (home / 'maps').read_text().splitlines()]
    for link in (home / 'fd').iterdir():
        with contextlib.suppress(OSError):
            words.append(os.readlink(link))
    here = f'{SHARED_MEMORY}/'
    return {word for word in words if word.startswith(here)}


def _has_part(folder: Path) -> bool:
    return any((folder / 'recordings').rglob('*.mcap.part'))


def _publish_until(gateway: Gateway, seconds: float, done: Callable[[], bool]) -> bool:
    """Publish at a steady rate until it is done, or so long; tell whether it was."""
    end_s = time.monotonic() + seconds
    number = 0
    while time.monotonic() < end_s:
        for publisher, value in gateway:
            publisher.publish(Float64(data=value + 0.01 * (number % 100)))
        number += 1
        if number % 4 == 0 and done():
            return True
        time.sleep(PERIOD_S)
    return bool(done())
