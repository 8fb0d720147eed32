# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Disks that fail at every call in turn, that are really full, and that lose their power."""

from __future__ import annotations

import errno
import json
import random
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml
from fault_points import SHORT, Faults
from log_files import (
    FLOAT64,
    QUICK,
    START_NS,
    STOCK,
    balanced,
    float64,
    recorder_of,
    stock,
    write_chunks,
    write_part,
)

from benchmarks.torture.trial import Options, Outcome, run_bounded
from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import (
    Recorder,
    RecorderSettings,
    RecorderState,
    RecordingWriter,
    open_log,
    recover,
    recover_leftovers,
)
from valveflow_ros.logs.part_file import PartFile

TOPIC = '/valve_opening'
CALLS = 300
BATCHES, PER_BATCH, ROTATE_EVERY = 30, 20, 3
PATIENCE_S = 20.0
DEGRADED_WITHIN_S = 1.0
KINDS = {'full disk': errno.ENOSPC, 'broken disk': errno.EIO, 'short write': SHORT}
# Behind everything that stood in the folder before.
LATER_NS = START_NS + 10**12


def fail_every_write(options: Options) -> Outcome:
    """Fail each of the first 300 calls in three ways, and all that follow until it is noticed."""
    outcome, folder = Outcome(), options.folder / 'log'
    left, _ = write_part(options.folder / 'left', chunks=3)
    for kind, error in KINDS.items():
        for call in range(1, CALLS + 1, options.step):
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            shutil.copy(left, folder / 'log_0.mcap.part')
            _try(folder, Faults('recorder', call, error), f'{kind}, call {call}', outcome)
    counts = outcome.counts
    outcome.sentence = (
        f'{counts["faults"]} faults ({counts["calls_hit"]}): {counts["messages"]} messages handed '
        f'in, {counts["lost"]} lost, degraded after at most '
        f'{1000 * outcome.measured["longest_until_degraded_s"]:.0f} ms'
    )
    return outcome


def _try(folder: Path, faults: Faults, what: str, outcome: Outcome) -> None:
    with faults.active():
        recorder = recorder_of(folder, replace(QUICK, sync_period_s=0.004), name='log')
        for batch in range(BATCHES):
            for number in range(batch * PER_BATCH, (batch + 1) * PER_BATCH):
                recorder.record(TOPIC, float64(number), LATER_NS + number, LATER_NS + number)
            if batch % ROTATE_EVERY == ROTATE_EVERY - 1:
                recorder.rotate()
            _settle(recorder, faults, what, outcome, (batch + 1) * PER_BATCH)
        status = recorder.close(PATIENCE_S)
    if faults.failed_at_s is None:
        outcome.count('not_reached')
        return
    outcome.count('faults')
    hit = outcome.counts.setdefault('calls_hit', {})
    hit[faults.what] = hit.get(faults.what, 0) + 1
    outcome.count('messages', status.received)
    outcome.count('lost', status.lost + sum(status.dropped.values()))
    what = f'{what} ({faults.what})'
    healthy = status.state == RecorderState.STOPPED and not status.reason
    outcome.expect(healthy, f'{what}: ended as {status.state.value} ({status.reason})')
    outcome.expect(balanced(status), f'{what}: the account is wrong: {status}')
    outcome.expect(status.written == BATCHES * PER_BATCH, f'{what}: {status.written} written')
    _read(folder, what, outcome)


def _settle(recorder: Recorder, faults: Faults, what: str, outcome: Outcome, wanted: int) -> None:
    """Wait until a batch is on disk; on the way, see that a failure shows, and end it then."""

    def done() -> bool:
        return recorder.status().written >= wanted and not recorder.is_rotating

    seen = _wait(lambda: recorder.status().state != RecorderState.RECORDING or done())
    status = recorder.status()
    outcome.expect(balanced(status), f'{what}: the account is wrong: {status}')
    if faults.failed_at_s is not None:
        if status.state != RecorderState.RECORDING:
            late_s = time.monotonic() - faults.failed_at_s
            outcome.worst('longest_until_degraded_s', round(late_s, 4))
            outcome.expect(late_s <= DEGRADED_WITHIN_S, f'{what}: degraded after {late_s:.2f} s')
        faults.heal()
    over = seen and _wait(lambda: done() or recorder.status().state == RecorderState.STOPPED)
    outcome.expect(over, f'{what}: stuck in {recorder.status()}')


def _wait(condition: Callable[[], bool]) -> bool:
    end_s = time.monotonic() + PATIENCE_S
    while not condition() and time.monotonic() < end_s:
        time.sleep(0.0005)
    return condition()


def _unlisted(folder: Path) -> set[str]:
    """Return the whole files that `metadata.yaml` does not name, and the names without a file."""
    text = (folder / 'metadata.yaml').read_text('utf-8')
    listed = set(yaml.safe_load(text)['rosbag2_bagfile_information']['relative_file_paths'])
    return listed ^ {path.name for path in folder.glob('*.mcap')}


def _read(folder: Path, what: str, outcome: Outcome) -> None:
    """Look at what is on disk after the next start: nothing twice, nothing changed, no gaps."""
    outcome.expect(not _unlisted(folder), f'{what}: metadata.yaml: {_unlisted(folder)}')
    recover_leftovers(folder)
    with outcome.surprises(what):
        contents = open_log(folder, columns={'valve_opening': TOPIC})
        found = contents.readings.value[contents.log_time_ns >= LATER_NS].tolist()
        same = found == list(range(BATCHES * PER_BATCH))
        outcome.expect(same, f'{what}: {len(found)} values on disk, or in another order')
        outcome.expect(contents.warnings == (), f'{what}: {contents.warnings}')
    outcome.expect(not _unlisted(folder), f'{what}: metadata.yaml: {_unlisted(folder)}')
    strange = [p.name for p in folder.iterdir() if p.suffix != '.mcap' and p.stem != 'metadata']
    outcome.expect(not strange, f'{what}: left over: {sorted(strange)}')
    for path in folder.glob('*.mcap'):
        with outcome.surprises(f'{what}: {path.name}'):
            outcome.count('stock_messages', len(stock(path)))


# A disk that is really full -------------------------------------------------------------------

RATE = 2000
WITHIN_S = 10.0
FULL_PATIENCE_S = 40.0
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
        elif error := found.get('error'):
            outcome.expect(False, f'{name}: {error}')
        else:
            _judge_full(name, found, outcome)
    _retention(options.folder / 'kept', outcome)
    tried = [found for found in outcome.counts.values() if isinstance(found, dict)]
    outcome.sentence = (
        f'{sum(f["received"] for f in tried)} messages over {len(tried)} full disks: '
        f'{sum(f["lost"] for f in tried)} lost, a new file '
        f'{outcome.measured["longest_until_new_file_s"]:.1f} s after room returned'
    )
    return outcome


def _judge_full(name: str, found: dict[str, Any], outcome: Outcome) -> None:
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
        kind = resource.RLIMIT_FSIZE
        _, hard = resource.getrlimit(kind)
        return _record(
            folder, lambda: resource.setrlimit(kind, (0, hard)),
            lambda: resource.setrlimit(kind, (hard, hard)),
        )  # fmt: skip

    ended = run_bounded(work, 2 * FULL_PATIENCE_S)
    return ended.value or {'error': ended.error}


def _by_file_system(folder: Path) -> dict[str, Any] | None:
    """Record in a file system of its own, that no other process sees; None if that is refused."""
    folder.mkdir()
    inside = [sys.executable, '-m', 'benchmarks.torture.disks', str(folder)]
    command = ['unshare', '--user', '--map-root-user', '--mount', 'sh', '-c', MOUNT, str(folder)]
    if shutil.which('unshare') is None:
        return None
    if subprocess.run([*command, 'true'], capture_output=True, check=False).returncode:
        return None
    done = subprocess.run([*command, *inside], capture_output=True, text=True, check=False)
    found = done.stdout.strip().splitlines()
    return json.loads(found[-1]) if found else {'error': done.stderr[-300:]}


def _inside(folder: Path) -> None:
    """Fill the small file system with a file, and take that away again."""
    ballast = folder / 'ballast'

    def fill() -> None:
        with ballast.open('wb', buffering=0) as stream, suppress(OSError):
            while stream.write(bytes(4096)):
                pass

    print(json.dumps(_record(folder / 'log', fill, ballast.unlink)))


def _record(folder: Path, fill: Callable[[], None], free: Callable[[], None]) -> dict[str, Any]:
    recorder = recorder_of(folder, SETTINGS, name='log')
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
    status = recorder.close(FULL_PATIENCE_S)
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
        if time.monotonic() - begun_s > FULL_PATIENCE_S:
            raise TimeoutError(f'waited in vain: {recorder.status()}')
        due = first + int((time.monotonic() - begun_s) * RATE)
        while number < due:
            recorder.record(TOPIC, float64(number), START_NS + number, START_NS + number)
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
    settings = replace(QUICK, flush_period_s=0.01, sync_period_s=0.0, keep_files=3)
    recorder = recorder_of(folder, settings, name='log')
    for number in range(12):
        recorder.record(TOPIC, float64(number), START_NS + number, START_NS + number)
        recorder.rotate()
        _wait(lambda number=number: recorder.status().files_finished > number)
    recorder.close()
    left = {path.name for path in folder.iterdir()} - {'metadata.yaml'}
    numbers = sorted(int(name[4:-5]) for name in left - kept)
    outcome.counts['retention'] = len(numbers)
    outcome.expect(left >= kept, f'retention removed {sorted(kept - left)}')
    newest = list(range(numbers[-1] - 2, numbers[-1] + 1)) if numbers else []
    outcome.expect(numbers == newest and len(numbers) == 3, f'retention left {numbers}')
    for number in numbers:
        outcome.count('retained_messages', len(stock(folder / f'log_{number}.mcap')))


# A power cut after each sync, with torn tails -------------------------------------------------

SECONDS = 120
PER_S = 40
FLUSH_S, SYNC_S = 0.5, 5.0
TAILS = 40
SECTORS = (512, 4096)


class Tape(PartFile):
    """A real file that notes all bytes, and at each sync those before it and their messages."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.data, self.messages = bytearray(), 0
        self.synced: list[tuple[int, int]] = []

    def write(self, data: bytes) -> int:
        """Append bytes."""
        taken = super().write(data)
        self.data += data[:taken]
        return taken

    def sync(self) -> None:
        """Note what is safe from now on."""
        super().sync()
        self.synced.append((len(self.data), self.messages))

    def publish(self) -> None:
        """Note that all is safe."""
        super().publish()
        self.synced.append((len(self.data), self.messages))


def power_loss(options: Options) -> Outcome:
    """Cut the power between any two syncs; some of the sectors written since have reached it."""
    outcome, generator = Outcome(), random.Random(options.seed)
    tape = _recorded(options.folder / 'log', options.many(SECONDS, 20))
    ends = [*[size for size, _ in tape.synced[1:]], len(tape.data)]
    for (size, messages), end in zip(tape.synced, ends, strict=True):
        for number in range(options.many(TAILS, 4)):
            raw = _torn(tape.data, size, end, number, generator)
            what = f'cut after {size} of {len(tape.data)} bytes, tail {number}'
            _judge_cut(options.folder, raw, messages, tape.messages, what, outcome)
    outcome.counts['syncs'] = len(tape.synced)
    outcome.sentence = (
        f'{outcome.counts["cuts"]} power cuts around {len(tape.synced)} syncs: nothing synced was '
        f'lost, {outcome.counts["invented"]} messages invented'
    )
    return outcome


def _recorded(folder: Path, seconds: int) -> Tape:
    tapes: list[Tape] = []

    def opened(path: Path) -> Tape:
        tapes.append(Tape(path))
        return tapes[-1]

    with RecordingWriter(folder, definitions=STOCK, open_file=opened) as writer:
        writer.add_topic(TOPIC, FLOAT64)
        for number in range(1, seconds * PER_S + 1):
            time_ns = START_NS + number * 10**9 // PER_S
            writer.write(TOPIC, float64(number - 1), time_ns, time_ns)
            if number % round(FLUSH_S * PER_S) == 0:
                writer.flush()
                tapes[0].messages = number
            if number % round(SYNC_S * PER_S) == 0:
                writer.sync()
    return tapes[0]


def _torn(data: bytearray, size: int, end: int, number: int, generator: random.Random) -> bytes:
    """Return the file after a cut: whole up to ``size``, then any of the sectors up to ``end``."""
    sector = SECTORS[number % len(SECTORS)]
    length = generator.randint(size, end)
    raw = bytearray(data[:length])
    if number % 4 < 2:
        # The length has reached the disk, some sectors have not: zeros, or what stood there.
        for begin in range(size // sector * sector, length, sector):
            first, last = max(begin, size), min(begin + sector, length)
            if last > first and generator.random() < 0.5:
                stale = generator.random() < 0.5
                missing = last - first
                raw[first:last] = generator.randbytes(missing) if stale else bytes(missing)
    return bytes(raw)


def _judge_cut(
    folder: Path, raw: bytes, safe: int, sent: int, what: str, outcome: Outcome
) -> None:
    path, copy = folder / 'cut.mcap', folder / 'whole.mcap'
    path.write_bytes(raw)
    copy.unlink(missing_ok=True)
    outcome.count('cuts')
    try:
        numbers = open_log(path).readings.value.astype(int).tolist()
        report = recover(path, copy)
    except RecordingError as error:
        outcome.expect(safe == 0, f'{what}: {error}')
        return
    invented = len(set(numbers) - set(range(sent))) + (numbers != sorted(set(numbers)))
    outcome.count('invented', invented)
    outcome.expect(not invented, f'{what}: values that nobody wrote, or twice')
    outcome.expect(numbers[:safe] == list(range(safe)), f'{what}: synced messages are lost')
    same = report.messages == len(numbers) == len(stock(copy))
    outcome.expect(same, f'{what}: recovered {report.messages} of {len(numbers)}')
    outcome.count('found_beyond_the_sync', len(numbers) - safe)


if __name__ == '__main__':
    _inside(Path(sys.argv[1]))
