# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Runs a piece of work in a child process that may take so much time and memory, and no more."""

from __future__ import annotations

import os
import pickle
import resource
import select
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from benchmarks.torture.memory import MIB, address_space, forget_peak, peak, resident

# Room beyond the promise, for the interpreter and its report.
_SLACK = 16 * MIB


@dataclass(frozen=True, slots=True)
class Ended:
    """How the work ended.

    Attributes
    ----------
    value : object
        What it returned, None if it did not.
    error : str
        The exception that left it, or how the process ended; empty if it returned.
    seconds : float
        Wall time of the work alone.
    bytes : int
        Most resident memory above what the process began with.
    """

    value: Any
    error: str
    seconds: float
    bytes: int


def run_bounded(
    work: Callable[[], Any], patience_s: float, most_bytes: int | None = None
) -> Ended:
    """Run ``work`` in a fork of this process and wait for it so long.

    Parameters
    ----------
    work : callable
        Its result must be picklable.
    patience_s : float
        After so long the child is killed.
    most_bytes : int, optional
        Address space that it may take in addition.
    """
    sys.stdout.flush()
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        _work(work, writing, most_bytes)
    os.close(writing)
    end_s = time.monotonic() + patience_s
    raw, done = b'', False
    while not done and (left := end_s - time.monotonic()) > 0:
        if select.select([reading], [], [], left)[0]:
            part = os.read(reading, 1 << 20)
            raw, done = raw + part, not part
    os.close(reading)
    if not done:
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    if not done:
        return Ended(None, f'took more than {patience_s:g} s', patience_s, 0)
    if os.WIFSIGNALED(status):
        return Ended(None, f'died of signal {os.WTERMSIG(status)}', 0.0, 0)
    found: Ended = pickle.loads(raw)
    return found


def _work(work: Callable[[], Any], writing: int, most_bytes: int | None) -> None:
    try:
        forget_peak()
        before = resident()
        if most_bytes is not None:
            limit = address_space() + most_bytes + _SLACK
            resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        begun_s = time.perf_counter()
        value, error = None, ''
        try:
            value = work()
        except BaseException as raised:  # noqa: BLE001 - whatever it is, it is to be told
            error = f'{type(raised).__name__}: {raised}'
        ended = Ended(value, error, time.perf_counter() - begun_s, max(0, peak() - before))
        view = memoryview(pickle.dumps(ended))
        while view:
            view = view[os.write(writing, view) :]
    finally:
        os._exit(0)
