# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a fleet costs beside its work, and whether anything it suffers changes its results.

    python -m benchmarks.fleet_study [--parts PART...] [--units N] [--months N] [--twice N]
        [--kills N] [--broken N] [--tiny N] [--folder DIR] [--output DIR]

Every fifth unit is the paper's, recorded once a second; the others are built from physics, as
means of a minute. The parts:

scheduling  tasks that do nothing, in chains as those of a fleet
speed       the first months of four units with one worker, and with two; then all with two
faults      all units again with broken logs among them, workers killed one after the other, and
            the command itself killed in the middle and started again: the results are compared,
            byte by byte, with those of the undisturbed runs

A machine that does something else meanwhile tells less speed than it has: `busy_percent` is the
share of their time in which the workers had a task, `cpu_s` what they used of processors. On free
cores two workers would be as much faster as ``times_on_free_cores`` says.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pandas as pd

import valveflow_ros as vf
from benchmarks import study
from valveflow_ros.interface.fleets.fleet import Chain, FleetResult, spread
from valveflow_ros.interface.fleets.unit_logs import UnitLog, read_options
from valveflow_ros.interface.fleets.unit_month import FleetTask, Row

_VERBS = ('read_s', 'identify_s', 'diagnose_s', 'monitor_s')
# The monitor keeps the reference that it is given: a task of about a second.
_WORDS = ['--no-diagnosis', '--set', 'refit_period=0', '--set', 'refit_segments=0']
# A copy of a log stands elsewhere.
_NOT_COMPARED = ('task_s', 'source', *_VERBS)
_BROKEN = (b'', b'\x00\xff' * 500, b'time,valve_opening_percent\n2026,1\n', b'PK\x03\x04 no zip')


def plants(folder: Path, units: int, months: int) -> list[Path]:
    """Simulate the units, each one record cut into months; return their folders."""
    found = []
    for number in range(units):
        kind = 'choked' if number % 5 else 'paper'
        place = folder / 'plants' / f'{kind}_{number:02d}'
        found.append(place)
        if place.exists():
            continue
        more = {'unit': f'choked:number={number}', 'recording': 'minute'}
        days, more = (1.0, more) if number % 5 else (0.25, {})
        frame = vf.simulate(days * months, 7000 + number, **more).to_dataframe()
        place.mkdir(parents=True)
        month = (frame.time - frame.time.iloc[0]) // pd.Timedelta(days=days)
        for k, part in frame.groupby(month):
            if k < months:
                part.to_csv(place / f'{k + 1:03d}.csv', index=False)
        print(place.name, flush=True)
    return found


@contextmanager
def cluster(workers: int) -> Iterator[tuple[Any, Any]]:
    """Give a cluster of so many workers of one thread, as `fleet` makes it, and a client.

    Every worker has loaded what tasks need.
    """
    from distributed import Client, LocalCluster

    with LocalCluster(
        n_workers=workers, threads_per_worker=1, processes=True, dashboard_address='127.0.0.1:0',
        silence_logs=50, env={'NUMBA_NUM_THREADS': '1'},
    ) as made:  # fmt: skip
        made.adapt(minimum=workers, maximum=workers, interval='1s')
        with Client(made, set_as_default=False) as client:
            client.run(lambda: __import__('valveflow_ros.interface.fleets.unit_month') and None)
            yield made, client


def _rows(out: Path) -> list[Path]:
    return list(out.glob('units/*/*/row.json'))


def timed_fleet(logs: list[Path], out: Path, workers: int) -> dict[str, Any]:
    """Run a fleet; return its wall time and what the tasks took that it did, in s."""
    kept = {p: p.stat().st_mtime_ns for p in _rows(out)}
    with cluster(workers) as (made, client):
        cpu = sum(client.run(time.process_time).values())
        begun = time.perf_counter()
        found = vf.fleet(logs, out, scheduler=made.scheduler_address, options=_WORDS)
        wall = time.perf_counter() - begun
        cpu = sum(client.run(time.process_time).values()) - cpu
    new = [p for p in _rows(out) if kept.get(p) != p.stat().st_mtime_ns]
    rows = [json.loads(p.read_text())['row'] for p in new]
    tasks = sum(row['task_s'] for row in rows)
    return {
        'workers': workers, 'tasks': found.anew, 'failed': found.failed, 'wall_s': round(wall, 1),
        'cpu_s': round(cpu, 1), 'task_s': round(tasks, 1),
        'verbs_s': round(sum(row[v] for row in rows for v in _VERBS), 1),
        'busy_percent': round(100.0 * tasks / (wall * workers), 1),
        'load_average': round(os.getloadavg()[0], 1),
    }  # fmt: skip


def digests(out: Path) -> dict[str, str]:
    """Return a hash of all files of each log but its times, of broken logs none."""
    hashes = {}
    for place in (p.parent for p in sorted(_rows(out)) if not p.parent.name.endswith('_broken')):
        found = hashlib.sha256()
        for path in sorted(p for p in place.rglob('*') if p.is_file()):
            data = path.read_bytes()
            if path.name == 'row.json':
                row = json.loads(data)['row']
                row = {k: v for k, v in row.items() if k not in _NOT_COMPARED}
                data = json.dumps(row).encode()
            found.update(f'{path.relative_to(place)} {len(data)}\n'.encode() + data)
        hashes[f'{place.parent.name}/{place.name}'] = found.hexdigest()
    return hashes


def break_logs(folder: Path, logs: list[Path], count: int) -> list[Path]:
    """Copy the plants with broken logs among their months; return the folders."""
    copied = [folder / 'broken' / place.name for place in logs]
    for place, copy in zip(logs, copied, strict=True):
        shutil.copytree(place, copy, dirs_exist_ok=True)
    for k in range(count):
        place = copied[k % len(copied)]
        after = sorted(place.glob('*.csv'))[1 + k // len(copied)]
        (place / f'{after.stem}_broken.csv').write_bytes(_BROKEN[k % len(_BROKEN)])
    return copied


def disturbed(logs: list[Path], out: Path, kills: int, expected: int) -> dict[str, Any]:
    """Run the command while its workers are killed, kill it in the middle, run it again."""
    words = [sys.executable, '-m', 'valveflow_ros.cli', 'fleet', *map(str, logs), '-o', str(out),
             '--quiet', '--json', *_WORDS]  # fmt: skip
    done = threading.Event()
    killed: list[int] = []

    def executioner(client: Any) -> None:
        # Spread over the whole run, whatever its speed.
        while len(killed) < kills and not done.wait(0.3):
            if len(_rows(out)) < (len(killed) + 1) * 0.9 * expected / kills:
                continue
            if pids := list(client.run(os.getpid, on_error='ignore').values()):
                os.kill(pids[len(killed) % len(pids)], signal.SIGKILL)
                killed.append(len(_rows(out)))

    with cluster(2) as (made, client):
        words += ['--scheduler', made.scheduler_address]
        thread = threading.Thread(target=executioner, args=(client,))
        thread.start()
        begun = time.perf_counter()
        first = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        while len(_rows(out)) < expected // 2 and first.poll() is None:
            time.sleep(0.2)
        first.kill()
        first.communicate()
        stopped_at = len(_rows(out))
        second = subprocess.run(words, capture_output=True, text=True, check=True)
        wall = time.perf_counter() - begun
        done.set()
        thread.join()
        again = subprocess.run(words, capture_output=True, text=True, check=True)
    return {
        'workers_killed': len(killed), 'command_killed_after_tasks': stopped_at,
        'wall_s': round(wall, 1), 'after_restart': json.loads(second.stdout)['tasks'],
        'third_run': json.loads(again.stdout)['tasks'],
    }  # fmt: skip


def nothing(task: FleetTask) -> Row:
    """Do a task that is none, on a worker."""
    return {'unit': task.of.unit, 'log': task.of.name}


def _tiny_chain(unit: int, length: int) -> Chain:
    how, folder = read_options(_WORDS), Path('/nowhere')
    for k in range(length):
        log = UnitLog(f'U{unit:04d}', f'{k:03d}', folder / 'none.csv', how)
        yield FleetTask(log, folder, 'a reference', 'a first one')


def scheduling(count: int, units: int) -> dict[str, Any]:
    with cluster(2) as (_, client):
        chains = [_tiny_chain(u, count // units) for u in range(units)]
        took, done = study.timed(lambda: sum(1 for _ in spread(client, nothing, chains)))
    return {
        'tasks': done, 'units': units, 'wall_s': round(took['wall_s'], 1),
        'wall_ms_per_task': round(1000.0 * took['wall_s'] / done, 2),
        'client_and_scheduler_cpu_ms_per_task': round(1000.0 * took['cpu_s'] / done, 2),
        'client_and_scheduler_memory_mb': round(
            resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3, 1
        ),
        'load_average': round(os.getloadavg()[0], 1),
    }  # fmt: skip


def sizes(out: Path, logs: list[Path]) -> dict[str, float]:
    """Return the bytes of a task in MB."""

    def mean(pattern: str) -> float:
        size = sum(p.stat().st_size for p in out.glob(pattern))
        return round(size / max(len(_rows(out)), 1) / 1e6, 4)

    read = [p.stat().st_size for place in logs for p in place.glob('*.csv')]
    return {
        'log_mb': round(sum(read) / len(read) / 1e6, 3), 'reports_mb': mean('units/*/*/*/*.html'),
        'json_mb': mean('units/*/*/*/*.json'), 'parquet_mb': mean('fleet.parquet/*/*'),
        'overview_mb': round((out / 'fleet.html').stat().st_size / 1e6, 3),
    }  # fmt: skip


def part_scheduling(folder: Path, given: argparse.Namespace) -> dict[str, Any]:
    """Measure tasks that do nothing: ten and a hundred a unit."""
    return {'runs': [scheduling(given.tiny, max(given.tiny // n, 1)) for n in (10, 100)]}


def part_speed(folder: Path, given: argparse.Namespace) -> dict[str, Any]:
    """Run all units, four of them with one worker too."""
    logs = plants(folder, given.units, given.months)
    early = [p for u in logs[:4] for p in sorted(u.glob('*.csv'))[: given.twice]]
    # What is done is not done again.
    runs = [
        timed_fleet(what, folder / f'of_{workers}', workers)
        for what, workers in ((early, 1), (early, 2), (logs, 2))
    ]
    one, two = runs[:2]
    tasks, verbs, cpu, count = (
        sum(r[k] for r in runs) for k in ('task_s', 'verbs_s', 'cpu_s', 'tasks')
    )
    free = one['cpu_s'] / two['cpu_s'] * two['task_s'] / two['wall_s']
    first, second = (digests(folder / name) for name in ('of_1', 'of_2'))
    return {
        'runs': runs,
        'times_one_worker': round(one['wall_s'] / two['wall_s'], 2),
        'times_on_free_cores': round(free, 2),
        'work_s_per_task': round(verbs / count, 2),
        'cpu_s_per_task': round(cpu / count, 2),
        'beside_work_ms_per_task': round(1000.0 * (tasks - verbs) / count, 1),
        'sizes': sizes(folder / 'of_2', logs),
        'one_and_two_workers_identical': first.items() <= second.items(),
    }


def part_faults(folder: Path, given: argparse.Namespace) -> dict[str, Any]:
    """Run all units again, disturbed; compare with the runs of `part_speed` in the folder."""
    logs = plants(folder, given.units, given.months)
    calm = digests(folder / 'of_2')
    broken = break_logs(folder, logs, given.broken)
    out = folder / 'disturbed'
    found = disturbed(broken, out, given.kills, len(calm) + given.broken)
    rows = FleetResult(out, (), 0, 0, 0).to_dataframe()
    bad = rows[rows.log.str.contains('broken')]
    after = digests(out)
    return found | {
        'broken_logs': given.broken, 'rows_of_broken_logs': len(bad),
        'their_sentences': sorted({
            ' '.join(s).rsplit('/', 1)[-1][:120] for s in bad.sentences
        }),
        'other_failed': int((rows.status == 'failed').sum() - len(bad)),
        'logs_compared': len(after), 'identical': after == calm,
    }  # fmt: skip


PARTS = {'scheduling': part_scheduling, 'speed': part_speed, 'faults': part_faults}


def main() -> None:
    parser = study.options(
        __doc__, units=10, months=20, twice=10, kills=20, broken=10, tiny=10_000
    )
    parser.add_argument('--parts', nargs='+', choices=list(PARTS), default=list(PARTS))
    parser.add_argument('--folder', type=Path, help='keeps the simulated logs and the results')
    parser.add_argument('--output', type=Path, help='folder for fleet_PART.json')
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        for part in given.parts:
            found = PARTS[part](given.folder or Path(place), given)
            study.keep(f'fleet_{part}', given.output, machine=study.machine(), **found)


if __name__ == '__main__':
    main()
