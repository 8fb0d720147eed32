# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The traditional manual test: constant pressure, the opening raised in steps and held."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from valveflow_ros.plant.effect import Hooks, clock_at_ns
from valveflow_ros.plant.plant import ChanceSource, Outside, Plant, Wander, generator
from valveflow_ros.plant.simulator import (
    DEFAULT_START_NS,
    WARM_UP_S,
    SimulatedLog,
    prepare,
)
from valveflow_ros.plant.spec import EffectSpec
from valveflow_ros.plant.unit import UnitDescription
from valveflow_ros.records import FloatArray


@dataclass(frozen=True, slots=True)
class StepPlan:
    """How the test is carried out.

    Attributes
    ----------
    pressure_mpa : float
        Kept all the time; the boiler holds it to ``pressure_wander_mpa`` (standard deviation).
    opening_from_percent, opening_to_percent : float
        First and last opening; either may be the larger.
    steps : int
        Number of moves between them.
    hold_s : float
        Time at each opening, the first and the last included.
    speed_percent_per_s : float
        Of the moves.
    """

    pressure_mpa: float = 16.7
    pressure_wander_mpa: float = 0.02
    opening_from_percent: float = 45.0
    opening_to_percent: float = 98.0
    steps: int = 18
    hold_s: float = 900.0
    speed_percent_per_s: float = 0.5

    def corners(self) -> tuple[FloatArray, FloatArray]:
        openings = np.linspace(self.opening_from_percent, self.opening_to_percent, self.steps + 1)
        move_s = np.abs(np.diff(openings)) / self.speed_percent_per_s
        begins = np.append(0.0, np.cumsum(self.hold_s + move_s))
        times = np.column_stack([begins, begins + self.hold_s]).ravel()
        return times, np.repeat(openings, 2)


class _ByHand:
    """The unit under manual control, the power control and the grid's pulses being off."""

    manual = True

    def __init__(self, unit: UnitDescription, seed: int, plan: StepPlan, warm_up: int) -> None:
        self._unit = unit
        self._plan = plan
        self._warm_up = warm_up
        h, usual = unit.sample_period_s, unit.programme
        self._pressure = Wander(generator(seed, ChanceSource.PRESSURE), usual.pressure_wander_s, h)
        self._temperature = Wander(
            generator(seed, ChanceSource.TEMPERATURE), usual.temperature_wander_s, h
        )

    def advance(self, first: int, count: int) -> Outside:
        """Return rows ``[first, first + count)``; the load is what the curve gives."""
        unit, plan = self._unit, self._plan
        row = np.arange(first, first + count, dtype=np.float64) - self._warm_up
        opening = np.interp(row * unit.sample_period_s, *plan.corners())
        pressure = plan.pressure_mpa + plan.pressure_wander_mpa * self._pressure.advance(count)
        usual = unit.programme
        temperature = usual.temperature_degc + usual.temperature_wander_k * (
            self._temperature.advance(count)
        )
        load = unit.curve(opening * plan.pressure_mpa**unit.pressure_exponent)
        return Outside(load, pressure, temperature, opening)


def step_test(
    seed: int,
    plan: StepPlan | None = None,
    unit: UnitDescription | None = None,
    start_ns: int = DEFAULT_START_NS,
    effects: Sequence[EffectSpec] = (),
) -> SimulatedLog:
    """Carry out the manual test that Section I of the paper describes.

    The unit stands at the first opening for an hour before the record begins.
    The outermost pieces of the curve go on where the test leaves its knots.
    """
    unit, plan = unit or UnitDescription(), plan or StepPlan()
    h = unit.sample_period_s
    rows = round(float(plan.corners()[0][-1]) / h)
    hooks = Hooks.of(unit, rows * h)
    recorder = prepare(hooks, seed, start_ns, effects)
    warm_up = round(WARM_UP_S / h)
    drive = _ByHand(unit, seed, plan, warm_up)
    plant = Plant(hooks, drive, seed, -warm_up, clock_at_ns(start_ns))
    return SimulatedLog.joined(list(recorder.parts(plant, warm_up, rows, rows)))
