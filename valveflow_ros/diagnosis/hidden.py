"""States that are not measured: inferred again where a model is to be judged or used."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from valveflow_ros.diagnosis.bench import Bench
from valveflow_ros.diagnosis.extended import Extended
from valveflow_ros.diagnosis.fitting import Task
from valveflow_ros.records import BoolArray, FloatArray


def inferred(task: Task, model: Extended, allowed: BoolArray) -> Extended:
    """Return the model with hidden states as the allowed sub-blocks show them.

    Parameters
    ----------
    task : Task
        Its rows are those that may be looked at, together with ``allowed``.
    allowed : bool (subs,)
    """
    for a in model.active:
        if a.cause.infer is not None:
            bench = Bench(task, model.without(a.name))
            model = model.having(replace(a, extra=a.cause.infer(bench, a, allowed)))
    return model


def fair_residual(task: Task, model: Extended) -> FloatArray:
    """Return the residual in MW, shape (m,), with hidden states inferred from other sub-blocks.

    In a sealed block a state cannot be known from outside. The even sub-blocks tell the
    state of the odd ones and the other way round, so that no row is judged by a state it helped
    to find. The size of the effect stays as fitted elsewhere.
    """
    return _crossed(replace(task, rows=task.scene.whole), model)


def fair_open_residual(task: Task, model: Extended) -> FloatArray:
    """Return the same with the states told by rows of the task alone."""
    return _crossed(task, model)


def _crossed(task: Task, model: Extended) -> FloatArray:
    if all(a.cause.infer is None for a in model.active):
        return task.residual(model)
    odd = np.arange(task.scene.subs) % 2 == 1
    by_even = task.residual(inferred(task, model, ~odd))
    by_odd = task.residual(inferred(task, model, odd))
    return np.where(odd[task.scene.sub], by_even, by_odd)
