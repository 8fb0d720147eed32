# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What studies share: options, plants, rows over seeds, and results that are printed and kept."""

from __future__ import annotations

import argparse
import json
import os
import platform
import shlex
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pandas as pd

import valveflow_ros as vf
from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.fit.fit import fit
from valveflow_ros.fit.task import FitTask
from valveflow_ros.interface.simulate import Simulation
from valveflow_ros.monitoring.events import FitRequested, SegmentClosed
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.parameters import Settings
from valveflow_ros.plant.simulator import simulate
from valveflow_ros.plant.unit import UnitDescription
from valveflow_ros.records import SampleTable, SpecialSegment, finite

RESULTS = Path(__file__).resolve().parent / 'results'
PAPER = 'paper'
T = TypeVar('T')


def options(about: str | None, **defaults: int | float) -> argparse.ArgumentParser:
    """Return a parser with an option for each number, of the type of its default."""
    parser = argparse.ArgumentParser(
        description=about, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, value in defaults.items():
        parser.add_argument(f'--{name.replace("_", "-")}', type=type(value), default=value)
    return parser


def command(*given: str) -> str:
    """Return this process as the command that was typed, or what is given instead of its words."""
    module = sys.modules['__main__'].__spec__
    name = (module.name if module else Path(sys.argv[0]).stem).removesuffix('.__main__')
    return ' '.join([f'python -m {name}', *(given or map(shlex.quote, sys.argv[1:]))])


def seeds(given: argparse.Namespace) -> range:
    return range(given.first, given.first + given.seeds)


def name_of(kind: str, given: argparse.Namespace) -> str:
    """Return the name of a result that has the seeds in it."""
    return f'{kind}_{given.first}_{given.first + given.seeds - 1}'


def rows_of(
    name: str, work: Callable[..., dict | list[dict]], items: Iterable[Any], *more: Any
) -> list[dict[str, Any]]:
    """Do the work for each item; print the row or rows of each, and keep them as they come."""
    rows: list[dict[str, Any]] = []
    for item in items:
        new = work(item, *more)
        for row in [new] if isinstance(new, dict) else new:
            rows.append(row)
            print(json.dumps(finite(row)), flush=True)
        keep(name, show=False, rows=rows)  # hours of work
    return rows


def by(key: str, rows: Iterable[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Return the rows in groups of one value of a key, in the order of their first ones."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault(row[key], []).append(row)
    return groups


def keep(name: str, folder: Path | None = RESULTS, show: bool = True, **content: Any) -> None:
    """Print a result without its rows; write it, headed by its command, unless folder is None."""
    content = finite({'command': command(), **content})
    if show:
        print(json.dumps({k: v for k, v in content.items() if k != 'rows'}, indent=1), flush=True)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f'{name}.json').write_text(json.dumps(content, indent=1) + '\n', 'utf-8')


def machine() -> dict[str, Any]:
    """Return what the times of a run depend on."""
    return {
        'cpus': len(os.sched_getaffinity(0)), 'load_average': round(os.getloadavg()[0], 1),
        'platform': platform.platform(), 'machine': platform.machine(),
        'python': platform.python_version(), 'numpy': np.__version__,
    }  # fmt: skip


def timed(action: Callable[[], T], repeats: int = 1) -> tuple[dict[str, float], T]:
    """Return the least wall and processor time of several runs, and the last result."""
    wall, cpu = [], []
    for _ in range(repeats):
        begin, begin_cpu = time.perf_counter(), time.process_time()
        result = action()
        wall.append(time.perf_counter() - begin)
        cpu.append(time.process_time() - begin_cpu)
    return {'wall_s': round(min(wall), 4), 'cpu_s': round(min(cpu), 4)}, result


def whole_window(unit: UnitDescription, days: float) -> Settings:
    """Return the settings to identify all days of a unit at once."""
    return Settings(
        {'refit_period': 0.0, 'window_days': max(days, 0.1),
         'sample_period': unit.sample_period_s}
    )  # fmt: skip


def task_of(table: SampleTable, settings: Settings) -> tuple[FitTask, list[SpecialSegment]]:
    """Return what a curve of these rows is found from, and their special segments."""
    monitor = Monitor(settings)
    events = monitor.feed(table).events
    (task,) = (e.task for e in monitor.request_fit() if isinstance(e, FitRequested))
    return task, [e.segment for e in events if isinstance(e, SegmentClosed)]


def identify(
    unit: UnitDescription, seed: int, days: float, recording: str = '1s'
) -> Characteristic:
    """Simulate a unit and identify it with the defaults, from rows or from means over a minute."""
    log = simulate(days, seed, unit)
    if recording == 'minute':
        return vf.identify(means(Simulation(log, days, seed))).characteristic
    return fit(task_of(log.table, whole_window(unit, days))[0])


def minute_means(
    kind: str, number: int, seed: int, days: float, effects: Iterable[str] = ()
) -> pd.DataFrame:
    """Return means over a minute of the paper's unit, or of one that is built from physics."""
    if kind != PAPER:
        unit = f'{kind}:number={number}'
        return vf.simulate(days, seed, effects, unit=unit, recording='minute').to_dataframe()
    return means(vf.simulate(days, seed, effects))


def means(simulation: Simulation) -> pd.DataFrame:
    """Return means over a minute of a record in rows."""
    table = simulation.to_dataframe().set_index('time')
    return table.resample('60s').mean().reset_index()
