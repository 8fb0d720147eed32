# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Input and output of one call of the engine."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from valveflow_ros.curve.characteristic import HeldCause
from valveflow_ros.errors import DataError
from valveflow_ros.monitoring.events import Event
from valveflow_ros.monitoring.prediction import PredictionBlock, as_measured
from valveflow_ros.records import FloatArray, IntArray, SampleTable, Signal
from valveflow_ros.signals.static_form import integrated_input
from valveflow_ros.state import State, perhaps

# Removal of known causes from rows, before the engine uses them.
#
# A corrector turns rows of a plant with a fault, a drift or an effect that the model lacks into
# those of a plant without it: segmenter, fit, prediction and alarms need no change.


class Corrector(Protocol):
    """An object that removes causes from rows.

    Rows come in order of time, in blocks of any size; the result does not depend on the blocks.
    The state has a bounded size.
    """

    @property
    def held(self) -> tuple[HeldCause, ...]:
        """Return the causes that are removed."""
        ...

    def correct(self, table: SampleTable) -> SampleTable:
        """Return the same number of rows, with opening and power as without the causes.

        Pressure and temperature stay as measured, so that u = V p^m holds for the returned
        rows. An unknown value is NaN and `BAD`.
        """
        ...

    def restart(self) -> None:
        """Forget all rows: the next one begins a new series."""
        ...

    def snapshot(self) -> State:
        """Return the state."""
        ...

    def restore(self, saved: State) -> None:
        """Continue from a saved state; raises `DataError` if it does not fit."""
        ...


class Correction:
    """Correct each row only once, although the engine may receive it twice.

    Parameters
    ----------
    corrector : Corrector, optional
        None: rows are not changed.

    Notes
    -----
    The engine stops within a block if it requests a fit, and receives the rest of the block
    again. That rest was corrected before; it is kept until newer rows arrive.
    """

    def __init__(self, corrector: Corrector | None = None) -> None:
        self._corrector = corrector
        self._ahead: SampleTable | None = None

    @property
    def corrector(self) -> Corrector | None:
        """Return the corrector; None if rows are not changed."""
        return self._corrector

    @property
    def on(self) -> bool:
        """Return True if rows are changed."""
        return self._corrector is not None

    @property
    def held(self) -> tuple[HeldCause, ...]:
        """Return the causes that are removed."""
        return () if self._corrector is None else self._corrector.held

    def rows(self, table: SampleTable) -> SampleTable:
        """Return the corrected rows, of the same number."""
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
        """Return the state."""
        ahead = self._ahead
        return {
            'corrector': None if self._corrector is None else self._corrector.snapshot(),
            'ahead': None if ahead is None else [ahead.time_ns, ahead.values, ahead.quality],
        }

    def restore(self, saved: State) -> None:
        """Continue from a saved state; raises `DataError` if it does not fit."""
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
    """The result of one call of `Monitor.feed`.

    Attributes
    ----------
    rows : int
        Number of rows taken. It is smaller than given after a `FitRequested`: a caller that
        computes fits at once returns the outcome before the rest is fed.
    events : list of Event
        In the order in which they happened.
    """

    rows: int
    events: list[Event]


@dataclass(frozen=True, slots=True)
class Rows:
    """The columns of some rows, all of shape (n,); covariates (n, k), or None without them."""

    time_ns: IntArray
    u: FloatArray
    power_mw: FloatArray
    temperature_degc: FloatArray
    opening_percent: FloatArray
    command_percent: FloatArray
    covariates: FloatArray | None = None

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
            None if self.covariates is None else self.covariates[cut],
        )

    @classmethod
    def of(cls, table: SampleTable, exponent: float, correction: Correction | None = None) -> Rows:
        """Return the columns that the engine uses, including u of eq. (1)."""
        if correction is not None and correction.on:
            measured = np.ascontiguousarray(table.column(Signal.GENERATED_POWER))
            return CorrectedRows(
                cls.of(replace(correction.rows(table), covariates=table.covariates), exponent),
                measured,
            )
        opening = np.ascontiguousarray(table.column(Signal.VALVE_OPENING))
        u = integrated_input(
            opening,
            table.column(Signal.MAIN_STEAM_PRESSURE),
            exponent,
        )
        power = np.ascontiguousarray(table.column(Signal.GENERATED_POWER))
        temperature = np.ascontiguousarray(table.column(Signal.MAIN_STEAM_TEMPERATURE))
        command = np.ascontiguousarray(table.column(Signal.VALVE_COMMAND))
        return cls(table.time_ns, u, power, temperature, opening, command, table.covariates)

    def shown(self, block: PredictionBlock) -> PredictionBlock:
        """Return the predictions of these rows for the measured power."""
        return block


class CorrectedRows(Rows):
    """Rows with causes removed, and the measured power.

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
            rows.opening_percent, rows.command_percent, rows.covariates,
        )  # fmt: skip
        object.__setattr__(self, 'measured_mw', measured_mw)

    def part(self, start: int, end: int) -> CorrectedRows:
        """Return the rows ``[start, end)`` without copying."""
        return CorrectedRows(Rows.part(self, start, end), self.measured_mw[start:end])

    def shown(self, block: PredictionBlock) -> PredictionBlock:
        """Return the predictions with the correction undone."""
        return as_measured(block, self.measured_mw)
