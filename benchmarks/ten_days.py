# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""From ten days of a simulated plant on disk to the report: how long each step takes.

    python -m benchmarks.ten_days [--days 10] [--seed 1] [--cold] [--json]

The steps are those of ``valveflow identify`` on an MCAP recording, one after
the other in one process. The kernels are compiled (or loaded from their cache)
beforehand on a few hours of the same plant, so that what is shown is the work
and not the compiler; ``--cold`` shows both.
"""

from __future__ import annotations

import json
import resource
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from benchmarks import study
from valveflow_ros.cli.command import table
from valveflow_ros.interface.logs import steps_of
from valveflow_ros.interface.observation import observe
from valveflow_ros.interface.settings import settings_for
from valveflow_ros.logs import open_log, write_samples
from valveflow_ros.plant.simulator import simulate
from valveflow_ros.report.identification import identification_report
from valveflow_ros.report.identified import Identified

T = TypeVar('T')
WARM_UP_DAYS = 0.4


def identify(path: Path) -> list[dict[str, Any]]:
    """Do what `valveflow identify` does; return what each step took and what came of it."""
    steps: list[dict[str, Any]] = []

    def step(name: str, work: Callable[[], T], what: Callable[[T], str]) -> T:
        seconds, result = study.timed(work)
        steps.append({'step': name, **seconds, 'what': what(result)})
        return result

    contents = step('read MCAP', lambda: open_log(path), lambda c: f'{len(c.readings):,} values')
    readings = contents.readings
    span_s = float(np.ptp(readings.time_ns)) / 1e9
    settings, _ = settings_for(steps_of(readings.by_signal()), span_s, {})
    seen = step(
        'rows and segments', lambda: observe(readings, settings),
        lambda w: f'{len(w.table):,} rows, {len(w.segments)} segments',
    )  # fmt: skip
    curve = step(
        'fit', seen.fit,
        lambda c: f'{len(c.pieces)} pieces from {c.source.samples:,} special samples',
    )  # fmt: skip
    found = Identified(path.name, curve, seen.table, seen.segments, seen.counts, settings)
    step('report', lambda: identification_report(found), lambda r: f'{len(r) / 1e6:.2f} MB')
    return steps


def main() -> None:
    parser = study.options(__doc__, days=10.0, seed=1)
    parser.add_argument('--cold', action='store_true', help='do not compile beforehand')
    parser.add_argument('--json', action='store_true')
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix='ten_days') as folder:

        def record(days: float) -> Path:
            table = simulate(days, given.seed).table
            return write_samples(table, Path(folder) / f'{days:g}_days.mcap').path

        if not given.cold:
            identify(record(WARM_UP_DAYS))
        path = record(given.days)
        size = path.stat().st_size
        steps = identify(path)
    about = {
        'command': study.command(), 'days': given.days, 'seed': given.seed, 'mcap_bytes': size,
        'total_wall_s': sum(s['wall_s'] for s in steps),
        'total_cpu_s': sum(s['cpu_s'] for s in steps),
        'peak_memory_mib': resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        **study.machine(),
    }  # fmt: skip
    if given.json:
        print(json.dumps({**about, 'steps': steps}, indent=2))
        return
    rows = [[s['step'], f'{s["wall_s"]:.2f}', f'{s["cpu_s"]:.2f}', s['what']] for s in steps]
    rows.append(['total', f'{about["total_wall_s"]:.2f}', f'{about["total_cpu_s"]:.2f}', ''])
    print(f'{given.days:g} days, {size / 1e6:.0f} MB of MCAP, {about["cpus"]} CPUs '
          f'(load {about["load_average"]:.1f}), Python {about["python"]}')  # fmt: skip
    print(table(['step', 'wall s', 'CPU s', 'what'], rows))
    print(f'Peak memory {about["peak_memory_mib"]:.0f} MiB.')


if __name__ == '__main__':
    main()
