# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Simulate a unit for some days and return the record of its instruments."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from valveflow_ros.errors import InputError
from valveflow_ros.plant.effect import DAY_S, HistorianRows, Hooks, clock_at_ns
from valveflow_ros.plant.plant import LoadProgramme, Plant, PlantRows
from valveflow_ros.plant.spec import EffectSpec, install
from valveflow_ros.plant.unit import UnitDescription
from valveflow_ros.records import NS_PER_S, FloatArray, SampleTable, Signal

# The historian's record of a plant: stamps, rounding, faults of the record.

DECIMALS = {
    Signal.VALVE_OPENING: 2, Signal.MAIN_STEAM_PRESSURE: 3, Signal.MAIN_STEAM_TEMPERATURE: 1,
    Signal.GENERATED_POWER: 2, Signal.VALVE_COMMAND: 2,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class SimulatedLog:
    """The record of the instruments, and the true values; float64 (n,) each.

    If the power is stamped early or late (`clock`), its true value and its
    noise are in the rows of the stamps. So without faults of the record, the
    power in the table is ``true_power_mw + noise_mw``, rounded.
    """

    # Opening, pressure, temperature, power and command, rounded as in a historian; the
    # command is the output of the controller, before the actuator.
    table: SampleTable
    true_u: FloatArray  # integrated input of the curve, % MPa^m
    true_power_mw: FloatArray  # without noise
    load_mw: FloatArray  # the set point
    unit: UnitDescription  # without its effects
    noise_mw: FloatArray
    plug_percent: FloatArray  # the true position
    active: tuple[EffectSpec, ...] = ()

    def __len__(self) -> int:
        return len(self.table)

    @classmethod
    def joined(cls, parts: list[SimulatedLog]) -> SimulatedLog:
        """Join the parts of one run."""
        names = ('true_u', 'true_power_mw', 'load_mw', 'noise_mw', 'plug_percent')
        columns: dict[str, Any] = {
            name: np.concatenate([getattr(p, name) for p in parts]) for name in names
        }
        table = SampleTable.concatenate([part.table for part in parts])
        return replace(parts[0], table=table, **columns)


class Recorder:
    """Convert the rows of a plant into tables, with early stamps of the power if required."""

    def __init__(self, hooks: Hooks, start_ns: int, active: tuple[EffectSpec, ...]) -> None:
        self._hooks, self._start_ns, self._active = hooks, start_ns, active
        self._shift = hooks.lead_s / hooks.unit.sample_period_s
        self.ahead = max(0, math.ceil(self._shift))
        self.behind = max(0, math.ceil(-self._shift))

    def parts(
        self, plant: Plant, warm_up: int, rows: int, part_rows: int
    ) -> Iterator[SimulatedLog]:
        """Run the plant and yield its record in parts of at most ``part_rows`` rows."""
        window = plant.advance(warm_up + self.ahead)
        for first in range(0, rows, part_rows):
            kept = window.command.size - self.ahead - self.behind
            window = window.part(kept, window.command.size)
            count = min(part_rows, rows - first)
            window = window.followed_by(plant.advance(count))
            yield self._part(window, first, count)

    def _part(self, window: PlantRows, first: int, count: int) -> SimulatedLog:
        """Return the record of rows ``[first, first + count)``, at ``behind`` in the window."""
        unit = self._hooks.unit
        rows = window.part(self.behind, self.behind + count)
        power, noise = self._stamped(window.power, count), self._stamped(window.noise, count)
        columns = {
            Signal.VALVE_OPENING: rows.opening_read,
            Signal.MAIN_STEAM_PRESSURE: rows.pressure_read,
            Signal.MAIN_STEAM_TEMPERATURE: rows.temperature_read,
            Signal.GENERATED_POWER: power + noise,
            Signal.VALVE_COMMAND: rows.command,
        }
        columns = {s: np.round(column, DECIMALS[s]) for s, column in columns.items()}
        time_s = np.arange(first, first + count, dtype=np.float64) * unit.sample_period_s
        for change in self._hooks.writing:
            change(HistorianRows(time_s, columns))
        time_ns = self._start_ns + np.round(time_s * NS_PER_S).astype(np.int64)
        table = SampleTable.from_columns(time_ns, columns)
        return SimulatedLog(table, rows.u, power, rows.load, unit, noise, rows.plug, self._active)

    def _stamped(self, column: FloatArray, count: int) -> FloatArray:
        whole = math.floor(self._shift)
        part = self._shift - whole
        first = self.behind + whole
        if part == 0.0:
            return column[first : first + count]
        later = column[first + 1 : first + 1 + count]
        return column[first : first + count] * (1.0 - part) + later * part


WARM_UP_S = 3600.0
LONGEST_DAYS = 400.0
DEFAULT_START_NS = 1_700_006_400 * NS_PER_S  # 2023-11-15 00:00:00 UTC, a midnight


def simulate(
    days: float, seed: int, unit: UnitDescription | None = None,
    start_ns: int = DEFAULT_START_NS, effects: Sequence[EffectSpec] = (),
) -> SimulatedLog:  # fmt: skip
    """Simulate ``days`` of operation, at most 400, of the paper's unit or another one.

    The seed determines every random number; they do not depend on the effects, whose order has no
    influence, and a longer run begins with the shorter one. ``start_ns`` determines the time of
    day in UTC. A row needs about 90 bytes, and twice this while the parts are joined: ten days at
    1 s need 160 MB, a year 6 GB. For long runs use `simulate_parts`. Raises `InputError` if
    ``days``, ``seed`` or ``start_ns`` is out of range, or effects cannot act in this run or not
    together.
    """
    return SimulatedLog.joined(list(simulate_parts(days, seed, unit, start_ns, effects)))


def simulate_parts(
    days: float, seed: int, unit: UnitDescription | None = None,
    start_ns: int = DEFAULT_START_NS, effects: Sequence[EffectSpec] = (), part_s: float = DAY_S,
) -> Iterator[SimulatedLog]:  # fmt: skip
    """Simulate as `simulate` does and yield the run in consecutive parts of ``part_s``.

    The state continues from part to part: the joined parts are equal to the result
    of `simulate`, bit for bit, for any ``part_s``. One part is in memory at a time.
    Errors are raised at the call, before the simulation.
    """
    unit = unit or UnitDescription()
    if not 0.0 < days <= LONGEST_DAYS:
        raise InputError(
            f'A simulation must last more than 0 and at most {LONGEST_DAYS:g} days, not {days}.'
        )
    h = unit.sample_period_s
    if not part_s >= h:
        raise InputError(f'A part must last one sample period or longer, not {part_s} s.')
    rows = max(1, round(days * DAY_S / h))
    hooks = Hooks.of(unit, rows * h)
    recorder = prepare(hooks, seed, start_ns, effects)
    warm_up = round(WARM_UP_S / h)
    length_s = (warm_up + rows + recorder.ahead) * h
    clock_s = clock_at_ns(start_ns)
    drive = LoadProgramme(unit, seed, length_s, clock_s - warm_up * h)
    plant = Plant(hooks, drive, seed, -warm_up, clock_s)
    return recorder.parts(plant, warm_up, rows, max(1, round(min(part_s, rows * h) / h)))


def prepare(hooks: Hooks, seed: int, start_ns: int, effects: Sequence[EffectSpec]) -> Recorder:
    """Check the arguments of a run as `simulate`, install the effects, return the recorder."""
    if seed < 0:
        raise InputError(f'The seed must be 0 or more, not {seed}.')
    end_ns = start_ns + round(hooks.length_s * NS_PER_S)
    if start_ns < 0 or end_ns >= 2**63:
        raise InputError('A simulation must lie between the years 1970 and 2262.')
    install(effects, hooks)
    return Recorder(hooks, start_ns, tuple(effects))
