# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Fits and diagnoses in a child process, so that no sample waits for them.

The parent uses `FitWorker` and `DiagnosisWorker`; the child is
``python -m valveflow_ros.ros.node.worker``. Tasks and results are sent as states
(`valveflow_ros.state`): plain values and arrays with a checksum, no executable content. If a child
dies, hangs or gives an invalid result, one fit is lost and reported; the pause before the next
child then doubles.
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
_LAST_ANSWER_S = 1.0  # wait for results sent before the process ended
_LONGEST_PAUSE_S = 60.0
_MAX_ANSWER_BYTES = 16 << 20  # a curve has about 10 kB
_LONGEST_WARM_UP_S = 600.0
_LAST_WORDS_S = 0.5
_WARM_UP = 0  # number of the warm-up task, whose result is not used
_PR_SET_PDEATHSIG = 1
# One thread leaves the other cores to the machine, and its sums are reproducible.
_ONE_THREAD = dict.fromkeys(
    ('NUMBA_NUM_THREADS', 'OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'), '1'
)


@dataclass(frozen=True, slots=True)
class WorkerResult:
    """Result of a request; a string is the reason why there is none.

    ``seconds`` is the duration including communication.
    """

    request_ns: int
    result: Characteristic | DiagnosisContent | str
    seconds: float


# Tasks and results as bytes


def task_to_bytes(task: Task) -> bytes:
    """Return a task in the form sent to the child."""
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
    """Return a task from `task_to_bytes`; raises `DataError` if the bytes are damaged."""
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
    """Return the result of a job in the form sent to the parent."""
    if isinstance(result, Characteristic):
        return to_bytes({'curve': to_json(result)})
    if isinstance(result, DiagnosisContent):
        return to_bytes({'window_end_ns': result.window_end_ns, 'text': result.text})
    return to_bytes({'sentence': result} if isinstance(result, str) else {})


def result_from_bytes(data: bytes) -> Characteristic | DiagnosisContent | str | None:
    """Return a result from `result_to_bytes`, None if the job gave none.

    Raises `DataError` if the bytes are no valid result.
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


# Checks of the results


def fit_objection(task: FitTask, result: object) -> str:
    """Return why a result must not be adopted; empty if it is valid.

    The worker is another process and may fail in any way. The current curve, which predicts and
    raises alarms, is only replaced by a valid one.
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
    # Innovations are clipped at four, so with a larger slack hardly any shift raises an alarm.
    if not (finite and min(chart.limit) > 0.0 and max(chart.slack) <= 3.0):
        return 'The fit gave no limits for the alarm.'
    if result.source.window_end_ns != int(task.contents.time_ns[-1]):
        return 'The fit answered for other data.'
    if replace(result, model_id='').with_id().model_id != result.model_id:
        return 'The fit gave a curve that does not fit its own name.'
    return ''


def diagnosis_objection(task: DiagnosisTask, result: object) -> str:
    """Return why the result of a diagnosis must not be published; empty if it is valid."""
    if not isinstance(result, DiagnosisContent):
        return 'The diagnosis gave no result.'
    if result.window_end_ns != task.window_end_ns:
        return 'The diagnosis answered for other data.'
    content = json.loads(result.text)
    if content['verdict'] not in VERDICTS or not content['sentence']:
        return 'The diagnosis gave no verdict.'
    # Raises if the result cannot be published as a message.
    encode(diagnosis_message(content, task, ''))
    return ''


def release_memory() -> None:
    """Return freed memory to the system if the C library (glibc) can; takes milliseconds.

    The snapshot of a window of days has 40 MB, which would otherwise remain in the heap of the
    process.
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

    A task that takes longer than ``timeout_s`` is aborted. ``job`` is the function to call, as
    ``module:function``; ``clock`` returns monotonic time in s.
    """

    word: ClassVar[str]
    parameter: ClassVar[str]
    job: ClassVar[str]
    nice: ClassVar[int]
    # True if the process waits for the next task; otherwise each task has its own process.
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
        """Return the id of the process, None if there is no process."""
        return None if self._process is None else self._process.pid

    @property
    def busy_s(self) -> float | None:
        """Return the duration of the current task in s, None without a task."""
        return None if self._running is None else self._clock() - self._running.begun_s

    @property
    def warming_up(self) -> bool:
        """Return True until the warm-up has ended."""
        return self._warming_since_s is not None

    def start(self, outcomes: list[WorkerResult] | None = None) -> None:
        """Start the process; if this fails, the current task ends with a failure.

        The kernel ends the child when the thread that started it ends, so call this from a thread
        that lives as long as the monitor.
        """
        ends: list[Any] = []
        try:
            ours, theirs = ends = list(multiprocessing.Pipe())
            process = subprocess.Popen(
                [
                    sys.executable, '-m', 'valveflow_ros.ros.node.worker', str(os.getpid()),
                    str(theirs.fileno()), self._job, str(self.nice), self.word,
                ],
                stdin=subprocess.DEVNULL,
                # Output of libraries must not appear as output of the monitor.
                stdout=2,
                pass_fds=[theirs.fileno()],
                env={**os.environ, **_ONE_THREAD},
                # Ctrl-C in a terminal must only reach the monitor.
                start_new_session=True,
            )  # fmt: skip
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
        """Start a task; a task that is still running is aborted."""
        if self._running is not None and self._process is not None:
            self._end()
        self._number += 1
        self._running = _Running(self._number, task, self._clock())
        self._send()

    def warm_up(self, task: Task) -> None:
        """Let the process compile or load what a task needs; this gives no result.

        A task that is submitted meanwhile is started afterwards, in the same process.
        """
        if self._process is not None:
            self._warming_since_s = self._clock()
            self._tasks.put((_WARM_UP, task))

    def poll(self) -> list[WorkerResult]:
        """Return the available results, and restart or end the process if needed."""
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
                # Use a result that was sent before the process ended.
                self._exchange.join(_LAST_ANSWER_S)
                self._take_answers(outcomes)
            if self._process is not None:
                sentence = f'The {self.word} process ended unexpectedly ({self._end()}).'
                self._failed(sentence, outcomes)
        elif self._warming_since_s is not None:
            # It may be compiling; a waiting task has not begun.
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
        """End the process immediately."""
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
                    # The wait for the warm-up does not count as time of the task.
                    running.begun_s = self._clock()
            if running is None or running.number != number:
                continue
            believed = self._believed(running.task, result)
            # The task holds days of rows, which must be freed before memory is released.
            del running
            self._conclude(believed, outcomes)
            self.failures_in_a_row = 0
            self._pause_s = _FIRST_PAUSE_S
            if not self.stays:
                self._end()
                return

    def _believed(self, task: Task, result: Any) -> Any:
        """Return the result, or the reason why it is refused."""
        if isinstance(result, str):
            return result
        try:
            problem = type(self).objection(task, result)
        except Exception as error:  # noqa: BLE001 - the fields may have any content
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
        # The wait for a process does not count as time of the task.
        running.begun_s = self._clock()
        self._tasks.put((running.number, running.task))

    def _end(self) -> str:
        """Kill the process and return a clause about its exit."""
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
    """Computes one diagnosis at a time, in a process that is started for each of them."""

    word, parameter, job = 'diagnosis', 'diagnosis_timeout', DIAGNOSIS_JOB
    nice, stays = 19, False
    objection = diagnosis_objection


def _exchange(
    connection: Connection,
    process: subprocess.Popen[bytes],
    tasks: queue.SimpleQueue[tuple[int, Task] | None],
    answers: queue.SimpleQueue[tuple[int, bytes]],
) -> None:
    """Send tasks and receive results in a thread, because a large window takes time to send."""
    with connection:
        while (item := tasks.get()) is not None:
            number, data = item[0], task_to_bytes(item[1])
            # Free the rows while the child computes.
            del item
            try:
                connection.send_bytes(data)
                del data
                answers.put((number, connection.recv_bytes(_MAX_ANSWER_BYTES)))
            except (EOFError, OSError):
                # The process has ended or sent an invalid message.
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(_LAST_WORDS_S)
                answers.put((number, b''))
                return


# The child's side


def compute(work: Callable[[Any], Any], task: Task, word: str) -> Any:
    """Run the job; return its result, or a sentence why there is none."""
    try:
        return work(task)
    except DataError as error:
        return str(error)
    except MemoryError:
        return f'The {word} needed more memory than there is.'
    except Exception as error:  # noqa: BLE001 - no failure may stop the monitor
        return f'The {word} failed unexpectedly: {with_place(error)}.'


def main(arguments: list[str]) -> int:
    """Answer tasks until the parent closes the connection.

    The arguments are the parent's process id, the descriptor of the connection, the job as
    ``module:function``, the nice value, and the name of the job for messages.
    """
    parent, descriptor, job, nice, word = arguments
    # The kernel ends this process when its parent ends for any reason.
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != int(parent):
        # The parent ended before this request.
        os._exit(1)
    os.nice(int(nice))
    # Output of libraries must not appear as output of the monitor.
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
    except Exception as error:  # noqa: BLE001 - the monitor reports that the process ended
        sys.exit(f'valveflow worker process: {one_line(error)}')
