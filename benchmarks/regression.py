# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Compare the speed of this tree with that of an earlier one, by ratios and not by seconds.

    python -m benchmarks.regression [--base COMMIT] [--rounds N] [--only NAME ...] [--output FILE]

The base is unpacked into a temporary folder. Then both trees do the same work by turns (base,
here, here, base, ...), each time in a new process: rows through the engine, a refit, the recorder,
the reader, the aligner. What is compared is the processor's time within each pair, so a busy
machine disturbs both alike. The exit status is 1 if the median of the ratios is above 1.25 for
one of them. Without ``--base`` it is the last tag, or, where there is none, the commit in
benchmarks/results/regression_base. A work that the base cannot do is named and not judged.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from io import BytesIO
from pathlib import Path
from statistics import median

from benchmarks import study
from benchmarks.regression_work import NAMES

ROOT = Path(__file__).resolve().parents[1]
WORK = Path(__file__).with_name('regression_work.py')
_LONGEST_S = 600.0
# Slower than so many times the base is a failure.
LIMIT = 1.25
LEAST_PAIRS = 7


@dataclass(frozen=True)
class Verdict:
    """What was found of one piece of work.

    Attributes
    ----------
    name : str
    base_s, here_s : float
        Medians of the processor's time.
    ratio : float
        Median of the pairs' ratios, new by old; a pair ran one straight after the other, so that
        both met about the same neighbours on the machine.
    low, high : float
        Quarters of the pairs lie below and above.
    slower : bool
        The ratio is above the limit.
    """

    name: str
    base_s: float
    here_s: float
    ratio: float
    low: float
    high: float
    slower: bool


def judge(pairs: Mapping[str, Sequence[tuple[float, float]]]) -> list[Verdict]:
    """Judge every piece of work by its pairs of times, of the base and of this tree.

    Raises
    ------
    ValueError
        If one has fewer pairs than `LEAST_PAIRS`, or a time that is none.
    """
    found = []
    for name, times in pairs.items():
        if len(times) < LEAST_PAIRS:
            raise ValueError(f'{name}: {len(times)} pairs, {LEAST_PAIRS} are wanted at least')
        if not all(0.0 < seconds < float('inf') for pair in times for seconds in pair):
            raise ValueError(f'{name}: a time that is none')
        ratios = sorted(here / base for base, here in times)
        ratio, quarter = median(ratios), len(ratios) // 4
        base_s, here_s = (median(column) for column in zip(*times, strict=True))
        ends = ratios[quarter], ratios[-1 - quarter]
        found.append(Verdict(name, base_s, here_s, ratio, *ends, ratio > LIMIT))
    return found


def table(verdicts: Sequence[Verdict]) -> str:
    """Return the verdicts as lines to read."""
    lines = [f'{"work":10} {"base":>8} {"here":>8} {"here/base":>10}   half of the pairs']
    for v in verdicts:
        lines.append(
            f'{v.name:10} {v.base_s:7.3f}s {v.here_s:7.3f}s {v.ratio:10.3f}   '
            f'{v.low:.3f} to {v.high:.3f}{"   SLOWER" if v.slower else ""}'
        )
    return '\n'.join(lines)


def git(*words: str) -> bytes:
    """Return what git says; empty if it does not know."""
    done = subprocess.run(['git', '-C', str(ROOT), *words], capture_output=True, check=False)
    return done.stdout if done.returncode == 0 else b''


def usual_base() -> str:
    """Return the commit to compare with where none is named."""
    tag = git('describe', '--tags', '--abbrev=0').decode().strip()
    return tag or (study.RESULTS / 'regression_base').read_text('utf-8').strip()


def unpacked(commit: str, place: Path) -> Path:
    """Unpack a commit's library; nothing is left in the checkout."""
    packed = git('archive', '--format=tar', commit, 'valveflow_ros')
    if not packed:
        raise SystemExit(f'regression: there is no commit {commit} here; --base names another')
    with tarfile.open(fileobj=BytesIO(packed)) as archive:
        archive.extractall(place)
    return place


def ran(tree: Path, *words: str) -> str | None:
    """Run the work with a tree's library; None if it failed, and why is shown."""
    environment = {
        **os.environ, 'PYTHONPATH': str(tree), 'NUMBA_NUM_THREADS': '1', 'OMP_NUM_THREADS': '1',
        'OPENBLAS_NUM_THREADS': '1',
    }  # fmt: skip
    done = subprocess.run(
        [sys.executable, str(WORK), *words], cwd=tree, env=environment, capture_output=True,
        text=True, timeout=_LONGEST_S, check=False,
    )  # fmt: skip
    if done.returncode:
        print(done.stderr[-1500:], file=sys.stderr)
        return None
    return done.stdout


def comparable(trees: dict[str, Path], inputs: Path, names: list[str]) -> list[str]:
    """Return what both can do; a first run of each compiles its kernels."""
    if ran(trees['here'], str(inputs), *names) is None:
        raise SystemExit('regression: this tree cannot do its work')
    if ran(trees['base'], str(inputs), *names) is not None:
        return names
    found = [name for name in names if ran(trees['base'], str(inputs), name) is not None]
    if not found:
        raise SystemExit('regression: the base can do nothing of it; --base names another')
    print(f'not judged, the base cannot: {", ".join(n for n in names if n not in found)}')
    return found


def measured(
    trees: dict[str, Path], inputs: Path, names: list[str], rounds: int
) -> dict[str, list[tuple[float, float]]]:
    """Return the pairs of times, of base and here."""
    pairs: dict[str, list[tuple[float, float]]] = {name: [] for name in names}
    for k in range(rounds):
        times: dict[str, dict[str, float]] = {}
        for which in ('base', 'here') if k % 2 == 0 else ('here', 'base'):
            said = ran(trees[which], str(inputs), *names)
            if said is None:
                raise SystemExit(f'regression: {which} failed in round {k + 1}')
            times[which] = json.loads(said)
        for name in names:
            pairs[name].append((times['base'][name], times['here'][name]))
    return pairs


def run(given: argparse.Namespace) -> int:
    """Compare, print, write; return the exit status."""
    commit = given.base or usual_base()
    with tempfile.TemporaryDirectory(prefix='regression_') as name:
        place = Path(name)
        inputs = place / 'inputs'
        inputs.mkdir()
        trees = {'base': unpacked(commit, place / 'base'), 'here': given.tree.resolve()}
        if ran(ROOT, 'make', str(inputs)) is None:
            raise SystemExit('regression: the inputs cannot be made')
        names = comparable(trees, inputs, given.only)
        pairs = measured(trees, inputs, names, given.rounds)
    verdicts = judge(pairs)
    print(f"against {commit}, {given.rounds} pairs, processor's time")
    print(table(verdicts))
    slower = [v.name for v in verdicts if v.slower]
    if given.output is not None:
        content = {
            'command': study.command(), 'base': commit, 'limit': LIMIT, 'slower': slower,
            'verdicts': [asdict(v) for v in verdicts], 'pairs_s': pairs,
            'machine': study.machine(),
        }  # fmt: skip
        given.output.write_text(json.dumps(content, indent=1) + '\n', 'utf-8')
    for name in slower:
        print(f'regression: {name} is more than {LIMIT:g} times as slow as in {commit}',
              file=sys.stderr)  # fmt: skip
    return 1 if slower else 0


def main() -> int:
    parser = study.options(__doc__, rounds=LEAST_PAIRS)
    parser.add_argument('--base', metavar='COMMIT')
    parser.add_argument('--only', nargs='+', choices=NAMES, default=list(NAMES), metavar='NAME')
    parser.add_argument('--tree', type=Path, default=ROOT, help='another tree than this one')
    parser.add_argument('--output', type=Path, metavar='FILE', help='write the figures as JSON')
    given = parser.parse_args()
    if given.rounds < LEAST_PAIRS:
        parser.error(f'--rounds must be {LEAST_PAIRS} at least')
    return run(given)


if __name__ == '__main__':
    sys.exit(main())
