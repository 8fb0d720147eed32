"""The traditional manual test: constant pressure, the opening raised in steps and held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from valveflow_ros.errors import InputError
from valveflow_ros.plant.effect import DAY_S, Hooks, clock_at_ns
from valveflow_ros.plant.plant import ChanceSource, Outside, Plant, Wander, generator
from valveflow_ros.plant.simulator import (
    DEFAULT_START_NS,
    LONGEST_DAYS,
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

    def __post_init__(self) -> None:
        """Refuse a test nobody could carry out."""
        ends = (self.opening_from_percent, self.opening_to_percent)
        checks = (
            (1.0 <= self.pressure_mpa <= 40.0, 'the pressure must be 1 to 40 MPa'),
            (0.0 <= self.pressure_wander_mpa <= 1.0, 'its wander must be 0 to 1 MPa'),
            (all(0.0 < end <= 100.0 for end in ends), 'openings must be above 0, at most 100 %'),
            (1 <= self.steps <= 1000, 'there must be 1 to 1000 steps'),
            (1.0 <= self.hold_s <= DAY_S, 'a hold must last 1 to 86400 s'),
            (0.001 <= self.speed_percent_per_s <= 100.0, 'the speed must be 0.001 to 100 %/s'),
        )
        for good, sentence in checks:
            if not good:
                raise InputError(f'This step test cannot be carried out: {sentence}.')

    def corners(self) -> tuple[FloatArray, FloatArray]:
        """Return corner points of the opening: seconds from the start, and %."""
        openings = np.linspace(self.opening_from_percent, self.opening_to_percent, self.steps + 1)
        move_s = np.abs(np.diff(openings)) / self.speed_percent_per_s
        begins = np.append(0.0, np.cumsum(self.hold_s + move_s))
        times = np.column_stack([begins, begins + self.hold_s]).ravel()
        return times, np.repeat(openings, 2)


class _ByHand:
    """The unit under manual control, the power control and the grid's pulses being off."""

    def __init__(self, unit: UnitDescription, seed: int, plan: StepPlan, warm_up: int) -> None:
        self._unit = unit
        self._plan = plan
        self._warm_up = warm_up
        h, usual = unit.sample_period_s, unit.programme
        self._pressure = Wander(generator(seed, ChanceSource.PRESSURE), usual.pressure_wander_s, h)
        self._temperature = Wander(
            generator(seed, ChanceSource.TEMPERATURE), usual.temperature_wander_s, h
        )

    @property
    def manual(self) -> bool:
        """The opening is set by hand."""
        return True

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

    Raises
    ------
    InputError
        As `valveflow_ros.plant.simulator.simulate`, or the test is too long.
    """
    unit, plan = unit or UnitDescription(), plan or StepPlan()
    h = unit.sample_period_s
    rows = round(float(plan.corners()[0][-1]) / h)
    if rows * h > LONGEST_DAYS * DAY_S:
        raise InputError(f'A step test may last {LONGEST_DAYS:g} days at most.')
    hooks = Hooks.of(unit, rows * h)
    recorder = prepare(hooks, seed, start_ns, effects)
    warm_up = round(WARM_UP_S / h)
    drive = _ByHand(unit, seed, plan, warm_up)
    plant = Plant(hooks, drive, seed, -warm_up, clock_at_ns(start_ns))
    return SimulatedLog.joined(list(recorder.parts(plant, warm_up, rows, rows)))
