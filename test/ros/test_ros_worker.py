# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import time
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import hurt_jobs
import psutil
import pytest
from ros_helpers import wait_until

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.errors import DataError
from valveflow_ros.fit.fit import fit
from valveflow_ros.fit.task import FitTask
from valveflow_ros.monitoring.events import DiagnosisTask
from valveflow_ros.parameters import Settings
from valveflow_ros.ros.node import worker as worker_module
from valveflow_ros.ros.node.engine import example_curve, example_task
from valveflow_ros.ros.node.worker import (
    FIT_JOB,
    FitWorker,
    WorkerResult,
    result_from_bytes,
    result_to_bytes,
    task_from_bytes,
    task_to_bytes,
)
from valveflow_ros.segments.window import NO_ROWS
from valveflow_ros.signals.static_form import OPENING, StaticForm
from valveflow_ros.state import to_bytes

pytestmark = pytest.mark.usefixtures('jobs_on_path')
TASK = example_task(Settings())
DIAGNOSIS = DiagnosisTask(5, TASK.contents, Settings(), example_curve(Settings()).with_id(), 6)


@contextmanager
def worker(job: str, timeout_s: float = 120.0) -> Iterator[FitWorker]:
    made = FitWorker(timeout_s, job if ':' in job else f'hurt_jobs:{job}')
    made.start()
    try:
        yield made
    finally:
        made.close()


def outcome_of(made: FitWorker) -> WorkerResult:
    made.submit(TASK)
    (outcome,) = wait_until(made.poll, 'the outcome')
    assert outcome.request_ns == TASK.request_ns
    assert outcome.seconds >= 0.0
    return outcome


def test_gives_what_a_fit_in_place_gives_bit_for_bit() -> None:
    with worker(FIT_JOB) as made:
        result = outcome_of(made).result
    assert isinstance(result, Characteristic)
    # NaN is equal to itself here, and to the last bit.
    assert repr(result) == repr(fit(TASK))


@pytest.fixture(scope='module')
def told_worker() -> Iterator[FitWorker]:
    before = os.environ.get('PYTHONPATH', '')
    os.environ['PYTHONPATH'] = f'{Path(__file__).parent}{os.pathsep}{before}'
    try:
        with worker('told') as made:
            yield made
    finally:
        os.environ['PYTHONPATH'] = before


@pytest.mark.parametrize(
    ('job', 'words'),
    [
        ('raises', 'failed unexpectedly: a fault (ZeroDivisionError, hurt_jobs.py, line'),
        ('refuses', 'There is no curve in these data.'),
        ('greedy', 'more memory than there is'),
        ('nothing', 'gave no curve'),
        ('nan', 'a curve that cannot be'),
        ('backwards', 'a curve that cannot be'),
        ('of_other_data', 'other data'),
        ('renamed', 'its own name'),
    ],
)
def test_a_bad_result_is_a_sentence_and_the_process_lives_on(
    told_worker: FitWorker, job: str, words: str
) -> None:
    pid = told_worker.pid
    number = [work.__name__ for work in hurt_jobs.ALL].index(job)
    told_worker.submit(replace(TASK, request_ns=number))
    (outcome,) = wait_until(told_worker.poll, 'the outcome')
    assert outcome.request_ns == number
    assert isinstance(outcome.result, str)
    assert words in outcome.result
    assert outcome.result.endswith('.')
    assert told_worker.pid == pid
    assert told_worker.failures_in_a_row == 0


def test_what_a_job_prints_does_not_get_between_the_results(told_worker: FitWorker) -> None:
    prints = hurt_jobs.ALL.index(hurt_jobs.prints)
    told_worker.submit(replace(TASK, request_ns=prints))
    (outcome,) = wait_until(told_worker.poll, 'the outcome')
    assert isinstance(outcome.result, Characteristic)


def test_a_killed_process_is_seen_and_replaced() -> None:
    with worker('good') as made:
        outcome_of(made)
        assert made.pid is not None
        os.kill(made.pid, signal.SIGKILL)
        begun = time.monotonic()
        wait_until(lambda: made.poll() or made.failures_in_a_row, 'the loss', 5.0)
        assert time.monotonic() - begun < 2.0
        assert isinstance(outcome_of(made).result, Characteristic)
        assert made.starts == 2
        assert made.failures_in_a_row == 0


def test_death_during_a_fit_is_its_outcome_and_the_pauses_grow() -> None:
    now = [0.0]
    made = FitWorker(120.0, 'hurt_jobs:dies', clock=lambda: now[0])
    made.start()
    try:
        pauses = []
        for _ in range(4):
            result = outcome_of(made).result
            assert isinstance(result, str)
            assert 'ended unexpectedly (signal SIGKILL)' in result
            assert made.pid is None
            begun = now[0]
            while made.pid is None:
                made.poll()
                now[0] += 0.01
            pauses.append(now[0] - begun)
        assert pauses == pytest.approx([0.5, 1.0, 2.0, 4.0], abs=0.03)
        assert made.failures_in_a_row == 4
    finally:
        made.close()


def test_a_process_that_cannot_start_costs_no_busy_restarts() -> None:
    now = [0.0]
    made = FitWorker(120.0, 'no_such_module:job', clock=lambda: now[0])
    made.start()
    try:
        for _ in range(3):
            wait_until(lambda: made.poll() or made.pid is None, 'the end of the process')
            for _ in range(100):
                made.poll()
            now[0] += 100.0
            made.poll()
        assert made.starts == 4
    finally:
        made.close()


@pytest.mark.parametrize('stopped', [False, True])
def test_a_hanging_fit_is_ended(stopped: bool) -> None:
    with worker('hangs', timeout_s=1.0) as made:
        made.submit(TASK)
        assert made.pid is not None
        pid = made.pid
        if stopped:
            os.kill(pid, signal.SIGSTOP)
        (outcome,) = wait_until(made.poll, 'the outcome')
        assert isinstance(outcome.result, str)
        assert 'longer than 1 s' in outcome.result
        assert 1.0 <= outcome.seconds < 5.0
        assert not psutil.pid_exists(pid)


def test_submitting_never_blocks_even_if_nobody_reads() -> None:
    with worker('good') as made:
        outcome_of(made)
        assert made.pid is not None
        os.kill(made.pid, signal.SIGSTOP)
        large = example_task(Settings())
        for name in ('u', 'power_mw', 'temperature_degc'):
            # 24 MB of data: far more than a pipe holds.
            object.__setattr__(large.contents, name, getattr(large.contents, name).repeat(170))
        begun = time.monotonic()
        made.submit(large)
        made.poll()
        assert time.monotonic() - begun < 0.1
        os.kill(made.pid, signal.SIGCONT)
        (outcome,) = wait_until(made.poll, 'the outcome')
        assert isinstance(outcome.result, Characteristic)


def test_a_late_answer_to_an_older_task_is_not_taken_for_the_newer_one() -> None:
    with worker('hangs', timeout_s=2.0) as made:
        made.submit(TASK)
        first = made.pid
        made.submit(TASK)
        assert made.pid != first
        (outcome,) = wait_until(made.poll, 'the outcome')
        assert isinstance(outcome.result, str)


# A fork of the tests' own process, with its many threads, may find a lock that nobody gives back.
_PARENT = """
import subprocess
import sys
import threading
import time
from valveflow_ros.ros.node.engine import example_task
from valveflow_ros.parameters import Settings
from valveflow_ros.ros.node.worker import FitWorker
made = FitWorker(120.0, 'hurt_jobs:hangs')
made.start()
made.submit(example_task(Settings()))
print(made.pid, flush=True)
time.sleep(600.0)
"""


def test_the_process_ends_with_its_parent() -> None:
    with subprocess.Popen([sys.executable, '-c', _PARENT], stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        child = psutil.Process(int(parent.stdout.readline()))
        parent.kill()
    wait_until(
        lambda: not child.is_running() or child.status() == psutil.STATUS_ZOMBIE, 'its end', 20.0
    )


@pytest.mark.parametrize('sent', [b'x' * 100, b'\xff' * 8, b'\x05' + 7 * b'\x00' + b'abcde'])
def test_a_process_that_writes_nonsense_costs_one_fit_and_is_replaced(sent: bytes) -> None:
    with worker('writes_nonsense') as made:
        made.submit(replace(TASK, request_ns=int.from_bytes(sent[:8], 'big') >> 1))
        (outcome,) = wait_until(made.poll, 'the outcome')
        assert outcome.result == 'The fit process gave an answer that cannot be read.'
        assert (made.pid, made.failures_in_a_row) == (None, 1)
        wait_until(lambda: made.poll() or made.pid, 'another process', 10.0)


@pytest.mark.parametrize('cut', [b'', b'valveflow-state', b'x' * 200, result_to_bytes(None)[:-1]])
def test_damaged_bytes_are_refused(cut: bytes) -> None:
    for read in (task_from_bytes, result_from_bytes):
        with pytest.raises(DataError):
            read(cut)
    half = to_bytes({'text': 'a diagnosis of no window'})
    with pytest.raises(DataError):
        result_from_bytes(half)


def test_a_fit_is_sent_with_the_form_that_it_must_have() -> None:
    for form in (None, StaticForm(OPENING, 1.05)):
        task = task_from_bytes(task_to_bytes(replace(TASK, form=form, known=form)))
        assert isinstance(task, FitTask)
        assert (task.form, task.known) == (form, form)


def test_tasks_and_results_arrive_as_they_were_sent() -> None:
    task = task_from_bytes(task_to_bytes(TASK))
    assert isinstance(task, FitTask)
    assert dict(task.settings) == dict(TASK.settings)
    bare = {'contents': NO_ROWS, 'settings': TASK.settings}
    assert repr(replace(task, **bare)) == repr(replace(TASK, **bare))
    for name in ('time_ns', 'u', 'power_mw', 'temperature_degc', 'spans'):
        assert getattr(task.contents, name).tobytes() == getattr(TASK.contents, name).tobytes()
    for result in (hurt_jobs.good(TASK), hurt_jobs.diagnosed(DIAGNOSIS), 'A sentence.', None):
        assert repr(result_from_bytes(result_to_bytes(result))) == repr(result)
    again = task_from_bytes(task_to_bytes(DIAGNOSIS))
    assert isinstance(again, DiagnosisTask)
    assert repr(replace(again, **bare)) == repr(replace(DIAGNOSIS, **bare))


def test_a_task_behind_a_warm_up_is_computed_by_the_same_process() -> None:
    with worker('good') as made:
        first = made.pid
        made.warm_up(TASK)
        assert made.warming_up
        made.submit(TASK)
        (outcome,) = wait_until(made.poll, 'the outcome')
        assert not made.warming_up
        assert isinstance(outcome.result, Characteristic)
        assert made.busy_s is None
        # Whether its answer came before or after, it is nobody's.
        time.sleep(0.3)
        assert made.poll() == []
        assert (made.pid, made.starts, made.failures_in_a_row) == (first, 1, 0)


def test_death_in_a_warm_up_is_no_outcome_and_the_process_is_replaced() -> None:
    with worker('dies') as made:
        made.warm_up(TASK)
        until_s = time.monotonic() + 60.0
        while made.starts < 2 and time.monotonic() < until_s:
            assert made.poll() == []
            time.sleep(0.02)
        assert made.starts == 2
        # Who waits for its end is not kept waiting.
        assert not made.warming_up
        assert made.failures_in_a_row == 1


def test_the_wait_for_a_warm_up_is_not_counted_as_the_tasks() -> None:
    now = [0.0]
    made = FitWorker(120.0, 'hurt_jobs:good', clock=lambda: now[0])
    made.start()
    try:
        made.warm_up(TASK)
        # So that its sender has the pipe.
        time.sleep(0.2)
        made.submit(TASK)
        now[0] = 50.0
        (outcome,) = wait_until(made.poll, 'the outcome')
    finally:
        made.close()
    assert outcome.seconds == 0.0


def test_what_waits_behind_a_warm_up_is_not_ended_for_taking_long() -> None:
    """It may compile for minutes, once; but not for ever."""
    now = [0.0]
    made = FitWorker(120.0, 'hurt_jobs:hangs', clock=lambda: now[0])
    made.start()
    try:
        made.warm_up(TASK)
        made.submit(TASK)
        now[0] = 500.0
        assert made.poll() == []
        assert (made.warming_up, made.starts) == (True, 1)
        now[0] = 700.0
        (outcome,) = made.poll()
        assert outcome.result == 'The fit process could not be made ready and was ended.'
        assert not made.warming_up
    finally:
        made.close()


@pytest.mark.parametrize(('job', 'works'), [(FIT_JOB, True), ('nothing_of_the_kind', False)])
def test_memory_is_given_back_once_after_each_outcome_when_the_task_was_let_go(
    job: str, works: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A task holds days of rows; what is given back while they are held is not given back."""
    held: list[bool] = []
    time_ns = TASK.contents.time_ns.copy()
    watched = weakref.ref(time_ns)
    task = replace(TASK, contents=replace(TASK.contents, time_ns=time_ns))
    monkeypatch.setattr(
        worker_module, 'release_memory', lambda: held.append(watched() is not None)
    )
    with worker(job) as made:
        made.submit(task)
        del task, time_ns
        (outcome,) = wait_until(made.poll, 'the outcome')
        assert isinstance(outcome.result, str) != works
        assert len(held) == 1
        # Where the process died, the thread that sends to it may be at work still.
        assert held == [False] or not works
        assert made.poll() == []
    assert len(held) == 1


def test_memory_is_given_back_by_what_the_c_library_has_or_not_at_all(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    worker_module.release_memory()
    asked: list[int] = []
    with_it = SimpleNamespace(malloc_trim=asked.append)
    monkeypatch.setattr(worker_module.ctypes, 'CDLL', lambda _name: with_it)
    worker_module.release_memory()
    assert asked == [0]
    monkeypatch.setattr(worker_module.ctypes, 'CDLL', lambda _name: SimpleNamespace())
    worker_module.release_memory()
    assert asked == [0]


def test_a_process_that_gets_no_descriptors_is_an_outcome(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> None:
        raise OSError(errno.EMFILE, 'Too many open files')

    monkeypatch.setattr(worker_module.multiprocessing, 'Pipe', refuse)
    with worker(FIT_JOB) as made:
        assert made.pid is None
        made.submit(TASK)
        (outcome,) = wait_until(made.poll, 'the outcome')
        assert 'could not be started (Too many open files)' in outcome.result


def killed(made: FitWorker) -> None:
    """Kill the process of a worker and wait until its end can be seen."""
    process = made._process
    assert process is not None
    process.kill()
    wait_until(lambda: process.poll() is not None, 'the end of the process')


def test_an_answer_that_comes_with_the_end_of_its_process_counts() -> None:
    with worker('hangs') as made:
        made.submit(TASK)
        killed(made)
        made._exchange.join()
        while not made._answers.empty():
            made._answers.get()
        answer = made._number, result_to_bytes(hurt_jobs.good(TASK))
        made._exchange = SimpleNamespace(join=lambda _seconds: made._answers.put(answer))
        (outcome,) = made.poll()
        assert isinstance(outcome.result, Characteristic)
        assert made.pid is None


def test_nothing_is_waited_for_where_an_idle_process_ends() -> None:
    with worker('good') as made:
        killed(made)
        made._exchange = SimpleNamespace(join=lambda _seconds: pytest.fail('waited'))
        assert made.poll() == []
        assert made.pid is None
