"""``simulate``: the unit of the paper's study, with any effect switched on."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from valveflow_ros.interface import SILENT, Progress
from valveflow_ros.interface.files import check_log, check_writable, whole_file, write_log
from valveflow_ros.interface.logs import Log, open_log
from valveflow_ros.plant.simulator import SimulatedLog, simulate_parts
from valveflow_ros.plant.spec import EffectSpec
from valveflow_ros.records import SIGNALS


@dataclass(frozen=True, slots=True)
class Simulation:
    """A simulated log and the truth behind it.

    Attributes
    ----------
    data : SimulatedLog
        What the instruments wrote, and true input, power and plug as arrays.
    days : float
    seed : int
    """

    data: SimulatedLog
    days: float
    seed: int

    @property
    def log(self) -> Log:
        """Return what the instruments wrote as a log, to hand on to `identify` and others."""
        return open_log(self.to_dataframe())

    def to_dataframe(self) -> Any:
        """Return what the instruments wrote as a pandas.DataFrame, as `open_log` takes it."""
        import pandas as pd

        table = self.data.table
        columns = {info.column: table.column(info.signal) for info in SIGNALS}
        return pd.DataFrame({'time': pd.to_datetime(table.time_ns, utc=True), **columns})

    def to_json(self) -> dict[str, Any]:
        """Return what is true of the plant, equal to the file of ``--truth``.

        The last region of the dynamics has no upper end: null.
        """
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
        """Write the log, and what is true of the plant where ``truth`` names a file.

        Parameters
        ----------
        path : str or Path
            ``.mcap``, ``.csv``, ``.parquet``, or a folder as ros2 bag makes it.

        Raises
        ------
        RecordingError
            It cannot be written, or is there already.
        """
        path = Path(path)
        check_log(path, overwrite=overwrite)
        if truth is not None:
            check_writable(Path(truth))
        written = write_log(self.data.table, path, overwrite)
        if truth is not None:
            with whole_file(Path(truth)) as draft:
                draft.write_text(json.dumps(self.to_json(), indent=2) + '\n', encoding='utf-8')
        return written


def simulate(
    days: float = 10.0,
    seed: int = 1,
    effects: Sequence[str | EffectSpec] = (),
    *,
    progress: Progress = SILENT,
) -> Simulation:
    """Simulate a 300 MW unit under load control, written down once a second.

    Parameters
    ----------
    days : float
        Length, more than 0 and at most 400.
    seed : int
        The same seed gives the same log.
    effects : sequence of str or EffectSpec
        What to switch on, each ``NAME[:key=value,...]``.
    progress : Progress

    Raises
    ------
    InputError
        An argument is out of range, or effects that cannot act in this run or not together.
    """
    specs = [e if isinstance(e, EffectSpec) else EffectSpec.parse(e) for e in effects]
    parts: list[SimulatedLog] = []
    # Day by day, which gives the same as all at once and can be watched.
    for part in simulate_parts(days, seed, effects=specs):
        parts.append(part)
        progress(min(0.6, 0.6 * len(parts) / days), 'simulating')
    return Simulation(SimulatedLog.joined(parts), days, seed)
