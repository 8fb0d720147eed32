# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The input of the identification report, and values derived once for all of its parts."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.shift import Shift
from valveflow_ros.fit.model_form import Misfit
from valveflow_ros.parameters import Settings
from valveflow_ros.records import (
    FloatArray,
    IntArray,
    SampleTable,
    SegmentKind,
    Signal,
    SpecialSegment,
)
from valveflow_ros.report.history import History
from valveflow_ros.signals.static_form import OPENING


@dataclass(frozen=True, slots=True)
class Identified:
    """An identification and its data."""

    source: str  # name of the log, as given by the user
    characteristic: Characteristic
    table: SampleTable  # the aligned rows used by the engine
    segments: tuple[SpecialSegment, ...]  # in order of time
    counts: Mapping[str, Mapping[str, int]]  # {topic: {reason: readings}}, of the aligner
    settings: Settings
    notes: tuple[str, ...] = ()  # about how the data were read
    shift: Shift | None = None  # the judgement against the reference, if there is one
    reference: Characteristic | None = None
    misfit: Misfit | None = None  # systematic error of the curve
    mixture: str = ''  # a sentence that the unit changed within the data
    history: History | None = None  # of a monitor, if the log is its recording
    one_pressure: bool = False  # in all rows: the curve is shown over the opening
    u: FloatArray = field(init=False)  # (n,) argument of the curve as shown: u or opening
    static_mw: FloatArray = field(init=False)  # (n,) the curve; the outer pieces are extrapolated
    rows: IntArray = field(init=False)  # (k, 2) first and end row (exclusive) of each segment
    special: IntArray = field(init=False)  # (m,) rows in segments with known input and power

    def __post_init__(self) -> None:
        u, scale = self.characteristic.static_form.of_rows(
            *self.table.values[:, [Signal.VALVE_OPENING, Signal.MAIN_STEAM_PRESSURE]].T
        )
        static = self.characteristic.model.static(u, 1.0 if scale is None else scale)
        first = np.searchsorted(self.table.time_ns, [s.start_ns for s in self.segments])
        end = np.searchsorted(self.table.time_ns, [s.end_ns for s in self.segments], 'right')
        rows = np.column_stack([first, end]).astype(np.int64)
        inside = [np.arange(a, b, dtype=np.int64) for a, b in rows.tolist()]
        special = np.concatenate([np.empty(0, dtype=np.int64), *inside])
        known = np.isfinite(u[special]) & np.isfinite(self.power[special])
        derived = {
            'u': u / self.u_per_percent,
            'static_mw': static,
            'rows': rows,
            'special': special[known],
        }
        for name, value in derived.items():
            object.__setattr__(self, name, value)

    @property
    def power(self) -> FloatArray:
        """Return the generated power in MW, shape (n,)."""
        return self.table.column(Signal.GENERATED_POWER)

    @property
    def median_pressure(self) -> float:
        """Return the median pressure of the rows in MPa; NaN if there is none."""
        pressure = self.table.column(Signal.MAIN_STEAM_PRESSURE)
        known = pressure[np.isfinite(pressure)]
        return float(np.median(known)) if len(known) else math.nan

    @property
    def u_per_percent(self) -> float:
        """Return u of the curve for each % of opening if there is one pressure, else 1."""
        q = self.characteristic.pressure_exponent if self.one_pressure else 0.0
        return self.median_pressure**q if q else 1.0

    @property
    def shown(self) -> Characteristic:
        """Return the curve as drawn.

        At the reference pressure if it depends on the pressure; over the opening if there is one
        pressure, as a constant given by the user.
        """
        if self.one_pressure:
            return self.characteristic.over_opening(self.median_pressure)
        return self.characteristic.at_pressure()

    @property
    def power_shown(self) -> FloatArray:
        """Return the power as drawn with the curve, in MW.

        The difference of the curve from that at the reference pressure is subtracted.
        """
        if self.characteristic.axis != OPENING:
            return self.power
        return np.asarray(self.power - self.static_mw + self.shown.model.static(self.u))

    @property
    def at_pressure(self) -> str:
        """Return ' at 12.3 MPa' if the curve is shown at one pressure, else ''."""
        if self.characteristic.axis != OPENING:
            return ''
        return f' at {self.characteristic.reference_pressure_mpa:.3g} MPa'

    @property
    def period_ns(self) -> int:
        """Return the step of the table in ns."""
        return round(self.settings.real('sample_period') * 1e9)

    def rows_of(self, kind: SegmentKind) -> IntArray:
        """Return (first, end) rows of the segments of one kind, shape (k, 2)."""
        wanted = np.array([s.kind == kind for s in self.segments], dtype=bool)
        return self.rows[wanted] if len(self.rows) else self.rows.reshape(-1, 2)
