"""What causes that live in time share."""

from __future__ import annotations

import numpy as np

from valveflow_ros.diagnosis.cause import Kind, Unknown
from valveflow_ros.diagnosis.scene import DAY_S, Scene
from valveflow_ros.errors import counted
from valveflow_ros.records import FloatArray

TEN_DAYS_S = 10.0 * DAY_S

ONSET = Unknown('t0_days', 'd', 2.0 / 24.0, 0.0, 400.0, Kind.LINE, dated=True)


def ramp(scene: Scene, time_s: FloatArray) -> FloatArray:
    """Return a ramp that rises by 1 in ten days and is 0 in the middle of the record.

    What changes with time is counted from the record's mean throughout: the curve is then the
    mean curve, and the levels between regions stay where they are while a change is fitted.
    """
    return np.asarray((time_s - 0.5 * scene.reference.span_s) / TEN_DAYS_S)


def since(scene: Scene, t0_days: float) -> FloatArray:
    """Return a step of height 1 at an onset, its mean over the record taken off."""
    onset, span = t0_days * DAY_S, scene.reference.span_s
    after = min(max(1.0 - onset / span, 0.0), 1.0)
    return np.where(scene.time_s >= onset, 1.0, 0.0) - after


def a_day(scene: Scene) -> str:
    """Say that a record is too short for what changes with time."""
    return _at_least(scene, 1.0)


def three_days(scene: Scene) -> str:
    """Say that a record is too short for what repeats daily."""
    return _at_least(scene, 3.0)


def _at_least(scene: Scene, days: float) -> str:
    if scene.days >= 0.98 * days:
        return ''
    return (
        f'it changes with time, and the record lasts '
        f'{counted(float(f"{scene.days:.2g}"), "day")}; at least {days:g} are needed'
    )


def change(share: float) -> str:
    """Return a relative change in words."""
    return f'{abs(100.0 * share):.2g} % {"more" if share > 0.0 else "less"}'
