# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``simulate``: the unit of the paper's study or a physical model, with effects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from valveflow_ros.errors import InputError
from valveflow_ros.interface import SILENT, Progress, files
from valveflow_ros.interface.logs import Log, open_log
from valveflow_ros.plant.historian import Historian
from valveflow_ros.plant.simulator import DEFAULT_START_NS, SimulatedLog, simulate_parts
from valveflow_ros.plant.spec import EffectSpec
from valveflow_ros.plant.thermal_plant import ThermalLog, simulate_thermal
from valveflow_ros.plant.thermal_unit import KINDS, ThermalUnit, unit_of
from valveflow_ros.records import SIGNALS, FloatArray

PAPER = 'paper'


@dataclass(frozen=True, slots=True, repr=False)
class Simulation:
    """A simulated log and its true values.

    Attributes
    ----------
    data : SimulatedLog or ThermalLog
        The measured values, and the true input, power and plug position as arrays.
    days : float
    seed : int
    """

    data: SimulatedLog | ThermalLog
    days: float
    seed: int

    def __repr__(self) -> str:
        """Return what was simulated, without the values."""
        return f'<Simulation: {self.days:g} days, seed {self.seed}>'

    @property
    def log(self) -> Log:
        """Return the measured values as a log for `identify` and other functions."""
        return open_log(self.to_dataframe())

    def to_dataframe(self) -> Any:
        """Return the measured values as a pandas.DataFrame that `open_log` accepts.

        A unit other than the paper's has further columns, such as ``condenser_pressure_kpa``.
        If each signal has its own times, NaN means that there is no new value.
        """
        import pandas as pd

        table = self.data.table
        columns = {info.column: table.column(info.signal) for info in SIGNALS} | self._extra()
        return pd.DataFrame({'time': pd.to_datetime(table.time_ns, utc=True), **columns})

    def static_power(self, opening_percent: FloatArray, pressure_mpa: FloatArray) -> FloatArray:
        """Return the true steady-state power in MW, without effects.

        Parameters
        ----------
        opening_percent, pressure_mpa : float64 (n,)
            True opening in %, and pressure in MPa absolute; one of them may be a scalar.
        """
        unit = self.data.unit
        if isinstance(unit, ThermalUnit):
            return unit.static_power(opening_percent, pressure_mpa)
        u = np.asarray(opening_percent) * np.asarray(pressure_mpa) ** unit.pressure_exponent
        return unit.curve(u)

    def _extra(self) -> dict[str, FloatArray]:
        return self.data.extra if isinstance(self.data, ThermalLog) else {}

    def to_json(self) -> dict[str, Any]:
        """Return the true values of the plant, equal to the file of ``--truth``.

        The last region of the dynamics of the paper's unit has the upper end null: no limit.
        """
        if isinstance(self.data, ThermalLog):
            return {'days': self.days, 'seed': self.seed, **self.data.to_json()}
        unit = self.data.unit
        curve = unit.curve
        return {
            'days': self.days,
            'seed': self.seed,
            'sample_period_s': unit.sample_period_s,
            'pressure_exponent': unit.pressure_exponent,
            'pieces': [
                {'u_from': a, 'u_to': b, 'slope': k, 'intercept': c}
                for a, b, k, c in zip(
                    curve.knots[:-1].tolist(), curve.knots[1:].tolist(),
                    curve.slopes.tolist(), curve.intercepts.tolist(), strict=True,
                )
            ],
            'dynamics': [
                {
                    'power_to': r.power_to_mw if r.power_to_mw < 1e9 else None,
                    'time_constant_s': r.time_constant_s,
                    'delay_s': r.delay_s,
                }
                for r in unit.regions
            ],
            'effects': [{'name': e.name, 'parameters': e.parameters} for e in self.data.active],
        }  # fmt: skip

    def write(
        self, path: str | Path, *, truth: str | Path | None = None, overwrite: bool = False
    ) -> Path:
        """Write the log, and the true values of the plant if ``truth`` names a file.

        Parameters
        ----------
        path : str or Path
            ``.mcap``, ``.csv``, ``.parquet``, or a folder as in ros2 bag. Only tables
            contain columns other than the five signals.

        Raises
        ------
        RecordingError
            It cannot be written, or exists already.
        """
        path = Path(path)
        files.check_log(path, overwrite=overwrite)
        if truth is not None:
            files.check_writable(Path(truth))
        written = self._write_log(path, overwrite)
        if truth is not None:
            with files.whole_file(Path(truth)) as draft:
                draft.write_text(files.as_text(self.to_json()), encoding='utf-8')
        return written

    def _write_log(self, path: Path, overwrite: bool) -> Path:
        from valveflow_ros.logs import write_table
        from valveflow_ros.logs.mcap.importing import write_readings

        if path.suffix.lower() in files.TABLES:
            with files.whole_file(path) as draft:
                write_table(self.data.table, draft, self._extra())
            return path
        if isinstance(self.data, ThermalLog) and self.data.historian.own_times:
            # A recording in rows would contain values that were never sent.
            return write_readings(
                [self.data.readings], [info.signal for info in SIGNALS], path,
                overwrite=overwrite or files.is_empty(path),
            ).path  # fmt: skip
        return files.write_log(self.data.table, path, overwrite)


def simulate(
    days: float = 10.0,
    seed: int = 1,
    effects: Sequence[str | EffectSpec] = (),
    *,
    unit: str | ThermalUnit = PAPER,
    recording: str | Historian = '1s',
    start_ns: int = DEFAULT_START_NS,
    progress: Progress = SILENT,
) -> Simulation:
    """Simulate a unit under load control and the values kept by its historian.

    Parameters
    ----------
    days : float
        Duration, more than 0 and at most 400 (60 for a unit other than the paper's).
    seed : int
        The same seed gives the same log.
    effects : sequence of str or EffectSpec
        Effects to switch on, each ``NAME[:key=value,...]``.
    unit : str or ThermalUnit
        'paper': the 300 MW unit of the paper's study, its power a function of V p^m. The others
        are reheat units of about 330 MW with a boiler, a governor, AGC and primary response:
        'choked' has one group of valves and the flow p^m f(V), 'sequence' has three or four
        valves that open in sequence, 'integrated_input' has the paper's form. They have sliding
        pressure, or fixed pressure with '_fixed' after the name. ``NAME:number=7`` is another
        unit of this kind; ``vacuum_per_kpa`` and ``temperature_per_k`` set how much its power
        depends on condenser pressure and steam temperature.
    recording : str or Historian
        For a unit other than the paper's: '1s' every sample, 'minute' means of a minute,
        'compressed' exception compression with values at their own times. Options are given as
        ``compressed:resample_s=60,dropouts_per_day=2``: ``band_percent``, ``scan_low_s``,
        ``scan_high_s``, ``longest_s``, ``resample_s``, ``dropouts_per_day``, ``dropout_minutes``.
    start_ns : int
        Time of the first sample, ns since 1970; it determines the time of day in UTC.
    progress : Progress

    Raises
    ------
    InputError
        An argument is out of range, or effects cannot act in this run or not together.
    """
    if not isinstance(recording, Historian):
        recording = Historian.parse(recording)
    if unit != PAPER:
        if not isinstance(unit, ThermalUnit):
            if unit.partition(':')[0].strip() not in KINDS:
                known = ', '.join((PAPER, *KINDS))
                raise InputError(f"There is no unit '{unit}': use one of {known}.")
            unit = unit_of(unit)
        data = simulate_thermal(days, seed, unit, recording, start_ns, effects)
        progress(0.6, 'simulating')
        return Simulation(data, days, seed)
    if recording != Historian():
        raise InputError(
            "The paper's unit is recorded once a second only. Choose another unit for the "
            f"recording '{recording.recording}'; integrated_input has the paper's form."
        )
    specs = [e if isinstance(e, EffectSpec) else EffectSpec.parse(e) for e in effects]
    parts: list[SimulatedLog] = []
    # Simulating day by day gives the same result as one call, and allows progress reports.
    for part in simulate_parts(days, seed, start_ns=start_ns, effects=specs):
        parts.append(part)
        progress(min(0.6, 0.6 * len(parts) / days), 'simulating')
    return Simulation(SimulatedLog.joined(parts), days, seed)
