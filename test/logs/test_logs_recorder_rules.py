# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What holds of a recorder's loop, account and chunks at any speed, on a clock moved by hand."""

import itertools
import threading
from collections import Counter
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from log_files import FLOAT64, STOCK

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import RecorderSettings, RecorderState, RecordingWriter, open_log
from valveflow_ros.logs.mcap import recorder
from valveflow_ros.logs.mcap.recorder import DROPS_SHOWN_S, RecorderCounters

STEP_S = 7.0


class Clock:
    """Stands still until it is moved."""

    def __init__(self):
        self.now = 1000.0

    def monotonic(self):
        return self.now


class Writer(RecordingWriter):
    """Notes when it was called, takes its time, and fails where it is told to."""

    def __init__(self, clock, folder, takes_s=0.0):
        super().__init__(folder, name='log', definitions=STOCK)
        super().add_topic('/a', FLOAT64)
        self.clock, self.takes_s, self.inside = clock, takes_s, False
        self.calls = []
        self.bad = set()
        self.before = lambda: None
        for name in ('write', 'flush', 'sync', 'rotate', 'close', 'note', 'abandon'):
            setattr(self, name, self._noting(name, getattr(self, name)))

    def _noting(self, name, real):
        def noting(*given):
            if self.inside:
                return real(*given)
            self.before()
            self.calls.append((name, self.clock.now))
            self.clock.now += self.takes_s
            if name in self.bad:
                raise RecordingError('log', f'{name} failed')
            self.inside = True
            try:
                return real(*given)
            finally:
                self.inside = False

        return noting

    def at(self, name):
        return [at for called, at in self.calls if called == name]


class Stage:
    """A recorder whose thread never runs: the test is the thread."""

    def __init__(self, folder, monkeypatch, takes_s=0.0, **given):
        self.folder, self.clock = folder, Clock()
        monkeypatch.setattr(recorder, 'time', self.clock)
        monkeypatch.setattr(threading.Thread, 'start', lambda _: None)
        asked = {'free_floor_bytes': 0, 'sync_period_s': 0.0, **given}
        self.recorder = recorder.Recorder(
            folder, RecorderSettings(**asked), definitions=STOCK, free_bytes=lambda _: 1 << 50
        )
        self.counters = RecorderCounters(10**6, clock=self.clock.monotonic)
        self.recorder._counters = self.counters
        self.recorder.add_topic('/a', FLOAT64)
        self.writer = Writer(self.clock, folder, takes_s)
        self.made = 0

        def made():
            self.made += 1
            return self.writer

        self.recorder._make_writer = made

    def put(self, count=1, topic='/a'):
        for _ in range(count):
            assert self.recorder.record(topic, b'', 1, 1)

    def cycle(self, stopping=False):
        self.recorder._cycle(stopping)

    def run_to_the_end(self):
        self.recorder._stopping = True
        self.recorder._run()


@pytest.fixture
def stage_of(tmp_path, monkeypatch):
    return lambda **given: Stage(tmp_path, monkeypatch, **given)


# --- the loop -------------------------------------------------------------------------------


def test_each_step_of_a_cycle_is_given_a_time_of_its_own(stage_of):
    """However long the steps before it took, no step begins with their time on its account."""
    stage = stage_of(takes_s=STEP_S, sync_period_s=1.0, rotate_s=0.0)
    begun = []
    stage.writer.before = lambda: begun.append(
        (stage.counters.status().stalled_s, stage.clock.now)
    )
    stage.put(3)
    stage.cycle()
    names = [name for name, _ in stage.writer.calls]
    assert names == ['write', 'write', 'write', 'flush', 'sync', 'rotate']
    assert [stalled_s for stalled_s, _ in begun] == [0.0] * len(names)
    assert stage.counters.status().stalled_s == STEP_S


def test_a_leftover_may_take_as_long_as_it_is_large(stage_of, monkeypatch):
    stage = stage_of()
    seen = []

    def slow(_folder):
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
    stage_of, first, longest
):
    stage = stage_of(retry_s=first, retry_max_s=longest)
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


def test_the_last_cycle_waits_for_no_retry(stage_of):
    stage = stage_of()
    stage.writer.bad = {'flush'}
    stage.cycle()
    stage.put()
    stage.writer.bad = set()
    stage.cycle()
    assert stage.counters.status().queued == 1
    stage.cycle(stopping=True)
    assert (stage.counters.status().queued, stage.counters.status().written) == (0, 1)


@given(
    st.lists(st.sampled_from([0.0, 0.5, 1.0, 3.0]), max_size=40), st.sampled_from([0.0, 1.0, 2.5])
)
@settings(max_examples=40)
def test_the_disk_is_asked_as_often_as_the_period_says_and_never_without_one(
    tmp_path_factory, waits, period
):
    """The slow truth asks at each cycle whether the last time is a period ago."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        folder = tmp_path_factory.mktemp('log')
        stage = Stage(folder, monkeypatch, sync_period_s=period)
        last, expected = 0.0, []
        for wait in waits:
            if period > 0 and stage.clock.now - last >= period:
                last = stage.clock.now
                expected.append(last)
            stage.cycle()
            stage.clock.now += wait
        assert stage.writer.at('sync') == expected


def test_a_file_that_somebody_else_removed_first_is_as_good_as_removed(stage_of):
    stage = stage_of(rotate_s=0.0, keep_files=1)
    stage.put()
    stage.cycle()
    (stage.folder / 'log_0.mcap').unlink()
    stage.put()
    stage.cycle()
    assert stage.counters.status().reason == ''
    assert [s.name for s in stage.writer.finished] == ['log_1.mcap']


def test_a_latched_message_is_a_repetition_only_once_it_is_on_disk(stage_of):
    stage = stage_of()
    stage.recorder.add_topic('/curve', FLOAT64, latched=True)
    stage.put(2)
    stage.put(2, '/curve')
    stage.writer.bad = {'flush'}
    stage.cycle()
    assert not stage.recorder._latched
    stage.writer.bad = set()
    stage.clock.now += 1.0
    stage.cycle()
    assert list(stage.recorder._latched) == ['/curve']


@pytest.mark.parametrize('bad', ['', 'note', 'close'])
def test_at_the_end_the_account_stands_in_the_file_and_a_failure_lets_go_of_it(stage_of, bad):
    stage = stage_of()
    stage.put(3)
    stage.writer.bad = {bad}
    stage.run_to_the_end()
    status = stage.counters.status()
    assert status.state == RecorderState.STOPPED
    assert status.reason == (f'log: {bad} failed.' if bad else '')
    assert (status.written, status.lost, status.file) == (3, 0, '')
    assert bool(stage.writer.at('abandon')) == bool(bad)
    assert status.files_finished == (0 if bad else 1)
    (file,) = stage.folder.glob('log_0.mcap*')
    assert bad or status.bytes_written == file.stat().st_size
    if bad != 'note':
        assert open_log(file).metadata['valveflow_recorder'] == {'received': '3'}


def test_what_never_began_says_that_nothing_could_be_recorded(stage_of, monkeypatch):
    def broken(_folder):
        raise RecordingError('log', 'cannot be read')

    monkeypatch.setattr(recorder, 'recover_leftovers', broken)
    stage = stage_of()
    stage.put()
    stage.run_to_the_end()
    status = stage.counters.status()
    assert (status.reason, status.lost) == ('nothing could be recorded', 1)
    assert status.stalled_s == 0.0


# --- the account ----------------------------------------------------------------------------

NOTHING = dict.fromkeys(('lost', 'removed', 'files_finished', 'bytes_finished', 'file_bytes'), 0)
NOTHING |= {'loss': '', 'path': None}
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
def test_every_message_is_in_exactly_one_column_whatever_happens(story, limit):
    """The slow truth keeps every message as one entry of a list."""
    clock = Clock()
    counters = RecorderCounters(limit, clock=clock.monotonic)
    messages = []
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
            written = messages.count('written')
            counters.on_disk(SimpleNamespace(**NOTHING | {'written': written}))
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
