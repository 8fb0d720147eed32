"""Fits and diagnoses in processes of their own, so that no sample waits for one.

A process is started once or when it is needed, is given low priority, and ends with the monitor.
When it is killed, hangs or fails, that is seen at the next `Worker.poll`; the
request gets an outcome that says so, and a new process is started after a pause
that doubles while failures follow each other.
"""

from __future__ import annotations

import contextlib
import ctypes
import itertools
import json
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.errors import DataError, counted
from valveflow_ros.fit.task import FitTask
from valveflow_ros.monitoring.events import DiagnosisContent, DiagnosisTask
from valveflow_ros.ros.conversions import VERDICTS, diagnosis, encode
from valveflow_ros.ros.worker.protocol import FrameReader, result_of, send, task_letter

# What comes back from a worker, and whether it may be believed.


@dataclass(frozen=True, slots=True)
class Outcome:
    """A curve or what a diagnosis gave, or the sentence why there is none.

    Attributes
    ----------
    request_ns : int
        Which request it answers.
    result : Characteristic, DiagnosisContent or str
    seconds : float
        How long it took, with the way there and back.
    """

    request_ns: int
    result: Characteristic | DiagnosisContent | str
    seconds: float


def objection(task: FitTask, result: object) -> str:
    """Return why a result is not to be adopted, empty if nothing speaks against it.

    The worker is another process and may have been hurt in any way; the curve
    that predicts and raises alarms is only replaced by a whole one.
    """
    if not isinstance(result, Characteristic):
        return 'The fit gave no curve.'
    pieces = result.pieces
    most = task.settings.whole('max_pieces')
    if not 1 <= len(pieces) <= most:
        return f'The fit gave {counted(len(pieces), "piece")} where 1 to {most} are possible.'
    numbers = [x for p in pieces for x in (p.u_from, p.u_to, p.slope, p.intercept)]
    numbers += [x for d in result.dynamics for x in (d.time_constant_s, d.delay_s)]
    numbers += [result.residuals.rmse_mw, result.residuals.average_sd_mw]
    if not all(map(math.isfinite, numbers)):
        return 'The fit gave numbers that are not finite.'
    knots = result.breakpoints
    joined = all(a.u_to == b.u_from for a, b in itertools.pairwise(pieces))
    if not joined or np.any(np.diff(knots) <= 0.0):
        return 'The fit gave breakpoints that do not increase.'
    if any(d.time_constant_s <= 0.0 or d.delay_s < 0.0 for d in result.dynamics):
        return 'The fit gave a time constant or delay that cannot be.'
    chart = result.residuals.chart
    if result.residuals.average_sd_mw <= 0.0 or chart is None or not chart.innovation_mw > 0.0:
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


def content_objection(task: DiagnosisTask, result: object) -> str:
    """Return why the result of a diagnosis is not to be published, empty if nothing says so."""
    if not isinstance(result, DiagnosisContent):
        return 'The diagnosis gave no result.'
    if result.window_end_ns != task.window_end_ns:
        return 'The diagnosis answered for other data.'
    content = json.loads(result.text)
    if content['verdict'] not in VERDICTS or not content['sentence']:
        return 'The diagnosis gave no verdict.'
    # What cannot be told as a message is no result.
    encode(diagnosis(content, task, ''))
    return ''


# What the processes beside the monitor do: fits and diagnoses.


FIT_JOB = 'valveflow_ros.fit.fit:fit'
DIAGNOSIS_JOB = 'valveflow_ros.diagnosis.from_window:diagnose_window'


@dataclass(frozen=True, slots=True)
class Trade:
    """What a worker does.

    Attributes
    ----------
    word : str
        What one piece of work is called.
    parameter : str
        Which parameter limits its time.
    objection : callable
        Says why a result is not to be believed, or nothing.
    nice : int
        How far the process stands back.
    stays : bool
        The process waits for the next task; otherwise it is started for each.
    """

    word: str
    parameter: str
    objection: Callable[[Any, object], str]
    nice: int
    stays: bool


FIT = Trade('fit', 'refit_timeout', objection, 10, True)
DIAGNOSIS = Trade('diagnosis', 'diagnosis_timeout', content_objection, 19, False)


# Give memory that is free back to the system.


def give_back() -> None:
    """Return what the C library keeps of freed memory, where it can (glibc); takes milliseconds.

    A snapshot of a window of days for a fit is 40 MB, and what it leaves in the heap when it is
    freed is otherwise held for good.
    """
    trim = getattr(ctypes.CDLL(None), 'malloc_trim', None)
    if trim is not None:
        trim(0)


_FIRST_PAUSE_S = 0.5
_LONGEST_PAUSE_S = 60.0
_MOST_ANSWER = 16 << 20  # bytes; a curve takes some ten thousand
_LONGEST_REHEARSAL_S = 600.0
_REHEARSAL = 0  # the number of a task that nobody waits for
# One core is what the machine can spare, and one thread adds up in one order only.
_ONE_THREAD = dict.fromkeys(
    ('NUMBA_NUM_THREADS', 'OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'), '1'
)


@dataclass(slots=True)
class _Running:
    number: int
    task: FitTask | DiagnosisTask
    begun_s: float
    sent: bool = False


class Worker:
    """Computes one task at a time.

    Parameters
    ----------
    trade : Trade
    timeout_s : float
        What takes longer is ended.
    job : str
        The function that is called, as ``module:function``.
    clock : callable
        Seconds by a clock that never goes back.
    """

    def __init__(
        self, trade: Trade, timeout_s: float, job: str, clock: Callable[[], float]
    ) -> None:
        self._timeout_s = timeout_s
        self._job = job
        self._clock = clock
        self._trade = trade
        self._process: subprocess.Popen[bytes] | None = None
        self._reader: FrameReader | None = None
        self._running: _Running | None = None
        self._number = _REHEARSAL
        self._sending = threading.Lock()
        self._pause_s = _FIRST_PAUSE_S
        self._start_at_s = 0.0
        self._rehearsing_since_s: float | None = None
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
    def rehearsing(self) -> bool:
        """Tell whether a rehearsal has not come to its end yet."""
        return self._rehearsing_since_s is not None

    def start(self, outcomes: list[Outcome] | None = None) -> None:
        """Start the process; call it from the thread that lives as long as the monitor.

        What becomes of the task at hand, if it cannot be started, is added to ``outcomes``.

        The kernel ends the process when the thread that started it ends.
        """
        command = [sys.executable, '-m', 'valveflow_ros.ros.worker.worker_child']
        try:
            self._process = subprocess.Popen(
                [*command, str(os.getpid()), self._job, str(self._trade.nice), self._trade.word],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                bufsize=0,
                env={**os.environ, **_ONE_THREAD},
                # Ctrl-C in a terminal is for the monitor to deal with.
                start_new_session=True,
            )
        except OSError as error:
            sentence = f'The {self._trade.word} process could not be started ({error.strerror}).'
            self._failed(sentence, [] if outcomes is None else outcomes)
            return
        self.starts += 1
        # What was being sent to an earlier process ends by itself.
        self._sending = threading.Lock()
        assert self._process.stdout is not None
        os.set_blocking(self._process.stdout.fileno(), False)
        self._reader = FrameReader(self._process.stdout.fileno(), _MOST_ANSWER)

    def submit(self, task: FitTask | DiagnosisTask) -> None:
        """Take a task; one that is still running is given up."""
        if self._running is not None and self._process is not None:
            self._end()
        self._number += 1
        self._running = _Running(self._number, task, self._clock())
        self._send()

    def rehearse(self, task: FitTask | DiagnosisTask) -> None:
        """Let the process compile or load what a task needs; no outcome comes of it.

        A task that is submitted meanwhile is begun afterwards, in the same process.
        """
        if self._process is not None:
            self._rehearsing_since_s = self._clock()
            self._post(self._process, _REHEARSAL, task)

    def poll(self) -> list[Outcome]:
        """Return the outcomes there are, and see to the process; never waits."""
        outcomes: list[Outcome] = []
        if self._process is None:
            wanted = self._trade.stays or self._running is not None
            if wanted and self._clock() >= self._start_at_s:
                self.start(outcomes)
                self._send()
            return outcomes
        self._take_results(outcomes)
        word = self._trade.word
        if self._reader is not None and self._reader.ended:
            status = self._end()
            self._failed(f'The {word} process ended unexpectedly ({status}).', outcomes)
        elif (since_s := self._rehearsing_since_s) is not None:
            # It may be compiling. What waits behind it has not begun.
            if self._clock() - since_s > _LONGEST_REHEARSAL_S:
                self._end()
                self._failed(
                    f'The {word} process could not be made ready and was ended.', outcomes
                )
        elif self.busy_s is not None and self.busy_s > self._timeout_s:
            self._end()
            self._failed(
                f'The {word} took longer than {self._timeout_s:g} s and was ended '
                f'(parameter {self._trade.parameter}).',
                outcomes,
            )
        return outcomes

    def close(self) -> None:
        """End the process at once, whatever it is doing."""
        if self._process is not None:
            self._end()
        self._running = None

    def _believed(self, task: Any, result: Any) -> Any:
        """Return the result, or why it is not believed."""
        if isinstance(result, str):
            return result
        word = self._trade.word
        try:
            problem = self._trade.objection(task, result)
        except Exception as error:  # noqa: BLE001 - anything may stand in its fields
            problem = f'The {word} gave a result that cannot be checked ({type(error).__name__}).'
        return problem or result

    def _take_results(self, outcomes: list[Outcome]) -> None:
        assert self._reader is not None
        try:
            results = [result_of(letter) for letter in self._reader.ready()]
        except DataError:
            self._end()
            self._failed(
                f'The {self._trade.word} process gave an answer that cannot be read.', outcomes
            )
            return
        for number, result in results:
            running = self._running
            if number == _REHEARSAL:
                self._rehearsing_since_s = None
                if running is not None:
                    # The time it waited for the rehearsal to end is not the task's.
                    running.begun_s = self._clock()
            if running is None or running.number != number:
                continue
            believed = self._believed(running.task, result)
            # The task holds days of rows; it is to be gone when memory is given back.
            del running
            self._conclude(believed, outcomes)
            self.failures_in_a_row = 0
            self._pause_s = _FIRST_PAUSE_S
        if results and self._running is None and not self._trade.stays:
            self._end()

    def _conclude(self, result: Any, outcomes: list[Outcome]) -> None:
        running = self._running
        if running is None:
            return
        self._running = None
        seconds = self._clock() - running.begun_s
        outcomes.append(Outcome(running.task.request_ns, result, seconds))
        del running
        give_back()

    def _failed(self, sentence: str, outcomes: list[Outcome]) -> None:
        self.failures_in_a_row += 1
        self._start_at_s = self._clock() + self._pause_s
        self._pause_s = min(2.0 * self._pause_s, _LONGEST_PAUSE_S)
        self._conclude(sentence, outcomes)

    def _send(self) -> None:
        """Send the task at hand."""
        running, process = self._running, self._process
        if running is None or running.sent or process is None:
            return
        running.sent = True
        # The time it waited for a process to be there is not the fit's.
        running.begun_s = self._clock()
        self._post(process, running.number, running.task)

    def _post(
        self, process: subprocess.Popen[bytes], number: int, task: FitTask | DiagnosisTask
    ) -> None:
        """Send a task from a thread: a snapshot of days takes the pipe a while."""
        assert process.stdin is not None
        thread = threading.Thread(
            target=_send_quietly,
            # A descriptor of its own: the other may be closed, and its number be
            # somebody else's, while this thread still writes.
            args=(self._sending, os.dup(process.stdin.fileno()), number, task),
            name=f'{self._trade.word} sender',
            daemon=True,
        )
        thread.start()

    def _end(self) -> str:
        """Kill the process and return what became of it, in words."""
        process, self._process, self._reader = self._process, None, None
        self._rehearsing_since_s = None
        if process is None:
            return ''
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        code = process.wait()
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdout.close()
        process.stdin.close()
        return f'signal {signal.Signals(-code).name}' if code < 0 else f'exit status {code}'


def _send_quietly(
    turn: threading.Lock, descriptor: int, number: int, task: FitTask | DiagnosisTask
) -> None:
    """Send, one after the other; the monitor learns from the other pipe if nobody is there."""
    try:
        with turn, contextlib.suppress(OSError):
            send(descriptor, task_letter(number, task))
    finally:
        os.close(descriptor)


class FitWorker(Worker):
    """Computes one fit at a time."""

    def __init__(
        self,
        timeout_s: float,
        job: str = FIT_JOB,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(FIT, timeout_s, job, clock)


class DiagnosisWorker(Worker):
    """Computes one diagnosis at a time, in a process that is there only while it does."""

    def __init__(
        self,
        timeout_s: float,
        job: str = DIAGNOSIS_JOB,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(DIAGNOSIS, timeout_s, job, clock)
