# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Files and names that are meant to hurt: a sentence or intact messages, at a bounded price."""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.torture.bombs import GOOD, chunk, file_of, hostile_files
from benchmarks.torture.bounded import run_bounded
from benchmarks.torture.memory import MIB
from benchmarks.torture.trial import Options, Outcome
from valveflow_ros.cli.main import main as valveflow
from valveflow_ros.errors import ValveflowError
from valveflow_ros.logs import open_log
from valveflow_ros.logs.mcap.recover import recover

# A file of up to a mebibyte may cost so much CPU time, a larger one more in proportion.
MOST_S = 2.0
MORE_S_PER_MIB = 0.3
MOST_BYTES = 200 * MIB
PATIENCE_S = 30.0
UNFORESEEN = 'This should not have happened'


def hostile(options: Options) -> Outcome:
    """Read, walk, recover and describe each file in a child that may take 200 MiB."""
    outcome = Outcome()
    _warm_up(options.folder)
    for name, raw, messages in hostile_files():
        path = options.folder / 'hostile.mcap'
        path.write_bytes(raw)
        _try(name, path, messages, outcome)
    for name, path in _places(options.folder):
        _try(name, path, 0, outcome)
    intact = options.folder / 'to_whole.mcap'
    (options.folder / 'whole.mcap').write_bytes(file_of(chunk(GOOD)))
    intact.symlink_to(options.folder / 'whole.mcap')
    _try('a link to a whole file', intact, 100, outcome)
    outcome.measured['largest_mib'] = round(outcome.measured['largest_mib'], 1)
    outcome.sentence = (
        f'{outcome.counts["files"]} files and names: longest '
        f'{outcome.measured["longest_cpu_s"]:.2f} s of CPU ({outcome.measured["longest"]}), '
        f'largest {outcome.measured["largest_mib"]:.0f} MiB'
    )
    return outcome


def _warm_up(folder: Path) -> None:
    """Load what is loaded lazily, so that each child is measured for its own work."""
    path = folder / 'good.mcap'
    path.write_bytes(file_of(chunk(GOOD, 'zstd'), chunk(GOOD, 'lz4')))
    for work in _works(path).values():
        work()


def _works(path: Path) -> dict[str, Callable[[], Any]]:
    copy = path.with_name('copy.mcap')

    def read() -> int:
        log = open_log(path)
        return sum(1 for _ in log.iter_messages())

    def mend() -> int:
        copy.unlink(missing_ok=True)
        return recover(path, copy).messages

    def describe() -> int:
        out = io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
            status = valveflow(['info', os.fspath(path)])
        if UNFORESEEN in out.getvalue() or status not in (0, 1):
            raise RuntimeError(f'status {status}: {out.getvalue()[-300:]}')
        return -1

    return {'read': read, 'recover': mend, 'info': describe}


def _try(name: str, path: Path, messages: int, outcome: Outcome) -> None:
    outcome.count('files')
    size = _size(path)
    most_s = MOST_S + MORE_S_PER_MIB * max(0.0, size / MIB - 1.0)
    for what, work in _works(path).items():
        ended = run_bounded(lambda work=work: _timed(work), PATIENCE_S, MOST_BYTES)
        kind, value, cpu_s = ended.value or ('none', 0, ended.seconds)
        outcome.count(f'{what}: {kind}')
        label = f'{name}, {what}'
        outcome.expect(not ended.error, f'{label}: {ended.error}')
        outcome.expect(cpu_s <= most_s, f'{label}: {cpu_s:.1f} s of CPU, {size} bytes')
        outcome.expect(ended.bytes <= MOST_BYTES, f'{label}: {ended.bytes / MIB:.0f} MiB')
        if kind == 'messages' and value >= 0 and messages >= 0:
            outcome.expect(value == messages, f'{label}: {value} messages, not {messages}')
        if kind == 'sentence':
            outcome.expect(messages <= 0, f'{label}: {messages} messages not read: {value}')
        if cpu_s >= outcome.measured.get('longest_cpu_s', 0.0):
            outcome.measured |= {'longest_cpu_s': round(cpu_s, 3), 'longest': label}
        if ended.bytes / MIB >= outcome.measured.get('largest_mib', 0.0):
            outcome.measured |= {'largest_mib': ended.bytes / MIB, 'largest': label}


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except (OSError, ValueError):
        return 0


def _timed(work: Callable[[], int]) -> tuple[str, Any, float]:
    """Return what came of it, and the CPU time: other programs may hold the machine."""
    before = os.times()
    try:
        kind, value = 'messages', work()
    except ValveflowError as error:
        kind, value = 'sentence', str(error)
        if '\n' in value or not value.endswith(('.', ')')):
            raise
    after = os.times()
    return kind, value, after.user + after.system - before.user - before.system


def _places(folder: Path) -> list[tuple[str, Path]]:
    """Return names that are no ordinary files."""
    home = folder / 'places'
    home.mkdir()
    (home / 'empty_folder').mkdir()
    os.mkfifo(home / 'pipe.mcap')
    (home / 'loop.mcap').symlink_to(home / 'loop.mcap')
    (home / 'zero.mcap').symlink_to('/dev/zero')
    (home / 'nowhere.mcap').symlink_to(home / 'missing')
    (home / 'folder.mcap').mkdir()
    os.mkfifo(home / 'folder.mcap' / 'inner.mcap')
    names = [
        'empty_folder', 'pipe.mcap', 'loop.mcap', 'zero.mcap', 'nowhere.mcap', 'folder.mcap',
        'missing.mcap', 'a' * 300 + '.mcap', 'line\nbreak.mcap', 'nul\0byte.mcap', '',
    ]  # fmt: skip
    strange = [(repr(name[:20]), home / name) for name in names]
    return [*strange, ('/dev/zero', Path('/dev/zero')), ('/proc/self/mem', Path('/proc/self/mem'))]
