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
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from benchmarks import study
from benchmarks.processes import own_domain, running, used
from valveflow_ros.records import SIGNALS

_PATIENCE_S = 300.0
_SETTLE_S = 5.0
_MONITOR = 'from valveflow_ros.ros import monitor; monitor()'


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
    message = PlantSample()
    begun_s = time.monotonic()
    for number, row in enumerate(rows):
        message.header.stamp = node.get_clock().now().to_msg()
        for info in SIGNALS:
            setattr(message, info.topic, float(row[info.signal]))
            setattr(message, f'{info.topic}_quality', PlantSample.QUALITY_GOOD)
        for publisher in out:
            publisher.publish(message)
        time.sleep(max(0.0, begun_s + number + 1 - time.monotonic()))


def arguments_of(folder: Path, unit: int) -> list[str]:
    """Write the parameter file of a unit; return what starts its monitor."""
    path = folder / f'u{unit}.yaml'
    given = {'unit_tag': f'U{unit}', 'record_directory': f'{folder}/u{unit}'}
    path.write_text(json.dumps({'/**': {'ros__parameters': given}}))
    return ['-c', _MONITOR, '--ros-args', '-r', f'__ns:=/u{unit}', '--params-file', str(path)]


def measured(units: int, seconds: float) -> dict[str, Any]:
    """Return what so many units cost."""
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        logs = [folder / f'u{unit}.log' for unit in range(units)]
        sender = ('-m', 'benchmarks.units_load', '--send', str(units))
        stack.enter_context(running(folder / 'sender.log', *sender))
        begun_s = time.monotonic()
        monitors = [
            stack.enter_context(running(log, *arguments_of(folder, unit)))
            for unit, log in enumerate(logs)
        ]
        while not all('listening to' in log.read_text() for log in logs):
            if time.monotonic() > begun_s + _PATIENCE_S:
                raise SystemExit('a monitor did not start')
            time.sleep(0.1)
        start_s = time.monotonic() - begun_s
        time.sleep(_SETTLE_S)
        before, _ = used(monitors)
        time.sleep(seconds)
        after, memory_mb = used(monitors)
        for monitor in monitors:
            monitor.terminate()
        ends = [monitor.wait(60) for monitor in monitors]
        said = [line for log in logs for line in log.read_text().splitlines()]
    counts = [line.split('Recorded ')[1].split()[0] for line in said if 'Recorded ' in line]
    return {
        'units': units, 'seconds': seconds, 'start_s': round(start_s, 1),
        'core_percent_a_unit': round(100.0 * (after - before) / seconds / units, 2),
        'memory_mb_a_unit': round(memory_mb / units, 1),
        'messages_recorded': sum(int(count.replace(',', '')) for count in counts),
        'ended_cleanly': ends == [0] * units,
        'warnings': sum('[WARN]' in line or '[ERROR]' in line for line in said),
    }  # fmt: skip


def main() -> None:
    parser = study.options(__doc__, seconds=60.0)
    parser.add_argument('--counts', type=int, nargs='+', default=[1, 4, 16])
    parser.add_argument('--output', type=Path, help='folder for units_load.json')
    parser.add_argument('--send', type=int, help='(for the process that sends)')
    given = parser.parse_args()
    if given.send:
        send(given.send)
        return
    own_domain()
    rows = [measured(units, given.seconds) for units in given.counts]
    study.keep('units_load', given.output, machine=study.machine(), units=rows, rows=rows)


if __name__ == '__main__':
    main()
