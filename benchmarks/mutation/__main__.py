"""How many small mistakes in recorder, recovery and snapshot the quick tests notice.

    python -m benchmarks.mutation [--seed N] [--count N] [--modules NAME ...] [--minutes M]
    python -m benchmarks.mutation --review      count again after a change of the equivalents

Draws mistakes (see `sites`), makes one at a time in a copy of the tree, and runs the quick tests
that concern the module, until one fails. A run that takes much longer than without a mistake has
noticed it, too. Writes every mistake and what became of it to benchmarks/results/mutation.json;
mistakes that change nothing anybody could see stand in `equivalents` with a reason, and do not
count. The exit status is 1 if less than 80 % of the others were noticed.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import random
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.mutation.equivalents import reason_for
from benchmarks.mutation.sites import Mutant, mutants, mutated
from benchmarks.mutation.trial import Ground

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / 'benchmarks' / 'results'
WANTED = 0.8
# The quickest and strictest first: a mistake is mostly noticed within two seconds.
_RECORDER = (
    'test/logs/test_logs_recorder_rules.py',
    'test/logs/test_logs_recorder_corners.py',
    'test/logs/test_logs_recorder.py',
)
_RECOVER = (
    'test/logs/test_logs_recover_rules.py',
    'test/logs/test_logs_recorder_corners.py',
    'test/logs/test_logs_edges.py',
    'test/logs/test_logs_recover.py',
)
_STATE = (
    'test/ros/test_ros_state_rules.py',
    'test/ros/test_ros_state_folder.py',
    'test/ros/test_ros_keeper.py',
)
TESTS: Mapping[str, tuple[str, ...]] = {
    'valveflow_ros/logs/mcap/recorder.py': _RECORDER,
    'valveflow_ros/logs/mcap/recover.py': _RECOVER,
    'valveflow_ros/logs/part_file.py': (*_RECOVER, _RECORDER[-1]),
    'valveflow_ros/logs/mcap/chunk_file.py': (*_RECORDER, _RECOVER[-1]),
    'valveflow_ros/ros/node/state_store.py': _STATE,
    'valveflow_ros/state.py': (*_STATE, 'test/core/test_continuing.py'),
}


def files_for(module: str) -> list[str]:
    return [name for name in TESTS[module] if (ROOT / name).exists()]


def drawn(ground: Ground, given: argparse.Namespace) -> list[Mutant]:
    """Return the mistakes to make, in the order of their modules."""
    found: list[Mutant] = []
    for name in TESTS:
        if not given.modules or Path(name).stem in given.modules:
            found += mutants(name, (ground.place / name).read_text('utf-8'))
    count = min(given.count, len(found))
    chosen = set(random.Random(given.seed).sample(range(len(found)), count))
    print(f'{len(found)} mistakes can be made, {count} of them are tried', flush=True)
    return [mutant for k, mutant in enumerate(found) if k in chosen]


def limits(ground: Ground, names: set[str]) -> dict[str, float]:
    """Return after which time a run must have failed; the tests must pass as the tree is."""
    found: dict[str, float] = {}
    for name in sorted(names):
        same = [other for other in found if TESTS[other] == TESTS[name]]
        if same:
            found[name] = found[same[0]]
            continue
        run = ground.run(files_for(name), 600.0, keep_compiled=True)
        if run.failed:
            print(run.text[-3000:], file=sys.stderr)
            raise SystemExit(f'{name}: without a mistake, too, {run.failed} fails')
        found[name] = 20.0 + 4.0 * run.seconds
        print(f'{name}: {run.seconds:.0f} s without a mistake', flush=True)
    return found


def tried(ground: Ground, mutant: Mutant, limit_s: float) -> dict[str, Any]:
    """Make a mistake and tell what came of it."""
    source = (ground.place / mutant.module).read_text('utf-8')
    text = mutated(source, mutant.index)
    run = ground.with_text(mutant.module, text, files_for(mutant.module), limit_s)
    reason = '' if run.failed else reason_for(mutant)
    verdict = 'killed' if run.failed else 'equivalent' if reason else 'survived'
    line = f'{verdict:10} {mutant.module}:{mutant.line} {mutant.before}  =>  {mutant.after}'
    print(line + (f'  ({run.failed})' if run.failed else ''), flush=True)
    said = {'verdict': verdict, 'by': run.failed, 'reason': reason, 'seconds': run.seconds}
    return {**asdict(mutant), **said, 'seconds': round(run.seconds, 1)}


def run_all(given: argparse.Namespace) -> list[dict[str, Any]]:
    """Try them one after the other, as long as the time allows."""
    with tempfile.TemporaryDirectory(prefix='mutation_') as place:
        ground = Ground(ROOT, Path(place))
        chosen = drawn(ground, given)
        within = limits(ground, {mutant.module for mutant in chosen})
        # In a random order, so that a run that is cut short has seen all modules.
        random.Random(given.seed).shuffle(chosen)
        end_s = time.monotonic() + 60.0 * given.minutes
        found = []
        for mutant in chosen:
            if time.monotonic() > end_s:
                break
            found.append(tried(ground, mutant, within[mutant.module]))
    return found


def counted(found: list[dict[str, Any]]) -> dict[str, Any]:
    """Return how many mistakes became of which kind, and the share that was noticed."""
    verdicts = ('killed', 'survived', 'equivalent')
    count: dict[str, Any] = {v: sum(m['verdict'] == v for m in found) for v in verdicts}
    modules = {}
    for name in TESTS:
        mine = [m['verdict'] for m in found if m['module'] == name]
        if mine:
            modules[name] = {verdict: mine.count(verdict) for verdict in verdicts}
    score = count['killed'] / max(1, count['killed'] + count['survived'])
    return {'tried': len(found), **count, 'score': round(score, 4), 'modules': modules}


def review(path: Path) -> dict[str, Any]:
    """Look at the mistakes of an earlier run that went unnoticed, with the table of today."""
    content: dict[str, Any] = json.loads(path.read_text('utf-8'))
    names = Mutant.__dataclass_fields__
    for one in content['mutants']:
        if one['verdict'] != 'killed':
            one['reason'] = reason_for(Mutant(**{name: one[name] for name in names}))
            one['verdict'] = 'equivalent' if one['reason'] else 'survived'
    return {**content, **counted(content['mutants'])}


def run(given: argparse.Namespace) -> dict[str, Any]:
    """Try, and return what is to be written."""
    begun_s = time.monotonic()
    found = run_all(given)
    words = ['--seed', str(given.seed), '--count', str(given.count)]
    words += ['--minutes', f'{given.minutes:g}'] if given.minutes else []
    words += ['--modules', *given.modules] if given.modules else []
    return {
        'command': ' '.join(['python -m benchmarks.mutation', *words]),
        **counted(found), 'wanted': WANTED, 'seconds': round(time.monotonic() - begun_s),
        'machine': {'cpus': os.cpu_count(), 'platform': platform.platform(),
                    'python': platform.python_version(), 'load': os.getloadavg()},
        'mutants': found,
    }  # fmt: skip


def main() -> int:
    """Run it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--count', type=int, default=150, help='how many mistakes (default 150)')
    parser.add_argument('--minutes', type=float, default=120.0, help='begin no more after these')
    parser.add_argument('--output', type=Path, default=RESULTS / 'mutation.json')
    names = [Path(name).stem for name in TESTS]
    parser.add_argument(
        '--modules', nargs='+', choices=names, metavar='NAME', help=', '.join(names)
    )
    parser.add_argument('--review', action='store_true', help='run nothing, judge again')
    given = parser.parse_args()
    content = review(given.output) if given.review else run(given)
    given.output.write_text(json.dumps(content, indent=1) + '\n', 'utf-8')
    print(
        '{killed} noticed, {survived} not, {equivalent} equivalent: {score:.1%}'.format(**content)
    )
    return 0 if content['score'] >= WANTED else 1


if __name__ == '__main__':
    sys.exit(main())
