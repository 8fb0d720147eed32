# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Units that make one thing visible at a time, their runs, and plants at rest."""

import dataclasses
import functools
import math

import numpy as np
from step_plan import StepPlan, step_test

from valveflow_ros.plant.simulator import simulate
from valveflow_ros.plant.spec import EffectSpec
from valveflow_ros.plant.unit import Noise, Programme, Region, UnitDescription

DAYS = 0.2
OPEN_LOOP = UnitDescription(
    regions=(Region(np.inf, 10.0, 3.0),), programme=Programme(feedback=False)
)
UNITS = {
    'paper': UnitDescription(),
    # One lag and no power control.
    'open': OPEN_LOOP,
    # Answers at once, so that power is F(u) times what acts on it.
    'prompt': dataclasses.replace(OPEN_LOOP, regions=(Region(np.inf, 1e-3, 0.0),)),
    # Sensors and grid make no noise.
    'quiet': UnitDescription(
        noise=Noise(0.0, 60.0, 0.0, 0.0, 0.0, 0.0), programme=Programme(temperature_wander_k=0.0)
    ),
}
TRUTHS = ('true_u', 'true_power_mw', 'noise_mw', 'load_mw', 'plug_percent')
# Static effects are read from a step test without noise: the end of each hold is at rest.
REST = StepPlan(pressure_wander_mpa=0.0, hold_s=1800.0)


@functools.cache
def run(*effects, unit='paper', days=DAYS, seed=1):
    """Simulate a unit by name with effects by their text; the log is shared: do not change it."""
    return simulate(days, seed, UNITS[unit], effects=[EffectSpec.parse(e) for e in effects])


@functools.cache
def rest(*effects):
    """Return the step test of the quiet unit."""
    return step_test(1, REST, UNITS['quiet'], effects=[EffectSpec.parse(e) for e in effects])


def at_rest(*effects):
    """Return the power half a minute before the end of each hold, less that without effects."""
    at = np.round(REST.corners()[0][1::2]).astype(int) - 31
    return rest(*effects).true_power_mw[at] - rest().true_power_mw[at]


def same(one, other):
    """Assert that two logs are equal bit for bit."""
    np.testing.assert_array_equal(one.table.time_ns, other.table.time_ns)
    np.testing.assert_array_equal(one.table.values, other.table.values)
    np.testing.assert_array_equal(one.table.quality, other.table.quality)
    for name in TRUTHS:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def naive_lag(y, x0, x1, time_s, h=1.0):
    """Solve T y' + y = x exactly over one step in which x is straight."""
    if time_s == 0.0:
        return x1
    slope = (x1 - x0) / h
    return x1 - slope * time_s + (y - x0 + slope * time_s) * math.exp(-h / time_s)
