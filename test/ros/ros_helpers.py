# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Waiting for events, processes that are ended, and the sockets they hold."""

import subprocess
import sys
import time

import pytest

# The limit for waiting on an event: the first run compiles, and the machine may be busy.
PATIENCE_S = 240.0
LOOPBACK = '127.0.0.1'


def wait_until(condition, what, patience_s=PATIENCE_S, pause_s=0.01):
    """Return what a condition gives once it is true; fail after a generous while."""
    end_s = time.monotonic() + patience_s
    while not (found := condition()):
        if time.monotonic() > end_s:
            pytest.fail(f'{what} did not come within {patience_s:g} s')
        time.sleep(pause_s)
    return found


def spin_until(executor, condition, what, patience_s=PATIENCE_S):
    """Wait as `wait_until` does, while an executor calls what has come."""
    return wait_until(
        lambda: executor.spin_once(timeout_sec=0.02) or condition(), what, patience_s, 0.0
    )


class Processes:
    """Starts modules of ours as processes and ends those that are left."""

    def __init__(self, environment, folder):
        self._environment = environment
        self._folder = folder
        self._all = []

    def start(self, module, *arguments, **more):
        """Start ``python -m module``; its output goes to files."""
        stem = f'{module.rsplit(".", 1)[-1]}_{len(self._all)}'
        with (self._folder / f'{stem}.log').open('wb') as out:
            process = subprocess.Popen(
                [sys.executable, '-m', module, *arguments],
                stdout=out,
                stderr=subprocess.STDOUT,
                env={**self._environment, **more},
                cwd=self._folder,
            )
        self._all.append(process)
        return process

    def output(self, process):
        number = self._all.index(process)
        (path,) = self._folder.glob(f'*_{number}.log')
        return path.read_text(errors='replace')

    def end_all(self):
        for process in self._all:
            if process.poll() is None:
                process.kill()
                process.wait()


def bound(process):
    """Return address and port of each internet socket of a process."""
    return [tuple(found.laddr) for found in process.net_connections('inet') if found.laddr]


def rtps_ports(domain):
    """Return the ports that DDS gives to a domain (OMG DDSI-RTPS 9.6.1)."""
    return range(7400 + 250 * domain, 7400 + 250 * (domain + 1))
