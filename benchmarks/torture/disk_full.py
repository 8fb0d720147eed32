# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A disk that is really full, by a small file system or a limit, until room returns."""

from __future__ import annotations

import json
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from log_files import FLOAT64, START_NS, STOCK, float64, write_chunks

from benchmarks.torture.bounded import run_bounded
from benchmarks.torture.stock import stock_count
from benchmarks.torture.trial import Options, Outcome
from valveflow_ros.logs import Recorder, RecorderSettings, RecorderState, open_log

RATE = 2000
WITHIN_S = 10.0
PATIENCE_S = 40.0
# The node's periods of retrying are not shortened.
SETTINGS = RecorderSettings(flush_period_s=0.1, sync_period_s=0.5, free_floor_bytes=0)
MOUNT = 'mount -t tmpfs -o size=1m none "$0" && exec "$@"'


def disk_full(options: Options) -> Outcome:
    """Fill a disk in two ways, give room back, and see that a new file begins; then retention."""
    outcome = Outcome()
    for name, way in (('file size limit', _by_limit), ('file system of 1 MiB', _by_file_system)):
        found = way(options.folder / name.replace(' ', '_'))
        if found is None:
            outcome.counts[name] = 'not tried: this user may not mount'
            continue
        _judge(name, found, outcome)
    _retention(options.folder / 'kept', outcome)
    tried = [found for found in outcome.counts.values() if isinstance(found, dict)]
    outcome.sentence = (
        f'{sum(f["received"] for f in tried)} messages over {len(tried)} full disks: '
        f'{sum(f["lost"] for f in tried)} lost, a new file '
        f'{outcome.measured["longest_until_new_file_s"]:.1f} s after room returned'
    )
    return outcome


def _judge(name: str, found: dict[str, Any], outcome: Outcome) -> None:
    if error := found.get('error'):
        outcome.expect(False, f'{name}: {error}')
        return
    waited_s = found.pop('until_new_file_s')
    outcome.worst('longest_until_degraded_s', found.pop('until_degraded_s'))
    outcome.worst('longest_until_new_file_s', waited_s)
    outcome.counts[name] = found
    outcome.expect(waited_s <= WITHIN_S, f'{name}: a new file came after {waited_s:.1f} s')
    sums = found['written'] + found['lost'] + found['dropped']
    outcome.expect(found['received'] == sums, f'{name}: the account is wrong: {found}')
    outcome.expect(found['lost'] + found['dropped'] == 0, f'{name}: {found}')
    outcome.expect(found['on_disk'] == found['written'], f'{name}: {found}')
    outcome.expect(found['in_order'], f'{name}: values changed or out of order')


def _by_limit(folder: Path) -> dict[str, Any]:
    def work() -> dict[str, Any]:
        _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)

        def fill() -> None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))

        def free() -> None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))

        return _record(folder, fill, free)

    ended = run_bounded(work, 2 * PATIENCE_S)
    return ended.value or {'error': ended.error}


def _by_file_system(folder: Path) -> dict[str, Any] | None:
    """Record in a file system of its own, that no other process sees."""
    folder.mkdir()
    inside = [sys.executable, '-m', 'benchmarks.torture.disk_full', str(folder)]
    command = ['unshare', '--user', '--map-root-user', '--mount', 'sh', '-c', MOUNT, str(folder)]
    if shutil.which('unshare') is None:
        return None
    if subprocess.run([*command, 'true'], capture_output=True, check=False).returncode:
        return None
    done = subprocess.run([*command, *inside], capture_output=True, text=True, check=False)
    found = done.stdout.strip().splitlines()
    return json.loads(found[-1]) if found else {'error': done.stderr[-300:]}


def _record(folder: Path, fill: Callable[[], None], free: Callable[[], None]) -> dict[str, Any]:
    recorder = Recorder(folder, SETTINGS, name='log', definitions=STOCK)
    recorder.add_topic('/valve_opening', FLOAT64)
    sent = _send(recorder, 0, lambda: recorder.status().written > RATE // 2)
    fill()
    full_s = time.monotonic()
    sent = _send(recorder, sent, lambda: recorder.status().state == RecorderState.DEGRADED)
    degraded_s = time.monotonic() - full_s
    # Long enough that the wait between tries has grown.
    until_s = time.monotonic() + 4.0
    sent = _send(recorder, sent, lambda: time.monotonic() > until_s)
    before = {path.name for path in folder.glob('*.mcap*')}
    free()
    freed_s = time.monotonic()
    sent = _send(recorder, sent, lambda: recorder.status().state == RecorderState.RECORDING)
    again_s = time.monotonic() - freed_s
    new = {path.name for path in folder.glob('*.mcap*')} - before
    status = recorder.close(PATIENCE_S)
    values = open_log(folder).readings.value.tolist()
    return {
        'until_degraded_s': round(degraded_s, 3), 'until_new_file_s': round(again_s, 2),
        'new_files': len(new), 'received': status.received, 'written': status.written,
        'lost': status.lost, 'dropped': sum(status.dropped.values()), 'on_disk': len(values),
        'in_order': values == list(range(len(values))), 'sent': sent,
    }  # fmt: skip


def _send(recorder: Recorder, number: int, enough: Callable[[], bool]) -> int:
    """Hand in numbered messages at a steady rate until it is enough; return the next number."""
    begun_s, first = time.monotonic(), number
    while not enough():
        if time.monotonic() - begun_s > PATIENCE_S:
            raise TimeoutError(f'waited in vain: {recorder.status()}')
        due = first + int((time.monotonic() - begun_s) * RATE)
        while number < due:
            time_ns = START_NS + number
            recorder.record('/valve_opening', float64(number), time_ns, time_ns)
            number += 1
        time.sleep(0.005)
    return number


def _retention(folder: Path, outcome: Outcome) -> None:
    """Keep three files beside files of others, one of them unfinished, and a link."""
    folder.mkdir()
    other, _, _ = write_chunks(folder.with_name('foreign'), chunks=1)
    for name in ('foreign.mcap', 'foreign_0.mcap'):
        shutil.copy(other, folder / name)
    (folder / 'notes.txt').write_text('keep me')
    (folder / 'log_x.mcap').symlink_to(other)
    kept = {path.name for path in folder.iterdir()}
    settings = RecorderSettings(
        flush_period_s=0.01, sync_period_s=0.0, free_floor_bytes=0, keep_files=3
    )
    recorder = Recorder(folder, settings, name='log', definitions=STOCK)
    recorder.add_topic('/valve_opening', FLOAT64)
    for number in range(12):
        recorder.record('/valve_opening', float64(number), START_NS + number, START_NS + number)
        recorder.rotate()
        end_s = time.monotonic() + PATIENCE_S
        while recorder.status().files_finished <= number and time.monotonic() < end_s:
            time.sleep(0.001)
    recorder.close()
    left = {path.name for path in folder.iterdir()} - {'metadata.yaml'}
    numbers = sorted(int(name[4:-5]) for name in left - kept)
    outcome.counts['retention'] = len(numbers)
    outcome.expect(left >= kept, f'retention removed {sorted(kept - left)}')
    newest = list(range(numbers[-1] - 2, numbers[-1] + 1)) if numbers else []
    outcome.expect(numbers == newest and len(numbers) == 3, f'retention left {numbers}')
    for number in numbers:
        outcome.count('retained_messages', stock_count(folder / f'log_{number}.mcap'))


def _inside(folder: Path) -> None:
    """Fill the small file system with a file, and take that away again."""
    ballast = folder / 'ballast'

    def fill() -> None:
        with ballast.open('wb', buffering=0) as stream, suppress(OSError):
            while stream.write(bytes(4096)):
                pass

    found = _record(folder / 'log', fill, ballast.unlink)
    print(json.dumps(found))


if __name__ == '__main__':
    _inside(Path(sys.argv[1]))
