# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the page costs, how soon it is there, and what slow clients do to it.

    python -m benchmarks.page_load [--seconds S] [--output DIR]

A monitor and a plant of one sample a second run beside the page, in a domain of their own. Told
are: the time from its start to the first answer (the middle of five), its share of a core without
and with ten clients that each ask for the whole page every 2 s, how long `/metrics` takes while
200 connections hold half a request, and while 200 do not read the largest file that they asked
for, and the resident memory after each.
"""

from __future__ import annotations

import socket
import statistics
import tempfile
import threading
import time
import urllib.request
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import psutil

from benchmarks import study
from benchmarks.processes import free_port, own_domain, running, used

_CROWD, _CLIENTS, _STARTS = 200, 10, 5
_HALF = b'GET / HTTP/1.1\r\nHost: localhost\r\n'
_LARGEST = (b'GET /_dash-component-suites/plotly/package_data/plotly.min.js HTTP/1.1\r\n'
            b'Host: localhost\r\nAccept-Encoding: gzip\r\n\r\n')  # fmt: skip


class Page:
    """The page under test."""

    def __init__(self, port: int) -> None:
        self.port = port

    def get(self, path: str = '/metrics') -> bytes:
        """Return an answer; raise `OSError` where there is none."""
        with urllib.request.urlopen(f'http://127.0.0.1:{self.port}{path}', timeout=20) as answer:
            return bytes(answer.read())

    def worst_ms(self, times: int = 20) -> float:
        """Return how long the slowest of some answers took."""
        return round(1000.0 * max(study.timed(self.get)[0]['wall_s'] for _ in range(times)), 1)

    def wait_for(self, text: bytes = b'') -> float:
        """Return after how many seconds there is an answer with that text."""
        begun_s = time.monotonic()
        while time.monotonic() < begun_s + 120.0:
            try:
                if text in self.get():
                    return time.monotonic() - begun_s
            except OSError:
                pass
            time.sleep(0.02)
        raise SystemExit('the page does not answer')

    def crowded_ms(self, sent: bytes) -> float:
        """Open connections that send something and then do not read; return the worst answer."""
        with ExitStack() as stack:
            for _ in range(_CROWD):
                peer = stack.enter_context(socket.socket())
                peer.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
                peer.connect(('127.0.0.1', self.port))
                peer.sendall(sent)
            time.sleep(2.0)
            return self.worst_ms()


def measured(folder: Path, seconds: float) -> dict[str, Any]:
    """Return every figure by its name."""
    page = Page(free_port())
    words = ('-m', 'valveflow_ros.ros.page_main', '--port', str(page.port))
    starts = []
    for _ in range(_STARTS):
        with running(folder / 'page.log', *words):
            starts.append(page.wait_for())
    with running(folder / 'page.log', *words) as process:

        def core_percent() -> float:
            before, _ = used([process])
            time.sleep(seconds)
            return round(100.0 * (used([process])[0] - before) / seconds, 1)

        def memory_mb() -> float:
            return round(psutil.Process(process.pid).memory_info().rss / 1e6, 1)

        page.wait_for(b'valveflow_power_measured_watts{')
        time.sleep(5.0)
        found: dict[str, Any] = {
            'start_s': round(statistics.median(starts), 2), 'core_percent_alone': core_percent(),
            'memory_mb': memory_mb(), 'metrics_ms_alone': page.worst_ms(),
            'metrics_ms_half_requests': page.crowded_ms(_HALF), 'memory_mb_half': memory_mb(),
            'metrics_ms_slow_readers': page.crowded_ms(_LARGEST), 'memory_mb_slow': memory_mb(),
        }  # fmt: skip
        end = threading.Event()

        def client() -> None:
            while not end.wait(2.0):
                page.get('/_dash-layout')

        threads = [threading.Thread(target=client) for _ in range(_CLIENTS)]
        for thread in threads:
            thread.start()
        found['core_percent_ten_clients'] = core_percent()
        end.set()
        for thread in threads:
            thread.join()
        return found | {'memory_mb_end': memory_mb()}


def main() -> None:
    parser = study.options(__doc__, seconds=30.0)
    parser.add_argument('--output', type=Path, help='folder for page_load.json')
    given = parser.parse_args()
    own_domain()
    ros = ('-m', 'valveflow_ros.ros.monitor_main', '--ros-args', '-p', 'record:=false')
    plant = ('-m', 'valveflow_ros.ros.simulator_main', '--ros-args', '-p', 'stamped:=true',
             '-p', 'rate:=1.0')  # fmt: skip
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        stack.enter_context(running(folder / 'monitor.log', *ros))
        stack.enter_context(running(folder / 'plant.log', *plant))
        study.keep('page_load', given.output, **measured(folder, given.seconds))


if __name__ == '__main__':
    main()
