"""Curve and regions found anew behind a strong cause.

A cause that moves the power by as much as the noise leads the identification astray: regions
are missed, knees are put where none is. Seen through the cause, the record is that of the
plant without it, and pieces and regions are searched for again as in an identification.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from valveflow_ros.curve.model import RegionalModel
from valveflow_ros.diagnosis.extended import Drive, Extended, answer, drive
from valveflow_ros.diagnosis.fitting import Task, settle
from valveflow_ros.diagnosis.simplify import simplified
from valveflow_ros.errors import TooFewSamplesError
from valveflow_ros.fit.problem import Samples
from valveflow_ros.fit.refine import search

_MORE_PIECES, _MOST = 3, 8
_EACH = 5.0  # log-likelihood that each number more of curve and regions must bring


def rebuilt(task: Task, model: Extended) -> tuple[Task, Extended]:
    """Return the model on a curve and regions of its own if they do better, else as it is."""
    try:
        base = simplified(search(_seen_through(task, model), _rich(model.base), _MOST))
    except (TooFewSamplesError, np.linalg.LinAlgError):
        return task, model
    if base.pieces == model.base.pieces and base.regions == model.base.regions:
        return task, model
    task_new, other, cost = settle(task, replace(model, base=base), rounds=1, steps=4)
    # Both under one whitening: the better model's.
    variance = cost / max(int(task.rows.sum()), 1)
    before = task_new.cost(model) / (2.0 * variance) + _EACH * len(model.base.pack())
    after = task_new.cost(other) / (2.0 * variance) + _EACH * len(other.base.pack())
    return (task_new, other) if after < before else (task, model)


def _seen_through(task: Task, model: Extended) -> Samples:
    """Return the record as it would be without the causes; sealed blocks are left out."""
    scene = task.scene
    driven = drive(scene, model)
    plain = answer(scene, model.without_causes(), Drive(driven.u, None, None))
    power = scene.power - (answer(scene, model) - plain)
    rows = np.repeat(task.rows, scene.group)
    return Samples(
        u=driven.u,
        power_mw=np.repeat(np.where(task.rows, power, 0.0), scene.group),
        usable=(rows & (scene.usable > 0)).astype(np.uint8),
        step_s=scene.step_s,
        settle_s=scene.settle_s,
        group=scene.group,
    )


def _rich(base: RegionalModel) -> RegionalModel:
    """Return the curve with its widest pieces cut in two, to be pruned."""
    for _ in range(_MORE_PIECES):
        k = int(np.argmax(np.diff(base.knots)))
        middle = 0.5 * (base.knots[k] + base.knots[k + 1])
        value = 0.5 * (base.left[k] + base.right[k])
        base = replace(
            base,
            knots=np.insert(base.knots, k + 1, middle),
            left=np.insert(base.left, k + 1, value),
            right=np.insert(base.right, k, value),
        )
    return base
