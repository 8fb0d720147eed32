"""Knees of the plain curve that are no valve points but the middle of a bump.

A curve found by prediction error puts a knee wherever one pays, in the middle of a bump too,
and `curve_shape` would find nothing left. Such a knee bends the other way than both its
neighbours. It is given up where a bump in its place does as well.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from valveflow_ros.diagnosis.bench import Bench
from valveflow_ros.diagnosis.causes import catalogue
from valveflow_ros.diagnosis.extended import Extended
from valveflow_ros.diagnosis.fitting import Task, settle
from valveflow_ros.diagnosis.simplify import simplified, without_knot

_WIDTHS = (0.5, 0.8, 1.2)  # of the shorter piece beside the knee
_PLACES = (-0.15, 0.0, 0.15)


def without_bumps(task: Task, plain: Extended) -> tuple[Task, Extended]:
    """Return the plain model without knees that a bump would replace, fitted again."""
    for knot in _suspects(plain):
        smaller = replace(plain, base=simplified(without_knot(plain.base, knot)))
        if _as_good(task, plain, smaller, float(plain.base.knots[knot]), _width(plain, knot)):
            task, smaller, _ = settle(task, smaller, rounds=1, steps=4)
            return without_bumps(task, smaller)
    return task, plain


def _suspects(plain: Extended) -> list[int]:
    """Return inner knots that bend against both neighbours."""
    bend = np.sign(np.diff(plain.base.slopes()))
    return [
        k + 1 for k in range(1, len(bend) - 1) if bend[k] == -bend[k - 1] == -bend[k + 1] != 0.0
    ]


def _width(plain: Extended, knot: int) -> float:
    knots = plain.base.knots
    return float(min(knots[knot] - knots[knot - 1], knots[knot + 1] - knots[knot]))


def _as_good(task: Task, plain: Extended, smaller: Extended, u: float, width: float) -> bool:
    """Tell whether a bump at ``u`` brings the smaller model to the cost of the plain one."""
    bench, cause = Bench(task, smaller), catalogue()['curve_shape']
    gain = max(
        bench.scaled_height(cause, (u + place * width, share * width)).gain
        for share in _WIDTHS
        for place in _PLACES
    )
    return bench.floor - 2.0 * bench.variance * gain <= task.cost(plain)
