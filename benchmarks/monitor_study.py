"""Whether a fault stands in the alarms to the end, and how often a healthy unit raises one.

Run: ``python -m benchmarks.monitor_study --seeds 10 --first 401 --effect
gain_step:g=-0.04,t0_days=10``. Each seed is a unit of ``plant/thermal_unit.py``; without
``--effect`` it is healthy. The monitor runs over the whole record without diagnoses, with the
defaults of its parameters, none of which was set on these seeds.
"""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import valveflow_ros as vf
from benchmarks import study

_DAY_NS = 86_400_000_000_000


def row_of(
    seed: int, kind: str, days: float, recording: str, effects: list[str]
) -> dict[str, Any]:
    """Run the monitor over one unit; return what it told."""
    simulation = vf.simulate(
        days, seed, effects, unit=f'{kind}:number={seed}', recording=recording
    )
    log, begin = simulation.log, time.process_time()
    found = vf.monitor(log, diagnose=False)
    content = found.to_json()
    alarms = {
        name: {
            'times': len(own),
            'raised_days': [round((a['raised'] - found.start_ns) / _DAY_NS, 2) for a in own],
            'state': own[-1]['state'] if own else '',
            'stands': bool(own) and own[-1]['cleared'] is None,
        }
        for name in ('residual', 'curve_shift')
        for own in [[a for a in content['alarms'] if a['name'] == name]]
    }
    return {
        'kind': kind, 'seed': seed, 'alarms': alarms, 'curves': len(content['curves']),
        'cpu_s': round(time.process_time() - begin, 1),
    }  # fmt: skip


def summary_of(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return what the units of one kind come to."""
    every = [r['alarms'].values() for r in rows]
    found = [any(a['times'] for a in own) for own in every]
    return {
        'units': len(rows), 'with_alarm': sum(found),
        'standing_at_the_end': sum(any(a['stands'] for a in own) for own in every),
        'most_occurrences': max(a['times'] for own in every for a in own),
    }  # fmt: skip


def main() -> None:
    """Run the study and write it beside the others."""
    parser = study.options(__doc__, seeds=10, first=401, days=20.0)
    parser.add_argument('--recording', default='minute')
    parser.add_argument('--kinds', default='choked,sequence')
    parser.add_argument('--effect', action='append', default=[])
    given = parser.parse_args()
    work = partial(row_of, days=given.days, recording=given.recording, effects=given.effect)
    rows = {
        kind: study.rows_of(partial(work, kind=kind), study.seeds(given.first, given.seeds))
        for kind in given.kinds.split(',')
    }
    what = '_'.join(e.partition(':')[0] for e in given.effect) or 'healthy'
    study.keep(
        study.name_of(f'monitor_{what}_{given.recording}', given.first, given.seeds),
        summary={kind: summary_of(own) for kind, own in rows.items()},
        rows=[row for own in rows.values() for row in own],
    )


if __name__ == '__main__':
    main()
