# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The node under load: what is lost, what it costs, how late it is.

    python -m benchmarks.node_load [CASE]... [--full] [--qos best_effort|reliable|both]
                                   [--hours H] [--strict] [--output DIR]

CASE is one of rates, headroom, stall, refit, flood; without one all are run. There is also `soak`,
hours at 4 x 100 Hz in real time, which is run only when it is named. The monitor runs as a
process as ever, recording; the senders are processes of their own and number what they send. So
what stands in the recording is known message by message, and every message that was sent must be
recorded, dropped by the recorder and counted, or lost on the way and counted. Where that does not
add up, or something is lost that must not be, a line says so and the exit status is 1.

Latency is the time from the publisher's stamp to the moment at which the engine has taken the
value, of every value. Latency, processor and memory are shown with their limits; a machine that
does other things passes them now and then, and they fail a run only with --strict.

That nothing is lost while the monitor is stopped for 0.8 s, or while one topic is flooded, takes a
socket that can wait: `sysctl net.core.rmem_max` must be 4194304 at least. Where it is less, a loss
then counts as a passed limit.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import rclpy

from benchmarks import study
from benchmarks.load.cases import BOTH, CASES, SOAK, cases
from benchmarks.load.trial import result_of
from benchmarks.processes import own_domain


def run(name: str, given: argparse.Namespace) -> list[str]:
    """Run the cases of a name and write what was found; return the sentences of what failed."""
    before = os.getloadavg()
    found: list[dict[str, Any]] = []
    wanted = given.qos or ('both' if given.full or name in BOTH else 'best_effort')
    for reliable in {'both': (False, True), 'reliable': (True,)}.get(wanted, (False,)):
        for case in cases(name, given.full, reliable, given.hours):
            with tempfile.TemporaryDirectory(prefix='node_load') as folder:
                found.append(result_of(case, Path(folder)))
            print('\n'.join(lines(found[-1])), flush=True)
    words = [name, *(['--full'] if given.full else [])]
    words += ['--qos', given.qos] if given.qos else []
    words += ['--hours', f'{given.hours:g}'] if name == SOAK else []
    study.keep(
        f'node_load_{name}', given.output, show=False, command=study.command(*words),
        passed=not any(r['faults'] for r in found),
        within_limits=not any(r['over_limits'] for r in found),
        machine={
            **study.machine(), 'load_before': before,
            'middleware': os.environ.get('RMW_IMPLEMENTATION', 'the default one'),
        },
        runs=found,
    )  # fmt: skip
    return [
        f'{r["case"]}: {sentence}' for r in found
        for sentence in r['faults'] + (r['over_limits'] if given.strict else [])
    ]  # fmt: skip


def lines(result: dict[str, Any]) -> list[str]:
    """Return what a person wants to know of a run."""
    qos = 'reliable' if result['reliable'] else 'best effort'
    measured, limits = result['measured'], result['limits']
    said = [f'{result["what"]} ({qos}, {result["seconds"]:g} s, sent in {measured["send_s"]:.1f})']
    for topic, a in result['accounts'].items():
        said.append(
            f'  {topic}: sent {a["sent"]} = recorded {a["recorded"]} + dropped {a["dropped"]} '
            f'+ lost {a["lost"] + a["missed_at_start"]}'
        )
    figures = [
        f'{name} {value:.1f}' + (f' (limit {limits[name]:g})' if name in limits else '')
        for name, value in measured.items()
        if name not in ('send_s', 'load_average')
    ]
    figures += [f'{name} {value}' for name, value in result['notes'].items()]
    said += [f'  {", ".join(figures[k : k + 4])}' for k in range(0, len(figures), 4)]
    said += [f'  NOT EXACT: {sentence}' for sentence in result['faults']]
    return said + [f'  over its limit: {sentence}' for sentence in result['over_limits']]


def main() -> int:
    parser = study.options(__doc__, hours=8.0)
    parser.add_argument('cases', nargs='*', metavar='CASE', help=', '.join((*CASES, SOAK)))
    parser.add_argument('--full', action='store_true', help='as long as the figures ask for')
    parser.add_argument('--qos', choices=('best_effort', 'reliable', 'both'))
    parser.add_argument('--strict', action='store_true', help='a passed limit fails, too')
    parser.add_argument('--output', type=Path, default=study.RESULTS)
    given = parser.parse_args()
    unknown = [name for name in given.cases if name not in (*CASES, SOAK)]
    if unknown:
        parser.error(f'there is no case {unknown[0]}; there are {", ".join((*CASES, SOAK))}')
    own_domain()
    rclpy.init(args=[])
    failed = [sentence for name in given.cases or CASES for sentence in run(name, given)]
    rclpy.try_shutdown()
    for sentence in failed:
        print(f'node_load: {sentence}', file=sys.stderr)
    return 1 if failed else 0


if __name__ == '__main__':
    sys.exit(main())
