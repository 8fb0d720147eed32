"""How often the number of pieces comes out right, and whether its confidence can be believed.

Run: ``python -m benchmarks.selection_study --sets 100 --first 5000``. Every kind of
`selection_kinds` is drawn ``sets`` times, N = 2000, noise of 3 MW. Each set is judged by the
evidence and by the paper's rule (24) with and without its guard, one in five also by the
evidence without knowing the order of time. Random curves with knees of any strength then
show whether sets that are called 90 % sure are right in 90 % of cases. Seeds below 1000 were
used to set the rule's constants; none of them may be used here.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import sys
import time
from pathlib import Path

import numpy as np

from benchmarks.selection_kinds import KINDS, Sampled, random_truth
from valveflow_ros.partition.partition import partition
from valveflow_ros.partition.selection import paper_rule, select
from valveflow_ros.partition.series import Series

RESULTS = Path(__file__).parent / 'results'
N, MOST, SHARE = 2000, 10, 0.01
FIRST_UNTOUCHED = 1000
_EVERY = 5  # sets of which one is also judged without its order, to save time
EDGES = (0.0, 0.5, 0.7, 0.85, 0.95, 1.0)


def judge(data: Sampled, also_unordered: bool = False) -> dict[str, object]:
    """Return what each rule answers for one set."""
    least = max(2, math.ceil(SHARE * len(np.unique(data.u))))
    found = partition(data.u, data.y, MOST, least, threads=1)
    fresh = np.zeros(len(data.u), dtype=bool)
    fresh[0] = True
    begin = time.process_time()
    timed = select(found, series=Series(data.u, data.y, fresh))
    seconds = time.process_time() - begin
    return {
        'truth': data.pieces,
        'evidence': timed.pieces,
        'confidence': {str(j): round(p, 6) for j, p in timed.confidence.items()},
        'evidence, order unknown': select(found).pieces if also_unordered else None,
        'paper (24), guarded': select(found, rule='paper').pieces,
        'paper (24)': paper_rule(found.cost)[1],
        'cpu_s': round(seconds, 3),
    }


RULES = ('evidence', 'evidence, order unknown', 'paper (24), guarded', 'paper (24)')


def of_kind(kind: str, seeds: range) -> list[dict[str, object]]:
    number = list(KINDS).index(kind)
    return [
        judge(KINDS[kind](N, np.random.default_rng([s, number])), s % _EVERY == 0) for s in seeds
    ]


def table_row(kind: str, rows: list[dict[str, object]]) -> dict[str, object]:
    """Sum up one kind: share right per rule, and the spread of answers."""
    truth = rows[0]['truth']
    out: dict[str, object] = {'kind': kind, 'truth': truth, 'sets': len(rows)}
    for rule in RULES:
        answers = np.array([row[rule] for row in rows if row[rule] is not None])
        counts = {
            int(j): int(c) for j, c in zip(*np.unique(answers, return_counts=True), strict=True)
        }
        out[rule] = {
            'right_percent': round(100.0 * float(np.mean(answers == truth)), 1)
            if truth and len(answers)
            else None,
            'sets': len(answers),
            'answers': counts,
        }
    sure = [row['confidence'][str(row['evidence'])] for row in rows]  # type: ignore[index]
    out['mean_confidence'] = round(float(np.mean(sure)), 3)
    out['cpu_s'] = round(float(np.median([row['cpu_s'] for row in rows])), 3)  # type: ignore[arg-type]
    return out


def calibration(rows: list[dict[str, object]]) -> list[dict[str, object]]:
    """Return for each range of confidence how often the answer was right."""
    sure = np.array([row['confidence'][str(row['evidence'])] for row in rows])  # type: ignore[index]
    right = np.array([row['evidence'] == row['truth'] for row in rows])
    out = []
    for low, high in itertools.pairwise(EDGES):
        inside = (sure >= low) & ((sure < high) | (high == EDGES[-1]))
        if inside.any():
            out.append({
                'from': low, 'to': high, 'sets': int(inside.sum()),
                'said': round(float(sure[inside].mean()), 3),
                'right': round(float(right[inside].mean()), 3),
            })  # fmt: skip
    return out


def show(row: dict[str, object]) -> None:
    shares = []
    for rule in RULES:
        found = row[rule]
        assert isinstance(found, dict)
        shares.append(
            f'{found["right_percent"]:5.1f}' if found['right_percent'] is not None
            else ' '.join(f'{j}:{c}' for j, c in found['answers'].items())
        )  # fmt: skip
    print(
        f'{row["kind"]:24}' + ' | '.join(shares) + f' | sure {row["mean_confidence"]}', flush=True
    )


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else '')
    parser.add_argument('--sets', type=int, default=100)
    parser.add_argument('--random', type=int, default=300, help='random curves, for confidence')
    parser.add_argument('--first', type=int, default=5000, help='first seed, 1000 or more')
    parser.add_argument('--kinds', nargs='+', choices=list(KINDS), default=list(KINDS))
    parser.add_argument('--out', default='selection_study.json', help='name of the result')
    options = parser.parse_args(arguments)
    if options.first < FIRST_UNTOUCHED:
        parser.error(f'seeds below {FIRST_UNTOUCHED} were used to set the constants')
    begin = time.process_time()
    seeds = range(options.first, options.first + options.sets)
    print('% right: ' + ' | '.join(RULES))
    result: dict[str, object] = {
        'command': f'python -m benchmarks.selection_study --sets {options.sets} '
        f'--random {options.random} --first {options.first}',
        'kinds': options.kinds,
        'samples': N, 'noise_mw': 3.0,
    }  # fmt: skip
    table: list[dict[str, object]] = []
    for kind in options.kinds:
        table.append(table_row(kind, of_kind(kind, seeds)))
        show(table[-1])
        seconds = round(time.process_time() - begin, 1)
        _keep(options.out, {**result, 'table': table, 'cpu_s': seconds})
    rows = [
        judge(random_truth(N, np.random.default_rng([s, 1000])))
        for s in range(options.first, options.first + options.random)
    ]
    result['table'] = table
    result['calibration'] = believed = calibration(rows)
    for line in believed:
        print(f'said {line["said"]:.2f}, right {line["right"]:.2f} ({line["sets"]} sets)')
    right = [row['evidence'] == row['truth'] for row in rows]
    result['random_right_percent'] = round(100.0 * float(np.mean(right)), 1) if rows else None
    _keep(options.out, {**result, 'cpu_s': round(time.process_time() - begin, 1)})
    return 0


def _keep(name: str, result: dict[str, object]) -> None:
    """Write what is there so far."""
    RESULTS.mkdir(exist_ok=True)
    text = json.dumps(result, indent=1)
    (RESULTS / name).write_text(text + '\n', encoding='utf-8')


if __name__ == '__main__':
    sys.exit(main())
