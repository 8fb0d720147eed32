"""The process that computes fits or diagnoses: started by a `Worker`, ends with it."""

from __future__ import annotations

import ctypes
import importlib
import os
import signal
import sys
from collections.abc import Callable
from typing import Any

from valveflow_ros.errors import DataError
from valveflow_ros.ros.process import one_line, with_place
from valveflow_ros.ros.worker.protocol import FrameReader, result_letter, send, task_of

_PR_SET_PDEATHSIG = 1


def die_with(parent: int) -> None:
    """Let the kernel end this process when its parent ends, in whatever way."""
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        # It ended before the kernel was asked.
        os._exit(1)


def load(job: str) -> Callable[[Any], Any]:
    """Return the function named ``module:function``."""
    module, _, function = job.partition(':')
    return getattr(importlib.import_module(module), function)  # type: ignore[no-any-return]


def answer(work: Callable[[Any], Any], task: Any, word: str = 'fit') -> Any:
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
    """Answer tasks from standard input on standard output until it closes.

    Parameters
    ----------
    arguments : list of str
        The parent's process id, the job as ``module:function``, how far to stand back, and what
        the job is called.
    """
    parent, job, nice, word = int(arguments[0]), arguments[1], int(arguments[2]), arguments[3]
    die_with(parent)
    os.nice(nice)
    results = os.dup(1)
    # Nothing that a library prints may get between the results.
    os.dup2(2, 1)
    work = load(job)
    tasks = FrameReader(0)
    while True:
        try:
            number, task = task_of(tasks.wait())
        except EOFError:
            return 0
        send(results, result_letter(number, answer(work, task, word)))


if __name__ == '__main__':
    try:
        sys.exit(main(sys.argv[1:]))
    except BrokenPipeError:
        sys.exit(0)
    except Exception as error:  # noqa: BLE001 - the monitor sees the end and says so
        sys.exit(f'valveflow worker process: {one_line(error)}')
