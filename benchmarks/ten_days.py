# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""From ten days of a simulated plant on disk to the report: how long each step takes.

    python -m benchmarks.ten_days [--days 10] [--seed 1] [--effect NAME]... [--cold] [--json]

The steps are those of ``valveflow identify`` on an MCAP recording, one after
the other in one process. The kernels are compiled (or loaded from their cache)
beforehand on a few hours of the same plant, so that what is shown is the work
and not the compiler; ``--cold`` shows both.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from benchmarks import study
from valveflow_ros.cli.command import columns
from valveflow_ros.interface.logs import steps_of
from valveflow_ros.interface.observation import observe
from valveflow_ros.interface.settings import settings_for
from valveflow_ros.logs import open_log, write_samples
from valveflow_ros.plant.simulator import simulate
from valveflow_ros.plant.spec import EffectSpec
from valveflow_ros.report.identification import identification_report
from valveflow_ros.report.identified import Identified

T = TypeVar('T')
WARM_UP_DAYS = 0.4


class Stopwatch:
    """Names, times and results of what was done, in order."""

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []

    def measure(self, name: str, work: Callable[[], T], what: Callable[[T], str]) -> T:
        """Do ``work`` and note how long it took and what came of it."""
        seconds, result = study.timed(work)
        self.rows.append({'step': name, **seconds, 'what': what(result)})
        return result

    def total(self, clock: str) -> float:
        """Return the sum over all steps of 'wall_s' or 'cpu_s'."""
        return float(sum(row[clock] for row in self.rows))


def record(folder: Path, days: float, seed: int, effects: list[str]) -> Path:
    """Simulate and write a recording; not part of what is measured."""
    log = simulate(days, seed, effects=[EffectSpec.parse(text) for text in effects])
    return write_samples(log.table, folder / f'{days:g}_days.mcap').path


def identify(path: Path, watch: Stopwatch) -> dict[str, Any]:
    """Do what `valveflow identify` does and return what was found."""
    contents = watch.measure(
        'read MCAP', lambda: open_log(path), lambda c: f'{len(c.readings):,} values'
    )
    readings = contents.readings
    span_s = float(np.ptp(readings.time_ns)) / 1e9
    settings, _ = settings_for(steps_of(readings.by_signal()), span_s, {})
    seen = watch.measure(
        'rows and segments', lambda: observe(readings, settings),
        lambda w: f'{len(w.table):,} rows, {len(w.segments)} segments',
    )  # fmt: skip
    rate = len(seen.table) / watch.rows[-1]['wall_s']
    curve = watch.measure(
        'fit', lambda: seen.fit(),
        lambda c: f'{len(c.pieces)} pieces from {c.source.samples:,} special samples',
    )  # fmt: skip
    found = Identified(path.name, curve, seen.table, seen.segments, seen.counts, settings)
    report = watch.measure(
        'report', lambda: identification_report(found), lambda r: f'{len(r) / 1e6:.2f} MB'
    )
    return {
        'pieces': [[p.u_from, p.u_to, p.slope, p.intercept] for p in curve.pieces],
        'report_bytes': len(report.encode()),
        'rows_per_s': rate,
    }


def options() -> argparse.Namespace:
    parser = study.options(__doc__, days=10.0, seed=1)
    parser.add_argument('--effect', action='append', default=[], metavar='NAME[:KEY=VALUE,...]')
    parser.add_argument('--cold', action='store_true', help='do not compile beforehand')
    parser.add_argument('--json', action='store_true')
    return parser.parse_args()


def main() -> int:
    asked = options()
    with tempfile.TemporaryDirectory(prefix='ten_days') as name:
        folder = Path(name)
        if not asked.cold:
            identify(record(folder, WARM_UP_DAYS, asked.seed, []), Stopwatch())
        path = record(folder, asked.days, asked.seed, asked.effect)
        size = path.stat().st_size
        watch = Stopwatch()
        found = identify(path, watch)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    about = {
        'command': study.command(),
        'days': asked.days, 'seed': asked.seed, 'effects': asked.effect, 'mcap_bytes': size,
        'total_wall_s': watch.total('wall_s'), 'total_cpu_s': watch.total('cpu_s'),
        'peak_memory_mib': peak, **study.machine(),
    }  # fmt: skip
    if asked.json:
        json.dump({**about, 'steps': watch.rows, **found}, sys.stdout, indent=2)
        sys.stdout.write('\n')
        return 0
    rows = [[r['step'], f'{r["wall_s"]:.2f}', f'{r["cpu_s"]:.2f}', r['what']] for r in watch.rows]
    rows.append(['total', f'{about["total_wall_s"]:.2f}', f'{about["total_cpu_s"]:.2f}', ''])
    print(f'{asked.days:g} days, {size / 1e6:.0f} MB of MCAP, {about["cpus"]} CPUs '
          f'(load {about["load_average"]:.1f}), Python {about["python"]}')  # fmt: skip
    print(columns(rows, ['step', 'wall s', 'CPU s', 'what']))
    print(f'Peak memory {peak:.0f} MiB.')
    for k, (u_from, u_to, slope, intercept) in enumerate(found['pieces']):
        print(f'  piece {k + 1}: u {u_from:.1f} to {u_to:.1f}, {slope:.4f} u {intercept:+.2f} MW')
    return 0


if __name__ == '__main__':
    sys.exit(main())
