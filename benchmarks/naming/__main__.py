# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A benchmark for naming the cause where a plant's simulation and its measured data differ.

    python -m benchmarks.naming make DIR [--practice]
    python -m benchmarks.naming answer DIR --with valveflow|regression|changepoint
    python -m benchmarks.naming score DIR ANSWERS.json
    python -m benchmarks.naming study DIR

``make`` writes the records and, apart, their truth; ``answer`` writes answers_METHOD.json;
``score`` compares answers with the truth; ``study`` does all of it with the sealed set and keeps
the result. Every limit of the baselines was set on the practice set.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks import study
from benchmarks.naming import records, scoring
from benchmarks.naming.answers import METHODS, answer
from valveflow_ros.errors import ValveflowError


def make(folder: Path, first: int) -> None:
    """Write a set; say whether it is the published one."""
    for name in records.write(folder, records.entries(first)):
        print(name, flush=True)
    if records.same_as_published(folder, first):
        print('The records and their truth are those of the published set.')
    else:
        print(
            'The records or their truth differ from the published set, so scores cannot be '
            'compared. Probably this is another version of the program or of NumPy.'
        )


def answers(folder: Path, method: str) -> dict[str, Any]:
    """Answer every record with a method and write the answers."""
    found = {}
    for name, about in scoring.read(folder / 'records.json').items():
        begin = time.process_time()
        found[name] = answer(folder / about['file'], method)
        print(f'{name} {time.process_time() - begin:5.1f} s  {found[name]["names"]}', flush=True)
    (folder / f'answers_{method}.json').write_text(json.dumps(found, indent=1) + '\n')
    return found


def keep(folder: Path, truth: dict[str, Any]) -> None:
    """Answer the sealed set with every method and keep the scores."""
    said = {method: answers(folder, method) for method in METHODS}
    study.keep(
        'naming', command=study.command('study', 'DIR'), first_seed=records.SEALED,
        days=records.DAYS, truth_sha256=records.sha256(folder),
        published=records.same_as_published(folder, records.SEALED),
        summary={method: scoring.score(truth, said[method]) for method in METHODS},
        rows=[{'record': r, **t, 'answers': {m: said[m][r] for m in METHODS}}
              for r, t in truth.items()],
    )  # fmt: skip


def run(given: argparse.Namespace) -> None:
    folder: Path = given.folder
    if given.verb in ('make', 'study'):
        practice = given.verb == 'make' and given.practice
        make(folder, records.PRACTICE if practice else records.SEALED)
    if given.verb == 'answer':
        answers(folder, given.method)
    elif given.verb == 'score':
        scored = scoring.score(scoring.read(folder / 'truth.json'), scoring.read(given.answers))
        print(scoring.words(scored))
    elif given.verb == 'study':
        keep(folder, scoring.read(folder / 'truth.json'))


def main() -> int:
    """Run a verb; return the exit status."""
    parser = study.options(__doc__)
    verbs = parser.add_subparsers(dest='verb', required=True)
    for verb in ('make', 'answer', 'score', 'study'):
        verbs.add_parser(verb).add_argument('folder', type=Path)
    verbs.choices['make'].add_argument('--practice', action='store_true')
    verbs.choices['answer'].add_argument('--with', dest='method', choices=METHODS, required=True)
    verbs.choices['score'].add_argument('answers', type=Path)
    try:
        run(parser.parse_args())
    except ValveflowError as error:
        print(f'naming: {error}', file=sys.stderr)
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())
