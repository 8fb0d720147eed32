# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Run the quick tests of recorder, recovery and state again and again, to find one that wavers.

    python -m benchmarks.repeats [--count 200] [--minutes M] [--seed N] [--lanes L]

Each time in a new process and in another order of the files, with the machine as it is; with
lanes, that many beside each other, which also shows who cannot bear a neighbour. Writes to
benchmarks/results/repeats.json how often, which test failed and how, and in which order the files
stood then. The exit status is 1 if any did, or if there was no time for one run.
"""

from __future__ import annotations

import os
import random
import re
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks import study

ROOT = Path(__file__).resolve().parents[1]
FILES = sorted(
    str(path.relative_to(ROOT))
    for pattern in ('logs/test_*reco*.py', 'ros/test_*state*.py', 'test_state.py')
    for path in (ROOT / 'test').glob(pattern)
)
_SUMMARY = re.compile(r'^(?:FAILED|ERROR) (\S+)(?: - (.*))?$', re.MULTILINE)
_COUNT = re.compile(r'(\d+) passed')
_LONGEST_S = 1800.0


def once(order: list[str]) -> tuple[int, float, list[dict[str, Any]]]:
    """Run the files in this order; return how many tests passed, the seconds and the failures."""
    begun_s = time.monotonic()
    command = [sys.executable, '-m', 'pytest', '-q', '--tb=short', '-p', 'no:cacheprovider']
    try:
        done = subprocess.run(
            [*command, *order], cwd=ROOT, capture_output=True, text=True, timeout=_LONGEST_S,
            check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return 0, _LONGEST_S, [{'test': '', 'why': 'no end', 'order': order}]
    seconds = time.monotonic() - begun_s
    failed = [{'test': t, 'why': why, 'order': order} for t, why in _SUMMARY.findall(done.stdout)]
    if done.returncode and not failed:
        failed = [{'test': '', 'why': done.stdout[-500:] + done.stderr[-500:], 'order': order}]
    passed = _COUNT.search(done.stdout)
    return int(passed[1]) if passed else 0, seconds, failed


def main() -> int:
    """Run it."""
    # No run begins after so many minutes; lanes are runs beside each other.
    given = study.options(__doc__, count=200, minutes=600.0, seed=1, lanes=1).parse_args()
    chance, end_s = random.Random(given.seed), time.monotonic() + 60.0 * given.minutes
    orders = [chance.sample(FILES, len(FILES)) for _ in range(given.count)]
    passed: list[int] = []
    seconds: list[float] = []
    failures: list[dict[str, Any]] = []
    loads: list[float] = []

    def run(order: list[str]) -> tuple[float, tuple[int, float, list[dict[str, Any]]]] | None:
        return (os.getloadavg()[0], once(order)) if time.monotonic() < end_s else None

    with ThreadPoolExecutor(given.lanes) as pool:
        for done in pool.map(run, orders):
            if done is None:
                break
            load, found = done
            loads.append(load)
            passed.append(found[0])
            seconds.append(found[1])
            failures += [{'run': len(seconds), **failure} for failure in found[2]]
            print(f'{len(seconds)}: {found[0]} passed in {found[1]:.0f} s', *found[2], flush=True)
    study.keep(
        'repeats', wanted=given.count, done=len(seconds), files=FILES,
        tests_each=max(passed, default=0), passed=sum(passed), failed=len(failures),
        failures=failures, seconds_each=round(median(seconds), 1) if seconds else 0.0,
        machine=study.machine(),
        load=[round(x, 1) for x in (min(loads, default=0), max(loads, default=0))],
    )  # fmt: skip
    print(
        f'{len(seconds)} of {given.count} runs, {sum(passed)} tests passed, {len(failures)} failed'
    )
    # A run that counts fewer tests than another has not run all of them.
    whole = len(seconds) >= given.count and len(set(passed)) == 1
    return 0 if whole and not failures else 1


if __name__ == '__main__':
    sys.exit(main())
