# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What every study does: take options, identify plants, go through seeds, keep the result."""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import shlex
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.fit.fit import fit
from valveflow_ros.fit.task import FitTask
from valveflow_ros.monitoring.events import FitRequested, SegmentClosed
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.parameters import Settings
from valveflow_ros.plant.simulator import simulate
from valveflow_ros.plant.unit import UnitDescription
from valveflow_ros.records import SampleTable, SpecialSegment

RESULTS = Path(__file__).resolve().parent / 'results'
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


def rows_of(work: Callable[[Any], T], seeds: Iterable[Any]) -> list[T]:
    """Do the work for each seed, and show what came of it as it comes."""
    rows = []
    for seed in seeds:
        rows.append(work(seed))
        print(json.dumps(finite(rows[-1])), flush=True)
    return rows


def seeds(first: int, count: int) -> range:
    """Return so many seeds."""
    return range(first, first + count)


def name_of(kind: str, first: int, count: int) -> str:
    """Return the name of a result that has the seeds in it."""
    return f'{kind}_{first}_{first + count - 1}'


def finite(value: Any) -> Any:
    """Return the value with null where JSON knows no number."""
    if isinstance(value, dict):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def keep(name: str, strict: bool = True, folder: Path = RESULTS, **content: Any) -> Path:
    """Write a result, headed by the command that brought it; return where it is.

    Numbers that JSON does not know become null, unless it need not be ``strict`` JSON.
    """
    content = {'command': command(), **content}
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f'{name}.json'
    text = json.dumps(finite(content) if strict else content, indent=1)
    path.write_text(text + '\n', encoding='utf-8')
    return path


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


def identify(unit: UnitDescription, seed: int, days: float) -> Characteristic:
    """Simulate a unit and identify it with the defaults."""
    return fit(task_of(simulate(days, seed, unit).table, whole_window(unit, days))[0])


def episodes(values: Iterable[float], limit: float = 1.0, back: float = 0.7) -> int:
    """Count how often the size of a value passes a limit, with a return in between."""
    count, active = 0, False
    for value in values:
        if not active and abs(value) > limit:
            count, active = count + 1, True
        elif active and abs(value) < back * limit:
            active = False
    return count


def plots() -> Any:
    """Return matplotlib's pyplot, drawing into files."""
    import matplotlib

    matplotlib.use('Agg')
    import matplotlib.pyplot as pyplot

    return pyplot
