# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What goes into the engine in one call and what comes out of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from valveflow_ros.curve.characteristic import HeldCause
from valveflow_ros.errors import DataError
from valveflow_ros.monitoring.events import Event
from valveflow_ros.monitoring.prediction import PredictionBlock, as_measured
from valveflow_ros.records import FloatArray, IntArray, SampleTable, Signal
from valveflow_ros.signals.static_form import integrated_input
from valveflow_ros.state import State, perhaps

# Rows freed of causes that are known, before the engine sees them.
#
# A corrector turns rows of a plant with a fault, a drift or an effect the model lacks into those
# of a plant without it: segmenter, fit, prediction and alarms then work as they always do.


class Corrector(Protocol):
    """What takes causes out of rows.

    Rows come in order of time, cut into blocks of any size, which must not matter; what is
    remembered of them is bounded.
    """

    @property
    def held(self) -> tuple[HeldCause, ...]:
        """Return the causes that are taken out."""
        ...

    def correct(self, table: SampleTable) -> SampleTable:
        """Return as many rows with opening and power as they were without the causes.

        Pressure and temperature stay as measured, so that u = V p^m holds for the rows
        returned. A value that cannot be told is NaN and `BAD`.
        """
        ...

    def restart(self) -> None:
        """Forget all rows: the next one begins a new series."""
        ...

    def snapshot(self) -> State:
        """Return what is remembered."""
        ...

    def restore(self, saved: State) -> None:
        """Go on from a state; raises `DataError` if it does not fit."""
        ...


class Correction:
    """Hand each row to a corrector once, though the engine may be offered it twice.

    Parameters
    ----------
    corrector : Corrector, optional
        Without one rows pass as they are.

    Notes
    -----
    The engine stops within a block where it wants a fit, and is given the rest of it
    again. That rest was corrected already; it is kept until the rows go beyond it.
    """

    def __init__(self, corrector: Corrector | None = None) -> None:
        self._corrector = corrector
        self._ahead: SampleTable | None = None

    @property
    def corrector(self) -> Corrector | None:
        """Return what changes the rows; None if nothing does."""
        return self._corrector

    @property
    def on(self) -> bool:
        """Tell whether rows are changed."""
        return self._corrector is not None

    @property
    def held(self) -> tuple[HeldCause, ...]:
        """Return the causes that are taken out."""
        return () if self._corrector is None else self._corrector.held

    def rows(self, table: SampleTable) -> SampleTable:
        """Return the rows corrected, of the same number."""
        if self._corrector is None or not len(table):
            return table
        parts: list[SampleTable] = []
        done = 0
        if self._ahead is not None:
            first = int(np.searchsorted(self._ahead.time_ns, table.time_ns[0]))
            known = self._ahead.part(first, len(self._ahead))
            done = min(len(known), len(table))
            parts.append(known.part(0, done))
            if done == len(table):
                self._ahead = known
                return parts[0]
        parts.append(self._corrector.correct(table.part(done, len(table))))
        self._ahead = SampleTable.concatenate(parts) if done else parts[-1]
        return self._ahead

    def snapshot(self) -> State:
        """Return what is remembered."""
        ahead = self._ahead
        return {
            'corrector': None if self._corrector is None else self._corrector.snapshot(),
            'ahead': None if ahead is None else [ahead.time_ns, ahead.values, ahead.quality],
        }

    def restore(self, saved: State) -> None:
        """Go on from a state; raises `DataError` if it does not fit."""
        if (self._corrector is None) != (saved['corrector'] is None):
            raise DataError('The saved state was made with another model_file.')
        if self._corrector is not None:
            self._corrector.restore(saved['corrector'])
        ahead = perhaps(saved, 'ahead', list)
        self._ahead = None if ahead is None else SampleTable(*ahead)

    def restart(self) -> None:
        """Forget all rows after the clock went back."""
        self._ahead = None
        if self._corrector is not None:
            self._corrector.restart()


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
