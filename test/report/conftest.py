# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""An identification made by hand: everything in it is known."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from curves import curve

from valveflow_ros.curve.characteristic import (
    Characteristic,
    Choice,
    FittedData,
    RegionDynamics,
    ResidualStatistics,
)
from valveflow_ros.parameters import Settings
from valveflow_ros.records import (
    NS_PER_S,
    SIGNALS,
    SampleTable,
    SegmentKind,
    Signal,
    SpecialSegment,
)
from valveflow_ros.report.identified import Identified

START_NS = 1_700_000_000 * NS_PER_S
PRESSURE = 12.0
KNOTS = (800.0, 1200.0, 1500.0)
SLOPES = (0.2, 0.05)
INTERCEPTS = (-60.0, 120.0)


def _table(days: float, period_s: int) -> SampleTable:
    n = int(days * 86400 / period_s)
    rng = np.random.default_rng(11)
    t = np.arange(n, dtype=np.int64) * period_s
    u = np.interp((t // 1200) % 8, range(8), np.linspace(820.0, 1480.0, 8))
    power = np.where(u < KNOTS[1], SLOPES[0] * u + INTERCEPTS[0], SLOPES[1] * u + INTERCEPTS[1])
    return SampleTable.from_columns(
        START_NS + t * NS_PER_S,
        {
            Signal.VALVE_OPENING: u / PRESSURE**1.125 + 0.01 * rng.standard_normal(n),
            Signal.MAIN_STEAM_PRESSURE: np.full(n, PRESSURE),
            Signal.MAIN_STEAM_TEMPERATURE: 540.0 + rng.standard_normal(n),
            Signal.GENERATED_POWER: power + 2.0 * rng.standard_normal(n),
        },
    )


def _segments(table: SampleTable, period_s: int) -> tuple[SpecialSegment, ...]:
    """Call the second half of each rest a segment, every fourth a slope response."""
    found = []
    rows = 1200 // period_s
    for number, first in enumerate(range(rows // 2, len(table) - rows // 2, rows)):
        kind = SegmentKind.SLOPE if number % 4 == 3 else SegmentKind.STEADY
        end = first + rows // 2 - 1
        found.append(
            SpecialSegment(
                number + 1, kind, int(table.time_ns[first]), int(table.time_ns[end]), rows // 2,
                0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 540.0,
            )
        )  # fmt: skip
    return tuple(found)


def _characteristic(table: SampleTable, segments: tuple[SpecialSegment, ...]) -> Characteristic:
    made = curve(
        KNOTS, SLOPES, start=100.0, stderr=0.0012, samples=1000, notes=(),
        breakpoint_intervals=((1189.0, 1211.0),),
        choice=Choice(
            'paper', {1: 9e5, 2: 2e5, 3: 1.9e5, 4: 1.85e5}, {2: 0.81, 3: 0.32}, 'A <note>.'
        ),
        source=FittedData(
            int(table.time_ns[0]), int(table.time_ns[-1]),
            sum(s.kind == SegmentKind.STEADY for s in segments),
            sum(s.kind == SegmentKind.SLOPE for s in segments),
            sum(s.samples for s in segments), 540.0, 3.9, False,
        ),
        residuals=ResidualStatistics(2.0, 0.2, 300.0, 0.1, 2.0),
        dynamics=(
            RegionDynamics(100.0, 180.0, 11.5, 3.25, 0.4, 0.3),
            RegionDynamics(180.0, 195.0, 77.0, 9.5, 2.0, 1.0),
        ),
    )  # fmt: skip
    raw = tuple(replace(p, slope=1.01 * p.slope, slope_stderr=0.002) for p in made.pieces)
    return replace(made, partition_pieces=raw).with_id()


Make = Callable[..., Identified]


@pytest.fixture(scope='session')
def make() -> Make:
    """Return a maker of identifications: days, step, then any field of `Identified`."""

    def identified(days: float = 1.0, period_s: int = 10, **changes: object) -> Identified:
        table = _table(days, period_s)
        segments = _segments(table, period_s)
        counts = {i.topic: {'accepted': len(table)} for i in SIGNALS if i.required}
        fields: dict[str, object] = {
            'source': 'plant.mcap',
            'characteristic': _characteristic(table, segments),
            'table': table,
            'segments': segments,
            'counts': counts,
            'settings': Settings({'sample_period': float(period_s)}),
        }
        return Identified(**{**fields, **changes})  # type: ignore[arg-type]

    return identified


@pytest.fixture(scope='session')
def identified(make: Make) -> Identified:
    """Return a day at ten seconds."""
    return make()
