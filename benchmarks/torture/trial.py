# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a trial is told, what it brings, and work in a child that may cost so much and no more."""

from __future__ import annotations

import json
import os
import pickle
import resource
import select
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

RESULTS = Path(__file__).resolve().parents[1] / 'results'
SHOWN = 20
MIB = 1 << 20
# Room beyond the promise, for the interpreter and its report.
_SLACK = 16 * MIB


@dataclass(frozen=True, slots=True)
class Options:
    """How much is tried, and from which random numbers.

    Attributes
    ----------
    scale : float
        1 is the full trial, 0.1 a tenth of it.
    seed : int
        Every random number of a trial follows from it.
    folder : Path
        Scratch, removed afterwards.
    minutes : float
        How long a trial goes on that has no end of its own.
    """

    scale: float
    seed: int
    folder: Path
    minutes: float = 1.0

    def many(self, count: int, least: int = 1) -> int:
        """Return a count of the full trial at this scale."""
        return max(least, round(count * self.scale))

    @property
    def step(self) -> int:
        """Return 1 for everything, more for every so many-th."""
        return max(1, round(1 / self.scale))


@dataclass(slots=True)
class Outcome:
    """What a trial brought.

    Attributes
    ----------
    counts : dict
        What does not depend on the machine.
    measured : dict
        Times and memory, which do.
    failures : list of str
        Sentences, the first few of them; `failed` counts all.
    missed : list of str
        Times that were wished for and not kept. They depend on the machine, so no trial fails by
        them, but they are told.
    """

    counts: dict[str, Any] = field(default_factory=dict)
    measured: dict[str, Any] = field(default_factory=dict)
    failures: list[str] = field(default_factory=list)
    failed: int = 0
    missed: list[str] = field(default_factory=list)
    sentence: str = ''

    def expect(self, holds: bool, sentence: str) -> None:
        """Note a failure unless ``holds``."""
        if not holds:
            self.failed += 1
            if len(self.failures) < SHOWN:
                self.failures.append(sentence)

    @contextmanager
    def surprises(self, what: str) -> Iterator[None]:
        """Note a failure for whatever a program of others raises."""
        try:
            yield
        except Exception as error:  # noqa: BLE001 - that is what is looked for
            self.expect(False, f'{what}: {type(error).__name__}: {error}')

    def wish(self, holds: bool, sentence: str) -> None:
        """Note a time that was not kept unless ``holds``."""
        if not holds:
            self.missed.append(sentence)

    def count(self, name: str, by: int = 1) -> None:
        """Add to a count."""
        self.counts[name] = self.counts.get(name, 0) + by

    def worst(self, name: str, value: float) -> None:
        """Keep the largest of a measured number."""
        self.measured[name] = max(self.measured.get(name, value), value)

    def write(self, name: str, options: Options, seconds: float, to: Path) -> None:
        """Write this beside the other results."""
        command = f'python -m benchmarks.torture --only {name} --scale {options.scale:g}'
        minutes = f' --minutes {options.minutes:g}' if options.minutes != 1 else ''
        content = {
            'command': f'{command} --seed {options.seed}{minutes}', 'trial': name,
            'scale': options.scale, 'seed': options.seed, 'passed': not self.failed,
            'failed': self.failed, 'failures': self.failures, 'missed': self.missed,
            'counts': self.counts, 'measured': {**self.measured, 'seconds': round(seconds, 1)},
            'sentence': self.sentence,
        }  # fmt: skip
        text = json.dumps(content, indent=1) + '\n'
        (to / f'torture_{name}.json').write_text(text, 'utf-8')


def memory(name: str) -> int:
    """Return bytes of this process: VmRSS held, VmHWM held at most, VmSize of address space."""
    lines = Path('/proc/self/status').read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(f'{name}:'))


class Ended(NamedTuple):
    """How work ended: its value, or the exception or signal that ended it; what it cost.

    ``bytes`` is the most resident memory above what the process began with.
    """

    value: Any
    error: str = ''
    seconds: float = 0.0
    bytes: int = 0


def run_bounded(
    work: Callable[[], Any], patience_s: float, most_bytes: int | None = None
) -> Ended:
    """Run ``work``, whose result is picklable, in a fork of this process.

    After ``patience_s`` the child is killed. It may take ``most_bytes`` of address space more.
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
            part = os.read(reading, MIB)
            raw, done = raw + part, not part
    os.close(reading)
    if not done:
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    if not done:
        return Ended(None, f'took more than {patience_s:g} s', patience_s)
    if os.WIFSIGNALED(status):
        return Ended(None, f'died of signal {os.WTERMSIG(status)}')
    return Ended(*pickle.loads(raw))


def _work(work: Callable[[], Any], writing: int, most_bytes: int | None) -> None:
    try:
        Path('/proc/self/clear_refs').write_text('5')  # lets the peak begin anew
        before = memory('VmRSS')
        if most_bytes is not None:
            limit = memory('VmSize') + most_bytes + _SLACK
            resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        begun_s = time.perf_counter()
        value, error = None, ''
        try:
            value = work()
        except BaseException as raised:  # noqa: BLE001 - whatever it is, it is to be told
            error = f'{type(raised).__name__}: {raised}'
        seconds = time.perf_counter() - begun_s
        ended = value, error, seconds, max(0, memory('VmHWM') - before)
        with os.fdopen(writing, 'wb') as stream:
            pickle.dump(ended, stream)
    finally:
        os._exit(0)
