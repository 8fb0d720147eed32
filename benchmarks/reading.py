"""How fast a ten-day recording is written and read, beside the libraries one would take else.

Run: python benchmarks/reading.py [--days 10] [--peers] [--json]

All readers read the same file in the same run; a peer counts only if it gives
the same sum of values.
"""

from __future__ import annotations

import argparse
import json
import platform
import struct
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from valveflow_ros.logs import open_log, recover, write_samples, write_table
from valveflow_ros.records import SampleTable, Signal

SECONDS_A_DAY = 86_400


def plant(days: float) -> SampleTable:
    generator = np.random.default_rng(2024)
    n = int(days * SECONDS_A_DAY)
    time_ns = 1_700_000_000_000_000_000 + np.arange(n, dtype=np.int64) * 10**9
    columns = {Signal(k): 50 + 0.01 * np.cumsum(generator.normal(size=n)) for k in range(4)}
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


def timed(action: Callable[[], object]) -> tuple[dict[str, float], object]:
    wall, cpu = time.perf_counter(), time.process_time()
    result = action()
    seconds = {
        'wall_s': round(time.perf_counter() - wall, 2),
        'cpu_s': round(time.process_time() - cpu, 2),
    }
    return seconds, result


def measure(days: float, peers: bool) -> dict[str, dict[str, float]]:
    table = plant(days)
    results: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = folder / 'log' / 'log.mcap'
        results['write mcap'], written = timed(lambda: write_samples(table, path))
        results['read mcap, cold'], _ = timed(lambda: open_log(path))
        results['read mcap, warm'], contents = timed(lambda: open_log(path))
        total = float(contents.readings.value.sum())
        results['raw messages in order'], _ = timed(
            lambda: sum(1 for _ in contents.iter_messages())
        )
        results['recover'], _ = timed(lambda: recover(path, folder / 'copy.mcap'))
        for suffix in ('.csv', '.parquet'):
            target = folder / f'table{suffix}'
            results[f'write {suffix[1:]}'], _ = timed(lambda t=target: write_table(table, t))
            results[f'read {suffix[1:]}'], _ = timed(lambda t=target: open_log(t))
        for reader in (by_rosbags, by_mcap, by_mcap_ros2) if peers else ():
            results[f'peer {reader.__name__}'], found = timed(lambda r=reader: r(path))
            if not np.isclose(found, total, rtol=1e-9):
                raise SystemExit(f'{reader.__name__} read other values')
        results['file'] = {'messages': written.messages, 'bytes': path.stat().st_size}
    return results


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--days', type=float, default=10.0)
    parser.add_argument('--peers', action='store_true', help='also time other libraries (slow)')
    parser.add_argument('--json', action='store_true')
    options = parser.parse_args()
    results = measure(options.days, options.peers)
    if options.json:
        print(json.dumps(results, indent=2))
        return 0
    print(f'{platform.python_implementation()} {platform.python_version()}, {platform.machine()}')
    for name, numbers in results.items():
        print(f'{name:24}', '  '.join(f'{key} {value}' for key, value in numbers.items()))
    return 0


if __name__ == '__main__':
    sys.exit(main())
