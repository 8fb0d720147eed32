# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Plants at rest, and effects from their text."""

from __future__ import annotations

import numpy as np
from step_plan import StepPlan, step_test

from valveflow_ros.plant.simulator import SimulatedLog
from valveflow_ros.plant.spec import EffectSpec
from valveflow_ros.plant.unit import UnitDescription

DAYS = 0.25


def spec(name: str, values: str = '') -> EffectSpec:
    """Return an effect from its name and the text behind it."""
    return EffectSpec.parse(f'{name}:{values}')


# Static effects on a step test without noise: the end of each hold is at rest.
REST = StepPlan(pressure_wander_mpa=0.0, hold_s=1800.0)


def at_rest(unit: UnitDescription, *effects: EffectSpec) -> tuple[np.ndarray, SimulatedLog]:
    """Return the power half a minute before the end of each hold, and the log."""
    log = step_test(1, REST, unit, effects=effects)
    corners_s = REST.corners()[0]
    return log.true_power_mw[np.round(corners_s[1::2]).astype(int) - 31], log


def rest_points(unit: UnitDescription) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return u, x and F' u at the holds."""
    u = REST.corners()[1][1::2] * REST.pressure_mpa**1.125
    piece = np.searchsorted(unit.curve.knots[1:-1], u, side='right')
    return u, unit.curve(u), unit.curve.slopes[piece] * u
