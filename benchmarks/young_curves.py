# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""How often the residual alarm cries wolf while a unit's curve is young.

Run: ``python -m benchmarks.young_curves --plants 20 --days 3 --first 8000``. Each plant is drawn
at random, without a fault; the monitor starts with nothing and refits as it does by default.
Counted are the occurrences of the residual alarm by the age of the first curve.
"""

from __future__ import annotations

import json
from functools import partial

import numpy as np

from benchmarks import study
from valveflow_ros.monitoring.alarms import AlarmChange, AlarmState
from valveflow_ros.monitoring.events import CurveAdopted
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.offline import feed_rows
from valveflow_ros.parameters import Settings
from valveflow_ros.plant.simulator import simulate
from valveflow_ros.plant.unit import random_unit

_BLOCK = 3600
_DAY_NS = 86_400 * 10**9


def plant(seed: int, days: float) -> dict[str, object]:
    """Watch one plant from its first row."""
    unit = random_unit(np.random.default_rng(seed))
    log = simulate(days, seed, unit)
    monitor = Monitor(Settings({'sample_period': unit.sample_period_s}))
    table, first_ns, curves = log.table, 0, 0
    alarms: list[dict[str, float]] = []
    for start in range(0, len(table), _BLOCK):
        for event in feed_rows(monitor, table.part(start, start + _BLOCK)):
            if isinstance(event, CurveAdopted):
                curves += 1
                first_ns = first_ns or event.characteristic.source.window_end_ns
            elif (
                isinstance(event, AlarmChange)
                and event.name == 'residual'
                and event.state == AlarmState.UNACKNOWLEDGED
            ):
                alarms.append(
                    {
                        'curve': curves,
                        'days_after_the_first_curve': (event.time_ns - first_ns) / _DAY_NS,
                    }
                )
    watched = (int(table.time_ns[-1]) - first_ns) / _DAY_NS if first_ns else 0.0
    return {'seed': seed, 'days_watched': round(watched, 3), 'curves': curves, 'alarms': alarms}


def summary(rows: list[dict[str, object]]) -> dict[str, object]:
    """Count by the age of the first curve."""
    ages = [
        float(alarm['days_after_the_first_curve'])  # type: ignore[index]
        for row in rows
        for alarm in row['alarms']  # type: ignore[attr-defined]
    ]
    watched = [float(str(row['days_watched'])) for row in rows]
    by_age = {}
    for low, high in ((0.0, 0.25), (0.25, 1.0), (1.0, 1e9)):
        by_age[f'{low:g} to {high:g} days' if high < 1e8 else f'more than {low:g} days'] = {
            'alarms': sum(low <= age < high for age in ages),
            'days_watched': round(sum(max(0.0, min(w, high) - low) for w in watched), 2),
        }
    return {'plants': len(rows), 'plants_with_alarms': sum(bool(r['alarms']) for r in rows),
            'by_age_of_the_first_curve': by_age}  # fmt: skip


def main() -> None:
    """Run, print and write."""
    args = study.options(__doc__, plants=20, days=3.0, first=8000).parse_args()
    rows = study.rows_of(partial(plant, days=args.days), study.seeds(args.first, args.plants))
    found = summary(rows)
    study.keep(study.name_of('young_curves', args.first, args.plants), summary=found, plants=rows)
    print(json.dumps(found, indent=1))


if __name__ == '__main__':
    main()
