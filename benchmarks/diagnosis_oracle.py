# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a diagnosis could know at best: the causes with their true sizes, the rest fitted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from valveflow_ros.diagnosis.cause import FittedCause
from valveflow_ros.diagnosis.causes import catalogue
from valveflow_ros.diagnosis.diagnose import Record
from valveflow_ros.diagnosis.evidence import colour, rmse
from valveflow_ros.diagnosis.extended import Extended
from valveflow_ros.diagnosis.fitting import Task, held, improve, search_levels, whitening
from valveflow_ros.diagnosis.grids import ORDER, make_grids
from valveflow_ros.diagnosis.record_faults import faults
from valveflow_ros.diagnosis.result import Diagnosis
from valveflow_ros.plant.spec import EffectSpec


@dataclass(frozen=True)
class Oracle:
    """What the true causes are worth.

    Attributes
    ----------
    available : float
        Log-likelihood on the open blocks over the simulation; 64 in the whole record, 51 on
        four fifths of it, is twice the smallest detectable amplitude.
    rmse_mw : float
        On the sealed blocks.
    """

    available: float
    rmse_mw: float


def oracle(
    record: Record, found: Diagnosis, effects: tuple[EffectSpec, ...], given: bool
) -> Oracle | None:
    """Fit everything but the causes, whose sizes are known; None where a hidden path is needed."""
    true = tuple(a for a in map(_active, effects) if a is not None)
    if len(true) < len(effects):
        return None
    bad, _ = faults(record.table, record.step_s)
    grids = make_grids(*record.about, bad)
    task = Task(grids, grids.open_rows, np.zeros(ORDER), given)
    task = replace(task, ar=whitening(grids, task.residual(found.extended)))
    base = found.extended.base if found.extended.active else found.simulation.base
    model = held(grids, Extended(base, true), task.ar)
    model, cost = _others(task, model)
    variance = cost / int(task.rows.sum()) * colour(task, task.innovations(task.residual(model)))
    available = (task.cost(found.simulation) - cost) / (2.0 * variance)
    return Oracle(available, rmse(task, model, grids.sealed_rows))


def _active(spec: EffectSpec) -> FittedCause | None:
    cause = catalogue().get(spec.name)
    if cause is None or cause.infer is not None:
        return None
    return FittedCause(cause, tuple(float(spec.parameters[u.name]) for u in cause.unknowns))


def _others(task: Task, model: Extended) -> tuple[Extended, float]:
    """Fit curve and dynamics alone."""
    true = model.active
    for _ in range(2):
        model, cost = improve(task, model, 6)
        model = replace(model, active=true)
        model, cost = search_levels(task, model, task.cost(model))
    return model, cost
