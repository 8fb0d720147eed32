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

import argparse
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import psutil

from benchmarks import study

_CROWD, _CLIENTS, _STARTS = 200, 10, 5
_LARGEST = '/_dash-component-suites/plotly/package_data/plotly.min.js'


@contextmanager
def process(folder: str, module: str, *words: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run a module beside the others and end it."""
    with open(os.path.join(folder, f'{module}.log'), 'ab') as out:
        made = subprocess.Popen(
            [sys.executable, '-m', f'valveflow_ros.ros.{module}', *words],
            stdout=out, stderr=out, cwd=folder,
        )  # fmt: skip
    try:
        yield made
    finally:
        made.terminate()
        made.wait(30)


class Page:
    """The page under test."""

    def __init__(self, port: int) -> None:
        self.port = port

    def get(self, path: str = '/metrics') -> float:
        """Return how long an answer took, in ms; raises `OSError` where there is none."""
        begun_s = time.monotonic()
        with urllib.request.urlopen(f'http://127.0.0.1:{self.port}{path}', timeout=20) as answer:
            self.last = answer.read()
        return 1000.0 * (time.monotonic() - begun_s)

    def worst_ms(self, times: int = 20) -> float:
        """Return the longest of some answers."""
        return round(max(self.get() for _ in range(times)), 1)

    def crowd(self, stack: ExitStack, sent: bytes) -> None:
        """Open connections that send something and then do not read."""
        for _ in range(_CROWD):
            peer = stack.enter_context(socket.socket())
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            peer.connect(('127.0.0.1', self.port))
            peer.sendall(sent)
        time.sleep(2.0)


def wait_for(page: Page, text: bytes = b'') -> float:
    """Return after how many seconds there is an answer with that text."""
    begun_s = time.monotonic()
    while True:
        try:
            page.get()
            if text in page.last:
                return time.monotonic() - begun_s
        except OSError:
            pass
        if time.monotonic() - begun_s > 120.0:
            raise SystemExit('the page does not answer')
        time.sleep(0.02)


def share_of_core(seen: psutil.Process, seconds: float) -> float:
    """Return the processor time of a while, in percent of a core."""
    before = seen.cpu_times()
    time.sleep(seconds)
    after = seen.cpu_times()
    used_s = after.user + after.system - before.user - before.system
    return round(100.0 * used_s / seconds, 1)


def measured(folder: str, port: int, seconds: float) -> dict[str, Any]:
    """Return every figure by its name."""
    page, words = Page(port), ('--port', str(port))
    starts = []
    for _ in range(_STARTS):
        with process(folder, 'page_main', *words):
            starts.append(wait_for(page))
    found: dict[str, Any] = {'start_s': round(statistics.median(starts), 2)}
    with process(folder, 'page_main', *words) as running:
        seen = psutil.Process(running.pid)

        def memory_mb() -> float:
            return round(seen.memory_info().rss / 1e6, 1)

        wait_for(page, b'valveflow_power_measured_watts{')
        time.sleep(5.0)
        found |= {
            'core_percent_alone': share_of_core(seen, seconds), 'memory_mb': memory_mb(),
            'metrics_ms_alone': page.worst_ms(),
        }  # fmt: skip
        with ExitStack() as stack:
            page.crowd(stack, b'GET / HTTP/1.1\r\nHost: localhost\r\n')
            found |= {'metrics_ms_half_requests': page.worst_ms(), 'memory_mb_half': memory_mb()}
        with ExitStack() as stack:
            head = f'GET {_LARGEST} HTTP/1.1\r\nHost: localhost\r\nAccept-Encoding: gzip\r\n\r\n'
            page.crowd(stack, head.encode())
            found |= {'metrics_ms_slow_readers': page.worst_ms(), 'memory_mb_slow': memory_mb()}
        end = threading.Event()

        def client() -> None:
            own = Page(port)
            while not end.wait(2.0):
                own.get('/_dash-layout')

        threads = [threading.Thread(target=client) for _ in range(_CLIENTS)]
        for thread in threads:
            thread.start()
        found |= {'core_percent_ten_clients': share_of_core(seen, seconds)}
        end.set()
        for thread in threads:
            thread.join()
        found |= {'memory_mb_end': memory_mb()}
    return found


def main() -> int:
    """Measure, print, and write where it was asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').split('\n')[0])
    parser.add_argument('--seconds', type=float, default=30.0, help='length of each measurement')
    parser.add_argument('--output', type=Path, help='folder for page_load.json')
    options = parser.parse_args()
    os.environ['ROS_DOMAIN_ID'] = str(os.getpid() % 101 + 1)
    with socket.create_server(('127.0.0.1', 0)) as free:
        port = free.getsockname()[1]
    plant = ('--ros-args', '-p', 'stamped:=true', '-p', 'rate:=1.0')
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        stack.enter_context(process(folder, 'monitor_main', '--ros-args', '-p', 'record:=false'))
        stack.enter_context(process(folder, 'simulator_main', *plant))
        found = measured(folder, port, options.seconds)
    for name, value in found.items():
        print(f'{name:28} {value}')
    if options.output is not None:
        study.keep('page_load', folder=options.output, **found)
    return 0


if __name__ == '__main__':
    sys.exit(main())
