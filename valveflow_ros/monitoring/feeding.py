"""What goes into the engine in one call and what comes out of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from valveflow_ros.monitoring.corrector import Correction
from valveflow_ros.monitoring.events import Event
from valveflow_ros.monitoring.prediction import PredictionBlock, as_measured
from valveflow_ros.records import FloatArray, IntArray, SampleTable, Signal
from valveflow_ros.signals.units import integrated_input


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
    command_percent: FloatArray

    def part(self, start: int, end: int) -> Rows:
        """Return the rows ``[start, end)`` without copying."""
        cut = slice(start, end)
        return Rows(
            self.time_ns[cut],
            self.u[cut],
            self.power_mw[cut],
            self.temperature_degc[cut],
            self.opening_percent[cut],
            self.command_percent[cut],
        )

    @classmethod
    def of(cls, table: SampleTable, exponent: float, correction: Correction | None = None) -> Rows:
        """Return the columns the engine works on, u of eq. (1) among them."""
        if correction is not None and correction.on:
            measured = np.ascontiguousarray(table.column(Signal.GENERATED_POWER))
            return CorrectedRows(cls.of(correction.rows(table), exponent), measured)
        opening = np.ascontiguousarray(table.column(Signal.VALVE_OPENING))
        u = integrated_input(
            opening,
            table.column(Signal.MAIN_STEAM_PRESSURE),
            exponent,
        )
        power = np.ascontiguousarray(table.column(Signal.GENERATED_POWER))
        temperature = np.ascontiguousarray(table.column(Signal.MAIN_STEAM_TEMPERATURE))
        command = np.ascontiguousarray(table.column(Signal.VALVE_COMMAND))
        return cls(table.time_ns, u, power, temperature, opening, command)

    def shown(self, block: PredictionBlock) -> PredictionBlock:
        """Return what is predicted of these rows in terms of the power that was measured."""
        return block


class CorrectedRows(Rows):
    """Rows freed of causes, with the power as it was measured.

    Parameters
    ----------
    rows : Rows
    measured_mw : float64 (n,)
    """

    __slots__ = ('measured_mw',)
    measured_mw: FloatArray

    def __init__(self, rows: Rows, measured_mw: FloatArray) -> None:
        Rows.__init__(
            self, rows.time_ns, rows.u, rows.power_mw, rows.temperature_degc,
            rows.opening_percent, rows.command_percent,
        )  # fmt: skip
        object.__setattr__(self, 'measured_mw', measured_mw)

    def part(self, start: int, end: int) -> CorrectedRows:
        """Return the rows ``[start, end)`` without copying."""
        return CorrectedRows(Rows.part(self, start, end), self.measured_mw[start:end])

    def shown(self, block: PredictionBlock) -> PredictionBlock:
        """Return the predictions with what the correction took out put back."""
        return as_measured(block, self.measured_mw)
