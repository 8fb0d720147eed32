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
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np

from benchmarks.load.monitor import Ears, History, Monitor
from benchmarks.load.sender import Plan, Stream
from valveflow_ros.logs import open_log
from valveflow_ros.records import SIGNALS
from valveflow_ros.signals.align import REASONS

REQUIRED = tuple(info.topic for info in SIGNALS if info.required)
_VALUES = {
    'valve_opening': 60.0, 'main_steam_pressure': 16.0, 'main_steam_temperature': 540.0,
    'generated_power': 400.0,
}  # fmt: skip
_PATIENCE_S = 180.0
_VALUE_AT = 4  # bytes before the value of a Float64
_ROOM_BYTES = 4 << 20


@dataclass(slots=True)
class Case:
    """What is tried.

    A `curve` comes from a history played before. `meanwhile` is called again and again while
    messages are sent, with the run and the seconds since. After 5 s the power jumps by `step_by`
    MW. Of a topic `slack` messages may be unaccounted for; the `lossless` ones must not lose
    anything, which is a passed limit where a socket holds less than 4 MiB and the case
    `needs_room`. `limits` are by the names of what is measured.
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


@dataclass(frozen=True, slots=True)
class Account:
    """What became of the messages of one topic.

    `sent` is by the sender; `recorded`, `repeated`, `disordered` and `missing` are by the numbers
    that the messages in the file carry; `dropped` is by the recorder's account in the file; the
    others are by the monitor's /diagnostics; `fed` readings were judged by the engine.
    """

    sent: int
    recorded: int
    repeated: int
    disordered: int
    missing: int
    received: int
    lost: int
    missed_at_start: int
    irregular: int
    unreadable: int
    dropped: int
    fed: int

    @property
    def gone(self) -> int:
        """Return what the monitor says it did not get."""
        return self.lost + self.missed_at_start

    def faults(self, topic: str, slack: int = 0) -> list[str]:
        """Return what does not add up; so many may be unaccounted for."""
        equations = (
            ('sent', self.sent, 'recorded + dropped + lost', self.kept + self.gone, slack),
            ('received', self.received, 'recorded + dropped', self.kept, 0),
            ('received', self.received, 'fed + unreadable', self.fed + self.unreadable, 0),
            ('missing in the file', self.missing, 'dropped + lost', self.dropped + self.gone,
             slack),
            ('recorded twice', self.repeated, 'none', 0, 0),
            ('recorded out of order', self.disordered, 'none', 0, 0),
        )  # fmt: skip
        return [
            f'{topic}: {left} is {a}, and {right} is {b}'
            for left, a, right, b, most in equations
            if abs(a - b) > most
        ]

    @property
    def kept(self) -> int:
        """Return what the recorder was given."""
        return self.recorded + self.dropped


def fed(ears: Ears, topic: str) -> int:
    """Return how many readings of a signal the engine has judged; late ones are accepted too."""
    kinds = (reason.replace('_', ' ') for reason in REASONS if reason != 'late')
    return sum(ears.number(f'input {topic}', f'Readings {kind} in all runs') for kind in kinds)


def account(
    ears: Ears,
    recordings: Path,
    streams: list[Stream],
    sent: Mapping[str, int],
    fed_before: Mapping[str, int],
) -> dict[str, Account]:
    """Count a run that is over; ``fed_before`` is what the engine had judged before, by topic."""
    (folder,) = (p for p in recordings.iterdir() if p.is_dir())
    log = open_log(folder)
    counters = log.metadata.get('valveflow_recorder', {})
    found = {}
    for stream in streams:
        topic = f'/{stream.topic}'
        data = b''.join(m.data[_VALUE_AT:] for m in log.iter_messages([topic]))
        numbers = stream.numbers(np.frombuffer(data, '<f8'))
        different = len(np.unique(numbers))
        item = f'input {stream.topic}'
        found[stream.topic] = Account(
            sent=sent[stream.topic],
            recorded=len(numbers),
            repeated=len(numbers) - different,
            disordered=int(np.sum(np.diff(numbers) < 0)),
            missing=sent[stream.topic] - different,
            received=ears.number(item, 'Messages received'),
            lost=ears.number(item, 'Messages lost on the way'),
            missed_at_start=ears.number(item, 'Messages sent before the first received'),
            irregular=ears.number(item, 'Messages with irregular numbers'),
            unreadable=ears.number(item, 'Messages that cannot be read')
            + ears.number(item, 'Messages without a time'),
            dropped=int(counters.get(f'dropped {topic}', 0)),
            fed=fed(ears, stream.topic) - fed_before[stream.topic],
        )
    return found


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
