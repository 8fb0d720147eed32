# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Fits and diagnoses in a child process, so that no sample waits for one.

The parent's side is `FitWorker` and `DiagnosisWorker`; ``python -m valveflow_ros.ros.worker`` is
the child. Tasks and results travel as states (`valveflow_ros.state`): plain values and arrays with
a checksum, nothing that could be executed. A child that dies, hangs or answers nonsense costs one
fit and a sentence; the next child is started after a pause that doubles with each failure.
"""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import importlib
import itertools
import json
import math
import multiprocessing
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from typing import Any, ClassVar

import numpy as np

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.characteristic_json import from_json, held_from, held_json, to_json
from valveflow_ros.errors import DataError, counted
from valveflow_ros.fit.task import FitTask
from valveflow_ros.monitoring.events import DiagnosisContent, DiagnosisTask
from valveflow_ros.parameters import Settings
from valveflow_ros.ros.encoding import VERDICTS, diagnosis_message, encode
from valveflow_ros.ros.process import one_line, with_place
from valveflow_ros.segments.window import WindowContents
from valveflow_ros.signals.static_form import StaticForm
from valveflow_ros.state import from_bytes, to_bytes

FIT_JOB = 'valveflow_ros.fit.fit:fit'
DIAGNOSIS_JOB = 'valveflow_ros.diagnosis.from_window:diagnose_window'
Task = FitTask | DiagnosisTask

_FIRST_PAUSE_S = 0.5
_LAST_ANSWER_S = 1.0  # for what a process that has ended had sent
_LONGEST_PAUSE_S = 60.0
_MAX_ANSWER_BYTES = 16 << 20  # a curve takes some ten thousand
_LONGEST_WARM_UP_S = 600.0
_LAST_WORDS_S = 0.5
_WARM_UP = 0  # the number of a task whose result nobody waits for
_PR_SET_PDEATHSIG = 1
# One core is what the machine can spare, and one thread adds up in one order only.
_ONE_THREAD = dict.fromkeys(
    ('NUMBA_NUM_THREADS', 'OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'), '1'
)


@dataclass(frozen=True, slots=True)
class WorkerResult:
    """What became of a request.

    Attributes
    ----------
    request_ns : int
        Which request it answers.
    result : Characteristic, DiagnosisContent or str
        A string is the sentence why there is no result.
    seconds : float
        How long it took, with the way there and back.
    """

    request_ns: int
    result: Characteristic | DiagnosisContent | str
    seconds: float


# Tasks and results as bytes


def task_to_bytes(task: Task) -> bytes:
    """Return a task as it is sent to the child."""
    contents = {f.name: getattr(task.contents, f.name) for f in dataclasses.fields(WindowContents)}
    state: dict[str, Any] = {
        'request_ns': task.request_ns, 'settings': dict(task.settings), 'contents': contents
    }  # fmt: skip
    if isinstance(task, DiagnosisTask):
        state |= {'curve': to_json(task.curve), 'window_end_ns': task.window_end_ns}
    else:
        state |= {'input_noise': task.input_noise, 'power_noise_mw': task.power_noise_mw}
        state |= held_json(task.held)
        for name, form in (('form', task.form), ('known', task.known)):
            if form is not None:
                state[name] = [form.axis, form.exponent]
    return to_bytes(state)


def task_from_bytes(data: bytes) -> Task:
    """Return the task in such bytes; raises `DataError` if they are damaged."""
    state = from_bytes(data)
    window, settings = WindowContents(**state['contents']), Settings(state['settings'])
    if 'curve' in state:
        curve = from_json(state['curve'])
        return DiagnosisTask(state['request_ns'], window, settings, curve, state['window_end_ns'])
    held = held_from(state)
    noise = state['input_noise'], state['power_noise_mw']
    forms = {name: StaticForm(*state[name]) for name in ('form', 'known') if name in state}
    return FitTask(state['request_ns'], window, settings, *noise, held, **forms)


def result_to_bytes(result: object) -> bytes:
    """Return the result of a job as it is sent to the parent."""
    if isinstance(result, Characteristic):
        return to_bytes({'curve': to_json(result)})
    if isinstance(result, DiagnosisContent):
        return to_bytes({'window_end_ns': result.window_end_ns, 'text': result.text})
    return to_bytes({'sentence': result} if isinstance(result, str) else {})


def result_from_bytes(data: bytes) -> Characteristic | DiagnosisContent | str | None:
    """Return the result in such bytes, None if the job gave none.

    Raises
    ------
    DataError
        They are no answer.
    """
    state = from_bytes(data)
    try:
        if 'curve' in state:
            return from_json(state['curve'])
    except DataError as error:
        return f'The fit gave a curve that cannot be: {error}'
    try:
        if 'text' in state:
            return DiagnosisContent(int(state['window_end_ns']), str(state['text']))
    except (LookupError, TypeError, ValueError):
        raise DataError('The answer is none.') from None
    return str(state['sentence']) if 'sentence' in state else None


# Which results are believed


def fit_objection(task: FitTask, result: object) -> str:
    """Return why a result is not to be adopted, empty if nothing speaks against it.

    The worker is another process and may have been damaged in any way; the curve that predicts
    and raises alarms is only replaced by a whole one.
    """
    if not isinstance(result, Characteristic):
        return 'The fit gave no curve.'
    pieces, dynamics, residuals = result.pieces, result.dynamics, result.residuals
    most = task.settings.whole('max_pieces')
    if not 1 <= len(pieces) <= most:
        return f'The fit gave {counted(len(pieces), "piece")} where 1 to {most} are possible.'
    numbers = [x for p in pieces for x in (p.u_from, p.u_to, p.slope, p.intercept)]
    numbers += [x for d in dynamics for x in (d.time_constant_s, d.delay_s)]
    numbers += [residuals.rmse_mw, residuals.average_sd_mw]
    if not all(map(math.isfinite, numbers)):
        return 'The fit gave numbers that are not finite.'
    joined = all(a.u_to == b.u_from for a, b in itertools.pairwise(pieces))
    if not joined or np.any(np.diff(result.breakpoints) <= 0.0):
        return 'The fit gave breakpoints that do not increase.'
    if any(d.time_constant_s <= 0.0 or d.delay_s < 0.0 for d in dynamics):
        return 'The fit gave a time constant or delay that cannot be.'
    chart = residuals.chart
    if residuals.average_sd_mw <= 0.0 or chart is None or not chart.innovation_mw > 0.0:
        return 'The fit gave residuals without spread.'
    finite = all(map(math.isfinite, chart.limit + chart.slack))
    # Innovations are clipped at four: with more slack than this hardly a shift raises an alarm.
    if not (finite and min(chart.limit) > 0.0 and max(chart.slack) <= 3.0):
        return 'The fit gave no limits for the alarm.'
    if result.source.window_end_ns != int(task.contents.time_ns[-1]):
        return 'The fit answered for other data.'
    if replace(result, model_id='').with_id().model_id != result.model_id:
        return 'The fit gave a curve that does not fit its own name.'
    return ''


def diagnosis_objection(task: DiagnosisTask, result: object) -> str:
    """Return why the result of a diagnosis is not to be published, empty if nothing says so."""
    if not isinstance(result, DiagnosisContent):
        return 'The diagnosis gave no result.'
    if result.window_end_ns != task.window_end_ns:
        return 'The diagnosis answered for other data.'
    content = json.loads(result.text)
    if content['verdict'] not in VERDICTS or not content['sentence']:
        return 'The diagnosis gave no verdict.'
    # What cannot be published as a message is no result.
    encode(diagnosis_message(content, task, ''))
    return ''


def release_memory() -> None:
    """Return freed memory to the system where the C library can (glibc); takes milliseconds.

    The snapshot of a window of days takes 40 MB, and what it leaves in the heap would otherwise
    be held for good.
    """
    trim = getattr(ctypes.CDLL(None), 'malloc_trim', None)
    if trim is not None:
        trim(0)


# The parent's side


@dataclass(slots=True)
class _Running:
    number: int
    task: Task
    begun_s: float
    sent: bool = False


class Worker:
    """Computes one task at a time in a child process.

    Parameters
    ----------
    timeout_s : float
        A task that takes longer is ended.
    job : str, optional
        The function that is called, as ``module:function``.
    clock : callable
        Seconds by a clock that never goes back.

    Attributes
    ----------
    starts, failures_in_a_row : int
    """

    word: ClassVar[str]
    parameter: ClassVar[str]
    job: ClassVar[str]
    nice: ClassVar[int]
    # The process waits for the next task; otherwise one is started for each.
    stays: ClassVar[bool]
    objection: ClassVar[Callable[[Any, object], str]]

    def __init__(
        self, timeout_s: float, job: str = '', clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._timeout_s = timeout_s
        self._job = job or self.job
        self._clock = clock
        self._process: subprocess.Popen[bytes] | None = None
        self._tasks: queue.SimpleQueue[tuple[int, Task] | None] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[tuple[int, bytes]] = queue.SimpleQueue()
        self._running: _Running | None = None
        self._number = _WARM_UP
        self._pause_s = _FIRST_PAUSE_S
        self._start_at_s = 0.0
        self._warming_since_s: float | None = None
        self.starts = 0
        self.failures_in_a_row = 0

    @property
    def pid(self) -> int | None:
        """Return the process's id, None while there is none."""
        return None if self._process is None else self._process.pid

    @property
    def busy_s(self) -> float | None:
        """Return how long the task at hand has been running, None without one."""
        return None if self._running is None else self._clock() - self._running.begun_s

    @property
    def warming_up(self) -> bool:
        """Return True until the warm-up has ended."""
        return self._warming_since_s is not None

    def start(self, outcomes: list[WorkerResult] | None = None) -> None:
        """Start the process; if it cannot be, the task at hand ends with an outcome.

        The kernel ends the child when the thread that started it ends, so call this from one that
        lives as long as the monitor.
        """
        ends: list[Any] = []
        try:
            ours, theirs = ends = list(multiprocessing.Pipe())
            arguments = (
                str(os.getpid()),
                str(theirs.fileno()),
                self._job,
                str(self.nice),
                self.word,
            )
            process = subprocess.Popen(
                [sys.executable, '-m', 'valveflow_ros.ros.worker', *arguments],
                stdin=subprocess.DEVNULL,
                # What a library prints while it loads is no result of the monitor.
                stdout=2,
                pass_fds=[theirs.fileno()],
                env={**os.environ, **_ONE_THREAD},
                # Ctrl-C in a terminal is for the monitor to deal with.
                start_new_session=True,
            )
        except OSError as error:
            for end in ends:
                end.close()
            sentence = f'The {self.word} process could not be started ({error.strerror}).'
            self._failed(sentence, [] if outcomes is None else outcomes)
            return
        theirs.close()
        self.starts += 1
        self._process = process
        self._tasks, self._answers = queue.SimpleQueue(), queue.SimpleQueue()
        self._exchange = threading.Thread(
            target=_exchange, args=(ours, process, self._tasks, self._answers),
            name=f'{self.word} exchange', daemon=True,
        )  # fmt: skip
        self._exchange.start()

    def submit(self, task: Task) -> None:
        """Take a task; one that is still running is given up."""
        if self._running is not None and self._process is not None:
            self._end()
        self._number += 1
        self._running = _Running(self._number, task, self._clock())
        self._send()

    def warm_up(self, task: Task) -> None:
        """Let the process compile or load what a task needs; no outcome comes of it.

        A task that is submitted meanwhile is begun afterwards, in the same process.
        """
        if self._process is not None:
            self._warming_since_s = self._clock()
            self._tasks.put((_WARM_UP, task))

    def poll(self) -> list[WorkerResult]:
        """Return the outcomes there are, and see to the process; never waits."""
        outcomes: list[WorkerResult] = []
        if self._process is None:
            wanted = self.stays or self._running is not None
            if wanted and self._clock() >= self._start_at_s:
                self.start(outcomes)
                self._send()
            return outcomes
        self._take_answers(outcomes)
        now_s = self._clock()
        if self._process is None:
            pass
        elif self._process.poll() is not None:
            if self._running is not None:
                # What it had said before it ended counts; an idle thread has nothing to say.
                self._exchange.join(_LAST_ANSWER_S)
                self._take_answers(outcomes)
            if self._process is not None:
                sentence = f'The {self.word} process ended unexpectedly ({self._end()}).'
                self._failed(sentence, outcomes)
        elif self._warming_since_s is not None:
            # It may be compiling. What waits behind it has not begun.
            if now_s - self._warming_since_s > _LONGEST_WARM_UP_S:
                sentence = f'The {self.word} process could not be made ready and was ended.'
                self._failed(sentence, outcomes)
        elif self.busy_s is not None and self.busy_s > self._timeout_s:
            sentence = (
                f'The {self.word} took longer than {self._timeout_s:g} s and was ended '
                f'(parameter {self.parameter}).'
            )
            self._failed(sentence, outcomes)
        return outcomes

    def close(self) -> None:
        """End the process at once, whatever it is doing."""
        self._end()
        self._running = None

    def _take_answers(self, outcomes: list[WorkerResult]) -> None:
        assert self._process is not None
        while not self._answers.empty():
            number, data = self._answers.get()
            try:
                result = result_from_bytes(data)
            except DataError:
                if self._process.poll() is None:
                    sentence = f'The {self.word} process gave an answer that cannot be read.'
                    self._failed(sentence, outcomes)
                return
            running = self._running
            if number == _WARM_UP:
                self._warming_since_s = None
                if running is not None:
                    # The time it waited for the warm-up to end is not the task's.
                    running.begun_s = self._clock()
            if running is None or running.number != number:
                continue
            believed = self._believed(running.task, result)
            # The task holds days of rows; it must be gone when memory is released.
            del running
            self._conclude(believed, outcomes)
            self.failures_in_a_row = 0
            self._pause_s = _FIRST_PAUSE_S
            if not self.stays:
                self._end()
                return

    def _believed(self, task: Task, result: Any) -> Any:
        """Return the result, or why it is not believed."""
        if isinstance(result, str):
            return result
        try:
            problem = type(self).objection(task, result)
        except Exception as error:  # noqa: BLE001 - anything may stand in its fields
            name = type(error).__name__
            problem = f'The {self.word} gave a result that cannot be checked ({name}).'
        return problem or result

    def _conclude(self, result: Any, outcomes: list[WorkerResult]) -> None:
        if self._running is None:
            return
        seconds = self._clock() - self._running.begun_s
        outcomes.append(WorkerResult(self._running.task.request_ns, result, seconds))
        self._running = None
        release_memory()

    def _failed(self, sentence: str, outcomes: list[WorkerResult]) -> None:
        self._end()
        self.failures_in_a_row += 1
        self._start_at_s = self._clock() + self._pause_s
        self._pause_s = min(2.0 * self._pause_s, _LONGEST_PAUSE_S)
        self._conclude(sentence, outcomes)

    def _send(self) -> None:
        running = self._running
        if running is None or running.sent or self._process is None:
            return
        running.sent = True
        # The time it waited for a process to be there is not the task's.
        running.begun_s = self._clock()
        self._tasks.put((running.number, running.task))

    def _end(self) -> str:
        """Kill the process and return what became of it, in words."""
        process, self._process = self._process, None
        self._warming_since_s = None
        if process is None:
            return ''
        self._tasks.put(None)
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        code = process.wait()
        return f'signal {signal.Signals(-code).name}' if code < 0 else f'exit status {code}'


class FitWorker(Worker):
    """Computes one fit at a time."""

    word, parameter, job = 'fit', 'refit_timeout', FIT_JOB
    nice, stays = 10, True
    objection = fit_objection


class DiagnosisWorker(Worker):
    """Computes one diagnosis at a time, in a process that is there only while it does."""

    word, parameter, job = 'diagnosis', 'diagnosis_timeout', DIAGNOSIS_JOB
    nice, stays = 19, False
    objection = diagnosis_objection


def _exchange(
    connection: Connection,
    process: subprocess.Popen[bytes],
    tasks: queue.SimpleQueue[tuple[int, Task] | None],
    answers: queue.SimpleQueue[tuple[int, bytes]],
) -> None:
    """Send tasks and receive their answers in a thread, as a snapshot of days takes a while."""
    with connection:
        while (item := tasks.get()) is not None:
            number, data = item[0], task_to_bytes(item[1])
            # The rows must not be held while the child computes.
            del item
            try:
                connection.send_bytes(data)
                del data
                answers.put((number, connection.recv_bytes(_MAX_ANSWER_BYTES)))
            except (EOFError, OSError):
                # The process has ended, or it sent something that is no message.
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(_LAST_WORDS_S)
                answers.put((number, b''))
                return


# The child's side


def compute(work: Callable[[Any], Any], task: Task, word: str) -> Any:
    """Do the work; return its result, or a sentence why there is none."""
    try:
        return work(task)
    except DataError as error:
        return str(error)
    except MemoryError:
        return f'The {word} needed more memory than there is.'
    except Exception as error:  # noqa: BLE001 - whatever it is, the monitor goes on
        return f'The {word} failed unexpectedly: {with_place(error)}.'


def main(arguments: list[str]) -> int:
    """Answer tasks until the parent closes the connection.

    Parameters
    ----------
    arguments : list of str
        The parent's process id, the descriptor of the connection, the job as ``module:function``,
        the nice value, and what the job is called.
    """
    parent, descriptor, job, nice, word = arguments
    # The kernel ends this process when its parent ends, in whatever way.
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != int(parent):
        # It ended before the kernel was asked.
        os._exit(1)
    os.nice(int(nice))
    # Nothing that a library prints may look like output of the monitor.
    os.dup2(2, 1)
    module, _, function = job.partition(':')
    work = getattr(importlib.import_module(module), function)
    with Connection(int(descriptor)) as connection, contextlib.suppress(EOFError):
        while True:
            task = task_from_bytes(connection.recv_bytes())
            connection.send_bytes(result_to_bytes(compute(work, task, word)))
    return 0


if __name__ == '__main__':
    try:
        sys.exit(main(sys.argv[1:]))
    except BrokenPipeError:
        sys.exit(0)
    except Exception as error:  # noqa: BLE001 - the monitor sees the end and says so
        sys.exit(f'valveflow worker process: {one_line(error)}')
