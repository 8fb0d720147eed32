"""What the processes beside the monitor do: fits and diagnoses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from valveflow_ros.ros.worker.outcome import content_objection, objection

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
