# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Input and output of one call of the engine."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Protocol

import numpy as np

from valveflow_ros.curve.characteristic import HeldCause
from valveflow_ros.errors import DataError
from valveflow_ros.monitoring.events import Event
from valveflow_ros.monitoring.prediction import PredictionBlock
from valveflow_ros.records import FloatArray, IntArray, SampleTable, Signal
from valveflow_ros.signals.static_form import integrated_input
from valveflow_ros.state import State, perhaps


class Corrector(Protocol):
    """An object that removes known causes from rows, before the engine uses them.

    It turns rows of a plant with a fault, a drift or an effect that the model lacks into those of
    a plant without it: segmenter, fit, prediction and alarms need no change. Rows come in order of
    time, in blocks of any size, on which the result does not depend. The state has a bounded size.
    """

    @property
    def held(self) -> tuple[HeldCause, ...]:
        """Return the causes that are removed."""

    def correct(self, table: SampleTable) -> SampleTable:
        """Return the same number of rows, with opening and power as without the causes.

        Pressure and temperature stay as measured, so that u = V p^m holds for the returned
        rows. An unknown value is NaN and `BAD`.
        """

    def restart(self) -> None:
        """Forget all rows: the next one begins a new series."""

    def snapshot(self) -> State:
        """Return the state."""

    def restore(self, saved: State) -> None:
        """Continue from a saved state; raises `DataError` if it does not fit."""


class Correction:
    """Correct each row only once, although the engine may receive it twice.

    Without a corrector rows are not changed. The engine stops within a block if it requests a fit,
    and receives the rest of the block again. That rest was corrected before; it is kept until
    newer rows arrive.
    """

    def __init__(self, corrector: Corrector | None = None) -> None:
        self.corrector = corrector
        self._ahead: SampleTable | None = None

    @property
    def held(self) -> tuple[HeldCause, ...]:
        """Return the causes that are removed."""
        return () if self.corrector is None else self.corrector.held

    def rows(self, table: SampleTable) -> SampleTable:
        """Return the corrected rows, of the same number."""
        if self.corrector is None or not len(table):
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
        parts.append(self.corrector.correct(table.part(done, len(table))))
        self._ahead = SampleTable.concatenate(parts) if done else parts[-1]
        return self._ahead

    def snapshot(self) -> State:
        """Return the state."""
        ahead = self._ahead
        return {
            'corrector': None if self.corrector is None else self.corrector.snapshot(),
            'ahead': None if ahead is None else [ahead.time_ns, ahead.values, ahead.quality],
        }

    def restore(self, saved: State) -> None:
        """Continue from a saved state; raises `DataError` if it does not fit."""
        if (self.corrector is None) != (saved['corrector'] is None):
            raise DataError('The saved state was made with another model_file.')
        if self.corrector is not None:
            self.corrector.restore(saved['corrector'])
        ahead = perhaps(saved, 'ahead', list)
        self._ahead = None if ahead is None else SampleTable(*ahead)

    def restart(self) -> None:
        """Forget all rows after the clock went back."""
        self._ahead = None
        if self.corrector is not None:
            self.corrector.restart()


@dataclass(frozen=True, slots=True)
class Fed:
    """The result of one call of `Monitor.feed`."""

    # Rows taken: fewer than given after a `FitRequested`. A caller that computes fits at once
    # returns the outcome before the rest is fed.
    rows: int
    events: list[Event]  # in the order in which they happened


@dataclass(frozen=True, slots=True)
class Rows:
    """The columns of some rows, all of shape (n,); covariates (n, k), or None without them.

    If causes were removed from them, ``measured_mw`` is the power with the causes.
    """

    time_ns: IntArray
    u: FloatArray
    power_mw: FloatArray
    temperature_degc: FloatArray
    opening_percent: FloatArray
    command_percent: FloatArray
    covariates: FloatArray | None = None
    measured_mw: FloatArray | None = None

    def part(self, start: int, end: int) -> Rows:
        """Return the rows ``[start, end)`` without copying."""
        columns: list[Any] = [getattr(self, field.name) for field in fields(self)]
        parts: list[Any] = [None if c is None else c[start:end] for c in columns]
        return Rows(*parts)

    @classmethod
    def of(cls, table: SampleTable, exponent: float, correction: Correction | None = None) -> Rows:
        """Return the columns that the engine uses, including u of eq. (1)."""
        measured = None
        if correction is not None and correction.corrector is not None:
            measured = np.ascontiguousarray(table.column(Signal.GENERATED_POWER))
            table = replace(correction.rows(table), covariates=table.covariates)
        opening, power, temperature, command = (
            np.ascontiguousarray(table.column(signal))
            for signal in (
                Signal.VALVE_OPENING, Signal.GENERATED_POWER, Signal.MAIN_STEAM_TEMPERATURE,
                Signal.VALVE_COMMAND,
            )
        )  # fmt: skip
        u = integrated_input(opening, table.column(Signal.MAIN_STEAM_PRESSURE), exponent)
        return cls(
            table.time_ns, u, power, temperature, opening, command, table.covariates, measured
        )

    def shown(self, block: PredictionBlock) -> PredictionBlock:
        """Return the predictions of these rows for the measured power.

        The residual stays; the correction of the power is undone in measurement and prediction.
        """
        if self.measured_mw is None:
            return block
        taken_out = self.measured_mw - block.measured_mw
        return replace(
            block, measured_mw=self.measured_mw, static_mw=block.static_mw + taken_out,
            dynamic_mw=block.dynamic_mw + taken_out,
        )  # fmt: skip
