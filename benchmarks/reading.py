# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""How fast a ten-day recording is written and read, beside the libraries one would take else.

Run: python -m benchmarks.reading [--days 10] [--peers] [--json] [--keep]

All readers read the same file in the same run; a peer counts only if it gives
the same sum of values. ``--keep`` writes what was measured, and each peer's CPU time
as a multiple of ours, to benchmarks/results/reading.json, or reading_peers.json. ``import csv`` is
``valveflow import`` of a table with names, dates and decimals of a German
control system, in a process of its own, whose largest memory is told too.
"""

from __future__ import annotations

import json
import platform
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

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


def by_mcap(path: Path) -> float:
    from mcap.reader import make_reader

    unpack = struct.Struct('<d').unpack_from
    with path.open('rb') as stream:
        messages = make_reader(stream, validate_crcs=True).iter_messages()
        return sum(unpack(message.data, 4)[0] for _, _, message in messages)


def by_rosbags(path: Path) -> float:
    from rosbags.highlevel import AnyReader

    with AnyReader([path]) as reader:
        messages = reader.messages()
        return sum(reader.deserialize(raw, c.msgtype).data for c, _, raw in messages)


def by_mcap_ros2(path: Path) -> float:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with path.open('rb') as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return sum(message.data for _, _, _, message in reader.iter_decoded_messages())


def german_table(table: SampleTable, path: Path) -> None:
    """Write a table as a control system would: its own names, bar, decimal commas, local dates."""
    names = (
        'Zeitstempel', 'Ventilstellung [%]', 'Frischdampfdruck [bar]', 'FD-Temperatur [°C]',
        'Leistung [MW]',
    )  # fmt: skip
    with path.open('w', encoding='cp1252') as out:
        out.write(f'Archiv Block 3\n{";".join(names)}\n')
        for start in range(0, len(table), SECONDS_A_DAY):
            part = table.part(start, start + SECONDS_A_DAY)
            stamps = np.datetime_as_string(part.time_ns.astype('datetime64[ns]'), unit='s')
            for stamp, row in zip(stamps.tolist(), part.values[:, :4].tolist(), strict=True):
                date = f'{stamp[8:10]}.{stamp[5:7]}.{stamp[:4]} {stamp[11:]}'
                values = ';'.join(f'{v:.2f}' for v in (row[0], 10.0 * row[1], *row[2:]))
                out.write(f'{date};{values.replace(".", ",")}\n')


def in_a_process(*words: str) -> dict[str, float]:
    """Run the command in a process of its own; return its times and its largest memory."""
    ran = subprocess.run(
        [sys.executable, '-c', _IN_A_PROCESS, *words, '--quiet'],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    found: dict[str, float] = json.loads(ran.stderr.splitlines()[-1])
    return found


def measure(days: float, peers: bool) -> dict[str, dict[str, float]]:
    table = plant(days)
    results: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = folder / 'log' / 'log.mcap'
        results['write mcap'], written = study.timed(lambda: write_samples(table, path))
        results['read mcap, cold'], _ = study.timed(lambda: open_log(path))
        results['read mcap, warm'], contents = study.timed(lambda: open_log(path))
        total = float(contents.readings.value.sum())
        results['raw messages in order'], _ = study.timed(
            lambda: sum(1 for _ in contents.iter_messages())
        )
        results['recover'], _ = study.timed(lambda: recover(path, folder / 'copy.mcap'))
        for suffix in ('.csv', '.parquet'):
            target = folder / f'table{suffix}'
            results[f'write {suffix[1:]}'], _ = study.timed(lambda t=target: write_table(table, t))
            results[f'read {suffix[1:]}'], _ = study.timed(lambda t=target: open_log(t))
        results['info mcap'] = in_a_process('info', str(path))
        german = folder / 'german.csv'
        german_table(table, german)
        results['import csv'] = in_a_process(
            'import', str(german), '-o', str(folder / 'german.mcap')
        )
        results['import csv']['csv_mib'] = round(german.stat().st_size / 2**20)
        for reader in (by_rosbags, by_mcap, by_mcap_ros2) if peers else ():
            results[f'peer {reader.__name__}'], found = study.timed(lambda r=reader: r(path))
            if not np.isclose(found, total, rtol=1e-9):
                raise SystemExit(f'{reader.__name__} read other values')
        results['file'] = {'messages': written.messages, 'bytes': path.stat().st_size}
    return results


def main() -> int:
    parser = study.options(__doc__, days=10.0)
    parser.add_argument('--peers', action='store_true', help='also time other libraries (slow)')
    parser.add_argument('--json', action='store_true')
    parser.add_argument('--keep', action='store_true', help='write to benchmarks/results')
    options = parser.parse_args()
    results = measure(options.days, options.peers)
    # CPU time, which other work on the machine does not stretch.
    ours = results['read mcap, warm']['cpu_s']
    for name, numbers in results.items():
        if name.startswith('peer '):
            numbers['cpu_times_ours'] = round(numbers['cpu_s'] / ours, 1)
    if options.keep:
        name = 'reading_peers' if options.peers else 'reading'
        study.keep(name, machine=study.machine(), results=results)
    if options.json:
        print(json.dumps(results, indent=2))
        return 0
    print(f'{platform.python_implementation()} {platform.python_version()}, {platform.machine()}')
    for name, numbers in results.items():
        print(f'{name:24}', '  '.join(f'{key} {value}' for key, value in numbers.items()))
    return 0


if __name__ == '__main__':
    sys.exit(main())
