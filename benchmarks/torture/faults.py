# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Every call by which the recorder changes the disk fails once in turn, until all have."""

from __future__ import annotations

import errno
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import yaml
from fault_points import SHORT, Faults
from log_files import FLOAT64, START_NS, STOCK, float64, write_chunks

from benchmarks.torture.stock import stock_count
from benchmarks.torture.trial import Options, Outcome
from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import (
    Recorder,
    RecorderSettings,
    RecorderState,
    RecorderStatus,
    open_log,
    recover_leftovers,
)
from valveflow_ros.logs.mcap.folder import METADATA_NAME

CALLS = 300
BATCHES, PER_BATCH, ROTATE_EVERY = 30, 20, 3
PATIENCE_S = 20.0
DEGRADED_WITHIN_S = 1.0
KINDS = {'full disk': errno.ENOSPC, 'broken disk': errno.EIO, 'short write': SHORT}
QUICK = RecorderSettings(
    flush_period_s=0.002, sync_period_s=0.004, retry_s=0.002, retry_max_s=0.01, free_floor_bytes=0,

)  # fmt: skip


def fail_every_write(options: Options) -> Outcome:
    """Fail each of the first 300 calls in three ways, and all that follow until it is noticed."""
    outcome = Outcome()
    _, _, writer = write_chunks(options.folder / 'left', close=False, chunks=3)
    writer.abandon()
    step = max(1, round(1 / options.scale))
    for kind, error in KINDS.items():
        for call in range(1, CALLS + 1, step):
            folder = options.folder / 'log'
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            shutil.copy(options.folder / 'left' / 'left_0.mcap.part', folder / 'log_0.mcap.part')
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
        recorder = Recorder(folder, QUICK, name='log', definitions=STOCK)
        recorder.add_topic('/valve_opening', FLOAT64)
        for batch in range(BATCHES):
            for number in range(batch * PER_BATCH, (batch + 1) * PER_BATCH):
                time_ns = START_NS + 10**12 + number
                recorder.record('/valve_opening', float64(number), time_ns, time_ns)
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
    outcome.expect(_balanced(status), f'{what}: the account is wrong: {status}')
    outcome.expect(status.written == BATCHES * PER_BATCH, f'{what}: {status.written} written')
    _read(folder, what, outcome)


def _settle(recorder: Recorder, faults: Faults, what: str, outcome: Outcome, wanted: int) -> None:
    """Wait until a batch is on disk; on the way, see that a failure shows, and end it then."""
    degraded = _wait(lambda: _is_ill(recorder) or _done(recorder, wanted))
    status = recorder.status()
    outcome.expect(_balanced(status), f'{what}: the account is wrong: {status}')
    if status.state != RecorderState.RECORDING and faults.failed_at_s is not None:
        late_s = time.monotonic() - faults.failed_at_s
        outcome.worst('longest_until_degraded_s', round(late_s, 4))
        outcome.expect(late_s <= DEGRADED_WITHIN_S, f'{what}: degraded after {late_s:.2f} s')
    if faults.failed_at_s is not None:
        faults.heal()
    done = degraded and _wait(
        lambda: _done(recorder, wanted) or recorder.status().state == RecorderState.STOPPED
    )
    outcome.expect(done, f'{what}: stuck in {recorder.status()}')


def _is_ill(recorder: Recorder) -> bool:
    return recorder.status().state != RecorderState.RECORDING


def _done(recorder: Recorder, wanted: int) -> bool:
    return recorder.status().written >= wanted and not recorder.is_rotating


def _wait(condition: Callable[[], bool]) -> bool:
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > end_s:
            return False
        time.sleep(0.0005)
    return True


def _balanced(status: RecorderStatus) -> bool:
    columns = status.written + status.queued + status.lost + status.removed
    columns += sum(status.dropped.values())
    return status.received == columns


def _listed(folder: Path) -> set[str]:
    text = (folder / METADATA_NAME).read_text('utf-8')
    return set(yaml.safe_load(text)['rosbag2_bagfile_information']['relative_file_paths'])


def _whole(folder: Path) -> set[str]:
    return {path.name for path in folder.glob('*.mcap')}


def _read(folder: Path, what: str, outcome: Outcome) -> None:
    """Look at what is on disk after the next start: nothing twice, nothing changed, no gaps."""
    before = _whole(folder), _listed(folder)
    outcome.expect(before[0] == before[1], f'{what}: metadata.yaml names {before[1]}')
    recover_leftovers(folder)
    try:
        contents = open_log(folder, columns={'valve_opening': '/valve_opening'})
    except RecordingError as error:
        outcome.expect(False, f'{what}: {error}')
        return
    found = contents.readings.value[contents.log_time_ns >= START_NS + 10**12].tolist()
    same = found == list(range(BATCHES * PER_BATCH))
    outcome.expect(same, f'{what}: {len(found)} values on disk, or in another order')
    outcome.expect(contents.warnings == (), f'{what}: {contents.warnings}')
    outcome.expect(_listed(folder) == _whole(folder), f'{what}: metadata.yaml: {_listed(folder)}')
    names = sorted(os.listdir(folder))
    strange = [n for n in names if not n.endswith('.mcap') and n != 'metadata.yaml']
    outcome.expect(not strange, f'{what}: left over: {strange}')
    for path in folder.glob('*.mcap'):
        try:
            outcome.count('stock_messages', stock_count(path))
        except Exception as error:  # noqa: BLE001 - readers raise what they like
            outcome.expect(False, f'{what}: {path.name}: {type(error).__name__}: {error}')
