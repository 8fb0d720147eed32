"""The places of the plant where an effect may take hold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from valveflow_ros.errors import InputError
from valveflow_ros.plant.unit import Region, UnitDescription
from valveflow_ros.records import NS_PER_S, FloatArray, Signal

DAY_S = 86_400.0


@dataclass(frozen=True, slots=True)
class Forcing:
    """Rows of the closed loop before it runs; all float64 (n,).

    ``time_s`` counts from the first recorded row (the warm-up is negative),
    ``clock_s`` from a midnight UTC. An effect writes into ``gain`` (factor on
    x = F(u)), ``input_gain`` (factor on u) and ``offset_mw`` (added to the
    power), nowhere else.
    """

    time_s: FloatArray
    clock_s: FloatArray
    pressure_mpa: FloatArray
    temperature_degc: FloatArray
    gain: FloatArray
    input_gain: FloatArray
    offset_mw: FloatArray


@dataclass(frozen=True, slots=True)
class Written:
    """Rows as the historian is about to keep them; columns are changed in place."""

    time_s: FloatArray
    columns: dict[Signal, FloatArray]


@dataclass(slots=True)
class Bank:
    """What stands between two places of the actuator; the defaults let everything through.

    Attributes
    ----------
    rate_percent_per_s : float
        Fastest motion.
    band_percent, jump_percent : float
        Stick-slip parameters S and J.
    top_percent : float
        Highest position.
    slack_percent : float
        Dead band of a loose linkage.
    """

    rate_percent_per_s: float = np.inf
    band_percent: float = 0.0
    jump_percent: float = 0.0
    top_percent: float = np.inf
    slack_percent: float = 0.0


@dataclass(frozen=True, slots=True)
class AddedCurve:
    """MW added to x as a piecewise-linear function of u from ``from_s`` on, level outside."""

    u: FloatArray
    x_mw: FloatArray
    from_s: float = -np.inf


@dataclass(slots=True)
class Hooks:
    """Everything effects can change, set up once for a run.

    The position sensor stands between the two banks: what happens in
    ``before_sensor`` (from command to sensor) shows in the measured opening,
    what happens in ``after_sensor`` (from sensor to plug) does not.

    Attributes
    ----------
    unit : UnitDescription
        The unit without any effect.
    length_s : float
        Length of the recorded part.
    forcing : list of callables
        Each changes the `Forcing` of every part of the run.
    writing : list of callables
        Each changes what is `Written` of every part of the run.
    lead_s : float
        How much earlier than the other signals the power is stamped.
    kappa_mpa_per_mw, critical_ratio : float
        Back pressure per power (0: always choked) and critical pressure ratio.
    reheater_share, reheater_s : float
        Share of the power made before the reheater, and its time constant.
    """

    unit: UnitDescription
    length_s: float
    regions: tuple[Region, ...]
    forcing: list[Callable[[Forcing], None]] = field(default_factory=list)
    writing: list[Callable[[Written], None]] = field(default_factory=list)
    before_sensor: Bank = field(default_factory=Bank)
    after_sensor: Bank = field(default_factory=Bank)
    added_curves: list[AddedCurve] = field(default_factory=list)
    lead_s: float = 0.0
    kappa_mpa_per_mw: float = 0.0
    critical_ratio: float = 0.546
    reheater_share: float = 1.0
    reheater_s: float = 0.0
    _claimed: set[str] = field(default_factory=set)

    @classmethod
    def of(cls, unit: UnitDescription, length_s: float) -> Hooks:
        """Return hooks with nothing on them."""
        return cls(unit, length_s, unit.regions)

    def bank(self, before_sensor: float) -> Bank:
        """Return the bank on one side of the position sensor."""
        return self.before_sensor if before_sensor else self.after_sensor

    def claim(self, name: str, place: str = '') -> None:
        """Say that a place that holds one setting only is taken.

        Raises
        ------
        InputError
            It was taken before.
        """
        key = f'{name} {place}'
        if key in self._claimed:
            where = f' {place}' if place else ''
            raise InputError(f"Effect '{name}'{where} is given twice; it can act only once.")
        self._claimed.add(key)


def clock_at_ns(start_ns: int) -> float:
    """Return the seconds since the last midnight UTC at ``start_ns``."""
    return (start_ns % (int(DAY_S) * NS_PER_S)) / NS_PER_S
