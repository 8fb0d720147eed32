# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Several units on one host: start-up, processor time and memory of a monitor each.

    python -m benchmarks.units_load [--counts N...] [--seconds S] [--output DIR]

For each count so many monitors are started together, as `units.launch.py` does it, with the values
that a file gives them and a recording each. One more process sends every unit one `PlantSample` a
second from a simulated record. Told are the time until all listen, and over the seconds that
follow the share of a core that a unit takes and its memory: all its processes, memory that several
share divided among them. A refit and a diagnosis need processor time of their own; they do not
come in so short a run.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import psutil

from benchmarks import study
from valveflow_ros.records import SIGNALS

_PATIENCE_S = 300.0
_SETTLE_S = 5.0


def send(units: int) -> None:
    """Send every unit a sample a second."""
    import rclpy
    from rclpy.qos import qos_profile_sensor_data
    from valveflow_msgs.msg import PlantSample

    from valveflow_ros.plant.simulator import simulate

    rows = simulate(0.05, 1).table.values
    rclpy.init()
    node = rclpy.create_node('units_load')
    out = [
        node.create_publisher(PlantSample, f'/u{k}/plant_sample', qos_profile_sensor_data)
        for k in range(units)
    ]
    begun_s = time.monotonic()
    for number, row in enumerate(rows):
        now = node.get_clock().now().to_msg()
        for publisher in out:
            message = PlantSample()
            message.header.stamp = now
            for info in SIGNALS:
                setattr(message, info.topic, float(row[info.signal]))
                setattr(message, f'{info.topic}_quality', PlantSample.QUALITY_GOOD)
            publisher.publish(message)
        time.sleep(max(0.0, begun_s + number + 1 - time.monotonic()))


def start(folder: Path, unit: int) -> subprocess.Popen[bytes]:
    """Start the monitor of a unit."""
    path = folder / f'u{unit}.yaml'
    given = {'unit_tag': f'U{unit}', 'record_directory': f'{folder}/u{unit}'}
    path.write_text(json.dumps({'/**': {'ros__parameters': given}}))
    with (folder / f'u{unit}.log').open('wb') as log:
        return subprocess.Popen(
            [sys.executable, '-c', 'from valveflow_ros.ros import monitor; monitor()',
             '--ros-args', '-r', f'__ns:=/u{unit}', '--params-file', str(path)],
            stdout=log, stderr=log,
        )  # fmt: skip


def usage(monitors: list[subprocess.Popen[bytes]]) -> tuple[float, float]:
    """Return processor time in s and memory in MB of all processes of the monitors."""
    cpu_s = memory_mb = 0.0
    for monitor in monitors:
        whole = psutil.Process(monitor.pid)
        for process in (whole, *whole.children(recursive=True)):
            times = process.cpu_times()
            cpu_s += times.user + times.system
            memory_mb += process.memory_full_info().pss / 1e6
    return cpu_s, memory_mb


def measured(units: int, seconds: float) -> dict[str, Any]:
    """Return what so many units cost."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sender = subprocess.Popen(
            [sys.executable, '-m', 'benchmarks.units_load', '--send', str(units)],
        )
        begun_s = time.monotonic()
        monitors = [start(folder, unit) for unit in range(units)]
        try:
            logs = [folder / f'u{unit}.log' for unit in range(units)]
            while not all('listening to' in log.read_text() for log in logs):
                if time.monotonic() > begun_s + _PATIENCE_S:
                    raise SystemExit('a monitor did not start')
                time.sleep(0.1)
            start_s = time.monotonic() - begun_s
            time.sleep(_SETTLE_S)
            before, _ = usage(monitors)
            time.sleep(seconds)
            after, memory_mb = usage(monitors)
            for monitor in monitors:
                monitor.terminate()
            ends = [monitor.wait(60) for monitor in monitors]
            said = [line for log in logs for line in log.read_text().splitlines()]
            recorded = sum(int(line.split('Recorded ')[1].split()[0].replace(',', ''))
                           for line in said if 'Recorded ' in line)  # fmt: skip
        finally:
            for process in (sender, *monitors):
                process.kill()
                process.wait()
    return {
        'units': units, 'seconds': seconds, 'start_s': round(start_s, 1),
        'core_percent_a_unit': round(100.0 * (after - before) / seconds / units, 2),
        'memory_mb_a_unit': round(memory_mb / units, 1), 'messages_recorded': recorded,
        'ended_cleanly': ends == [0] * units,
        'warnings': sum('[WARN]' in line or '[ERROR]' in line for line in said),
    }  # fmt: skip


def main() -> int:
    """Measure, print, and write where it was asked for."""
    parser = study.options(__doc__, seconds=60.0)
    parser.add_argument('--counts', type=int, nargs='+', default=[1, 4, 16])
    parser.add_argument('--output', type=Path, help='folder for units_load.json')
    parser.add_argument('--send', type=int, help='(for the process that sends)')
    options = parser.parse_args()
    if options.send:
        send(options.send)
        return 0
    os.environ.setdefault('ROS_DOMAIN_ID', str(os.getpid() % 101 + 1))
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    rows = study.rows_of(lambda units: measured(units, options.seconds), options.counts)
    if options.output is not None:
        study.keep(
            'units_load', folder=options.output, command=study.command(),
            machine=study.machine(), rows=rows,
        )  # fmt: skip
    return 0


if __name__ == '__main__':
    sys.exit(main())
