"""What goes into the engine in one call and what comes out of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from valveflow_ros.core.events import Event
from valveflow_ros.core.units import integrated_input
from valveflow_ros.records import FloatArray, IntArray, SampleTable, Signal


@dataclass(frozen=True, slots=True)
class Fed:
    """What one call of `Monitor.feed` did.

    Attributes
    ----------
    rows : int
        Rows taken. Fewer than given after a `FitRequested`: whoever computes
        fits in place hands the outcome back before the rest is fed.
    events : list of Event
        In the order in which they happened.
    """

    rows: int
    events: list[Event]


@dataclass(frozen=True, slots=True)
class Rows:
    """The columns of some rows, all of shape (n,)."""

    time_ns: IntArray
    u: FloatArray
    power_mw: FloatArray
    temperature_degc: FloatArray
    opening_percent: FloatArray

    def part(self, start: int, end: int) -> Rows:
        """Return the rows ``[start, end)`` without copying."""
        cut = slice(start, end)
        return Rows(
            self.time_ns[cut],
            self.u[cut],
            self.power_mw[cut],
            self.temperature_degc[cut],
            self.opening_percent[cut],
        )

    @classmethod
    def of(cls, table: SampleTable, exponent: float) -> Rows:
        """Return the columns the engine works on, u of eq. (1) among them."""
        opening = np.ascontiguousarray(table.column(Signal.VALVE_OPENING))
        u = integrated_input(
            opening,
            table.column(Signal.MAIN_STEAM_PRESSURE),
            exponent,
        )
        power = np.ascontiguousarray(table.column(Signal.GENERATED_POWER))
        temperature = np.ascontiguousarray(table.column(Signal.MAIN_STEAM_TEMPERATURE))
        return cls(table.time_ns, u, power, temperature, opening)
