# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Processes under test, in a ROS domain of their own: started, measured, ended."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil


def own_domain() -> None:
    """Keep this process and its children to a ROS domain that stays on this machine."""
    os.environ['ROS_DOMAIN_ID'] = str(os.getpid() % 101 + 1)
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'


def free_port() -> int:
    with socket.create_server(('127.0.0.1', 0)) as free:
        return int(free.getsockname()[1])


@contextmanager
def running(log: Path, *words: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run Python with these words, its outputs into a file, and end it."""
    with log.open('ab') as out:
        made = subprocess.Popen([sys.executable, *words], stdout=out, stderr=out)
    try:
        yield made
    finally:
        made.terminate()
        try:
            made.wait(60)
        except subprocess.TimeoutExpired:
            made.kill()
            made.wait()


def used(processes: Iterable[subprocess.Popen[bytes]]) -> tuple[float, float]:
    """Return the processor time in s and the memory in MB of processes and their children.

    Memory that several share is divided among them.
    """
    cpu_s = memory_mb = 0.0
    for made in processes:
        whole = psutil.Process(made.pid)
        for process in (whole, *whole.children(recursive=True)):
            times = process.cpu_times()
            cpu_s += times.user + times.system
            memory_mb += process.memory_full_info().pss / 1e6
    return cpu_s, memory_mb
