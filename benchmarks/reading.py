# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""How fast a ten-day recording is written, read, repaired and imported.

Run: python -m benchmarks.reading [--days 10] [--keep]

``--keep`` writes what was measured to benchmarks/results/reading.json. ``import csv`` is
``valveflow import`` of a table with names, dates and decimals of a German control system, in a
process of its own, whose largest memory is told too.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks import study
from valveflow_ros.logs import open_log, write_samples, write_table
from valveflow_ros.logs.mcap.recover import recover
from valveflow_ros.records import SampleTable, Signal

SECONDS_A_DAY = 86_400
_IN_A_PROCESS = """
import json, re, sys, time
from valveflow_ros.cli.main import main
begin, cpu = time.perf_counter(), time.process_time()
status = main(sys.argv[1:])
# What getrusage tells begins with the memory of the process this one came from.
peak = int(re.search(r'VmHWM:\\s*(\\d+)', open('/proc/self/status').read())[1]) / 1024
print(json.dumps({
    'wall_s': round(time.perf_counter() - begin, 2),
    'cpu_s': round(time.process_time() - cpu, 2),
    'peak_mib': round(peak),
}), file=sys.stderr)
sys.exit(status)
"""


def plant(days: float) -> SampleTable:
    generator = np.random.default_rng(2024)
    n = int(days * SECONDS_A_DAY)
    time_ns = 1_700_000_000_000_000_000 + np.arange(n, dtype=np.int64) * 10**9
    # About what a plant reads, in %, MPa, degC and MW, so that nothing of it is impossible.
    columns = {
        Signal(k): base * (1.0 + 1e-4 * np.cumsum(generator.normal(size=n)))
        for k, base in enumerate((60.0, 13.0, 538.0, 230.0))
    }
    return SampleTable.from_columns(time_ns, columns)


def german_table(table: SampleTable, path: Path) -> None:
    """Write a table as a control system would: its own names, bar, decimal commas, local dates."""
    v = table.values
    frame = pd.DataFrame({
        'Zeitstempel': pd.to_datetime(table.time_ns), 'Ventilstellung [%]': v[:, 0],
        'Frischdampfdruck [bar]': 10.0 * v[:, 1], 'FD-Temperatur [°C]': v[:, 2],
        'Leistung [MW]': v[:, 3],
    })  # fmt: skip
    with path.open('w', encoding='cp1252') as out:
        out.write('Archiv Block 3\n')
        frame.to_csv(out, sep=';', decimal=',', index=False, float_format='%.2f',
                     date_format='%d.%m.%Y %H:%M:%S')  # fmt: skip


def in_a_process(*words: str) -> dict[str, Any]:
    """Run the command in a process of its own; return its times and its largest memory."""
    ran = subprocess.run(
        [sys.executable, '-c', _IN_A_PROCESS, *words, '--quiet'],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    return dict(json.loads(ran.stderr.splitlines()[-1]))


def measure(days: float, folder: Path) -> dict[str, dict[str, Any]]:
    table = plant(days)
    path, german = folder / 'log' / 'log.mcap', folder / 'german.csv'
    results: dict[str, dict[str, Any]] = {}
    results['write mcap'], written = study.timed(lambda: write_samples(table, path))
    results['read mcap, cold'], _ = study.timed(lambda: open_log(path))
    results['read mcap, warm'], contents = study.timed(lambda: open_log(path))
    in_order = study.timed(lambda: sum(1 for _ in contents.iter_messages()))
    results['raw messages in order'] = in_order[0]
    results['recover'], _ = study.timed(lambda: recover(path, folder / 'copy.mcap'))
    for kind in ('csv', 'parquet'):
        target = folder / f'table.{kind}'
        results[f'write {kind}'], _ = study.timed(lambda t=target: write_table(table, t))
        results[f'read {kind}'], _ = study.timed(lambda t=target: open_log(t))
    results['info mcap'] = in_a_process('info', str(path))
    german_table(table, german)
    results['import csv'] = {
        **in_a_process('import', str(german), '-o', str(folder / 'german.mcap')),
        'csv_mib': round(german.stat().st_size / 2**20),
    }
    results['file'] = {'messages': written.messages, 'bytes': path.stat().st_size}
    return results


def main() -> None:
    parser = study.options(__doc__, days=10.0)
    parser.add_argument('--keep', action='store_true', help='write to benchmarks/results')
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        results = measure(given.days, Path(name))
    folder = study.RESULTS if given.keep else None
    study.keep('reading', folder, machine=study.machine(), results=results)


if __name__ == '__main__':
    main()
