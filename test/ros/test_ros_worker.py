# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Fits in a child process: each task has one outcome, whatever becomes of the process."""

import errno
import os
import signal
import subprocess
import sys
import time
import weakref
from contextlib import contextmanager
from dataclasses import replace
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
    DiagnosisWorker,
    FitWorker,
    compute,
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
def worker(job, timeout_s=120.0, **more):
    made = FitWorker(timeout_s, job if ':' in job else f'hurt_jobs:{job}', **more)
    made.start()
    try:
        yield made
    finally:
        made.close()


class Clock:
    def __init__(self):
        self.now_s = 0.0

    def __call__(self):
        return self.now_s


def answered(made, task=TASK):
    """Return the result of a task, or of the one that was submitted already."""
    if task is not None:
        made.submit(task)
    (outcome,) = wait_until(made.poll, 'the outcome')
    assert task is None or outcome.request_ns == task.request_ns
    assert outcome.seconds >= 0.0
    return outcome.result


def test_one_process_gives_a_fit_bit_for_bit_and_sentences_for_bad_results():
    with worker(FIT_JOB) as made:
        # NaN is equal to itself here, and to the last bit.
        assert repr(answered(made)) == repr(fit(TASK))
    with worker('told') as made:
        pid = made.pid
        for number, words in enumerate(hurt_jobs.BAD_FITS.values()):
            result = answered(made, replace(TASK, request_ns=number))
            assert isinstance(result, str)
            assert words in result
            assert result.endswith('.')
        # What a job prints does not get between the results.
        prints = replace(TASK, request_ns=len(hurt_jobs.BAD_FITS))
        assert isinstance(answered(made, prints), Characteristic)
        assert (made.pid, made.failures_in_a_row) == (pid, 0)


def test_a_bad_diagnosis_is_a_sentence():
    made = DiagnosisWorker(60.0)
    for job, words in hurt_jobs.BAD_DIAGNOSES.items():
        believed = made._believed(DIAGNOSIS, compute(job, DIAGNOSIS, 'diagnosis'))
        assert words in believed
        assert believed.endswith('.')
    good = hurt_jobs.diagnosed(DIAGNOSIS)
    assert made._believed(DIAGNOSIS, good) == good


@pytest.mark.parametrize('job', ['diagnosed', 'hangs'])
def test_each_diagnosis_has_a_process_of_its_own(job):
    made = DiagnosisWorker(1.0 if job == 'hangs' else 60.0, f'hurt_jobs:{job}')
    assert made.poll() == []
    assert made.pid is None
    late = 'The diagnosis took longer than 1 s and was ended (parameter diagnosis_timeout).'
    try:
        assert answered(made, DIAGNOSIS) in (late, hurt_jobs.diagnosed(DIAGNOSIS))
        assert (made.starts, made.pid, made.busy_s) == (1, None, None)
    finally:
        made.close()


def test_a_killed_process_is_seen_at_once_and_replaced_and_nobody_waits_for_it():
    with worker('good') as made:
        assert isinstance(answered(made), Characteristic)
        killed(made)
        made._exchange = SimpleNamespace(join=lambda _seconds: pytest.fail('waited'))
        assert made.poll() == []
        assert (made.pid, made.failures_in_a_row) == (None, 1)
        assert isinstance(answered(made), Characteristic)
        assert (made.starts, made.failures_in_a_row) == (2, 0)


def killed(made):
    process = made._process
    assert process is not None
    process.kill()
    wait_until(lambda: process.poll() is not None, 'the end of the process')


def test_death_during_a_fit_is_its_outcome_and_the_pauses_grow():
    clock = Clock()
    with worker('dies', clock=clock) as made:
        pauses = []
        for k in range(2):
            assert 'ended unexpectedly (signal SIGKILL)' in answered(made)
            assert (made.pid, made.failures_in_a_row) == (None, k + 1)
            begun = clock.now_s
            while made.pid is None:
                made.poll()
                clock.now_s += 0.01
            pauses.append(clock.now_s - begun)
        assert pauses == pytest.approx([0.5, 1.0], abs=0.03)


def test_a_process_that_cannot_start_costs_no_busy_restarts():
    clock = Clock()
    with worker('no_such_module:job', clock=clock) as made:
        for _ in range(2):
            wait_until(lambda: made.poll() or made.pid is None, 'the end of the process')
            for _ in range(100):
                made.poll()
            clock.now_s += 100.0
            made.poll()
        assert made.starts == 3


def test_a_newer_task_ends_an_older_one_and_a_hanging_one_is_ended():
    with worker('hangs', timeout_s=1.0) as made:
        made.submit(TASK)
        first = made.pid
        made.submit(TASK)
        wait_until(lambda: made.poll() or made.pid, 'another process', 10.0)
        pid = made.pid
        assert pid not in (first, None)
        os.kill(pid, signal.SIGSTOP)
        (outcome,) = wait_until(made.poll, 'the outcome')
        assert 'longer than 1 s' in outcome.result
        assert 1.0 <= outcome.seconds < 5.0
        assert not psutil.pid_exists(pid)


def test_submitting_never_blocks_even_if_nobody_reads():
    with worker('good') as made:
        answered(made)
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
        assert isinstance(answered(made, None), Characteristic)


# A fork of the tests' own process, with its many threads, may find a lock that nobody gives back.
_PARENT = """
import time
from valveflow_ros.ros.node.worker import FitWorker
made = FitWorker(120.0, 'hurt_jobs:hangs')
made.start()
print(made.pid, flush=True)
time.sleep(600.0)
"""


def test_the_process_ends_with_its_parent():
    with subprocess.Popen([sys.executable, '-c', _PARENT], stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        child = psutil.Process(int(parent.stdout.readline()))
        parent.kill()
    wait_until(
        lambda: not child.is_running() or child.status() == psutil.STATUS_ZOMBIE, 'its end', 20.0
    )


@pytest.mark.parametrize('sent', [b'x' * 8, b'\xff' * 8])
def test_a_process_that_writes_nonsense_costs_one_fit_and_is_replaced(sent):
    with worker('writes_nonsense') as made:
        task = replace(TASK, request_ns=int.from_bytes(sent, 'big') >> 1)
        assert answered(made, task) == 'The fit process gave an answer that cannot be read.'
        assert (made.pid, made.failures_in_a_row) == (None, 1)
        wait_until(lambda: made.poll() or made.pid, 'another process', 10.0)


def test_damaged_bytes_are_refused():
    for read in (task_from_bytes, result_from_bytes):
        for cut in (b'', b'valveflow-state', b'x' * 200, result_to_bytes(None)[:-1]):
            with pytest.raises(DataError):
                read(cut)
    with pytest.raises(DataError):
        result_from_bytes(to_bytes({'text': 'a diagnosis of no window'}))


def test_tasks_and_results_arrive_as_they_were_sent():
    bare = {'contents': NO_ROWS, 'settings': TASK.settings}
    shaped = replace(TASK, form=StaticForm(OPENING, 1.05), known=StaticForm(OPENING, 1.05))
    for sent in (TASK, shaped, DIAGNOSIS):
        task = task_from_bytes(task_to_bytes(sent))
        assert isinstance(task, FitTask | DiagnosisTask)
        assert dict(task.settings) == dict(sent.settings)
        assert repr(replace(task, **bare)) == repr(replace(sent, **bare))
        for name in ('time_ns', 'u', 'power_mw', 'temperature_degc', 'spans'):
            column = getattr(TASK.contents, name)
            assert getattr(task.contents, name).tobytes() == column.tobytes()
    for result in (hurt_jobs.good(TASK), hurt_jobs.diagnosed(DIAGNOSIS), 'A sentence.', None):
        assert repr(result_from_bytes(result_to_bytes(result))) == repr(result)


def test_a_task_behind_a_warm_up_is_computed_by_the_same_process_in_its_own_time():
    clock = Clock()
    with worker('good', clock=clock) as made:
        first = made.pid
        made.warm_up(TASK)
        assert made.warming_up
        # So that its sender has the pipe.
        time.sleep(0.2)
        made.submit(TASK)
        clock.now_s = 50.0
        (outcome,) = wait_until(made.poll, 'the outcome')
        assert isinstance(outcome.result, Characteristic)
        assert (made.warming_up, outcome.seconds, made.busy_s) == (False, 0.0, None)
        # Whether its answer came before or after, it is nobody's.
        time.sleep(0.1)
        assert made.poll() == []
        assert (made.pid, made.starts, made.failures_in_a_row) == (first, 1, 0)


def test_death_in_a_warm_up_is_no_outcome_and_the_process_is_replaced():
    with worker('dies') as made:
        made.warm_up(TASK)

        def replaced():
            assert made.poll() == []
            return made.starts == 2

        wait_until(replaced, 'another process', 60.0)
        # Who waits for its end is not kept waiting.
        assert (made.warming_up, made.failures_in_a_row) == (False, 1)


def test_what_waits_behind_a_warm_up_is_not_ended_for_taking_long():
    """It may compile for minutes, once; but not for ever."""
    clock = Clock()
    with worker('hangs', clock=clock) as made:
        made.warm_up(TASK)
        made.submit(TASK)
        clock.now_s = 500.0
        assert made.poll() == []
        assert (made.warming_up, made.starts) == (True, 1)
        clock.now_s = 700.0
        (outcome,) = made.poll()
        assert outcome.result == 'The fit process could not be made ready and was ended.'
        assert not made.warming_up


def test_memory_is_given_back_once_after_an_outcome_when_the_task_was_let_go(monkeypatch):
    """A task holds days of rows; what is given back while they are held is not given back."""
    held = []
    time_ns = TASK.contents.time_ns.copy()
    watched = weakref.ref(time_ns)
    task = replace(TASK, contents=replace(TASK.contents, time_ns=time_ns))
    monkeypatch.setattr(
        worker_module, 'release_memory', lambda: held.append(watched() is not None)
    )
    with worker('good') as made:
        made.submit(task)
        del task, time_ns
        assert isinstance(answered(made, None), Characteristic)
        assert made.poll() == []
    assert held == [False]


def test_a_process_that_gets_no_descriptors_is_an_outcome(monkeypatch):
    def refuse():
        raise OSError(errno.EMFILE, 'Too many open files')

    monkeypatch.setattr(worker_module.multiprocessing, 'Pipe', refuse)
    with worker(FIT_JOB) as made:
        assert made.pid is None
        assert 'could not be started (Too many open files)' in answered(made)


def test_an_answer_that_comes_with_the_end_of_its_process_counts():
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
