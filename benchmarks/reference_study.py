# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""How well a diagnosis tells what changed since the model that it is given was found.

Run: ``python -m benchmarks.reference_study --seeds 8 --first 20001``. A unit is identified in one
record and diagnosed in another, of other days and another weather, with that model. Before, the
columns of the second record are changed as a plant would change them: the scale of the power
meter, its zero, the scale of the position sensor, or the power above some opening. ``none`` is
the same unit unchanged.
"""

from __future__ import annotations

import itertools
import time
from typing import Any

import numpy as np
import pandas as pd

import valveflow_ros as vf
from benchmarks import study

KINDS = (study.PAPER, 'choked', 'sequence', 'integrated_input')
_NAMES = {
    'none': '', 'gain': 'gain_change', 'offset': 'offset_change', 'input': 'input_change',
    'curve': 'curve_change',
}  # fmt: skip
_SIZES = (0.01, 0.02, 0.04)
_OTHER_WEATHER = 500_000


def changed(record: pd.DataFrame, what: str, size: float) -> tuple[pd.DataFrame, float]:
    """Return a record of a unit that changed by a share of its power, and the true number."""
    record = record.copy()
    power, opening = record['generated_power_mw'], record['valve_opening_percent']
    if what in ('offset', 'curve'):
        size *= float(power.quantile(0.99))
    above = 1.0 / (1.0 + np.exp(-(opening - opening.median()) / 2.0))
    if what == 'input':
        record['valve_opening_percent'] = opening / (1.0 + size)
    elif what != 'none':
        added = {'gain': size * power, 'offset': size, 'curve': size * above}
        record['generated_power_mw'] = power + added[what]
    return record, size


def rows_of(unit: tuple[str, int], days: float) -> list[dict[str, Any]]:
    """Diagnose one unit with every change, a model of earlier days given."""
    kind, seed = unit
    curve = vf.identify(study.minute_means(kind, seed, seed, days)).characteristic
    later = study.minute_means(kind, seed, seed + _OTHER_WEATHER, days)
    drawn = np.random.default_rng(seed)
    rows = []
    for what, name in _NAMES.items():
        size = float(drawn.choice(_SIZES) * drawn.choice((-1.0, 1.0)))
        record, size = changed(later, what, size)
        begin = time.process_time()
        found = vf.diagnose(record, model=curve).diagnosis
        since = [c for c in found.causes if c.name in _NAMES.values()]
        told = [c.name for c in since]
        near = [n for c in since for n in c.not_told_apart]
        sizes = {k: e for c in since for k, e in c.parameters.items()}
        one_number = told == [name] != ['curve_change']
        rows.append({
            'kind': kind, 'seed': seed, 'change': what, 'size': round(size, 4),
            'verdict': found.verdict, 'named': [c.name for c in found.causes], 'near': near,
            'sizes': {k: [e.value, e.low, e.high] for k, e in sizes.items()},
            'rmse_mw': [round(r, 3) for r in (found.rmse_simulation, found.rmse_extended)],
            'cpu_s': round(time.process_time() - begin, 1),
            'right': told == ([name] if name else []),
            'wider': told == ['curve_change'] and (name in near or what == 'curve'),
            'holds': [e.low <= size <= e.high for e in sizes.values()] if one_number else [],
            'others': [c.name for c in found.causes if c not in since],
        })  # fmt: skip
    return rows


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return what the units of one kind come to, by change."""
    return {
        what: {
            'records': len(mine),
            'right': sum(r['right'] for r in mine),
            'as_curve_change': sum(r['wider'] and not r['right'] for r in mine),
            'silent': sum(r['verdict'] == 'nothing' for r in mine),
            'unexplained': sum(r['verdict'] == 'unexplained' for r in mine),
            'intervals_hold': f'{sum(sum(r["holds"]) for r in mine)} of '
            f'{sum(len(r["holds"]) for r in mine)}',
            'other_names': sorted(n for r in mine for n in r['others']),
        }
        for what, mine in study.by('change', rows).items()
    }


def main() -> None:
    parser = study.options(__doc__, seeds=8, first=20001, days=6.0)
    parser.add_argument('--kinds', default=','.join(KINDS))
    given = parser.parse_args()
    name = study.name_of('reference', given)
    units = itertools.product(given.kinds.split(','), study.seeds(given))
    rows = study.rows_of(name, rows_of, units, given.days)
    groups = study.by('kind', rows)
    study.keep(name, summary={kind: summary(own) for kind, own in groups.items()}, rows=rows)


if __name__ == '__main__':
    main()
