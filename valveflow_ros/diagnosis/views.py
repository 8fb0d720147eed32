"""What the pictures of a diagnosis show, taken from the record and the models."""

from __future__ import annotations

import numpy as np

from valveflow_ros.diagnosis.diagnose import Record
from valveflow_ros.diagnosis.fitting import Task
from valveflow_ros.diagnosis.grid import make_scene
from valveflow_ros.diagnosis.residual_map import ResidualMap, residual_maps
from valveflow_ros.diagnosis.result import Diagnosis
from valveflow_ros.diagnosis.scene import ORDER
from valveflow_ros.diagnosis.signature import Answer, Signature, after_moves, signatures

Views = tuple[tuple[Signature, ...], tuple[Answer, ...], tuple[ResidualMap, ...]]


def views(record: Record, found: Diagnosis) -> Views:
    """Return residuals by variable, around fast moves and in maps, before and after extending."""
    bad, _ = record.faults()
    scene = make_scene(record.table, record.step_s, record.pressure_exponent, record.settle_s, bad)
    task = Task(scene, scene.whole, np.zeros(ORDER))
    return (
        signatures(task, found.simulation, found.extended),
        after_moves(task, found.simulation, found.extended),
        residual_maps(task, found.simulation, found.extended),
    )
