# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Whether a fault stands in the alarms to the end, and how often a healthy unit raises one.

Run: ``python -m benchmarks.monitor_study --seeds 10 --first 431`` for healthy units, and with
``--effect gain_step --times 3`` for units on which that effect begins after half of the days,
three times as large as by default; ``--effect all`` takes each effect of the catalogue, one at a
time. Units are those of ``plant/thermal_unit.py``, and ``paper`` the one of the paper, all as
means over a minute. ``--wear 1 --days 365`` lets each unit lose so many MW a month from the first
day on, of what it gives in the mean. With ``--vacuum 10`` the first ten days are diagnosed with
the condenser pressure as a covariate, and the monitor gets the model of that diagnosis. It runs
over the record without diagnoses, with the defaults of its parameters; what was set there by
looking at such units was set on seeds 421 to 430.
"""

from __future__ import annotations

import argparse
import itertools
import time
from typing import Any

import numpy as np
import pandas as pd

import valveflow_ros as vf
from benchmarks import study
from valveflow_ros.plant.effect import Effect
from valveflow_ros.plant.effects import catalogue
from valveflow_ros.plant.thermal_effects import thermal_catalogue

_DAY_NS = 86_400_000_000_000
# What spoils values is no change of the plant; a limit has no size that could be multiplied, and
# the back pressure of a choked valve cannot be three times as high.
_LEFT_OUT = ('choked', 'flatline', 'quantisation', 'rate_limit', 'saturation', 'spikes')


def joined(healthy: pd.DataFrame, faulty: pd.DataFrame) -> pd.DataFrame:
    """Return a record that is healthy for its first half: every effect gets an onset by that."""
    middle = healthy['time'].iloc[0] + (healthy['time'].iloc[-1] - healthy['time'].iloc[0]) / 2
    parts = [healthy[healthy['time'] < middle], faulty[faulty['time'] >= middle]]
    return pd.concat(parts, ignore_index=True)


def effect_at(effect: Effect, times: float) -> str:
    """Return an effect so many times its default size, from the first row on where it can be."""
    size = next(p for p in effect.parameters if not isinstance(p.default, str))
    value = min(max(times * size.default, size.low), size.high)
    onset = ',t0_days=0' if any(p.name == 't0_days' for p in effect.parameters) else ''
    return f'{effect.name}:{size.name}={value:g}{onset}'


def units(given: argparse.Namespace) -> list[tuple[str, str, int]]:
    """Return kind, effect and seed of every unit."""
    found: list[tuple[str, str, int]] = []
    for kind in given.kinds.split(','):
        own = catalogue() if kind == study.PAPER else thermal_catalogue()
        chosen = [
            effect_at(e, given.times) for e in own.values()
            if e.name not in _LEFT_OUT and (e.name in given.effect or 'all' in given.effect)
        ]  # fmt: skip
        found += itertools.product([kind], chosen if given.effect else [''], study.seeds(given))
    return found


def row_of(unit: tuple[str, str, int], given: argparse.Namespace) -> dict[str, Any]:
    """Run the monitor over one unit; return what it told."""
    kind, effect, seed = unit
    record = study.minute_means(kind, seed, seed, given.days)
    if given.wear:
        month = np.asarray(record['time'] - record['time'].iloc[0]) / np.timedelta64(30, 'D')
        power = record['generated_power_mw'].to_numpy()
        record['generated_power_mw'] = power * (1.0 - given.wear / power.mean() * month)
    if effect:
        record = joined(record, study.minute_means(kind, seed, seed, given.days, [effect]))
    begin = time.process_time()
    model = None
    if given.vacuum:
        end = record['time'].iloc[0] + pd.Timedelta(days=given.vacuum)
        diagnosed = vf.diagnose(
            record[record['time'] < end], covariates={'vacuum': 'condenser_pressure_kpa'}
        )
        model = diagnosed.extended_model if diagnosed.diagnosis.causes else None
    found = vf.monitor(record, diagnose=False, model=model)
    content = found.to_json()

    def day(time_ns: int) -> float:
        return round((time_ns - found.start_ns) / _DAY_NS, 2)

    def told(name: str) -> dict[str, Any]:
        own = [a for a in content['alarms'] if a['name'] == name]
        state = own[-1]['state'] if own else ''
        # One that is only not to be judged for the moment stands too.
        stands = bool(own) and (own[-1]['cleared'] is None or state == 'suppressed')
        days = [day(a['raised']) for a in own]
        return {'raised_days': days, 'state': state, 'stands': stands}

    reference = content['reference']
    return {
        'kind': kind, 'seed': seed, 'effect': effect,
        'alarms': {name: told(name) for name in ('residual', 'curve_shift')},
        'reference_day': None if reference is None else day(reference['set']),
        'held': [] if model is None else list(model.model.names),
        'wear': content['wear'] and round(content['wear']['mw_per_month'], 3),
        'curves': len(content['curves']), 'cpu_s': round(time.process_time() - begin, 1),
    }  # fmt: skip


def summary(rows: list[dict[str, Any]], onset_days: float) -> dict[str, Any]:
    """Return what the units of one kind come to; only alarms since the onset count."""
    since = [
        [sum(d >= onset_days for d in a['raised_days']) for a in r['alarms'].values()]
        for r in rows
    ]
    stands = [any(a['stands'] for a in r['alarms'].values()) for r in rows]
    return {
        'units': len(rows), 'with_alarm': sum(any(own) for own in since),
        'alarms': sum(map(sum, since)),
        'standing_at_the_end': sum(any(o) and s for o, s in zip(since, stands, strict=True)),
        'most_occurrences': max(map(max, since)),
    }  # fmt: skip


def main() -> None:
    parser = study.options(
        __doc__, seeds=10, first=431, days=20.0, times=3.0, wear=0.0, vacuum=0.0
    )
    parser.add_argument('--kinds', default='choked,sequence,paper')
    parser.add_argument('--effect', action='append', default=[])
    given = parser.parse_args()
    what = f'wear_{given.wear:g}' if given.wear else 'healthy'
    what = f'{"_".join(given.effect)}_times_{given.times:g}' if given.effect else what
    name = study.name_of(f'monitor_{what}{"_vacuum" if given.vacuum else ""}', given)
    rows = study.rows_of(name, row_of, units(given), given)
    onset = 0.5 * given.days if given.effect else 0.0
    groups = study.by('kind', rows)
    study.keep(name, summary={k: summary(own, onset) for k, own in groups.items()}, rows=rows)


if __name__ == '__main__':
    main()
