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
from importlib.metadata import version
from pathlib import Path
from typing import Any

import rclpy

from benchmarks import study
from benchmarks.load.cases import BOTH, CASES, SOAK, cases
from benchmarks.load.trial import result_of

_DOMAINS = 101


def run_all(options: argparse.Namespace) -> list[str]:
    """Run the cases asked for, write a file for each name; return the sentences of what failed."""
    failed: list[str] = []
    for name in options.cases or CASES:
        before = os.getloadavg()
        found: list[dict[str, Any]] = []
        for reliable in qualities(name, options):
            for case in cases(name, options.full, reliable, options.hours):
                with tempfile.TemporaryDirectory(prefix='node_load') as folder:
                    found.append(result_of(case, Path(folder)))
                print('\n'.join(lines(found[-1])), flush=True)
                wrong = found[-1]['faults'] + (found[-1]['over_limits'] if options.strict else [])
                failed += [f'{case.name}: {sentence}' for sentence in wrong]
        write(name, found, before, options)
    return failed


def qualities(name: str, options: argparse.Namespace) -> tuple[bool, ...]:
    """Return whether to send reliably, for each of the runs of a name."""
    wanted = options.qos or ('both' if options.full or name in BOTH else 'best_effort')
    return {'both': (False, True), 'reliable': (True,)}.get(wanted, (False,))


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


def write(
    name: str, found: list[dict[str, Any]], before: tuple[float, ...], options: argparse.Namespace
) -> None:
    """Write what was found, with the machine it was found on."""
    given = [name, *(['--full'] if options.full else [])]
    given += ['--qos', options.qos] if options.qos else []
    given += ['--hours', f'{options.hours:g}'] if name == SOAK else []
    study.keep(
        f'node_load_{name}', folder=options.output, command=study.command(*given),
        passed=not any(r['faults'] for r in found),
        within_limits=not any(r['over_limits'] for r in found),
        machine={
            **study.machine(), 'load_before': before, 'load_after': os.getloadavg(),
            'rclpy': _version('rclpy'),
            'middleware': os.environ.get('RMW_IMPLEMENTATION', 'the default one'),
        },
        runs=found,
    )  # fmt: skip


def _version(name: str) -> str:
    try:
        return version(name)
    except LookupError:
        return 'unknown'


def main() -> int:
    """Run the benchmark."""
    parser = study.options(__doc__)
    parser.add_argument('cases', nargs='*', metavar='CASE', help=', '.join((*CASES, SOAK)))
    parser.add_argument('--full', action='store_true', help='as long as the figures ask for')
    parser.add_argument('--qos', choices=('best_effort', 'reliable', 'both'))
    parser.add_argument('--hours', type=float, default=8.0, help='of the soak (default 8)')
    parser.add_argument('--strict', action='store_true', help='a passed limit fails, too')
    parser.add_argument('--output', type=Path, default=study.RESULTS)
    options = parser.parse_args()
    unknown = [name for name in options.cases if name not in (*CASES, SOAK)]
    if unknown:
        parser.error(f'there is no case {unknown[0]}; there are {", ".join((*CASES, SOAK))}')
    os.environ['ROS_DOMAIN_ID'] = str(os.getpid() % _DOMAINS + 1)
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    rclpy.init(args=[])
    failed = run_all(options)
    rclpy.try_shutdown()
    for sentence in failed:
        print(f'node_load: {sentence}', file=sys.stderr)
    return 1 if failed else 0


if __name__ == '__main__':
    sys.exit(main())
