"""What the model could explain itself, to be taken away before a cause is judged."""

from __future__ import annotations

import numpy as np

from valveflow_ros.diagnosis.extended import Extended
from valveflow_ros.diagnosis.fitting import (
    Task,
    base_mask,
    base_tangents,
    cause_tangents,
    level_tangents,
)
from valveflow_ros.records import FloatArray


def nuisance(task: Task, model: Extended) -> FloatArray:
    """Return whitened tangents of everything the model could move itself, columns scaled to 1.

    A delay at its bound 0 cannot move down and is left out: it would swallow a clock offset.
    """
    free = np.flatnonzero(base_mask(task, model))
    base = base_tangents(task, model)
    first_delay = len(model.base.pack()) - model.base.regions
    at_bound = [
        k for k, p in enumerate(free)
        if p >= first_delay and model.base.delays[p - first_delay] <= 0.0
    ]  # fmt: skip
    base = np.delete(base, at_bound, axis=1)
    table = task.innovations(
        np.column_stack([base, cause_tangents(task, model), level_tangents(task, model)])
    )
    norm = np.sqrt((table**2).sum(axis=0))
    return np.asarray(table[:, norm > 1e-9 * norm.max()] / norm[norm > 1e-9 * norm.max()])
