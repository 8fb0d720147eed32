# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What holds of a recorder's loop, account and chunks at any speed, on a clock moved by hand."""

from __future__ import annotations

import itertools
import struct
import time
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from damage import records
from hypothesis import given, settings
from hypothesis import strategies as st
from log_files import FLOAT64, START_NS, STOCK, float64
from mcap.opcode import Opcode

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import (
    Message,
    Recorder,
    RecorderSettings,
    RecorderState,
    RecordingWriter,
    open_log,
)
from valveflow_ros.logs.mcap import recorder
from valveflow_ros.logs.mcap.recorder import (
    DROPS_SHOWN_S,
    NewTopic,
    RecorderCounters,
    RecorderLoop,
)
from valveflow_ros.logs.mcap.writer import Qos

STEP_S = 7.0


class Finished(NamedTuple):
    name: str


class Clock:
    """Stands still until it is moved."""

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now


class Writer:
    """Takes its time for everything, notes when it was called, and fails where it is told to."""

    def __init__(self, clock: Clock, folder: Path, takes_s: float = 0.0) -> None:
        self.clock, self.takes_s = clock, takes_s
        self.name, self._folder = 'log', folder
        self.calls: list[tuple[str, float]] = []
        self.bad: set[str] = set()
        self.before: Any = lambda: None
        self.path: Path | None = None
        self.written = self.waiting = self.file_bytes = 0
        self.bytes_finished = self.files_finished = 0
        self.lost = self.removed = 0
        self.loss = ''
        self.finished: list[Finished] = []
        self.noted: dict[str, Any] = {}
        self.took: list[tuple[Any, ...]] = []

    def _called(self, name: str) -> None:
        self.before()
        self.calls.append((name, self.clock.now))
        self.clock.now += self.takes_s
        if name in self.bad:
            raise RecordingError('log', f'{name} failed')

    def at(self, name: str) -> list[float]:
        return [at for called, at in self.calls if called == name]

    def add_topic(self, topic: str, type_name: str, **more: Any) -> None:
        self._called('add_topic')
        self.took.append((topic, type_name, more))

    def write(self, *message: Any) -> None:
        self._called('write')
        self.took.append(message)
        self.waiting += 1

    def flush(self) -> None:
        self._called('flush')
        if self.waiting:
            self.path = self.path or self._folder / f'log_{self.files_finished}.mcap'
            self.written, self.file_bytes = self.written + self.waiting, self.file_bytes + 100
            self.waiting = 0

    def check(self) -> None:
        """Nobody touches what is not there."""

    def check_finished(self, most_bytes: int = 0) -> bool:
        return True

    def sync(self) -> None:
        self._called('sync')

    def rotate(self) -> None:
        self._called('rotate')
        assert self.path is not None
        self.path.write_bytes(b'')
        self.finished.append(Finished(self.path.name))
        self.bytes_finished += self.file_bytes
        self.files_finished += 1
        self.path, self.file_bytes = None, 0

    def close(self) -> None:
        self._called('close')
        if self.path is not None:
            self.rotate()

    def abandon(self) -> None:
        self._called('abandon')

    def note(self, name: str, items: Any) -> None:
        self._called('note')
        self.noted[name] = dict(items)

    def forget(self, name: str) -> None:
        self._called('forget')
        self.finished.remove(Finished(name))


class Stage:
    """A loop whose thread never runs: the test is the thread."""

    def __init__(
        self, folder: Path, monkeypatch: pytest.MonkeyPatch, takes_s: float = 0.0, **given: Any
    ) -> None:
        self.clock = Clock()
        monkeypatch.setattr(recorder, 'time', self.clock)
        asked = {'free_floor_bytes': 0, 'sync_period_s': 0.0, **given}
        self.settings = RecorderSettings(**asked)
        self.counters = RecorderCounters(10**6, clock=self.clock.monotonic)
        self.writer = Writer(self.clock, folder, takes_s)
        self.free = 1 << 50
        self.made = 0

        def made(**_: Any) -> Any:
            self.made += 1
            return self.writer

        self.loop = RecorderLoop(folder, self.settings, made, self.counters, lambda _: self.free)

    def put(self, count: int = 1, topic: str = '/a') -> None:
        for _ in range(count):
            assert self.counters.admit(topic)
            self.loop.put(Message(topic, b'', 1, 1))

    def cycle(self, stopping: bool = False) -> None:
        self.loop._cycle(stopping)


# --- the loop -------------------------------------------------------------------------------


def test_each_step_of_a_cycle_is_given_a_time_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However long the steps before it took, no step begins with their time on its account."""
    stage = Stage(tmp_path, monkeypatch, STEP_S, sync_period_s=1.0, rotate_s=0.0)
    begun: list[tuple[float, float]] = []
    stage.writer.before = lambda: begun.append(
        (stage.counters.status().stalled_s, stage.clock.now)
    )
    stage.put(3)
    stage.cycle()
    names = [name for name, _ in stage.writer.calls]
    assert names == ['write', 'write', 'write', 'flush', 'sync', 'rotate']
    assert [stalled_s for stalled_s, _ in begun] == [0.0] * len(names)
    assert stage.counters.status().stalled_s == STEP_S


def test_a_leftover_may_take_as_long_as_it_is_large(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = Stage(tmp_path, monkeypatch)
    seen: list[float] = []

    def slow(_folder: Path) -> tuple[str, ...]:
        stage.clock.now += 3600.0
        seen.append(stage.counters.status().stalled_s)
        return ('report',)

    monkeypatch.setattr(recorder, 'recover_leftovers', slow)
    stage.counters.working()
    stage.put()
    stage.cycle()
    stage.cycle()
    assert seen == [0.0]
    assert stage.made == 1
    assert stage.counters.status().recovered == ('report',)
    assert stage.counters.status().stalled_s == 0.0


@pytest.mark.parametrize(('first', 'longest'), [(1.0, 10.0), (0.5, 0.5), (2.0, 1000.0)])
def test_each_failure_doubles_the_wait_up_to_the_longest_and_success_forgets_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, first: float, longest: float
) -> None:
    stage = Stage(tmp_path, monkeypatch, retry_s=first, retry_max_s=longest)
    expected = [min(first * 2**k, longest) for k in range(6)]
    for _ in range(2):
        stage.writer.bad = {'flush'}
        before = len(stage.writer.at('flush'))
        tick = 1.0 / 64.0
        while len(stage.writer.at('flush')) < before + 7:
            stage.cycle()
            assert stage.counters.status().reason == 'log: flush failed.'
            stage.clock.now += tick
        tries = stage.writer.at('flush')[before:]
        gaps = [b - a for a, b in itertools.pairwise(tries)]
        assert gaps == expected
        stage.writer.bad = set()
        stage.clock.now += longest
        stage.cycle()
        assert stage.counters.status().state == RecorderState.RECORDING
        stage.clock.now += tick
        stage.cycle()
        assert len(stage.writer.at('flush')) == before + 9


def test_the_last_cycle_waits_for_no_retry(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = Stage(tmp_path, monkeypatch)
    stage.writer.bad = {'flush'}
    stage.cycle()
    stage.put()
    stage.writer.bad = set()
    stage.cycle()
    assert stage.counters.status().queued == 1
    stage.cycle(stopping=True)
    assert (stage.counters.status().queued, stage.counters.status().written) == (0, 1)


@given(
    st.lists(st.sampled_from([0.0, 0.5, 1.0, 3.0]), max_size=40),
    st.sampled_from([0.0, 1.0, 2.5]),
    st.floats(1.0, 5.0),
)
@settings(max_examples=40)
def test_the_disk_is_asked_as_often_as_the_period_says_and_never_without_one(
    waits: list[float], period: float, takes: float
) -> None:
    """The slow truth asks at each cycle whether the last time is a period ago."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        stage = Stage(Path('/nowhere'), monkeypatch, sync_period_s=period)
        monkeypatch.setattr(recorder, 'recover_leftovers', lambda _: ())
        last, expected = 0.0, []
        for wait in waits:
            if period > 0 and stage.clock.now - last >= period:
                last = stage.clock.now
                expected.append(last)
            stage.cycle()
            stage.clock.now += wait
        assert stage.writer.at('sync') == expected


def test_a_file_that_somebody_else_removed_first_is_as_good_as_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = Stage(tmp_path, monkeypatch, rotate_s=0.0, keep_files=1)
    stage.put()
    stage.cycle()
    (tmp_path / 'log_0.mcap').unlink()
    stage.put()
    stage.cycle()
    assert stage.counters.status().reason == ''
    assert [s.name for s in stage.writer.finished] == ['log_1.mcap']


def test_a_latched_message_is_a_repetition_only_once_it_is_on_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = Stage(tmp_path, monkeypatch)
    stage.loop.put(NewTopic('/curve', FLOAT64, (Qos(),), 'hash', 'float64 data', True))
    stage.put(2)
    stage.put(2, '/curve')
    stage.writer.bad = {'flush'}
    stage.cycle()
    assert stage.loop.latched() == []
    stage.writer.bad = set()
    stage.clock.now += 1.0
    stage.cycle()
    assert [m.topic for m in stage.loop.latched()] == ['/curve']
    topic, _, more = stage.writer.took[0]
    assert (topic, more['type_hash'], more['definition']) == ('/curve', 'hash', 'float64 data')
    assert more['qos'] == (Qos(),)


@pytest.mark.parametrize('bad', ['', 'note', 'close'])
def test_at_the_end_the_account_stands_in_the_file_and_a_failure_lets_go_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bad: str
) -> None:
    stage = Stage(tmp_path, monkeypatch)
    stage.put(3)
    stage.loop._stopping = True
    stage.writer.bad = {bad}
    stage.loop._run()
    status = stage.counters.status()
    assert status.state == RecorderState.STOPPED
    assert status.reason == (f'log: {bad} failed.' if bad else '')
    assert (status.written, status.lost, status.file) == (3, 0, '')
    assert bool(stage.writer.at('abandon')) == bool(bad)
    assert (status.files_finished, status.bytes_written) == ((0, 100) if bad else (1, 100))
    if bad != 'note':
        assert stage.writer.noted == {'valveflow_recorder': {'received': '3'}}


def test_what_never_began_says_that_nothing_could_be_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_folder: Path) -> tuple[()]:
        raise RecordingError('log', 'cannot be read')

    monkeypatch.setattr(recorder, 'recover_leftovers', broken)
    stage = Stage(tmp_path, monkeypatch)
    stage.put()
    stage.loop._stopping = True
    stage.loop._run()
    status = stage.counters.status()
    assert (status.reason, status.lost) == ('nothing could be recorded', 1)
    assert status.stalled_s == 0.0


# --- the account ----------------------------------------------------------------------------

acts = st.lists(
    st.one_of(
        st.tuples(st.just('admit'), st.sampled_from(['/a', '/b'])),
        st.tuples(st.just('write'), st.integers(0, 5)),
        st.tuples(st.sampled_from(['well', 'ill', 'work', 'rest', 'refuse', 'stop'])),
        st.tuples(st.just('wait'), st.sampled_from([0.25, 1.0, DROPS_SHOWN_S, 10.0])),
    ),
    max_size=60,
)


@given(acts, st.integers(0, 6))
@settings(max_examples=60)
def test_every_message_is_in_exactly_one_column_whatever_happens(
    story: list[tuple[Any, ...]], limit: int
) -> None:
    """The slow truth keeps every message as one entry of a list."""
    clock = Clock()
    counters = RecorderCounters(limit, clock=clock.monotonic)
    messages: list[str] = []
    open_, since, dropped_at, state = True, None, -1e9, ('recording', '')
    for act, *more in story:
        queued = [k for k, where in enumerate(messages) if where == 'queued']
        drops = sum(where.startswith('/') for where in messages)
        if act == 'admit':
            taken = open_ and len(queued) < limit
            assert counters.admit(more[0]) == taken
            messages.append('queued' if taken else more[0])
            dropped_at = dropped_at if taken else clock.now
        elif act == 'write':
            for k in queued[: more[0]]:
                messages[k] = 'written'
            writer = Writer(clock, Path())
            writer.written = messages.count('written')
            counters.on_disk(writer)
        elif act == 'well':
            counters.healthy()
            lately = clock.now - dropped_at < DROPS_SHOWN_S
            why = f'{drops} messages were dropped, too many were waiting'
            state = ('degraded', why) if lately else ('recording', '')
        elif act == 'ill':
            counters.failing('why')
            state = ('degraded', 'why')
        elif act == 'work':
            counters.working()
            since = clock.now
        elif act == 'rest':
            counters.resting()
            since = None
        elif act == 'refuse':
            counters.refuse()
            open_ = False
        elif act == 'stop':
            counters.stopped('ended')
            open_, since, state = False, None, ('stopped', 'ended')
            messages = ['lost' if where == 'queued' else where for where in messages]
        else:
            clock.now += more[0]
        status = counters.status()
        count = Counter(messages)
        assert status.received == len(messages)
        assert (status.written, status.queued) == (count['written'], count['queued'])
        assert status.lost == count['lost']
        assert status.dropped == {t: n for t, n in count.items() if t.startswith('/')}
        assert (status.state.value, status.reason) == state
        assert status.stalled_s == (0.0 if since is None else clock.now - since)
    told = counters.as_metadata()
    assert told.pop('received') == str(len(messages))
    assert told == {f'dropped {t}': str(n) for t, n in counters.status().dropped.items()}


# --- chunks ---------------------------------------------------------------------------------

times_ns = st.integers(0, 2**63 - 1)
rows = st.lists(
    st.tuples(
        st.integers(0, 65535), st.integers(0, 2**34), times_ns, times_ns, st.binary(max_size=40)
    ),
    max_size=20,
)


@pytest.mark.parametrize('size', [1, 1000, 70_000])
def test_a_chunk_is_closed_by_the_message_that_fills_64_kib(tmp_path: Path, size: int) -> None:
    """So much and no more is lost with a chunk, and so much is compressed at once."""
    with RecordingWriter(tmp_path / 'log', definitions=STOCK) as writer:
        writer.add_topic('/a', FLOAT64)
        for k in range(250_000 // (31 + size)):
            writer.write('/a', bytes(size), START_NS + k, START_NS + k)
    raw = (tmp_path / 'log' / 'log_0.mcap').read_bytes()
    heads = [begin for op, begin, _ in records(raw) if op == Opcode.CHUNK]
    sizes = [struct.unpack_from('<Q', raw, begin + 9 + 16)[0] for begin in heads]
    assert len(sizes) > 2
    # The tables of topics stand in some of them, too; they are small.
    assert all(65536 <= n < 65536 + 31 + size + 2000 for n in sizes[:-1])


# --- the whole ------------------------------------------------------------------------------


def test_only_what_was_asked_for_is_repeated_and_a_hash_is_made_where_none_is_given(
    tmp_path: Path,
) -> None:
    quick = RecorderSettings(flush_period_s=0.002, free_floor_bytes=0)
    folder = tmp_path / 'deep' / 'log'
    recorder = Recorder(folder, quick, definitions=STOCK, name='mine', metadata={'m': {'a': 'b'}})
    recorder.add_topic('/a', FLOAT64)
    recorder.add_topic('/own', 'x_msgs/msg/Own', definition='float64 data\n')
    # Again changes nothing, whatever else is said.
    other = {'definition': 'nonsense[', 'latched': True, 'type_hash': 'RIHS01_' + '0' * 64}
    recorder.add_topic('/own', 'x_msgs/msg/Own', **other)
    for part in range(2):
        for topic in ('/a', '/own'):
            assert recorder.record(topic, float64(part), START_NS + part, START_NS) is True
        recorder.rotate()
        end_s = time.monotonic() + 20.0
        while recorder.is_rotating and time.monotonic() < end_s:
            time.sleep(0.001)
    status = recorder.close(20.0)
    assert (status.state, status.written) == (RecorderState.STOPPED, 4)
    assert recorder.record('/a', float64(0), START_NS, START_NS) is False
    found = open_log(folder)
    assert [m.topic for m in found.iter_messages()] == ['/a', '/own'] * 2
    # The second split alone: nothing of the first stands at its head.
    second = list(open_log(folder / 'mine_1.mcap').iter_messages())
    assert [(m.topic, m.data) for m in second] == [(t, float64(1)) for t in ('/a', '/own')]
    assert all(info.type_hash.startswith('RIHS01_') for info in found.topics.values())
    assert found.topics['/a'].type_hash != found.topics['/own'].type_hash
    assert found.topics['/own'].definition == 'float64 data\n'
    assert '0' * 64 not in found.topics['/own'].type_hash
    assert found.metadata['m'] == {'a': 'b'}
    assert all(p.name.startswith('mine_') for p in folder.glob('*.mcap'))
    assert folder.stat().st_mode & 0o777 == 0o700
    assert recorder.folder == folder
