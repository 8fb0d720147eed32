# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""How rarely the monitor says of a clean plant that its model fits no longer, how soon of others.

    python -m benchmarks.mismatch_study --kind clean --seeds 10 --first 400
    python -m benchmarks.mismatch_study --kind hidden --seeds 2 --first 420

Every plant is drawn (every third is the paper's), runs for ten days with a row every two
seconds, and is watched by the monitor with a refit once a day. Hidden effects are 2 to 4 times the
smallest that ten days show. A plant is told of where a statistic of `core.mismatch` passes the
limit, or the residual alarm is raised. The limit was fixed on the clean seeds 400 to 409.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks import study
from benchmarks.diagnosis_cases import Case, hidden, null
from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.monitoring.events import CurveAdopted
from valveflow_ros.monitoring.mismatch import Mismatch
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.offline import feed_rows
from valveflow_ros.monitoring.prediction import PredictionBlock
from valveflow_ros.parameters import PARAMETERS, Settings
from valveflow_ros.plant.simulator import simulate
from valveflow_ros.records import Signal

STEP_S = 2.0
KINDS = (
    'gain_drift', 'gain_step', 'input_step', 'curve_step', 'temperature', 'diurnal', 'backlash',
    'region_lag', 'intervals',
)  # fmt: skip
LIMITS = (3.5, 4.0, 4.5, 5.0, 5.5, 6.0)


@dataclass(frozen=True)
class Look:
    """What the monitor thought at one time."""

    day: float
    score: float
    name: str
    alarm: bool


def looks(case: Case, days: float) -> Iterator[Look]:
    """Watch a plant; yield what is thought of it after every block of predictions."""
    unit = replace(case.unit, sample_period_s=STEP_S)
    table = simulate(days, case.seed, unit, effects=case.effects).table
    monitor = Monitor(
        Settings({'sample_period': STEP_S, 'refit_period': 86400.0, 'refit_segments': 0})
    )
    watch, model, rows = Mismatch(STEP_S), None, 0
    part_rows = round(3600.0 / STEP_S)
    for start in range(0, len(table), part_rows):
        part = table.part(start, start + part_rows)
        for event in feed_rows(monitor, part):
            if isinstance(event, CurveAdopted):
                model = event.characteristic.model
            elif isinstance(event, PredictionBlock):
                warm = table.column(Signal.MAIN_STEAM_TEMPERATURE)[rows : rows + len(event)]
                rows += len(event)
                _feed(watch, event, warm, model)
        found = watch.judge()
        yield Look(rows * STEP_S / 86400.0, found.score, found.name, monitor.alarm.active)


def _feed(
    watch: Mismatch, event: PredictionBlock, warm: np.ndarray, model: RegionalModel | None
) -> None:
    if model is not None:
        watch.feed(event, np.ascontiguousarray(warm), model)


def onset_of(case: Case) -> float:
    """Return the day from which on the effect is there."""
    return max((float(e.parameters.get('t0_days', 0.0)) for e in case.effects), default=0.0)


def row_of(case: Case, days: float) -> dict[str, Any]:
    """Watch one plant and return what is counted."""
    seen, onset = list(looks(case, days)), onset_of(case)
    late = [look for look in seen if look.day >= onset]
    scores = [look.score for look in seen]
    largest = max(seen, key=lambda look: abs(look.score))
    first: dict[str, float | None] = {}
    for limit in LIMITS:
        times = [look.day - onset for look in late if abs(look.score) > limit]
        first[f'{limit:g}'] = round(times[0], 2) if times else None
    alarm = [look.day - onset for look in late if look.alarm]
    return {
        'label': case.label, 'seed': case.seed, 'effects': [str(e) for e in case.effects],
        'onset_day': round(onset, 2), 'largest': round(largest.score, 2), 'by': largest.name,
        'episodes': {f'{limit:g}': study.episodes(scores, limit) for limit in LIMITS},
        'days_until_told': first, 'days_until_alarm': round(alarm[0], 2) if alarm else None,
    }  # fmt: skip


def cases(kind: str, first: int, seeds: int, days: float, names: list[str]) -> Iterator[Case]:
    """Yield the plants asked for."""
    for seed in range(first, first + seeds):
        if kind == 'clean':
            # The seed that is drawn from is the same; nothing tempting is added.
            yield replace(null(6 * seed), seed=seed)
        else:
            yield from (hidden((name,), seed, days, (2.0, 4.0)) for name in names)


def summary(rows: list[dict[str, Any]], days: float, limit: str) -> dict[str, Any]:
    """Count what the limit of the parameter table gives."""
    told: dict[str, Any] = {}
    for label in dict.fromkeys(row['label'] for row in rows):
        mine = [row for row in rows if row['label'] == label]
        delays = [row['days_until_told'][limit] for row in mine]
        either = [
            min((d for d in (a, row['days_until_alarm']) if d is not None), default=None)
            for a, row in zip(delays, mine, strict=True)
        ]
        told[label] = {
            'plants': len(mine), 'told': sum(d is not None for d in delays),
            'told_or_alarm': sum(d is not None for d in either), 'days_until': either,
        }  # fmt: skip
    count = {f'{v:g}': sum(row['episodes'][f'{v:g}'] for row in rows) for v in LIMITS}
    return {'limit': limit, 'days_watched': days * len(rows), 'episodes': count, 'told': told}


def main() -> None:
    """Watch, print, and write the result beside the others."""
    parser = study.options(__doc__, seeds=10, first=400, days=10.0)
    parser.add_argument('--kind', choices=('clean', 'hidden'), default='clean')
    parser.add_argument('--effects', nargs='*', default=list(KINDS), metavar='NAME')
    args = parser.parse_args()
    plants = cases(args.kind, args.first, args.seeds, args.days, args.effects)
    rows = study.rows_of(partial(row_of, days=args.days), plants)
    table = PARAMETERS.get('mismatch_limit')
    limit = f'{float(table.default):g}' if table else '5'
    found = summary(rows, args.days, limit)
    print(json.dumps(found, indent=1))
    name = study.name_of(f'mismatch_{args.kind}', args.first, args.seeds)
    study.keep(name, summary=found, plants=rows)


if __name__ == '__main__':
    main()
