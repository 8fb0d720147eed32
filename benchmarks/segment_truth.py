# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Which rows of a simulated run are special in truth, known from what drove the unit.

The load programme says when the unit is held and when it is ramped; the pulses of primary
frequency control say when the valve is moved besides. The input the curve wants is then
constant, or a straight line of time until the ramp ends or crosses a knee of the curve. As in
the paper (eqs. (10) to (14)) such a stretch is special once the transient, 5 T + tau, has
passed, and if what is left is long enough.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from valveflow_ros.parameters import Settings
from valveflow_ros.plant.plant import ChanceSource, Pulses, generator
from valveflow_ros.plant.simulator import WARM_UP_S, SimulatedLog
from valveflow_ros.plant.unit import UnitDescription
from valveflow_ros.records import SegmentKind

NEITHER = 0


class Stretch(NamedTuple):
    """Rows ``[first, end)`` that are special, and what they are."""

    first: int
    end: int
    kind: int


def wanted_input(unit: UnitDescription, load_mw: np.ndarray) -> np.ndarray:
    """Return the input that gives a load, u = F^-1(load)."""
    x, u = unit.curve.inverse_table()
    return np.interp(load_mw, x, u)


def true_stretches(
    log: SimulatedLog, seed: int, settings: Settings, knees: bool = True
) -> list[Stretch]:
    """Return the special stretches of a run of `simulate` with this seed.

    Rates of u are compared as they are driven, without noise: rows belong to one stretch
    while the rate stays the same. The feedback of the power control, which wanders slowly
    by some units of u, counts as held. Without ``knees`` a ramp of the load is one stretch
    even where it crosses a knee, which nobody knows before the curve is known.
    """
    unit = log.unit
    step_s = unit.sample_period_s
    n = len(log.load_mw)
    times_s = WARM_UP_S + np.arange(n) * step_s
    # Drawn for longer than the run, which changes nothing before its end.
    length_s = WARM_UP_S + n * step_s + 86400.0
    pulses = Pulses.draw(generator(seed, ChanceSource.PULSES), length_s, unit.programme)
    pulsed = pulses.at(times_s) != 0.0
    driven = wanted_input(unit, log.load_mw) if knees else log.load_mw
    rate = np.diff(driven, append=np.nan) / step_s
    rate[-1] = rate[-2]
    held = np.abs(rate) < 1e-9
    # Within a ramp on one piece the rate is the same to rounding of the load.
    changed = np.abs(np.diff(rate)) > 1e-4 * np.maximum(np.abs(rate[:-1]), np.abs(rate[1:])) + 1e-9
    begins = np.concatenate([[True], changed | (pulsed[1:] != pulsed[:-1])])
    first = np.flatnonzero(begins)
    ends = np.append(first[1:], n)
    settle = round(settings.settle_s / step_s)
    stretches = []
    for a, b in zip(first.tolist(), ends.tolist(), strict=True):
        kind = SegmentKind.STEADY if held[a] else SegmentKind.SLOPE
        name = 'steady_min' if kind == SegmentKind.STEADY else 'slope_min'
        if not pulsed[a] and (b - a - settle) * step_s >= settings.real(name):
            stretches.append(Stretch(a + settle, b, int(kind)))
    return stretches


def by_row(stretches: list[Stretch], n: int) -> np.ndarray:
    """Return for each row what it is."""
    kinds = np.full(n, NEITHER, dtype=np.int64)
    for first, end, kind in stretches:
        kinds[first:end] = kind
    return kinds
