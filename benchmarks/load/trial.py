# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""One run: a monitor, senders, something that happens meanwhile, and the account of it."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from benchmarks.load.counting import Account, account, fed
from benchmarks.load.monitor import Ears, History, Monitor
from benchmarks.load.sender import Plan, Stream
from valveflow_ros.records import SIGNALS

REQUIRED = tuple(info.topic for info in SIGNALS if info.required)
_VALUES = {
    'valve_opening': 60.0, 'main_steam_pressure': 16.0, 'main_steam_temperature': 540.0,
    'generated_power': 400.0,
}  # fmt: skip
_PATIENCE_S = 180.0
_ROOM_BYTES = 4 << 20


@dataclass(slots=True)
class Case:
    """What is tried.

    Attributes
    ----------
    name, what : str
    rates_hz : dict
        By topic.
    seconds : float
    curve : bool
        Whether there is a curve, from a history played before.
    reliable : bool
    parameters : dict
        Of the monitor, besides those of every run.
    meanwhile : callable, optional
        Called again and again while messages are sent, with the run and the seconds since.
    step_by : float
        The power jumps by so much after 5 s, MW.
    slack : int
        Messages of a topic that may be unaccounted for.
    lossless : tuple of str
        Topics that must not lose anything.
    needs_room : bool
        Nothing can be lost only where a socket may hold 4 MiB; elsewhere a loss is a passed limit.
    limits : dict
        By the names of what is measured.
    """

    name: str
    what: str
    rates_hz: dict[str, float]
    seconds: float
    curve: bool = False
    reliable: bool = False
    parameters: dict[str, object] = field(default_factory=dict)
    meanwhile: Callable[[Run, float], None] | None = None
    step_by: float = 0.0
    slack: int = 0
    lossless: tuple[str, ...] = REQUIRED
    needs_room: bool = False
    limits: dict[str, float] = field(default_factory=dict)


class Sender:
    """A sender's process, whose lines are read from a thread."""

    def __init__(self, plan: Plan) -> None:
        self._process = subprocess.Popen(
            [sys.executable, '-m', 'benchmarks.load.sender', plan.text()],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        self._lines: SimpleQueue[str] = SimpleQueue()
        threading.Thread(target=self._read, daemon=True).start()
        self.result: dict[str, Any] = {}

    def line(
        self, ears: Ears, meanwhile: Callable[[], None] = lambda: None, busy_s: float = 0.0
    ) -> str:
        """Return its next line, doing something until it comes; it may be busy for so long."""
        end_s = time.monotonic() + busy_s + _PATIENCE_S
        while time.monotonic() < end_s:
            try:
                return self._lines.get_nowait()
            except Empty:
                if self._process.poll():
                    break
                ears.spin(0.05)
                meanwhile()
        raise TimeoutError('a sender of the benchmark has said nothing')

    def go_on(self) -> None:
        """Let it take its next step."""
        assert self._process.stdin is not None
        self._process.stdin.write('\n')
        self._process.stdin.flush()

    def kill(self) -> None:
        """End it if it still runs."""
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._lines.put(line.strip())


class Run:
    """A case while it runs: what `meanwhile` may use, and what is measured."""

    def __init__(self, case: Case, folder: Path) -> None:
        self.case = case
        self.ears = Ears()
        given = {'refit_period': 0.0, 'refit_segments': 0, **case.parameters}
        if case.reliable:
            given['input_reliability'] = 'reliable'
        self.monitor = Monitor(folder, given)
        self.measured: dict[str, Any] = {}
        self.notes: dict[str, Any] = {}
        self.most_mib = 0.0
        self._senders: list[Sender] = []

    def go(self) -> dict[str, Account]:
        """Run it; return the account by topics."""
        try:
            return self._go()
        finally:
            for sender in self._senders:
                sender.kill()
            self.monitor.kill()
            self.ears.close()

    def _go(self) -> dict[str, Account]:
        ears, history = self.ears, None
        if self.case.curve:
            history = History(ears)
            history.play()
        else:
            ears.until(lambda: ears.looks >= 2, 'the health')
        streams = self._streams(history)
        self._senders = [Sender(p) for p in self._plans(streams)]
        for sender in self._senders:
            assert sender.line(ears) == 'ready'
        if history is not None:
            history.hold()
            ears.rest(lambda: ears.number('fit', 'Samples taken in all runs'), 1)
        before = {s.topic: fed(ears, s.topic) for s in streams}
        self._send()
        ears.rest(lambda: [ears.values(f'input {s.topic}').get('Messages received') for s in
                           streams])  # fmt: skip
        sent = {}
        for sender in self._senders:
            sent.update(sender.result['sent'])
            sender.go_on()
        self._watched(self.monitor.end())
        return account(ears, self.monitor.recordings, streams, sent, before)

    def _streams(self, history: History | None) -> list[Stream]:
        values = dict(_VALUES)
        if history is not None:
            values = {i.topic: float(history.last[i.signal]) for i in SIGNALS if i.required}
        rates = self.case.rates_hz
        step = {'generated_power': self.case.step_by}
        return [Stream(t, rates[t], values[t], 5.0, step.get(t, 0.0)) for t in rates]

    def _plans(self, streams: list[Stream]) -> Iterable[Plan]:
        """Yield a plan for each sender: whoever sends much more than others has one of its own."""
        least = min(s.rate_hz for s in streams)
        calm = [s for s in streams if s.rate_hz <= 10 * least]
        for together in (calm, [s for s in streams if s not in calm]):
            if together:
                yield Plan(self.case.seconds, self.case.reliable, together)

    def _send(self) -> None:
        """Let them send, with what happens meanwhile, and measure."""
        monitor, ears = self.monitor, self.ears
        ears.alarm_delays_s()
        monitor.clear()
        used_s, begun_s = monitor.used_s(), time.monotonic()
        self.most_mib = memory_mib = monitor.memory_mib()
        for sender in self._senders:
            sender.go_on()

        def meanwhile() -> None:
            self.most_mib = max(self.most_mib, monitor.memory_mib())
            if self.case.meanwhile is not None:
                self.case.meanwhile(self, time.monotonic() - begun_s)

        for sender in self._senders:
            assert sender.line(ears, meanwhile, self.case.seconds) == 'sent'
        took_s = time.monotonic() - begun_s
        self.measured['cpu_percent'] = 100.0 * (monitor.used_s() - used_s) / took_s
        for sender in self._senders:
            sender.result = json.loads(sender.line(ears, meanwhile))
        self.most_mib = max(self.most_mib, monitor.memory_mib())
        self.measured['memory_mib'] = self.most_mib
        self.measured['memory_growth_mib'] = self.most_mib - memory_mib
        self.measured['send_s'] = max(s.result['took_s'] for s in self._senders)
        self.measured['load_average'] = os.getloadavg()[0]

    def _watched(self, watch: dict[str, Any]) -> None:
        """Take what the stop-watch saw on the topics that must not lose anything."""
        topics = watch['topics']
        late = [topics[t] for t in self.case.lossless or tuple(self.case.rates_hz) if t in topics]
        for name in ('p50', 'p99', 'max'):
            self.measured[f'latency_{name}_ms'] = max(one[name] for one in late)
        self.measured['longest_pause_ms'] = watch['longest_pause_ms']


def _room_bytes() -> int:
    """Return how much a socket may hold on this machine."""
    try:
        return int(Path('/proc/sys/net/core/rmem_max').read_text())
    except (OSError, ValueError):
        return 0


def result_of(case: Case, folder: Path) -> dict[str, Any]:
    """Run a case; return its account, what was measured, and what is wrong with it."""
    run = Run(case, folder)
    accounts = run.go()
    faults = [f for topic, a in accounts.items() for f in a.faults(topic, case.slack)]
    over = [
        f'{name} is {run.measured.get(name, math.inf):.1f}, the limit is {limit:g}'
        for name, limit in case.limits.items()
        if not run.measured.get(name, math.inf) <= limit
    ]
    lost = {t: accounts[t].gone + accounts[t].dropped for t in case.lossless}
    wrong = [f'{t}: {n} messages are lost, and none may be' for t, n in lost.items() if n]
    (over if case.needs_room and _room_bytes() < _ROOM_BYTES else faults).extend(wrong)
    return {
        'case': case.name, 'what': case.what, 'reliable': case.reliable, 'seconds': case.seconds,
        'rates_hz': case.rates_hz, 'accounts': {t: asdict(a) for t, a in accounts.items()},
        'measured': {k: round(v, 3) for k, v in run.measured.items()}, 'notes': run.notes,
        'limits': case.limits, 'faults': faults, 'over_limits': over,
    }  # fmt: skip
