# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the OPC UA gateway costs, whether it misses a change, and how it comes back.

    python -m benchmarks.opcua_load [--seconds S] [--restarts N] [--output DIR]

A server in a process of its own writes 50 signals (ten units of five) ten times a second; the
gateway subscribes to them and publishes a sample of each unit a second, in a domain of its own.
Told are: changes written, received and reported as lost, samples and those of them that are good,
the age of a sample when it comes, and the gateway's share of a core and memory. Then the server
is killed and started again, and told is how long after its start every unit has good samples.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import psutil

from benchmarks import study
from benchmarks.processes import free_port, own_domain, running
from valveflow_ros.records import SIGNALS

_UNITS, _RATE_HZ = 10, 10.0
_SIGNALS = _UNITS * len(SIGNALS)
_PATIENCE_S = 120.0


async def serve(port: int) -> None:
    """Offer the signals; on a line ``go S`` change them for so long and tell how often."""
    from asyncua import Server, ua

    server = Server()
    await server.init()
    server.set_endpoint(f'opc.tcp://127.0.0.1:{port}')
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    index = await server.register_namespace('urn:load')
    names = [f'U{k}.{info.topic}' for k in range(_UNITS) for info in SIGNALS]
    nodes = [
        await server.nodes.objects.add_variable(ua.NodeId(name, index), f'{index}:{name}', 1.0)
        for name in names
    ]
    await server.start()
    print('ready', flush=True)
    line = await asyncio.to_thread(sys.stdin.readline)
    if line.startswith('go '):
        begun_s, count = time.monotonic(), 0
        while time.monotonic() < begun_s + float(line[3:]):
            count += 1
            for k, node in enumerate(nodes):
                await node.write_value(ua.Variant(10.0 + k + (count % 1000) / 1e4))
            await asyncio.sleep(max(0.0, begun_s + count / _RATE_HZ - time.monotonic()))
        print(count * len(nodes), flush=True)
        await asyncio.to_thread(sys.stdin.readline)


def start_server(port: int) -> subprocess.Popen[str]:
    """Start the server and wait until it listens."""
    made = subprocess.Popen(
        [sys.executable, '-m', 'benchmarks.opcua_load', '--serve', str(port)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
    )  # fmt: skip
    if made.stdout.readline() != 'ready\n':
        raise SystemExit('the server did not start')
    return made


def write_mapping(folder: Path, port: int) -> Path:
    """Write the mapping of all units."""
    units = [
        {'namespace': f'/u{k}', 'tag': f'U{k}', 'signals': {
            info.topic: {'node': f'nsu=urn:load;s=U{k}.{info.topic}', 'unit': info.unit}
            for info in SIGNALS
        }}
        for k in range(_UNITS)
    ]  # fmt: skip
    path = folder / 'opcua.yaml'
    path.write_text(json.dumps({
        'endpoint': f'opc.tcp://127.0.0.1:{port}', 'units': units, 'reconnect_longest': 2.0,
        'sampling_interval': 1.0 / _RATE_HZ, 'queue_size': 50,
        'security': {'policy': 'None', 'allow_unencrypted': True},
    }))  # fmt: skip
    return path


class Listener:
    """Counts what the gateway publishes."""

    def __init__(self) -> None:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from rclpy.executors import SingleThreadedExecutor
        from valveflow_msgs.msg import PlantSample

        rclpy.init()
        node = rclpy.create_node('opcua_load')
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)
        self.counts: dict[str, dict[str, str]] = {}
        self.good = 0
        self.ages_s: list[float] = []
        self.last_good_ns = [0] * _UNITS
        node.create_subscription(DiagnosticArray, '/diagnostics', self._on_health, 100)
        for k in range(_UNITS):
            node.create_subscription(
                PlantSample, f'/u{k}/plant_sample', lambda m, k=k: self._on_sample(m, k), 100
            )

    def _on_health(self, message: Any) -> None:
        for status in message.status:
            self.counts[status.name] = {v.key: v.value for v in status.values}

    def _on_sample(self, message: Any, unit: int) -> None:
        stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        self.ages_s.append((time.time_ns() - stamp_ns) / 1e9)
        if all(getattr(message, f'{info.topic}_quality') == 1 for info in SIGNALS):
            self.good += 1
            self.last_good_ns[unit] = stamp_ns

    def spin(self, seconds: float) -> None:
        """Listen for so long."""
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            self._executor.spin_once(timeout_sec=0.1)

    def total(self, key: str) -> int:
        """Return a count of all signals, or of all links."""
        return sum(int(float(v[key])) for v in self.counts.values() if key in v)

    def until_good(self) -> float:
        """Return how long it takes until every unit has a good sample from after now, in s."""
        begun_ns = time.time_ns()
        while min(self.last_good_ns) <= begun_ns:
            if time.time_ns() - begun_ns > _PATIENCE_S * 1e9:
                raise SystemExit('good samples did not come')
            self.spin(0.05)
        return (time.time_ns() - begun_ns) / 1e9


def under_load(
    listener: Listener, server: subprocess.Popen[str], gateway: psutil.Process, seconds: float
) -> dict[str, Any]:
    """Let the server change its values; return what came of it."""
    listener.until_good()
    # Every value once, when the subscription begins, told by the next message of the health.
    while listener.total('received') < _SIGNALS:
        listener.spin(0.5)
    listener.spin(2.0)
    before, losses = listener.total('received'), listener.total('losses')
    used = gateway.cpu_times()
    listener.good = 0
    listener.ages_s.clear()
    server.stdin.write(f'go {seconds}\n')
    server.stdin.flush()
    listener.spin(seconds)
    after = gateway.cpu_times()
    written = int(server.stdout.readline())
    good, ages = listener.good, sorted(listener.ages_s)
    listener.spin(4.0)
    used_s = after.user + after.system - used.user - used.system
    return {
        'signals': _SIGNALS, 'seconds': seconds, 'changes_written': written,
        'changes_received': listener.total('received') - before,
        'changes_lost': listener.total('lost'), 'messages_lost': listener.total('messages_lost'),
        'messages_sent_again': listener.total('messages_sent_again'),
        'links_lost': listener.total('losses') - losses, 'received_before': before,
        'samples': len(ages), 'samples_good': good,
        'sample_age_s_median': round(statistics.median(ages), 3),
        'sample_age_s_worst': round(ages[-1], 3),
        'core_percent': round(100.0 * used_s / seconds, 1),
        'memory_mb': round(gateway.memory_info().rss / 1e6, 1),
    }  # fmt: skip


def measured(folder: Path, port: int, given: argparse.Namespace) -> dict[str, Any]:
    """Return every figure by its name."""
    server = start_server(port)
    words = ('-m', 'valveflow_ros.ros.gateway_main', '--ros-args', '-p',
             f'mapping_file:={write_mapping(folder, port)}')  # fmt: skip
    listener = Listener()
    try:
        with running(folder / 'gateway.log', *words) as gateway:
            seen = psutil.Process(gateway.pid)
            found = under_load(listener, server, seen, given.seconds)
            back = []
            for _ in range(given.restarts):
                server.kill()
                server.wait()
                listener.spin(1.0)
                server = start_server(port)
                back.append(listener.until_good())
            if back:
                found |= {
                    'restarts': given.restarts, 'back_s_median': round(statistics.median(back), 2),
                    'back_s_worst': round(max(back), 2),
                    'losses_per_unit': listener.total('losses') / _UNITS,
                    'memory_mb_end': round(seen.memory_info().rss / 1e6, 1),
                }  # fmt: skip
            gateway.terminate()
            found['exit_status'] = gateway.wait(30)
    finally:
        server.kill()
    return found | study.machine()


def main() -> None:
    parser = study.options(__doc__, seconds=600.0, restarts=5)
    parser.add_argument('--output', type=Path, help='folder for opcua_load.json')
    parser.add_argument('--serve', type=int, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.serve:
        asyncio.run(serve(given.serve))
        return
    own_domain()
    with tempfile.TemporaryDirectory() as folder:
        found = measured(Path(folder), free_port(), given)
    study.keep('opcua_load', given.output, **found)


if __name__ == '__main__':
    main()
