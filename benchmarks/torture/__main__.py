# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Hurt recordings, files and processes on purpose, and count what comes of it.

    python -m benchmarks.torture [--only NAME ...] [--scale 0.1] [--seed N]

Each trial runs in a process of its own, for a bounded time, and writes
``benchmarks/results/torture_NAME.json``. The exit status is 1 if one failed.
"""

from __future__ import annotations

import argparse
import importlib
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.torture.trial import RESULTS, Options, Outcome

SEED = 20_240_601
# Where each trial stands, and after how many seconds it is given up.
TRIALS = {
    'truncation': ('damage_trials', 1800),
    'flips': ('damage_trials', 1800),
    'first_chunk': ('damage_trials', 600),
    'hostile': ('hostile', 600),
    'kill9': ('kills', 2400),
    'recover_big': ('kills', 1800),
    'rotation': ('kills', 600),
    'fail_every_write': ('disks', 2400),
    'disk_full': ('disks', 600),
    'power_loss': ('disks', 1200),
    'fuzz': ('fuzz', 7200),
    'signals': ('monitors', 3600),
    'restart': ('restart', 5400),
    'rehearing': ('monitors', 3600),
    'adversary': ('adversary', 7200),
    'soak': ('soak', 7200),
}


def run_here(name: str, given: argparse.Namespace) -> int:
    """Run one trial in this process, write what it brought, and print it."""
    begun_s = time.monotonic()
    trial = getattr(importlib.import_module(f'benchmarks.torture.{TRIALS[name][0]}'), name)
    with tempfile.TemporaryDirectory(prefix=f'torture_{name}_') as folder:
        options = Options(given.scale, given.seed, Path(folder), given.minutes)
        outcome: Outcome = trial(options)
    seconds = time.monotonic() - begun_s
    outcome.write(name, options, seconds, given.results)
    verdict = 'FAILED' if outcome.failed else 'passed'
    print(f'{name:17} {verdict}  {outcome.sentence}  ({seconds:.0f} s)')
    for line in [*outcome.failures, *(f'missed: {missed}' for missed in outcome.missed)]:
        print(f'    {line}')
    return 1 if outcome.failed else 0


def run_apart(name: str, given: argparse.Namespace) -> int:
    """Run one trial in a process of its own; whatever ends that process is a failure."""
    command = [sys.executable, '-m', 'benchmarks.torture', '--inside', '--only', name]
    for option in ('scale', 'seed', 'minutes', 'results'):
        command += [f'--{option}', str(getattr(given, option))]
    limit_s = TRIALS[name][1] + 60 * given.minutes
    try:
        status = subprocess.run(command, timeout=limit_s, check=False).returncode
    except subprocess.TimeoutExpired:
        print(f'{name:17} FAILED  took more than {limit_s:g} s and was ended')
        return 1
    if status not in (0, 1):
        print(f'{name:17} FAILED  its process ended with status {status}')
    return 1 if status else 0


def main() -> int:
    parser = argparse.ArgumentParser(
        prog='python -m benchmarks.torture',
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('--only', nargs='+', choices=list(TRIALS), default=list(TRIALS))
    parser.add_argument('--scale', type=float, default=1.0, help='1 is everything')
    parser.add_argument('--seed', type=int, default=SEED)
    parser.add_argument('--minutes', type=float, default=1.0, help='how long fuzz goes on')
    parser.add_argument('--results', type=Path, default=RESULTS, help='folder for the results')
    parser.add_argument('--inside', action='store_true', help=argparse.SUPPRESS)
    given = parser.parse_args()
    if not 0 < given.scale <= 1:
        parser.error('--scale is more than 0 and at most 1')
    if given.inside:
        return run_here(given.only[0], given)
    return max(run_apart(name, given) for name in given.only)


if __name__ == '__main__':
    sys.exit(main())
